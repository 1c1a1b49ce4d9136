"""Plots by what their artists hold: against the FMU's own samples, Pinocchio and closed forms."""

from __future__ import annotations

import base64
import copy
import itertools
import json
import math
import os
import re
import resource
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NamedTuple

import browser
import matplotlib
import numpy as np
import oracles
import pinocchio as pin
import plotly.graph_objects
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from PIL import Image
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore
from sinks import Collector

import twodof
from twodof.cli.main import main
from twodof.errors import PlotError, TwoDofError
from twodof.pages.replay import replay
from twodof.plots.figure import file_kind, save
from twodof.plots.interactive import in_workspace, over_time
from twodof.plots.panels import with_joints
from twodof.plots.runs import drawing, plot
from twodof.plots.track import read_tracks
from twodof.plots.words import labels, outcome
from twodof.simulation.sample import Sample

START = 1_700_000_000  # s since the epoch
STORE = get_typestore(Stores.ROS2_HUMBLE)
LINK = 0.15  # m, of the default arm
UR5_JOINTS = [
    "elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint", "wrist_1_joint", "wrist_2_joint",
    "wrist_3_joint",
]  # fmt: skip


# --- bags ---


class Recording(NamedTuple):
    bag: Path
    samples: list[Sample]

    def __getattr__(self, name: str) -> np.ndarray:  # t, q, v, x: N or N × n
        return np.array([getattr(sample, name) for sample in self.samples])


def record(bag: Path, fmu: Path, **options: Any) -> Recording:
    run = twodof.experiment(fmu, stamp_start=START, **options)
    samples = Collector()
    twodof.simulate(run, samples, twodof.Bag(bag))
    return Recording(bag, samples)


@pytest.fixture(scope="session")
def gains(fmu_path: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[int, Recording]:
    """The default arm's run with three gains; that with 50 is the default run."""
    folder = tmp_path_factory.mktemp("gains")
    return {
        gain: record(folder / f"Kp{gain}", fmu_path, settings={"Kp": gain})
        for gain in (20, 50, 400)
    }


@pytest.fixture(scope="session")
def default(gains: dict[int, Recording]) -> Recording:
    return gains[50]


def elsewhere(
    bag: Path, names: Sequence[str], t: np.ndarray, q: np.ndarray, v: np.ndarray | None
) -> Path:
    """A bag as another recorder writes it, without provenance."""
    types = STORE.types
    with Writer(bag, version=9) as writer:
        topic = writer.add_connection(
            "/joint_states", "sensor_msgs/msg/JointState", typestore=STORE
        )
        for k, time in enumerate(t):
            stamp = START * 10**9 + round(time * 1e9)
            header = types["std_msgs/msg/Header"](
                stamp=types["builtin_interfaces/msg/Time"](
                    sec=stamp // 10**9, nanosec=stamp % 10**9
                ),
                frame_id="",
            )
            message = types["sensor_msgs/msg/JointState"](
                header=header,
                name=list(names),
                position=np.asarray(q[k], dtype=np.float64),
                velocity=np.asarray([] if v is None else v[k], dtype=np.float64),
                effort=np.zeros(0),
            )
            writer.write(topic, stamp, STORE.serialize_cdr(message, topic.msgtype))
    return bag


def waves(n: int, count: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times at uneven steps, and n joints that swing about different middles."""
    t = np.linspace(0.0, 1.0, count) ** 1.5 * 6.0
    phase = np.arange(n)
    q = -0.4 - 0.1 * phase + 0.3 * np.sin(t[:, None] * (1 + 0.2 * phase))
    return t, q, 0.3 * (1 + 0.2 * phase) * np.cos(t[:, None] * (1 + 0.2 * phase))


def bare(urdf: str) -> str:
    """A URDF without its meshes, which the FMU of a test need not carry."""
    tree = ET.fromstring(urdf)
    for link in tree.findall("link"):
        for part in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(part)
    return ET.tostring(tree, encoding="unicode")


def chain_urdf(joints: str, length: float = 0.4, low: float = -2.0, high: float = 2.0) -> str:
    """A chain; ``joints`` has a letter for each: x, y, z turn about, X, Y, Z slide along."""
    text = '<robot name="chain"><link name="base"/>'
    for i, letter in enumerate(joints):
        kind = "prismatic" if letter.isupper() else "revolute"
        axis = " ".join("1" if letter.lower() == axis else "0" for axis in "xyz")
        parent, offset = ("base", 0.0) if i == 0 else (f"l{i}", length)
        text += (
            f'<link name="l{i + 1}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="1"/>'
            '<inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-2" iyz="0" izz="1e-2"/></inertial></link>'
            f'<joint name="j{i + 1}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="l{i + 1}"/><origin xyz="{offset} 0 0"/><axis xyz="{axis}"/>'
            f'<limit lower="{low}" upper="{high}" effort="9" velocity="9"/></joint>'
        )
    return (
        f'{text}<link name="tip"/><joint name="end" type="fixed"><parent link="l{len(joints)}"/>'
        f'<child link="tip"/><origin xyz="{length} 0 0"/></joint></robot>'
    )


def build(folder: Path, urdf: str, **options: Any) -> Path:
    (folder / "robot.urdf").write_text(urdf)
    options = {"urdf": folder / "robot.urdf", "frame": "tip", **options}
    return twodof.build_fmu(folder / "Robot.fmu", twodof.FmuOptions(**options))


def kinematics(urdf: str, frame: str, names: Sequence[str], q: np.ndarray) -> np.ndarray:
    """Path of a frame by Pinocchio straight from the URDF, N × 3."""
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    path = []
    for row in q:
        configuration = pin.neutral(model)
        for name, value in zip(names, row, strict=True):
            if model.existJointName(name):
                configuration[model.joints[model.getJointId(name)].idx_q] = value
        pin.framesForwardKinematics(model, data, configuration)
        path.append(data.oMf[model.getFrameId(frame)].translation.copy())
    return np.array(path)


# --- what a figure holds ---


def lines(axes: Axes, label: str) -> list[Line2D]:
    return [line for line in axes.get_lines() if line.get_label() == label]


def points(line: Line2D) -> np.ndarray:
    return np.column_stack([line.get_xdata(), line.get_ydata()])


def only(axes: Axes, label: str) -> np.ndarray:
    (line,) = lines(axes, label)
    return points(line)


class Panels(NamedTuple):
    """The panels of a figure, joints in the order of their rows."""

    q: list[Axes]
    v: list[Axes]
    error: Axes | None
    views: list[Axes]


def panels(figure: Figure) -> Panels:
    error = [axes for axes in figure.axes if axes.get_title("left").startswith("Distance")]
    views = [axes for axes in figure.axes if re.fullmatch("[xyz] in m", axes.get_xlabel())]
    joints = [axes for axes in figure.axes if axes not in (*error, *views)]
    if any(axes.get_title("left").startswith("Velocity") for axes in joints):
        return Panels(joints[0::2], joints[1::2], error[0] if error else None, views)
    return Panels(joints, [], error[0] if error else None, views)


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.findobj(Text) if text.get_text()]


def key(figure: Figure) -> list[str]:
    """The labels that tell tracks apart."""
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def notes(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.texts]


# --- the default arm ---


@pytest.fixture(scope="session")
def figure(default: Recording) -> Figure:
    return plot(default.bag)


def test_joints_are_drawn_as_the_fmu_gave_them(default: Recording, figure: Figure) -> None:
    found = panels(figure)
    assert len(found.q) == len(found.v) == 2
    for i in range(2):
        for axes, values in ((found.q[i], default.q), (found.v[i], default.v)):
            line = only(axes, default.bag.name)
            np.testing.assert_allclose(line[:, 0], default.t, rtol=0.0, atol=1e-9)
            np.testing.assert_array_equal(line[:, 1], values[:, i])
            low, high = axes.get_ylim()
            assert low < values[:, i].min() <= values[:, i].max() < high
            assert axes.get_xlim() == (0.0, 5.0)


def test_units_and_settings_are_told(figure: Figure) -> None:
    found = panels(figure)
    assert found.q[0].get_title("left") == "Position in rad"
    assert found.v[0].get_title("left") == "Velocity in rad/s"
    assert found.q[1].get_xlabel() == found.v[1].get_xlabel() == "time in s"
    assert found.error is not None
    assert found.error.get_title("left") == "Distance from the target in m"
    (view,) = found.views
    assert (view.get_xlabel(), view.get_ylabel()) == ("x in m", "y in m")
    assert view.get_title("left") == "Path of EndEffector in world"
    told = texts(figure)
    assert "2dof" in told
    assert "joint1" in told
    (settings,) = [text for text in told if "Kp" in text]
    assert settings == (
        "x_des = (0.2, 0.05) m, Kp = 50 s⁻², Kd = 40 s⁻¹, step 10 ms, TwoDof.fmu, bag Kp50"
    )
    assert key(figure) == []


def test_path_and_arm_are_those_of_the_closed_form(default: Recording, figure: Figure) -> None:
    (view,) = panels(figure).views
    q = default.q
    path = only(view, "path")
    np.testing.assert_allclose(path, oracles.position(q), rtol=0.0, atol=1e-14)
    for label, angle in (("arm at the start", q[0]), ("arm at the end", q[-1])):
        elbow = LINK * np.array([math.cos(angle[0]), math.sin(angle[0])])
        joints = [(0.0, 0.0), (0.0, 0.0), elbow, oracles.position(angle)]  # root and first joint
        np.testing.assert_allclose(only(view, label), joints, rtol=0.0, atol=1e-14)
    np.testing.assert_array_equal(only(view, "target"), [(0.2, 0.05)])
    circle = only(view, "reach 0.3 m")
    np.testing.assert_allclose(np.hypot(*circle.T), 2 * LINK, rtol=1e-12)
    angles = np.sort(np.unwrap(np.arctan2(circle[:, 1], circle[:, 0])))
    assert angles[-1] - angles[0] == pytest.approx(2 * math.pi)


def test_a_metre_is_as_long_up_as_across(default: Recording) -> None:
    figure = plot(default.bag)
    (view,) = panels(figure).views
    limits = view.get_xlim(), view.get_ylim()
    FigureCanvasAgg(figure).draw()
    assert (view.get_xlim(), view.get_ylim()) == limits
    origin, x, y = view.transData.transform([(0.0, 0.0), (0.1, 0.0), (0.0, 0.1)])
    assert x[0] - origin[0] == pytest.approx(y[1] - origin[1], rel=1e-9)
    (left, right), (low, high) = view.get_xlim(), view.get_ylim()
    for label in ("path", "arm at the start", "arm at the end", "target"):
        xs, ys = only(view, label).T
        assert left < xs.min() <= xs.max() < right
        assert low < ys.min() <= ys.max() < high


def test_error_is_the_distance_that_the_fmu_tells_and_the_closed_form(
    default: Recording, figure: Figure
) -> None:
    error = panels(figure).error
    assert error is not None
    assert error.get_yscale() == "log"
    target = np.array([0.2, 0.05])
    run = only(error, default.bag.name)
    np.testing.assert_allclose(
        run[:, 1], np.linalg.norm(default.x - target, axis=1), rtol=1e-9, atol=1e-15
    )
    closed = only(error, "closed form")
    expected = oracles.task_error(default.x[0] - target, 50.0, 40.0, default.t)
    np.testing.assert_allclose(closed[:, 1], np.linalg.norm(expected, axis=1), rtol=1e-12)
    low, high = error.get_ylim()
    assert low <= run[:, 1].min() <= run[:, 1].max() <= high
    assert [text.get_text() for text in error.get_legend().get_texts()] == ["closed form"]


def test_what_came_out_is_told(default: Recording, figure: Figure) -> None:
    left = np.linalg.norm(default.x[-1] - (0.2, 0.05))
    (told,) = [text for text in texts(figure) if "at the end;" in text]
    found = re.fullmatch(
        r"(\S+) m from its target at the end; at most (\S+) m off the closed form", told
    )
    assert found is not None
    assert float(found[1]) == pytest.approx(left, rel=2e-3)
    assert float(found[2]) < 1e-12


# --- limits ---


def test_limits_are_lines_that_are_in_view_where_they_are_near(
    fmu_path: Path, tmp_path: Path
) -> None:
    """The second joint stops at 1.2 rad, far from its lower limit."""
    recording = record(
        tmp_path / "bag", fmu_path, settings={"q_max": (0.9, 1.2), "x_des": (-0.1, 0.2)}
    )
    assert recording.q[-1, 1] == 1.2
    found = panels(plot(recording.bag))
    second = found.q[1]
    assert sorted(line.get_ydata()[0] for line in lines(second, "limit")) == [-math.pi, 1.2]
    low, high = second.get_ylim()
    assert low > -1.0
    assert high > 1.2
    assert notes(second) == ["limits −3.14, 1.2"]
    assert notes(found.q[0]) == ["limits −3.14, 0.9"]
    assert recording.q[:, 0].max() == 0.5
    assert found.q[0].get_ylim()[1] > 0.9  # near enough to be in view
    assert not any(lines(axes, "limit") for axes in found.v)


def test_equal_limits_are_told_once(figure: Figure) -> None:
    first = panels(figure).q[0]
    assert sorted(line.get_ydata()[0] for line in lines(first, "limit")) == [-math.pi, math.pi]
    assert notes(first) == ["limits ±3.14"]
    low, high = first.get_ylim()
    assert -math.pi < low < high < math.pi  # both far away


# --- inputs over time ---


@pytest.fixture(scope="session")
def changing(fmu_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Changes before and at the start, between communication points, at one, and too late."""
    folder = tmp_path_factory.mktemp("changing")
    (folder / "in.csv").write_text(
        "time,x_des[1],x_des[2],Kp[1],xdd_des[2]\n-1,0,0.1,50,0\n0,0.2,0.05,50,0\n0.503,0.1,0.2,50,0\n"
        "0.75,0.1,0.2,90,0.5\n1.2,0.05,0.2,90,0\n2,0.3,0.3,90,0\n"
        "9,0.3,0.3,90,0\n"
    )
    return record(folder / "bag", fmu_path, stop_time=2.0, input_file=folder / "in.csv")


def test_changes_are_where_the_master_makes_them(changing: Recording) -> None:
    """Distances by the FMU's own x and the inputs of its samples; the closed form by its x."""
    found = panels(plot(changing.bag))
    assert found.error is not None
    targets = np.array([[s.inputs[f"x_des[{k}]"] for k in (1, 2)] for s in changing.samples])
    assert len(np.unique(targets, axis=0)) == 3
    expected = np.linalg.norm(changing.x - targets, axis=1)
    run, closed = only(found.error, "bag"), only(found.error, "closed form")
    np.testing.assert_allclose(run[:, 1], expected, rtol=1e-9)
    np.testing.assert_allclose(closed[:, 1], expected, rtol=0.0, atol=1e-10)
    marked = only(found.views[0], "target")
    np.testing.assert_array_equal(marked, [(0.2, 0.05), (0.1, 0.2), (0.05, 0.2)])


def test_what_does_not_change_remains(fmu_path: Path, tmp_path: Path) -> None:
    """A change names some inputs; the others are as they were."""
    run = twodof.experiment(fmu_path, stop_time=0.4)
    changes = [(0.1, {"x_des[1]": 0.15}), (0.2, {"Kp[2]": 90.0}), (0.3, {"x_des[2]": 0.1})]
    run, samples = replace(run, changes=changes), Collector()
    twodof.simulate(run, samples, twodof.Bag(tmp_path / "bag"))
    error = panels(plot(tmp_path / "bag")).error
    assert error is not None
    targets = np.array([[s.inputs[f"x_des[{k}]"] for k in (1, 2)] for s in samples])
    distance = np.linalg.norm(Recording(tmp_path, samples).x - targets, axis=1)
    np.testing.assert_allclose(only(error, "bag")[:, 1], distance, rtol=1e-9)
    np.testing.assert_allclose(only(error, "closed form")[:, 1], distance, rtol=0.0, atol=1e-10)


def test_settings_that_change_are_told_so(changing: Recording) -> None:
    (told,) = [text for text in texts(plot(changing.bag)) if "step" in text]
    assert told == (
        "x_des varied, xdd_des varied, Kp varied, Kd = 40 s⁻¹, step 10 ms, TwoDof.fmu, bag bag"
    )


def test_a_target_on_a_path_is_drawn_as_a_path(fmu_path: Path, tmp_path: Path) -> None:
    t = np.arange(100) * 0.01
    circle = np.column_stack([0.15 + 0.05 * np.cos(t), 0.1 + 0.05 * np.sin(t)])
    rows = "".join(f"{a},{x!r},{y!r}\n" for a, (x, y) in zip(t.tolist(), circle.tolist()))
    (tmp_path / "in.csv").write_text("time,x_des[1],x_des[2]\n" + rows)
    recording = record(tmp_path / "bag", fmu_path, stop_time=1.0, input_file=tmp_path / "in.csv")
    (view,) = panels(plot(recording.bag)).views
    (line,) = lines(view, "target")
    assert line.get_linestyle() == "-"
    np.testing.assert_array_equal(points(line), circle)


# --- where the closed form does not hold ---

DAMPED = chain_urdf("zz").replace("<limit", '<dynamics damping="0.3"/><limit')
DISTURBED: dict[str, tuple[str, dict[str, Any], str]] = {
    "damping": (DAMPED, {}, "closed form without damping"),
    "external torque": (
        chain_urdf("zz"), {"tau_ext": (0.0, 1.0)}, "closed form without external torque",
    ),
    "effort limits": (
        chain_urdf("zz"), {"limit_effort": True}, "closed form without effort limits",
    ),
    "singularities": (chain_urdf("zz"), {"x_des": (1.0, 0.2)}, "closed form without singularities"),
    "joint limits": (chain_urdf("zz"), {"q_max": (2.0, 0.6)}, "closed form without joint limits"),
    "two of them": (
        DAMPED, {"limit_effort": True}, "closed form without effort limits,\ndamping",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("urdf", "settings", "label"), DISTURBED.values(), ids=list(DISTURBED))
def test_the_closed_form_says_what_it_leaves_out(
    urdf: str, settings: dict[str, Any], label: str, tmp_path: Path
) -> None:
    fmu = build(tmp_path, urdf, axes="xy", q_start=(0.3, 0.5))
    settings = {"x_des": (0.3, 0.6), **settings}
    recording = record(tmp_path / "bag", fmu, stop_time=0.5, settings=settings)
    error = panels(plot(recording.bag)).error
    assert error is not None
    closed = only(error, label)
    away = recording.x[0] - settings["x_des"]
    expected = oracles.task_error(away, 50.0, 40.0, recording.t)
    np.testing.assert_allclose(closed[:, 1], np.linalg.norm(expected, axis=1), rtol=1e-10)
    assert [text.get_text() for text in error.get_legend().get_texts()] == [label]


@pytest.mark.parametrize(("joints", "control"), [("z", "task"), ("zz", "pose")])
def test_a_task_that_the_joints_cannot_follow_has_no_closed_form(
    joints: str, control: str, tmp_path: Path
) -> None:
    """One joint for two axes; two joints for these and an orientation."""
    start = (0.3, 0.5)[: len(joints)]
    fmu = build(
        tmp_path, chain_urdf(joints), axes="xy", q_start=start, control=control, native=True
    )
    recording = record(tmp_path / "bag", fmu, stop_time=0.5, settings={"x_des": (0.3, 0.3)})
    (track,) = read_tracks([recording.bag])
    error = panels(plot(recording.bag)).error
    assert error is not None and not lines(error, "closed form without singularities")
    assert error.get_legend() is None and notes(error) == [""]
    away = np.linalg.norm(recording.x - (0.3, 0.3), axis=1)
    np.testing.assert_allclose(only(error, "bag")[:, 1], away, rtol=1e-12)
    assert re.fullmatch(r"\S+ m from its target at the end", outcome(track))


def test_targets_of_joints_are_dashed_lines(tmp_path: Path) -> None:
    """Of each bag its own, in view, told, and legible beside limits and efforts; on a page too."""
    fmu = build(tmp_path, chain_urdf("zz", low=-1.5), control="joint", native=True)
    (tmp_path / "in.csv").write_text("time,q_des[1],q_des[2]\n0,0.8,1\n0.2,1.2,-0.1\n")
    bags = [tmp_path / "one", tmp_path / "two"]
    first, second = Collector(), Collector()
    run = twodof.experiment(fmu, stop_time=0.4, input_file=tmp_path / "in.csv")
    twodof.simulate(run, first, twodof.Bag(bags[0], effort=True))
    still = {"q_des": (0.6, 0.0)}
    twodof.simulate(fmu, second, twodof.Bag(bags[1]), stop_time=0.4, settings=still)
    alone, both = plot(bags[0]), plot(*bags)
    for figure in (alone, both):
        assert_legible(figure)
        position = [axes for axes in figure.axes if lines(axes, "target")]
        for i, axes in enumerate(position):
            drawn = [points(line)[:, 1] for line in lines(axes, "target")]
            expected = [[s.inputs[f"q_des[{i + 1}]"] for s in each] for each in (first, second)]
            np.testing.assert_array_equal(drawn, expected[: len(drawn)])
    over = over_time(read_tracks(bags))
    assert "Position in rad; thin dashes: target" in [
        a["text"] for a in over["layout"]["annotations"]
    ]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("gains", [(0.0, 40.0), (0.0, 0.0), (50.0, 0.0)])
def test_a_controller_without_a_gain_is_drawn(
    gains: tuple[float, float], fmu_path: Path, tmp_path: Path
) -> None:
    Kp, Kd = gains
    recording = record(
        tmp_path / "bag", fmu_path, stop_time=0.3,
        settings={"Kp": Kp, "Kd": Kd, "v_start": (0.1, 0.2), "xd_des": (0.01, 0.0)},
    )  # fmt: skip
    error = panels(plot(recording.bag)).error
    assert error is not None
    distance = np.linalg.norm(recording.x - (0.2, 0.05), axis=1)
    np.testing.assert_allclose(only(error, "closed form")[:, 1], distance, rtol=0.0, atol=1e-9)


def test_an_arm_at_its_target_has_an_error_panel_too(fmu_path: Path, tmp_path: Path) -> None:
    at_rest = oracles.position(np.array([0.5, 0.35]))
    recording = record(
        tmp_path / "bag", fmu_path, stop_time=0.1, settings={"x_des": tuple(at_rest)}
    )
    figure = plot(recording.bag)
    FigureCanvasAgg(figure).draw()
    error = panels(figure).error
    assert error is not None
    low, high = error.get_ylim()
    assert 0.0 < low < high <= 1e-9
    assert error.get_legend() is None  # of curves that are not seen
    assert [text.get_text() for text in error.texts] == ["less than 1e-12 m throughout"]
    (page,) = [a["text"] for a in over_time(read_tracks([recording.bag]))["layout"]["annotations"]
               if "Distance" in a["text"]]  # fmt: skip
    assert page == "Distance from the target in m: less than 1e-12 m throughout"


@pytest.mark.parametrize("at", [0.5, 2.0 * math.pi, 4321.987, -1e-3])
def test_ticks_of_what_does_not_move_differ(default: Recording, at: float) -> None:
    run = long_run(default, np.full((200, 2), at))
    figure = plot(replace(run, v=run.q, tau=run.q))
    FigureCanvasAgg(figure).draw()
    joints = [axes for axes in figure.axes if axes not in panels(figure).views][:6]
    for axes in joints:
        low, high = axes.get_ylim()
        ticks = [t.get_text() for t in axes.get_yticklabels() if low <= t.get_position()[1] <= high]
        assert len({*ticks}) == len(ticks) >= 2


# --- several bags ---


def test_bags_that_differ_in_a_gain_are_told_apart_by_it(gains: dict[int, Recording]) -> None:
    figure = plot(*(recording.bag for recording in gains.values()))
    names = ["Kp = 20 s⁻²", "Kp = 50 s⁻²", "Kp = 400 s⁻²"]
    assert key(figure) == names
    assert "x_des = (0.2, 0.05) m, Kd = 40 s⁻¹, step 10 ms, TwoDof.fmu" in texts(figure)
    found = panels(figure)
    assert found.error is not None
    for name, recording in zip(names, gains.values(), strict=True):
        np.testing.assert_array_equal(only(found.q[1], name)[:, 1], recording.q[:, 1])
        np.testing.assert_array_equal(only(found.v[0], name)[:, 1], recording.v[:, 0])
        distance = np.linalg.norm(recording.x - (0.2, 0.05), axis=1)
        np.testing.assert_allclose(only(found.error, name)[:, 1], distance, rtol=1e-9, atol=1e-15)
    paths = [points(line) for line in lines(found.views[0], "path")]
    for path, recording in zip(paths, gains.values(), strict=True):
        np.testing.assert_allclose(path, oracles.position(recording.q), rtol=0.0, atol=1e-14)
    assert len(lines(found.error, "closed form")) == 3
    assert len(lines(found.views[0], "arm at the start")) == 1  # all start alike
    legend = [text.get_text() for text in found.views[0].get_legend().get_texts()]
    assert legend == ["arm at the start", "arm at the end", "path", "target", "reach 0.3 m"]


def test_each_track_has_one_look_in_all_panels(gains: dict[int, Recording]) -> None:
    figure = plot(*(recording.bag for recording in gains.values()))
    found = panels(figure)
    assert found.error is not None
    (legend,) = figure.legends
    for i, handle in enumerate(legend.get_lines()):
        look = (handle.get_color(), handle.get_linestyle())
        name = key(figure)[i]
        for axes in (*found.q, *found.v, found.error):
            (line,) = lines(axes, name)
            assert (line.get_color(), line.get_linestyle()) == look
        path = lines(found.views[0], "path")[i]
        assert (path.get_color(), path.get_linestyle()) == look


def looks(count: int, bag: Path) -> list[tuple[str, Any]]:
    """Colour and dashes of each of that many tracks."""
    figure = plot(*[bag] * count)
    found = panels(figure).q[0].get_lines()
    return [
        (line.get_color(), tuple(line._unscaled_dash_pattern[1] or ()))
        for line in found
        if line.get_label() != "limit"
    ]


def test_looks_are_different_and_their_colours_those_of_okabe_and_ito(tmp_path: Path) -> None:
    """Black, orange, sky blue, bluish green, blue, vermillion and reddish purple, as published."""
    t, q, v = waves(1, 3)
    found = looks(28, elsewhere(tmp_path / "bag", ["a"], t, q, v))
    assert len(set(found)) == 28
    published = [
        (0, 0, 0), (230, 159, 0), (86, 180, 233), (0, 158, 115), (0, 114, 178), (213, 94, 0),
        (204, 121, 167),
    ]  # fmt: skip
    colours = {matplotlib.colors.to_rgb(colour) for colour, _ in found}
    assert colours == {tuple(value / 255 for value in colour) for colour in published}
    first = [dashes for _, dashes in found[:4]]
    assert len(set(first)) == 4  # on paper without colours


LABELS: dict[str, tuple[list[dict[str, Any]], list[str]]] = {
    "a vector": (
        [{"settings": {"x_des": (0.25, 0.1)}}, {"settings": {"x_des": (0.2, -0.1)}}],
        ["x_des = (0.25, 0.1) m", "x_des = (0.2, −0.1) m"],
    ),
    "two gains": (
        [{"settings": {"Kp": 20}}, {"settings": {"Kp": (20, 30), "Kd": 9}}],
        ["Kp = 20 s⁻², Kd = 40 s⁻¹", "Kp = (20, 30) s⁻², Kd = 9 s⁻¹"],
    ),
    "the step": ([{"step": 0.01}, {"step": 0.02}], ["step 10 ms", "step 20 ms"]),
    "a switch": (
        [{}, {"settings": {"limit_effort": True}}],
        ["limit_effort = false", "limit_effort = true"],
    ),
    "nothing": ([{}, {}], ["bag0", "bag1"]),
    "too much": (
        [{}, {"settings": {"Kp": 9, "Kd": 8, "Kn": 7, "rcond": 0.1}}], ["bag0", "bag1"],
    ),
    "not all of them": ([{}, {}, {"settings": {"Kp": 9}}], ["bag0", "bag1", "bag2"]),
    "a digit that is not told": ([{}, {"settings": {"Kp": 50.0000001}}], ["bag0", "bag1"]),
}  # fmt: skip


@pytest.mark.parametrize(("runs", "expected"), LABELS.values(), ids=list(LABELS))
def test_labels_say_what_differs(
    runs: list[dict[str, Any]], expected: list[str], fmu_path: Path, tmp_path: Path
) -> None:
    bags = [
        record(tmp_path / f"bag{i}", fmu_path, stop_time=0.1, **options).bag
        for i, options in enumerate(runs)
    ]
    assert labels(read_tracks(bags)) == expected


def test_flavours_are_told_by_their_files(default: Recording, tmp_path: Path) -> None:
    native = tmp_path / "native"
    shutil.copytree(default.bag, native)
    text = (native / "run.json").read_text()
    (native / "run.json").write_text(text.replace('"TwoDof.fmu"', '"TwoDof-native.fmu"'))
    assert labels(read_tracks([default.bag, native])) == ["TwoDof.fmu", "TwoDof-native.fmu"]


def test_bags_of_one_name_are_told_by_their_paths(tmp_path: Path) -> None:
    t, q, v = waves(1, 3)
    bags = [elsewhere(tmp_path / folder / "bag", ["a"], t, q, v) for folder in ("one", "two")]
    assert labels(read_tracks(bags)) == [str(bag) for bag in bags]


# --- other robots ---


def test_a_robot_in_space_is_seen_from_above_and_from_the_side(ur5: str, tmp_path: Path) -> None:
    fmu = build(tmp_path, bare(ur5), frame="tool0", q_start=oracles.REST["ur5"])
    recording = record(tmp_path / "bag", fmu, stop_time=0.3, settings={"x_des": (0.3, 0.35, 0.5)})
    found = panels(plot(recording.bag))
    names = list(pin.buildModelFromXML(bare(ur5)).names)[1:]
    path = kinematics(bare(ur5), "tool0", names, recording.q)
    assert [(v.get_xlabel(), v.get_ylabel()) for v in found.views] == [
        ("x in m", "y in m"), ("x in m", "z in m"),
    ]  # fmt: skip
    for view, columns in zip(found.views, ([0, 1], [0, 2]), strict=True):
        np.testing.assert_allclose(only(view, "path"), path[:, columns], rtol=0.0, atol=1e-12)
        target = np.array([0.3, 0.35, 0.5])[columns]
        np.testing.assert_array_equal(only(view, "target"), [target])
        arm = only(view, "arm at the end")
        assert len(arm) == 8  # root, six joints, end effector
        np.testing.assert_allclose(arm[-1], path[-1, columns], rtol=0.0, atol=1e-12)
        assert not [line for line in view.get_lines() if "reach" in str(line.get_label())]
    assert found.error is not None
    start = recording.x[0] - (0.3, 0.35, 0.5)
    expected = np.linalg.norm(oracles.task_error(start, 50.0, 40.0, recording.t), axis=1)
    np.testing.assert_allclose(only(found.error, "closed form")[:, 1], expected, rtol=1e-10)
    assert len(found.q) == len(found.v) == 6
    elbow = [line.get_ydata()[0] for line in lines(found.q[2], "limit")]
    assert sorted(elbow) == pytest.approx([-math.pi, math.pi], rel=1e-3)


def test_links_of_an_arm_are_as_long_as_they_are(panda: str, tmp_path: Path) -> None:
    """Joints' places by Pinocchio; distances in space from the two views together."""
    fmu = build(tmp_path, bare(panda), frame="panda_hand_tcp", q_start=oracles.REST["panda"])
    recording = record(tmp_path / "bag", fmu, stop_time=0.05)
    above, beside = panels(plot(recording.bag)).views
    model = pin.buildModelFromXML(bare(panda))
    data = model.createData()
    pin.framesForwardKinematics(model, data, recording.q[0])
    tip = data.oMf[model.getFrameId("panda_hand_tcp")].translation
    expected = np.array([*(placement.translation for placement in data.oMi), tip])
    first = only(above, "arm at the start"), only(beside, "arm at the start")
    np.testing.assert_allclose(first[0], expected[:, [0, 1]], rtol=0.0, atol=1e-12)
    columns = ["xyz".index(beside.get_xlabel()[0]), 2]
    np.testing.assert_allclose(first[1], expected[:, columns], rtol=0.0, atol=1e-12)


def test_a_single_joint_has_its_position_above_its_velocity(tmp_path: Path) -> None:
    """The target is a height; across, the end effector may be anywhere."""
    fmu = build(tmp_path, chain_urdf("z"), axes="y", q_start=(-0.3,), native=True)
    recording = record(tmp_path / "bag", fmu, stop_time=1.0, settings={"x_des": 0.2})
    figure = plot(recording.bag)
    found = panels(figure)
    (above,), (below,) = found.q, found.v
    assert above.get_position().y0 > below.get_position().y1
    assert above.get_position().x0 == pytest.approx(below.get_position().x0)
    assert above.get_title("left") == "Position of j1 in rad"
    assert below.get_title("left") == "Velocity of j1 in rad/s"
    (view,) = found.views
    assert set(only(view, "target")[:, 1]) == {0.2}
    circle = only(view, "reach 0.4 m")
    np.testing.assert_allclose(np.hypot(*circle.T), 0.4)
    assert found.error is not None
    height = 0.4 * np.sin(recording.q[:, 0])
    np.testing.assert_allclose(
        only(found.error, "bag")[:, 1], np.abs(height - 0.2), rtol=1e-9, atol=1e-15
    )


def test_joints_that_slide_have_metres(tmp_path: Path) -> None:
    fmu = build(tmp_path, chain_urdf("zX", low=0.0), axes="xy", q_start=(0.3, 0.1))
    recording = record(tmp_path / "bag", fmu, stop_time=0.05)
    figure = plot(recording.bag)
    found = panels(figure)
    assert found.q[0].get_title("left") == "Position in rad or m"
    assert found.v[0].get_title("left") == "Velocity in rad/s or m/s"
    assert {"j1", "j2\n(m)"} <= set(texts(figure))
    assert not [t for t in texts(figure) if "reach" in t]  # it has no bound of this kind


PLANES = {
    "z": ("xy", 0.4), "y": ("xz", 0.4), "zz": ("xy", 0.8), "X": ("xz", None), "Y": ("xy", None),
    "Z": ("xz", None), "zX": ("xy", None), "yZ": ("xz", None), "yy": ("xz", 0.8),
}  # fmt: skip


@pytest.mark.parametrize(("axes", "expected"), PLANES.items(), ids=list(PLANES))
def test_motion_in_a_plane_is_seen_in_that_plane(
    axes: str, expected: tuple[str, float | None], tmp_path: Path
) -> None:
    """With the circle that it cannot leave, if all of its joints turn."""
    (tmp_path / "robot.urdf").write_text(chain_urdf(axes))
    t, q, v = waves(len(axes))
    names = [f"j{i + 1}" for i in range(len(axes))]
    bag = elsewhere(tmp_path / "bag", names, t, q, v)
    (view,) = panels(plot(bag, urdf=tmp_path / "robot.urdf")).views
    plane, reach = expected
    assert view.get_xlabel()[0] + view.get_ylabel()[0] == plane
    circles = [line for line in view.get_lines() if "reach" in str(line.get_label())]
    assert len(circles) == (reach is not None)
    if reach is not None:
        np.testing.assert_allclose(np.hypot(*points(circles[0]).T), reach)
        farthest = np.hypot(*only(view, "path").T).max()
        assert farthest <= reach + 1e-12


def test_only_what_is_in_the_plane_counts_for_the_circle(tmp_path: Path) -> None:
    """Links of 0.24 × 0.32 × 0.1 m whose joints turn about z: it is seen from above alone."""
    urdf = chain_urdf("zz").replace('<origin xyz="0.4 0 0"/>', '<origin xyz="0.24 0.32 0.1"/>')
    (tmp_path / "robot.urdf").write_text(urdf)
    bag = elsewhere(tmp_path / "bag", ["j1", "j2"], *waves(2))
    above, beside = panels(plot(bag, urdf=tmp_path / "robot.urdf")).views
    np.testing.assert_allclose(np.hypot(*only(above, "reach 0.8 m").T), 0.8)
    assert not lines(beside, "reach 0.8 m")
    assert "reach 0.8 m" in [text.get_text() for text in beside.get_legend().get_texts()]


def test_joints_that_turn_about_skew_axes_have_no_circle(tmp_path: Path) -> None:
    urdf = chain_urdf("zz").replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0.1 1"/>', 1)
    (tmp_path / "robot.urdf").write_text(urdf)
    bag = elsewhere(tmp_path / "bag", ["j1", "j2"], *waves(2))
    figure = plot(bag, urdf=tmp_path / "robot.urdf")
    assert len(panels(figure).views) == 2
    assert not [text for text in texts(figure) if "reach" in text]


def test_sixteen_joints_fit_on_a_page(tmp_path: Path) -> None:
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(chain_urdf("zy" * 8, length=0.1))
    t, q, v = waves(16)
    names = [f"j{i + 1}" for i in range(16)]
    figure = plot(elsewhere(tmp_path / "bag", names, t, q, v), urdf=urdf)
    width, height = figure.get_size_inches()
    assert height / width < math.sqrt(2.0)
    assert len(panels(figure).q) == len(panels(figure).v) == 16


# --- bags from elsewhere ---


@pytest.fixture(scope="session")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Joint states of a UR5 in alphabetical order, as joint_state_broadcaster writes them."""
    return elsewhere(tmp_path_factory.mktemp("foreign") / "ur5_log", UR5_JOINTS, *waves(6))


def test_a_bag_from_elsewhere_is_drawn_as_far_as_it_goes(foreign: Path) -> None:
    t, q, v = waves(6)
    figure = plot(foreign)
    found = panels(figure)
    assert (len(found.q), len(found.v), found.error, found.views) == (6, 6, None, [])
    for i in range(6):
        line = only(found.q[i], "ur5_log")
        np.testing.assert_allclose(line, np.column_stack([t, q[:, i]]), rtol=0.0, atol=1e-9)
        np.testing.assert_array_equal(only(found.v[i], "ur5_log")[:, 1], v[:, i])
        assert not lines(found.q[i], "limit")
    assert found.q[0].get_title("left") == "Position in rad or m"
    assert "ur5_log" in texts(figure)


def test_with_a_urdf_it_has_limits_path_and_arm(foreign: Path, ur5: str, tmp_path: Path) -> None:
    (tmp_path / "ur5.urdf").write_text(ur5)
    found = panels(plot(foreign, urdf=tmp_path / "ur5.urdf"))
    assert found.error is None
    path = kinematics(bare(ur5), "tool0", UR5_JOINTS, waves(6)[1])
    for view in found.views:
        columns = ["xyz".index(label[0]) for label in (view.get_xlabel(), view.get_ylabel())]
        np.testing.assert_allclose(only(view, "path"), path[:, columns], rtol=0.0, atol=1e-12)
    assert found.views[0].get_title("left") == "Path of tool0 in world"
    elbow = sorted(line.get_ydata()[0] for line in lines(found.q[0], "limit"))
    assert elbow == pytest.approx([-math.pi, math.pi], rel=1e-3)
    pan = sorted(line.get_ydata()[0] for line in lines(found.q[2], "limit"))
    assert pan == pytest.approx([-2 * math.pi, 2 * math.pi], rel=1e-3)
    assert found.q[0].get_title("left") == "Position in rad"


def test_another_frame_needs_only_the_joints_that_move_it(
    foreign: Path, ur5: str, tmp_path: Path
) -> None:
    t, q, v = waves(6)
    names = UR5_JOINTS[:4]  # those up to the forearm and one more
    bag = elsewhere(tmp_path / "bag", names, t, q[:, :4], v[:, :4])
    (tmp_path / "ur5.urdf").write_text(ur5)
    figure = plot(bag, urdf=tmp_path / "ur5.urdf", frame="forearm_link")
    path = kinematics(bare(ur5), "forearm_link", names, q[:, :4])
    view = panels(figure).views[0]
    np.testing.assert_allclose(only(view, "path"), path[:, :2], rtol=0.0, atol=1e-12)


def test_a_urdf_that_cannot_be_simulated_can_be_drawn(robots: Path, tmp_path: Path) -> None:
    """The Panda as it is: a finger mimics the other; and here its links have no masses."""
    urdf = bare((robots / "panda_description/urdf/panda.urdf").read_text())
    (tmp_path / "panda.urdf").write_text(re.sub("<inertial>.*?</inertial>", "", urdf, flags=re.S))
    names = [
        "panda_finger_joint1",
        "panda_finger_joint2",
        *(f"panda_joint{i}" for i in range(1, 8)),
    ]
    t, q, v = waves(9)
    bag = elsewhere(tmp_path / "bag", names, t, q, v)
    figure = plot(bag, urdf=tmp_path / "panda.urdf", frame="panda_rightfinger")
    alone = re.sub("<mimic[^>]*/>", "", urdf)
    path = kinematics(alone, "panda_rightfinger", names, q)
    np.testing.assert_allclose(
        only(panels(figure).views[0], "path"), path[:, :2], rtol=0.0, atol=1e-12
    )


def test_bags_without_velocities_or_with_gaps(tmp_path: Path) -> None:
    t, q, _ = waves(2, 50)
    q[10:20, 0] = math.nan
    q[:, 1] = math.nan
    q[3, 1] = math.inf
    figure = plot(elsewhere(tmp_path / "bag", ["a", "b"], t, q, None))
    found = panels(figure)
    assert (len(found.q), found.v) == (2, [])
    drawn = only(found.q[0], "bag")[:, 1]
    np.testing.assert_array_equal(np.isnan(drawn), np.isnan(q[:, 0]))
    FigureCanvasAgg(figure).draw()


def test_a_bag_of_one_sample_is_a_point(foreign: Path, ur5: str, tmp_path: Path) -> None:
    t, q, v = waves(6, 2)
    bag = elsewhere(tmp_path / "bag", UR5_JOINTS, t[:1], q[:1], v[:1])
    (tmp_path / "ur5.urdf").write_text(ur5)
    figure = plot(bag, urdf=tmp_path / "ur5.urdf")
    (line,) = lines(panels(figure).q[0], "bag")
    assert line.get_marker() == "o"
    FigureCanvasAgg(figure).draw()


def test_a_urdf_may_replace_that_of_the_bag(default: Recording, tmp_path: Path) -> None:
    """Longer links, as after a calibration; limits and target remain those of the run."""
    urdf = (Path(__file__).parents[1] / "urdf/2dof.urdf").read_text()
    longer = urdf.replace('<origin xyz="0.15 0 0"', '<origin xyz="0.3 0 0"')
    (tmp_path / "longer.urdf").write_text(longer.replace("3.141592653589793", "1.5"))
    found = panels(plot(default.bag, urdf=tmp_path / "longer.urdf"))
    path = only(found.views[0], "path")
    np.testing.assert_allclose(path, 2 * oracles.position(default.q), rtol=0.0, atol=1e-14)
    assert {line.get_ydata()[0] for line in lines(found.q[0], "limit")} == {-math.pi, math.pi}
    assert found.error is not None
    distance = np.linalg.norm(path - (0.2, 0.05), axis=1)
    np.testing.assert_allclose(only(found.error, "Kp50")[:, 1], distance, rtol=1e-12)


def test_a_xacro_file_may_be_the_robot_of_a_bag(default: Recording, tmp_path: Path) -> None:
    """Expanded as it is where an FMU is built of it."""
    urdf = (Path(__file__).parents[1] / "urdf/2dof.urdf").read_text()
    named = urdf.replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ')
    length = '<xacro:property name="length" value="${0.1 * 3}"/><link name="world"/>'
    text = named.replace('<link name="world"/>', length).replace('"0.15 0 0"', '"${length} 0 0"')
    (tmp_path / "longer.urdf.xacro").write_text(text)
    found = panels(plot(default.bag, urdf=tmp_path / "longer.urdf.xacro"))
    path = only(found.views[0], "path")
    np.testing.assert_allclose(path, 2 * oracles.position(default.q), rtol=0.0, atol=1e-14)
    page, _ = replay(default.bag, urdf=tmp_path / "longer.urdf.xacro")
    assert b"${length}" not in page


def test_for_another_frame_there_is_no_target(default: Recording) -> None:
    found = panels(plot(default.bag, frame="link2"))
    assert found.error is None
    elbow = LINK * np.column_stack([np.cos(default.q[:, 0]), np.sin(default.q[:, 0])])
    np.testing.assert_allclose(only(found.views[0], "path"), elbow, rtol=0.0, atol=1e-14)


def test_a_recovered_bag_with_a_gap(default: Recording) -> None:
    """Samples 100 to 199 are lost: the rest is where it was."""
    run = twodof.read_bag(default.bag)
    kept = np.r_[0:100, 200:501]
    short = replace(run, stamps=run.stamps[kept], q=run.q[kept], v=run.v[kept])
    error = panels(plot(short)).error
    assert error is not None
    found, closed = only(error, "Kp50"), only(error, "closed form")
    np.testing.assert_allclose(found[:, 0], default.t[kept], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(closed[:, 1], found[:, 1], rtol=1e-6)


# --- what a reader sees ---


def boxes(figure: Figure) -> list[tuple[Text, Any]]:
    """All texts that are seen and the boxes around them, in pixels."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    ticks = {}
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            slack = 1e-9 * (high - low)
            for tick in axis.get_major_ticks():
                ticks[tick.label1] = low - slack <= tick.get_loc() <= high + slack
                ticks[tick.label2] = False
    found = []
    for text in figure.findobj(Text):
        if text.get_text().strip() and text.get_visible() and ticks.get(text, True):
            found.append((text, text.get_window_extent(canvas.get_renderer())))
    return found


def overlap(a: Any, b: Any) -> bool:
    across, up = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
    return bool(min(across, up) >= 1.0)


def assert_legible(figure: Figure) -> None:
    """No text is cut off, none lies on another, and none is smaller than 5 pt on an A4 page."""
    found = boxes(figure)
    assert len(found) > 10
    width, height = figure.canvas.get_width_height()
    for text, box in found:
        inside = box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height
        assert inside, f"{text} is cut off"
    for (one, a), (other, b) in itertools.combinations(found, 2):
        assert not overlap(a, b), f"{one} lies on {other}"
    for axes in figure.axes:
        own = axes.findobj(Text)
        for text, box in found:
            assert text in own or not overlap(box, axes.bbox), f"{text} lies on a panel"
    on_paper = 17.0 / 2.54 / max(17.0 / 2.54, figure.get_size_inches()[0])
    sizes = [text.get_fontsize() * on_paper for text in figure.findobj(Text) if text.get_text()]
    assert min(sizes) > 5.0


def test_figures_are_legible(
    gains: dict[int, Recording], changing: Recording, foreign: Path, ur5: str, tmp_path: Path
) -> None:
    (tmp_path / "ur5.urdf").write_text(ur5)
    (tmp_path / "chain.urdf").write_text(chain_urdf("zyX" * 5 + "z", 0.1, low=-3.07, high=2.35))
    names = [f"j{i + 1}" for i in range(16)]
    chain = elsewhere(tmp_path / "chain", names, *waves(16))
    long = [f"left_front_{part}_of_the_gripper_joint" for part in ("upper", "lower", "middle")]
    for figure in (
        plot(gains[50].bag),
        plot(*(recording.bag for recording in gains.values())),
        plot(changing.bag, gains[50].bag),
        plot(foreign),
        plot(foreign, urdf=tmp_path / "ur5.urdf"),
        plot(chain, urdf=tmp_path / "chain.urdf"),
        plot(elsewhere(tmp_path / "long", long, *waves(3))),
        plot(elsewhere(tmp_path / "one", ["a"], *waves(1))),
        plot(*[foreign] * 9),
        plot(*(elsewhere(tmp_path / (c * 140), ["a"], *waves(1)) for c in "abc")),
        plot(elsewhere(tmp_path / ("d" * 200), ["a"], *waves(1))),
    ):
        assert_legible(figure)


def test_names_are_drawn_as_they_are(tmp_path: Path) -> None:
    """A dollar sign would begin a formula."""
    bag = elsewhere(tmp_path / "a$b$_c^", ["$q$", "x_{1}"], *waves(2))
    figure = plot(bag)
    FigureCanvasAgg(figure).draw()
    named = [text for text in figure.findobj(Text) if "$" in text.get_text()]
    assert {text.get_text() for text in named} == {"a$b$_c^", "$q$"}
    assert not any(text.get_parse_math() for text in named)


def test_settings_of_the_user_do_not_change_it(default: Recording, tmp_path: Path) -> None:
    expected = save(drawing(read_tracks([default.bag])), tmp_path / "a.svg").read_bytes()
    with matplotlib.rc_context(
        {"lines.linewidth": 9.0, "axes.grid": False, "font.size": 30, "svg.fonttype": "none"}
    ):
        found = save(drawing(read_tracks([default.bag])), tmp_path / "b.svg").read_bytes()
        assert matplotlib.rcParams["lines.linewidth"] == 9.0
        figure = plot(default.bag)
        FigureCanvasAgg(figure).draw()  # as windows and notebooks do
    assert found == expected
    assert max(text.get_fontsize() for text in figure.findobj(Text) if text.get_text()) == 11.0


def test_notebooks_show_it(default: Recording) -> None:
    figure = plot(twodof.read_bag(default.bag))
    assert isinstance(figure, Figure)
    assert figure._repr_png_().startswith(b"\x89PNG")


# --- long bags ---


def long_run(default: Recording, q: np.ndarray) -> twodof.Recording:
    """A run of the default arm at 1 kHz that nothing has simulated."""
    run = twodof.read_bag(default.bag)
    stamps = START * 10**9 + np.arange(len(q)) * 10**6
    provenance = {**run.provenance, "step": 0.001}
    return replace(run, stamps=stamps, count=len(q), q=q, v=q - q[0], provenance=provenance)


def test_noise_in_a_long_bag_keeps_its_extremes(default: Recording, tmp_path: Path) -> None:
    """In each of 500 pixels across; and files stay small."""
    n = 120_000
    noise = np.random.default_rng(0).normal(scale=0.01, size=(n, 2))
    noise[41_152] = 0.3, -0.2  # a spike of one sample
    q = np.array([0.5, 0.35]) + noise
    run = long_run(default, q)
    run.v[[777, 778, 50_000], 1] = math.inf, 0.9, math.nan
    tracks = read_tracks([run])
    found = panels(plot(run))
    for axes, values in ((found.q[0], q[:, 0]), (found.v[1], run.v[:, 1])):
        line = only(axes, "Kp50")
        assert len(line) <= 4000
        at = np.rint(line[:, 0] * 1000).astype(int)
        np.testing.assert_array_equal(values[at], line[:, 1])  # nothing is made up
        for part in np.array_split(np.arange(n), 500):
            every = values[part][np.isfinite(values[part])]
            kept = line[(at >= part[0]) & (at <= part[-1]) & np.isfinite(line[:, 1]), 1]
            assert (kept.min(), kept.max()) == (every.min(), every.max())
    path = only(found.views[0], "path")
    exact = oracles.position(q)
    assert len(path) < 10_000
    np.testing.assert_allclose(np.ptp(path, axis=0), np.ptp(exact, axis=0), rtol=1e-12)
    for kind, most in (("svg", 1.5e6), ("pdf", 1.5e6), ("png", 1.5e6), ("html", 6e6)):
        assert save(drawing(tracks), tmp_path / f"long.{kind}").stat().st_size < most


def test_a_long_path_keeps_its_corners(default: Recording, tmp_path: Path) -> None:
    """A square in which the end effector rests long: no corner is cut."""
    corners = np.array([(0.1, 0.1), (0.2, 0.1), (0.2, 0.15), (0.1, 0.15), (0.1, 0.1)])
    side = np.linspace(0.0, 1.0, 1250)[:, None]
    legs = [a + (b - a) * side for a, b in itertools.pairwise(corners)]
    rests = [np.repeat(corner[None], 17_000, axis=0) for corner in corners[1:]]
    x = np.concatenate(list(itertools.chain.from_iterable(zip(legs, rests, strict=True))))
    distance = np.hypot(*x.T)
    elbow = np.arccos(distance**2 / (2 * LINK**2) - 1.0)
    q = np.column_stack([np.arctan2(x[:, 1], x[:, 0]) - elbow / 2, elbow])
    run = long_run(default, q)
    path = only(panels(plot(run)).views[0], "path")
    for corner in corners:
        assert np.hypot(*(path - corner).T).min() < 1e-12
    svg = save(drawing(read_tracks([run])), tmp_path / "long.svg")
    assert svg.stat().st_size < 500_000


# --- files ---


def test_each_kind_of_file_opens(gains: dict[int, Recording], tmp_path: Path) -> None:
    tracks = read_tracks([recording.bag for recording in gains.values()])
    png, svg, pdf, page = (
        save(drawing(tracks), tmp_path / f"a.{k}") for k in ("PNG", "svg", "pdf", "html")
    )
    with Image.open(png) as image:
        image.load()
        assert image.format == "PNG"
        across = plot(gains[50].bag, gains[20].bag).get_size_inches()[0]
        assert image.size[0] == pytest.approx(200 * across, abs=1)
    root = ET.parse(svg).getroot()
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert pdf.read_bytes().startswith(b"%PDF-1.")
    assert pdf.read_bytes().rstrip().endswith(b"%%EOF")
    assert b"/Type3" not in pdf.read_bytes()  # which journals refuse
    text = page.read_text("utf-8")
    assert text.startswith("<!DOCTYPE html>")
    table = ET.fromstring(text[text.index('<table class="runs">') : text.rindex("</body>")])
    rows = {row[0].text: [cell.text for cell in row[1:]] for row in table.findall("tr")}
    assert rows["bag"] == ["Kp20", "Kp50", "Kp400"]
    assert rows["Kp"] == ["20 s⁻²", "50 s⁻²", "400 s⁻²"]
    assert rows["x_des"] == ["(0.2, 0.05) m"] * 3
    assert rows["duration"] == ["5 s, 501 samples"] * 3
    assert rows["at a limit"] == ["no joint"] * 3
    assert [float(str(cell).split()[0]) for cell in rows["result"]] == pytest.approx(
        [np.linalg.norm(r.x[-1] - (0.2, 0.05)) for r in gains.values()], rel=2e-3, abs=1e-14
    )


def traces(figure: dict[str, Any], joint: str, kind: str) -> list[np.ndarray]:
    """Curves of a figure on a page, N × 2 each: bytes of little-endian doubles."""

    def numbers(packed: dict[str, str]) -> np.ndarray:
        assert packed["dtype"] == "f8"
        return np.frombuffer(base64.b64decode(packed["bdata"]), "<f8")

    return [
        np.column_stack([numbers(trace["x"]), numbers(trace["y"])])
        for trace in figure["data"]
        if trace["meta"][1:] == [joint, kind]
    ]


def test_a_page_has_the_curves_of_the_bags(gains: dict[int, Recording]) -> None:
    """As plotly itself takes them, which refuses what it does not know."""
    tracks = read_tracks([gains[20].bag, gains[50].bag])
    time, view = over_time(tracks), *in_workspace(tracks)
    for figure in (time, view):
        plotly.graph_objects.Figure(figure)
    for i, recording in enumerate((gains[20], gains[50])):
        for j in range(2):
            for kind in ("q", "v"):
                found = traces(time, f"joint{j + 1}", kind)[i]
                np.testing.assert_allclose(found[:, 0], recording.t, rtol=1e-15)
                np.testing.assert_array_equal(found[:, 1], getattr(recording, kind)[:, j])
        error = np.linalg.norm(recording.x - (0.2, 0.05), axis=1)
        np.testing.assert_allclose(traces(time, "", "error")[i][:, 1], error, atol=1e-15)


def test_a_page_of_an_hour_is_small_and_keeps_its_extremes(
    default: Recording, tmp_path: Path
) -> None:
    n = 360_000
    noise = np.random.default_rng(0).normal(scale=0.01, size=(n, 2))
    noise[41_152] = 0.3, -0.2  # a spike of one sample
    run = long_run(default, np.array([0.5, 0.35]) + noise)
    tracks = read_tracks([run])
    (line,) = traces(over_time(tracks), "joint1", "q")
    at = np.rint(line[:, 0] * 1000).astype(int)
    np.testing.assert_array_equal(run.q[at, 0], line[:, 1])
    for part in np.array_split(np.arange(n), 500):
        kept = line[(at >= part[0]) & (at <= part[-1]), 1]
        assert (kept.min(), kept.max()) == (run.q[part, 0].min(), run.q[part, 0].max())
    assert save(drawing(tracks), tmp_path / "hour.html").stat().st_size <= 6e6


def test_a_page_keeps_jumps_and_says_what_it_leaves_out(default: Recording, tmp_path: Path) -> None:
    """Jumps that are no extremes, of one sample, in a curve that swings further."""
    n, jumps = 60_000, np.array([11_113, 30_077, 47_042])
    swing = np.sin(np.arange(n) / 20)
    run = long_run(default, np.column_stack([swing, swing]))
    for k in jumps:
        run.v[k:, 0] += 0.2
    tracks = read_tracks([run])
    (line,) = traces(over_time(tracks), "joint1", "v")
    at = np.rint(line[:, 0] * 1000).astype(int)
    assert {*jumps, *jumps - 1} <= {*at}
    text = save(drawing(tracks), tmp_path / "long.html").read_text("utf-8")
    (told,) = re.findall(r"'Kp50' is drawn through at most (\d+) of 60000 samples", text)
    assert len(line) <= int(told) <= 30_000
    short = save(drawing(read_tracks([default.bag])), tmp_path / "short.html")
    assert "is drawn through" not in short.read_text("utf-8")


SEEN = """() => {
  const y = (place) =>
    place._fullData.filter((t) => t.visible === true).map((t) => t.meta.join(" "));
  const [time, view] = document.querySelectorAll(".plot");
  return { time: y(time), view: y(view) };
}"""


def test_a_page_answers(gains: dict[int, Recording], tmp_path: Path) -> None:
    """Boxes switch joints and bags in all figures, the cursor tells the values of all panels."""
    tracks = read_tracks([gains[20].bag, gains[50].bag])
    page = save(drawing(tracks), tmp_path / "a.html")
    said: list[str] = []
    with browser.chromium() as chromium, chromium.new_context(offline=True) as context:
        shown = context.new_page()
        shown.on("console", lambda message: said.append(message.text))
        shown.on("pageerror", lambda error: said.append(str(error)))
        shown.goto(page.as_uri())
        shown.wait_for_selector("#plots[data-ready]")
        whole = shown.evaluate(SEEN)
        assert {"0 joint1 q", "1 joint2 v", "1  error"} <= set(whole["time"])
        boxes = shown.locator("#legend input")  # Kp 20, its joints, Kp 50, its joints
        boxes.nth(1).click()
        assert "0 joint1 q" not in shown.evaluate(SEEN)["time"]
        assert shown.evaluate(SEEN)["view"] == whole["view"]
        boxes.nth(1).click()
        boxes.nth(3).click()
        seen = shown.evaluate(SEEN)
        assert {meta[0] for meta in seen["time"]} == {"0"}
        assert "1  " not in seen["view"]
        boxes.nth(3).click()
        panel = shown.locator(".plot .xy").first.bounding_box()
        assert panel is not None
        shown.mouse.move(panel["x"] + 0.4 * panel["width"], panel["y"] + 0.5 * panel["height"])
        cells = shown.locator("#legend tr").nth(5).locator("td")
        browser.until(shown, lambda words: words != "", lambda _: cells.nth(1).inner_text())
        told = float(shown.locator("#legend th").first.inner_text().split()[0])
        k = int(np.argmin(np.abs(gains[50].t - told)))
        assert told == pytest.approx(2.0, abs=0.1)
        found = [float(cells.nth(i).inner_text().replace("−", "-")) for i in (1, 2)]
        assert found == pytest.approx([gains[50].q[k, 0], gains[50].v[k, 0]], rel=1e-4)
    assert said == []


def test_buttons_of_a_page_cover_no_heading(default: Recording, tmp_path: Path) -> None:
    """Nor on a phone, where they are always shown."""
    page = save(drawing(read_tracks([default.bag])), tmp_path / "a.html")
    phone = {"viewport": {"width": 390, "height": 844}, "is_mobile": True, "has_touch": True}
    with browser.chromium() as chromium, chromium.new_context(offline=True, **phone) as context:
        shown = context.new_page()
        shown.goto(page.as_uri())
        shown.wait_for_selector("#plots[data-ready]")
        for plot in shown.locator(".plot").all():
            buttons = plot.locator(".modebar").bounding_box()
            heading = plot.locator(".annotation-text").first.bounding_box()
            assert buttons["width"] > 40 and heading["width"] > 40
            assert buttons["y"] + buttons["height"] <= heading["y"]


def test_efforts_are_drawn_with_their_limits(fmu_path: Path, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    samples = Collector()
    twodof.simulate(twodof.experiment(fmu_path), samples, twodof.Bag(bag, effort=True))
    found = {axes.get_title("left"): axes for axes in plot(bag).axes}["Effort in N·m"]
    tau = np.array([sample.tau for sample in samples])
    np.testing.assert_array_equal(only(found, "bag")[:, 1], tau[:, 0])
    assert sorted(line.get_ydata()[0] for line in lines(found, "limit")) == [-10.0, 10.0]
    assert notes(found) == ["limits ±10"]
    assert_legible(plot(bag))


@pytest.mark.parametrize("limited", [False, True])
def test_efforts_of_a_bare_plant_are_known_without_being_in_the_bag(
    limited: bool, tmp_path: Path
) -> None:
    """As the FMU's output has them, limited to 9 N·m or not."""
    fmu = build(tmp_path, chain_urdf("zz"), control="effort", native=True)
    (tmp_path / "in.csv").write_text("time,tau_cmd[1]\n0,1\n0.02,12\n0.04,-2\n")
    recording = record(
        tmp_path / "bag", fmu, stop_time=0.06, input_file=tmp_path / "in.csv",
        settings={"limit_effort": limited},
    )  # fmt: skip
    (track,) = read_tracks([recording.bag])
    for j, joint in enumerate(track.joints):
        np.testing.assert_array_equal(joint.tau[1:], recording.tau[1:, j])
    assert track.joints[0].tau.max() == (9.0 if limited else 12.0)


def test_joints_are_chosen(default: Recording, tmp_path: Path, capsys: Any) -> None:
    (track,) = with_joints(read_tracks([default.bag]), ["joint2"])
    assert [joint.name for joint in track.joints] == ["joint2"]
    output = ["-o", str(tmp_path / "a.svg")]
    assert main(["plot", str(default.bag), "--joints", "joint2,elbow", *output]) == 1
    assert "no joint 'elbow'; there are: joint1, joint2" in capsys.readouterr().err
    assert main(["plot", str(default.bag), "--joints", "joint2,joint1", *output]) == 0


def test_thirty_joints_fit_on_a_screen(tmp_path: Path) -> None:
    names = [f"j{i + 1}" for i in range(30)]
    figure = plot(elsewhere(tmp_path / "bag", names, *waves(30)))
    width, height = figure.get_size_inches()
    assert 1.0 / 1.5 < height / width < 1.5
    assert len(panels(figure).q) == len(panels(figure).v) == 30


class Links(HTMLParser):
    """What a page would load or run."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ("link", "iframe", "object", "embed", "image", "img"):
            self.found.append((tag, ""))
        for name, value in attrs:
            if name in ("src", "href", "xlink:href", "data", "action") and value[:1] != "#":
                self.found.append((tag, str(value)))


def test_a_page_needs_no_network(default: Recording, tmp_path: Path) -> None:
    """And names in it are text, whatever they are."""
    bag = tmp_path / "<script src=x> & co"
    shutil.copytree(default.bag, bag)
    page = save(drawing(read_tracks([bag])), tmp_path / "a.html").read_text("utf-8")
    links = Links()
    links.feed(page)
    assert links.found == []
    assert "url(http" not in page
    assert "@import" not in page
    assert "&lt;script src=x&gt; &amp; co" in page


PLOT = """
import sys
from twodof.plots.figure import save
from twodof.plots.runs import drawing
from twodof.plots.track import read_tracks
for kind in ("png", "svg", "pdf", "html"):
    save(drawing(read_tracks([sys.argv[1]])), f"{sys.argv[2]}.{kind}")
"""
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def test_equal_bags_give_equal_files(default: Recording, tmp_path: Path) -> None:
    """In another process, with other hashes, at another time."""
    subprocess.run(
        [sys.executable, "-c", PLOT, default.bag, "a"], cwd=tmp_path, check=True,
        env={**ENVIRONMENT, "PYTHONHASHSEED": "1", "SOURCE_DATE_EPOCH": "1"}, timeout=60,
    )  # fmt: skip
    tracks = read_tracks([default.bag])
    for kind in ("png", "svg", "pdf", "html"):
        here = save(drawing(tracks), tmp_path / f"b.{kind}")
        assert (tmp_path / f"a.{kind}").read_bytes() == here.read_bytes()


def test_without_a_name_the_plot_has_that_of_the_bag(
    gains: dict[int, Recording], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plot of ours is replaced, and nothing else is."""
    monkeypatch.chdir(tmp_path)
    tracks = read_tracks([gains[50].bag])
    assert save(drawing(tracks)) == Path("Kp50.png")
    first = Path("Kp50.png").read_bytes()
    Path("Kp50.png").write_bytes(first + b"older")
    assert save(drawing(tracks)) == Path("Kp50.png")
    assert Path("Kp50.png").read_bytes() == first
    Image.new("RGB", (9, 9)).save("Kp50.png")
    theirs = Path("Kp50.png").read_bytes()
    Path("Kp50-2.png").symlink_to("nowhere")
    assert save(drawing(tracks)) == Path("Kp50-3.png")
    assert Path("Kp50.png").read_bytes() == theirs
    assert Path("Kp50-2.png").is_symlink()
    assert save(drawing(read_tracks([gains[50].bag, gains[20].bag]))) == Path("Kp50-and-1-more.png")
    monkeypatch.chdir(gains[50].bag)
    assert read_tracks(["."])[0].name == "Kp50"


def test_a_file_is_written_whole_or_not_at_all(
    default: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.png").write_bytes(b"before")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(PlotError, match=r"cannot write '.*a\.png': No space left on device"):
        save(drawing(read_tracks([default.bag])), tmp_path / "a.png")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    assert (tmp_path / "a.png").read_bytes() == b"before"


# --- windows ---

BACKEND = """
from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg

class Manager(FigureManagerBase):
    @classmethod
    def pyplot_show(cls, *, block=None):
        from matplotlib._pylab_helpers import Gcf
        for manager in Gcf.get_all_fig_managers():
            print("window", len(manager.canvas.figure.axes), "panels")

class FigureCanvas(FigureCanvasAgg):
    required_interactive_framework = {framework!r}
    manager_class = Manager
"""
SHOW = """
import json, os, sys
from twodof.plots.track import read_tracks
tracks = read_tracks([sys.argv[1]])
for environment in json.loads(sys.argv[2]):
    if os.fork() == 0:
        os.environ.update(environment)
        import matplotlib.cbook
        matplotlib.cbook._get_running_interactive_framework = lambda: None  # stands for a display
        from twodof.plots.figure import show
        from twodof.plots.runs import drawing
        print(show(drawing(tracks)), "matplotlib.pyplot" in sys.modules, flush=True)
        os._exit(0)
    os.wait()
"""


def test_a_window_opens_where_there_is_a_display(default: Recording, tmp_path: Path) -> None:
    """An X or a Wayland one; and not by a backend for files, or one that is not there."""
    (tmp_path / "windows.py").write_text(BACKEND.format(framework="test"))
    (tmp_path / "files.py").write_text(BACKEND.format(framework=None))
    cases = [
        ({}, "windows", "False False"),
        ({"DISPLAY": ":7"}, "windows", "window 6 panels\nTrue True"),
        ({"WAYLAND_DISPLAY": "w"}, "windows", "window 6 panels\nTrue True"),
        ({"DISPLAY": ":7"}, "files", "False True"),
        ({"DISPLAY": ":7"}, "missing", "False True"),
    ]
    given = [{**display, "MPLBACKEND": f"module://{backend}"} for display, backend, _ in cases]
    environment = {k: v for k, v in ENVIRONMENT.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path), environment["PYTHONPATH"]])
    done = subprocess.run(
        [sys.executable, "-c", SHOW, default.bag, json.dumps(given)],
        capture_output=True, text=True, timeout=60, env=environment,
    )  # fmt: skip
    assert done.stdout == "".join(f"{said}\n" for *_, said in cases), done.stderr


# --- what is wrong ---


def text_file(name: str, content: str | bytes) -> Callable[[Path], None]:
    data = content.encode() if isinstance(content, str) else content
    return lambda folder: [(folder / name).write_bytes(data), None][1]


BAD: dict[str, tuple[str | bytes, dict[str, Any], str]] = {
    "no XML": ("a: 1", {}, r"u\.urdf: the URDF is not XML"),
    "no text": (b"\xff\x00", {}, r"the URDF '.*u\.urdf' is not UTF-8"),
    "another root": ("<model/>", {}, r"root element is <model>"),
    "entities": (
        '<!DOCTYPE robot [<!ENTITY a "b">]>' + chain_urdf("zz"), {}, "document type declaration",
    ),
    "no joints": ('<robot name="r"><link name="a"/></robot>', {}, "no joint moves the frame"),
    "a planar joint": (chain_urdf("zz").replace("revolute", "planar"), {}, "'j1' is of type 'plan"),
    "no such frame": (chain_urdf("zz"), {"frame": "hand"}, "no frame 'hand'.*: base, l1, l2, tip$"),
    "a frame at rest": (chain_urdf("zz"), {"frame": "base"}, "no joint moves the frame 'base'"),
    "joints of another robot": (
        chain_urdf("zzz"), {},
        r"'.*bag' has no joint 'j3', which the robot 'chain' needs to move 'tip';"
        " its joints are: j1, j2$",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("urdf", "options", "message"), BAD.values(), ids=list(BAD))
def test_a_urdf_that_is_wrong_is_named(
    urdf: str | bytes, options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "u.urdf"
    path.write_bytes(urdf if isinstance(urdf, bytes) else urdf.encode())
    bag = elsewhere(tmp_path / "bag", ["j1", "j2"], *waves(2))
    with pytest.raises(PlotError, match=message) as caught:
        plot(bag, urdf=path, **options)
    assert "\n" not in str(caught.value)


UNSOUND: dict[str, Callable[[dict[str, Any]], Any]] = {
    "no step": lambda made: made.update(step=0.0),
    "a step back": lambda made: made.update(step=-0.01),
    "a step that is no number": lambda made: made.update(step=math.nan),
    "a step without end": lambda made: made.update(step=math.inf),
    "a step that would take all memory": lambda made: made.update(step=1e-9),
    "half a target": lambda made: made["start_values"].pop("x_des[2]"),
    "half a gain": lambda made: made["start_values"].pop("Kp[2]"),
    "a target nowhere": lambda made: made["start_values"].update({"x_des[1]": math.nan}),
    "a target too far": lambda made: made["start_values"].update({"x_des[1]": 1e308}),
    "a target beyond": lambda made: made["start_values"].update({"x_des[1]": 10**400}),
    "a limit that is no number": lambda made: made["start_values"].update({"q_min[1]": math.nan}),
    "a change nowhere": lambda made: made["input_changes"].append([0.1, {"x_des[1]": math.inf}]),
    "a change at no time": lambda made: made["input_changes"].append([math.nan, {}]),
    "a change at the end of time": lambda made: made["input_changes"].append([math.inf, {}]),
    "a change of nothing": lambda made: made["input_changes"].append([0.1, {"y": 1.0}]),
    "no beginning": lambda made: made.update(start_time=math.nan, input_changes=[[0.1, {}]]),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("spoil", UNSOUND.values(), ids=list(UNSOUND))
def test_a_bag_whose_provenance_makes_no_sense_is_refused(
    spoil: Callable[[dict[str, Any]], Any], default: Recording
) -> None:
    run = twodof.read_bag(default.bag)
    made = copy.deepcopy(run.provenance)
    spoil(made)
    with pytest.raises(TwoDofError, match=r"^the run.json in '.*Kp50' does not fit its samples$"):
        plot(replace(run, provenance=made))


def test_a_bag_whose_robot_makes_no_sense_is_refused(default: Recording) -> None:
    run = twodof.read_bag(default.bag)
    for spoilt, message in (
        ({"urdf": "<robot/>"}, "the URDF in '.*Kp50': "),
        ({"axes": "xq"}, "the URDF in '.*Kp50': axes 'xq'"),
        ({"frame": "hand"}, "the URDF in '.*Kp50': no frame 'hand'"),
    ):
        with pytest.raises(PlotError, match=message):
            plot(replace(run, provenance={**run.provenance, **spoilt}))


def test_what_else_is_wrong_is_named(
    default: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    drawn = drawing(read_tracks([default.bag]))
    Path("folder.png").mkdir()
    Path("file").touch()
    for output, message in {
        "a.jpg": "'a.jpg': the name of a plot ends in .png, .svg, .pdf or .html",
        "a": "'a': the name of a plot ends in",
        ".png": "'.png': the name of a plot ends in",
        "gone/a.png": "cannot write 'gone/a.png': No such file or directory",
        "file/a.png": "cannot write 'file/a.png': Not a directory",
        "folder.png": "cannot write 'folder.png': Is a directory",
    }.items():
        with pytest.raises(PlotError, match=f"^{re.escape(message)}"):
            save(drawn, output)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.png"]
    with pytest.raises(PlotError, match=r"^cannot read the URDF 'gone\.urdf': No such file"):
        plot(default.bag, urdf="gone.urdf")
    none = elsewhere(tmp_path / "bag", ["a"], np.zeros(2), np.zeros((2, 0)), None)
    with pytest.raises(PlotError, match=r"'.*bag' has 0 positions for 1 joints"):
        plot(none)
    with pytest.raises(TwoDofError, match="gone"):
        plot("gone")
    assert file_kind("x/y.HTML") == "html"


def test_without_matplotlib_it_says_what_to_install() -> None:
    code = "import sys; sys.modules['matplotlib'] = None; import twodof.plots.runs"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=ENVIRONMENT, timeout=60
    )
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("twodof.errors.PlotError: cannot plot: ")
    assert last.endswith("install the package 'matplotlib' (the extra 'view')")


def test_figures_alone_import_matplotlib() -> None:
    importing = {
        path.parent.name
        for path in (Path(twodof.__file__).parent).rglob("*.py")
        if re.search(r"^\s*(import|from) matplotlib", path.read_text("utf-8"), re.MULTILINE)
    }
    assert importing == {"plots"}


# --- the command ---

COMMAND = [sys.executable, "-m", "twodof"]


def test_the_command_says_where_the_plot_is_and_what_came_out(
    gains: dict[int, Recording], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["plot", str(gains[50].bag)]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"plot  Kp50\.png \(\d+ KB\)", printed[0])
    assert re.fullmatch(r"Kp50  0\.000224 m from its target at the end; .*", printed[1])
    assert main(["plot", str(gains[20].bag), str(gains[50].bag), "-o", "both.html"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in printed] == ["plot", "Kp = 20 s⁻²", "Kp = 50 s⁻²"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["Kp50.png", "both.html"]


def test_the_command_takes_a_urdf_and_a_frame(
    foreign: Path, ur5: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ur5.urdf").write_text(ur5)
    options = ["--urdf", "ur5.urdf", "--frame", "forearm_link"]
    assert main(["plot", str(foreign), *options, "-o", "a.svg"]) == 0
    assert capsys.readouterr().out.startswith("plot  a.svg (")


def test_the_command_fails_in_one_line(
    default: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    for arguments, message in (
        (["gone", "-o", "a.jpg"], "'a.jpg': the name of a plot ends in"),  # before bags are read
        ([str(default.bag), "-o", "gone/a.png"], "cannot write 'gone/a.png'"),
        ([str(default.bag), "--urdf", "gone"], "cannot read the URDF 'gone'"),
        (["gone"], "'gone'"),
    ):
        assert main(["plot", *arguments]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("twodof: error: ")
        assert message in line
    assert list(tmp_path.iterdir()) == []


LIBRARIES = """
import matplotlib
matplotlib.use("agg")
import matplotlib.pyplot as plt, scipy.spatial.transform, rosbags.rosbag2, rosbags.typesys
rosbags.typesys.get_typestore(rosbags.typesys.Stores.ROS2_HUMBLE)
figure, axes = plt.subplots(2, 2)
figure.savefig("empty.png")
"""


def test_the_command_is_quick(default: Recording, tmp_path: Path) -> None:
    """Twice what its libraries take to be imported and to draw nothing, fonts searched for."""

    def spent(name: str, command: list[Any]) -> float:
        environment = {**ENVIRONMENT, "MPLCONFIGDIR": str(tmp_path / name)}
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(
            command, cwd=tmp_path, env=environment, check=True, timeout=120, capture_output=True
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    least = spent("libraries", [sys.executable, "-c", LIBRARIES])
    assert spent("command", [*COMMAND, "plot", default.bag]) < 2.0 * least
