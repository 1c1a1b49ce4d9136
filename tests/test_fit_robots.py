"""Fits to recordings by MuJoCo of robots of example-robot-data with hidden masses, friction and payload."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from motions import assert_true, bag_of, move, mujoco_model, noisy
from native_models import robots_folder

import twodof
from twodof.plant.robot import load_robot

UR5 = robots_folder() / "ur_description" / "urdf" / "ur5_robot.urdf"
PANDA = robots_folder() / "panda_description" / "urdf" / "panda.urdf"
XARM7 = robots_folder() / "xarm_description" / "urdf" / "xarm7.urdf"
# URDF, end effector, home, locked joints; friction, damping and armature of the joints
ARMS: dict[str, tuple[Path, str, list[float], dict[str, float], list[list[float]]]] = {
    "UR5": (UR5, "tool0", [0, -1.2, 1.2, -0.5, 0.3, 0], {},
        [[6, 8, 4, 1.5, 1, 1], [4, 5, 3, 0.5, 0.4, 0.3], [0.6, 0.6, 0.4, 0.1, 0.1, 0.1]]),
    "Panda": (PANDA, "panda_hand_tcp", [0, -0.6, 0, -1.9, 0, 1.6, 0.7], {"panda_finger_joint*": 0.0},
        [[2.5, 3, 2, 2, 1, 1, 0.8], [1.5, 1.5, 1, 1, 0.4, 0.4, 0.3], [0.3, 0.3, 0.2, 0.2, 0.08, 0.08, 0.05]]),
    "xArm7": (XARM7, "link7", [0, -0.3, 0, 0.9, 0, 1, 0], {},
        [[4, 5, 3, 3, 1.5, 1, 0.8], [3, 3, 2, 2, 0.8, 0.5, 0.4], [0.5, 0.5, 0.3, 0.3, 0.08, 0.08, 0.05]]),
}  # fmt: skip


def without_fingers(text: str) -> str:
    """A URDF whose finger joints are fixed at 0."""
    root = ET.fromstring(text)
    for joint in root.iter("joint"):
        if "finger" in joint.attrib["name"]:
            joint.set("type", "fixed")
    return ET.tostring(root, encoding="unicode")


@pytest.mark.parametrize("name", ARMS)
def test_friction_armature_and_payload_of_an_arm_are_found(name, tmp_path):
    urdf, end, home, lock, hidden = ARMS[name]
    groups = dict(zip(("friction", "damping", "armature"), hidden))
    model = mujoco_model(without_fingers(urdf.read_text("utf-8")), payload=1.5, end=end, **groups)
    joints = [model.joint(i).name for i in range(model.njnt)]
    bag = bag_of(tmp_path / "bag", joints, *noisy(move(model, home, 0.9, 60.0)))
    result = twodof.fit(urdf, bag, (*(f"{group}[*]" for group in groups), "payload"), lock=lock, frame=end)
    truth = {f"{group}[{i + 1}]": value for group, values in groups.items() for i, value in enumerate(values)}
    assert_true(result, {**truth, "payload": 1.5})
    assert result.explains and all(p.deviation < 0.05 * p.after for p in result.parameters)


def changed_links(text: str, rng: np.random.Generator) -> str:
    """A URDF with other masses, centres and inertias, which are physically possible."""
    root = ET.fromstring(text)
    for inertial in root.iterfind("link/inertial"):
        factor = rng.uniform(0.8, 1.25)
        mass, origin, tensor = (inertial.find(tag).attrib for tag in ("mass", "origin", "inertia"))  # type: ignore[union-attr]
        mass["value"] = repr(factor * float(mass["value"]))
        place = np.array(origin["xyz"].split(), float) + rng.uniform(-0.02, 0.02, 3)
        origin["xyz"] = " ".join(map(repr, place.tolist()))
        for key in tensor:
            tensor[key] = repr(factor * float(tensor[key]))
    return ET.tostring(root, encoding="unicode")


def test_all_masses_of_a_ur5_that_can_be_seen_are_found(tmp_path):
    text = UR5.read_text("utf-8")
    truth = changed_links(text, np.random.default_rng(2))
    friction = [6.0, 8.0, 4.0, 1.5, 1.0, 1.0]
    motion = move(mujoco_model(truth, friction=friction), [0, -1.2, 1.2, -0.5, 0.3, 0], 0.9, 30.0)
    robot = load_robot(text, "tool0", "xyz")
    bag = bag_of(tmp_path / "bag", robot.joints, *noisy(motion))
    result = twodof.fit(UR5, bag, ("mass:*", "com:*", "inertia:*", "friction[*]"), output=tmp_path / "fitted")
    assert result.explains and result.unseen
    summary = next(line for line in result.remarks if "do not determine" in line)
    assert f"fit.json lists {len(result.unseen) - 5} more combinations" in summary and len(summary) < 600
    assert not any(p.known for p in result.parameters if p.name.startswith("mass:shoulder_link"))
    for p in result.parameters:
        if p.name.startswith("friction"):
            assert abs(p.after - friction[int(p.name[9]) - 1]) <= 3.0 * p.deviation

    # efforts at random states are those of the truth, within what the fit says of its parameters
    names = [p.name for p in result.parameters if not p.name.startswith("friction")]
    values = np.array([p.after for p in result.parameters if p.name in names])
    count = len(names)
    covariance = result.covariance[-count:, -count:]
    rng, exact = np.random.default_rng(5), load_robot(truth, "tool0", "xyz").model
    states = [rng.uniform(-1.0, 1.0, (3, 6)) for _ in range(30)]
    steps = 1e-5 * np.eye(count)
    rates = (efforts(robot, names, values + s, states) - efforts(robot, names, values - s, states) for s in steps)
    J = np.array([rate / 2e-5 for rate in rates]).T
    exact_efforts = np.concatenate([pin.rnea(exact, exact.createData(), *state) for state in states])
    seen = np.linalg.svd(J * np.sqrt(np.diag(covariance)), full_matrices=False)
    directions = seen[0].T[: np.linalg.matrix_rank(J, 1e-6)]
    deviations = np.sqrt(np.diag(directions @ J @ covariance @ J.T @ directions.T))
    given = np.array([p.before for p in result.parameters if p.name in names])
    far, far_before = (
        np.abs(directions @ (efforts(robot, names, each, states) - exact_efforts)) / deviations
        for each in (values, given)
    )
    assert far.max() <= 3.5
    assert np.sum(far_before > 3.5) >= 12  # the comparison is sharp: it refuses the URDF from before the fit

    urdf = tmp_path / "fitted" / "robot.urdf"
    fmu = twodof.build_fmu(tmp_path / "fitted.fmu", twodof.FmuOptions(urdf, frame="tool0", meshes=False))
    assert twodof.simulate(fmu, stop_time=0.1).last.q == pytest.approx([0.0] * 6, abs=1e-6)
    fitted = load_robot(urdf.read_text("utf-8"), "tool0", "xyz").model
    for _ in range(200):
        M = pin.crba(fitted, fitted.createData(), rng.uniform(-3.0, 3.0, 6))
        assert np.linalg.eigvalsh(np.triu(M) + np.triu(M, 1).T)[0] > 0.0


def test_a_hidden_spring_of_a_ur5_is_reported_with_its_joint(tmp_path):
    """Its stiffness is 5 N·m/rad; the largest load of its joint is some 20 N·m."""
    text = UR5.read_text("utf-8")
    robot, friction = load_robot(text, "tool0", "xyz"), [6.0, 8.0, 4.0, 1.5, 1.0, 1.0]
    model = mujoco_model(text, friction=friction, stiffness=[0.0, 0.0, 5.0, 0.0, 0.0, 0.0])
    bag = bag_of(tmp_path / "bag", robot.joints, *noisy(move(model, [0, -1.2, 1.2, -0.5, 0.3, 0], 0.9, 20.0)))
    result = twodof.fit(UR5, bag, ("friction[*]", "damping[*]", "payload"), frame="tool0")
    assert not result.explains
    assert any("does not explain" in line and "'elbow_joint'" in line for line in result.remarks)
    assert result.suspects[0].name == "spring:elbow_joint"
    assert result.suspects[0].size == pytest.approx(5.0, rel=0.05)


def efforts(robot: Any, names: list[str], values: np.ndarray, states: list[np.ndarray]) -> np.ndarray:
    """Efforts at states of links with given masses, centres and inertias."""
    model, given = robot.model.copy(), dict(zip(names, values))
    for joint in range(1, model.njoints):
        model.inertias[joint].setZero()
    for link in {name.partition(":")[2].partition(".")[0] for name in names}:
        frame = model.frames[model.getFrameId(link, pin.FrameType.BODY)]
        com = np.array([given[f"com:{link}.{axis}"] for axis in "xyz"])
        xx, xy, xz, yy, yz, zz = (given[f"inertia:{link}.{k}"] for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        own = frame.placement.act(pin.Inertia(given[f"mass:{link}"], com, tensor))
        model.inertias[frame.parentJoint] = model.inertias[frame.parentJoint] + own
    return np.concatenate([pin.rnea(model, model.createData(), *state) for state in states])
