"""The icon of an FMU shows its robot."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from twodof import FmuOptions, build_fmu

Points = NDArray[np.float64]
COLOURS = ((84, 101, 124), (245, 140, 36), (255, 255, 255))
"""Colours of links, the last link and joints."""
SLIDER = """<robot name="slider"><link name="base"/>
<link name="cart"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="rail" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def points_of(fmu: Path) -> list[Points]:
    """Points of each colour, N × 2, x to the right and y up, pixels."""
    with zipfile.ZipFile(fmu) as archive:
        picture: Any = Image.open(io.BytesIO(archive.read("model.png")))
    assert picture.format == "PNG" and picture.size == (300, 200)
    pixels = np.array(picture)
    places = [np.argwhere((pixels == (*colour, 255)).all(axis=2)) for colour in COLOURS]
    return [found[:, ::-1].astype(np.float64) * np.array([1.0, -1.0]) for found in places]


def direction(points: Points) -> float:
    """Angle of the longest axis of points, rad."""
    axis = np.linalg.svd(points - points.mean(axis=0))[2][0]
    return float(np.arctan2(*(axis * np.sign(axis[0]))[::-1]))


@pytest.mark.parametrize("q", [(0.5, 0.35), (0.2, 0.9), (1.2, -1.9)])
def test_the_icon_is_of_the_robot_at_its_start(tmp_path, q):
    """It has two links of one length at q1 and q1 + q2, and a disc at each joint."""
    fmu = build_fmu(tmp_path / "Arm.fmu", FmuOptions(q_start=q))
    link, last, discs = points_of(fmu)
    assert [direction(link), direction(last)] == pytest.approx([q[0], sum(q)], abs=0.02)
    along = discs @ (np.cos(q[0]), np.sin(q[0]))
    base, elbow = (discs[(along < along.mean()) == first].mean(axis=0) for first in (True, False))
    assert np.arctan2(*(elbow - base)[::-1]) == pytest.approx(q[0], abs=0.02)
    tip = base + np.linalg.norm(elbow - base) * np.array([np.cos(q[0]) + np.cos(sum(q)), np.sin(q[0]) + np.sin(sum(q))])
    assert np.linalg.norm(last - tip, axis=1).min() < 3.0 < np.linalg.norm(link - tip, axis=1).min()


def test_a_robot_without_extent_has_an_icon(tmp_path):
    (tmp_path / "slider.urdf").write_text(SLIDER)
    link, last, discs = points_of(build_fmu(tmp_path / "Slider.fmu", FmuOptions(urdf=tmp_path / "slider.urdf")))
    assert not link.size and not last.size and discs.mean(axis=0) == pytest.approx([149.5, -99.5])
