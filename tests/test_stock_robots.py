"""All robots of example-robot-data: their generated C compiles, and the documentation lists them."""

from __future__ import annotations

import re
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pinocchio as pin
from native_models import ROOT, Engine, from_urdf, model, robots_folder
from tools import needs

from twodof.export.compiler import UNITS
from twodof.plant.urdf import RobotError

TABLE = re.compile(r"^\| ([^|]+\.urdf[^|]*) \| ", re.M)


def listed(part: str) -> set[str]:
    """URDFs in a table of docs/robots.md."""
    text = (ROOT / "docs" / "robots.md").read_text("utf-8")
    text = text.split(f"## {part}\n")[1].split("\n## ")[0]
    return {name for cell in TABLE.findall(text) for name in cell.split(", ")}


def test_every_stock_robot_is_refused_or_becomes_c_that_compiles(tmp_path: Path) -> None:
    command = [needs("gcc"), "-std=c99", "-fsyntax-only", "-Wall", "-Wextra", "-pedantic", "-Werror", *UNITS]
    refused, compiled = set(), []

    def compile_one(name: str, sources: dict[str, bytes]) -> tuple[str, str]:
        folder = tmp_path / name.replace("/", "-")
        folder.mkdir()
        for file, content in sources.items():
            (folder / file).write_bytes(content)
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        return name, done.stderr[:500]

    with ThreadPoolExecutor(2) as pool:
        for path in sorted(robots_folder().rglob("*.urdf")):
            name = str(path.relative_to(robots_folder()))
            try:
                sources = model(name).sources()
            except (RobotError, IndexError):  # IndexError: there is no joint
                refused.add(name)
            else:
                compiled.append(pool.submit(compile_one, name, sources))
    errors = dict(done.result() for done in compiled)
    assert not {name: error for name, error in errors.items() if error}
    assert refused == listed("Refused") and errors.keys() == listed("Built")


LINK = (
    '<link name="{}"><inertial><origin xyz="0.1 0.02 0"/><mass value="1"/><inertia ixx="0.01"'
    ' ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial></link>'
)
JOINT = (
    '<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/><axis xyz="{}"/>'
    '<origin xyz="0.3 0 0.1"/><limit lower="-2" upper="2" effort="5" velocity="1"/>{}</joint>'
)


def test_joints_that_share_an_angle() -> None:
    parts = [LINK.format(name) for name in "abc"]
    parts.append(JOINT.format("lead", "a", "b", "0 0 1", ""))
    parts.append(JOINT.format("copy", "b", "c", "0 0 1", '<mimic joint="lead" multiplier="1"/>'))
    of = from_urdf(f'<robot name="pair">{"".join(parts)}</robot>', "c", "xyz")
    engine, own = Engine(of), of.robot.model
    data = own.createData()
    for angle in np.linspace(-2.0, 2.0, 9):
        pin.framesForwardKinematics(own, data, np.array([angle, angle]))
        position, _, _ = engine.task(np.array([angle]), np.array([0.0]))
        expected = data.oMf[of.robot.frame_id].translation
        np.testing.assert_allclose(position, expected, rtol=0.0, atol=1e-14)
