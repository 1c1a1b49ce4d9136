"""Robots by name, of example-robot-data and the cache of robot_descriptions, with end effector and home pose."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import twodof
from twodof.cli.main import main
from twodof.export.stock_robots import stock_robots
from twodof.files import data_file


@pytest.mark.parametrize(
    ("name", "srdf", "pose", "frame"),
    [("panda", "panda", "default", "panda_hand_tcp"), ("z1", "z1", "home", ""), ("quadruped", "", "", "")],
)
def test_a_robot_has_its_home_pose_as_pinocchio_reads_it(name, srdf, pose, frame, tmp_path):
    path = stock_robots()[name]
    model = pin.buildModelFromUrdf(str(path), mimic=True)
    q = pin.neutral(model)
    if srdf:
        pin.loadReferenceConfigurations(model, str(path.parents[1] / f"srdf/{srdf}.srdf"))
        q = model.referenceConfigurations[pose]
    fmu = twodof.load_fmu(twodof.build_fmu(tmp_path / "robot.fmu", replace(twodof.stock_robot(name), meshes=False)))
    assert fmu.frame == (frame or fmu.frame) and fmu.frame in [f.name for f in model.frames]
    starts = [fmu.start_values[name] for name in fmu.vector("q_start")]
    for joint, start in zip(fmu.joints, starts):
        assert start == pytest.approx(q[model.joints[model.getJointId(joint)].idx_q], abs=1e-12), joint


@pytest.mark.parametrize(
    ("name", "frame"),
    [
        ("tiago_no_hand", "wrist_ft_tool_link"),
        ("tiago", "hand_tool_link"),
        ("anymal-kinova", "j2s6s200_end_effector"),
        ("b1-z1", "gripperMover"),
        ("so101", "gripper_frame_link"),
        ("ur10_robot", "tool0"),
        ("human", "left_hand"),
    ],
)
def test_the_end_effector_is_neither_a_wheel_nor_a_foot_of_a_robot_with_an_arm(name, frame):
    assert twodof.stock_robot(name).frame == frame


@pytest.mark.parametrize("name", ["ur3_robot", "ur5_joint_limited_robot", "ur10_robot"])
def test_an_arm_of_universal_robots_does_not_start_in_a_singular_pose(name):
    options = twodof.stock_robot(name)
    model = pin.buildModelFromUrdf(str(options.urdf))
    assert isinstance(options.q_start, dict) and options.frame
    ratios = []
    for home in ({}, options.q_start):
        q = np.array([home.get(joint, 0.0) for joint in model.names[1:]])
        frame = model.getFrameId(options.frame)
        sigma = np.linalg.svd(pin.computeFrameJacobian(model, model.createData(), q, frame), compute_uv=False)
        ratios.append(sigma[-1] / sigma[0])
    assert ratios[0] < 1e-3 and ratios[1] > 0.03, ratios


def test_a_panda_by_name_has_its_meshes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["build", "--robot", "panda"]) == 0
    fmu = twodof.load_fmu("panda.fmu")
    assert len([name for name in fmu.members if name.endswith(".dae")]) == 10


def test_a_panda_with_fixed_fingers_has_the_home_pose_of_its_arm(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["build", "--robot", "panda", "--lock", "*finger*", "--no-meshes", "-o", "fixed.fmu"]) == 0
    free, fixed = (
        twodof.load_fmu(twodof.build_fmu(f"{i}.fmu", replace(robot, meshes=False)))
        for i, robot in enumerate((twodof.stock_robot("panda"), twodof.stock_robot("panda", {"*finger*": 0.02})))
    )
    assert twodof.load_fmu("fixed.fmu").joints == fixed.joints == free.joints[:7]
    for fmu in (twodof.load_fmu("fixed.fmu"), fixed):
        assert [fmu.start_values[f"q_start[{i}]"] for i in range(1, 8)] == [
            free.start_values[f"q_start[{i}]"] for i in range(1, 8)
        ]


def test_the_cache_of_robot_descriptions_is_listed(tmp_path, monkeypatch, capsys):
    for package in ("left", "right"):
        (tmp_path / package / "urdf").mkdir(parents=True)
        shutil.copy(Path(__file__).parents[1] / "urdf/2dof.urdf", tmp_path / package / "urdf/arm.urdf")
    shutil.copy(tmp_path / "left/urdf/arm.urdf", tmp_path / "left/urdf/single.urdf")
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path))
    assert main(["build", "--list-robots"]) == 0
    listed = dict(line.split() for line in capsys.readouterr().out.splitlines())
    assert {"left/arm", "right/arm", "single", "panda"} <= {*listed} and "arm" not in listed
    assert listed["right/arm"] == str(tmp_path / "right/urdf")
    assert twodof.stock_robot("single").frame == "EndEffector"


def test_an_empty_list_of_robots_names_the_remedy(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path))
    monkeypatch.setattr("twodof.export.stock_robots.PACKAGE", "no-such-package")
    assert main(["build", "--list-robots"]) == 1
    assert "there are no installed robots; pip install example-robot-data" in capsys.readouterr().err


def test_a_robot_that_is_unknown_is_refused(capsys):
    assert main(["build", "--robot", "pandda"]) == 1
    assert "there is no robot 'pandda'; did you mean 'panda'?" in capsys.readouterr().err
    with pytest.raises(twodof.TwoDofError, match="no robot 'ur5'; did you mean 'ur5_robot'"):
        twodof.stock_robot("ur5")
    assert main(["build", "arm.urdf", "--robot", "panda"]) == 2
    with pytest.raises(twodof.TwoDofError, match="q_start: there is no joint 'joint3'; did you mean 'joint2'"):
        twodof.build_fmu("new.fmu", twodof.FmuOptions(q_start={"joint3": 1.0}))


def test_a_home_pose_outside_of_the_limits_is_the_same_pose_within_them():
    path, home = stock_robots()["kinova"], twodof.stock_robot("kinova").q_start
    assert isinstance(home, dict)
    model = pin.buildModelFromUrdf(str(path))
    pin.loadReferenceConfigurations(model, str(path.parents[1] / "srdf/kinova.srdf"))
    reference = model.referenceConfigurations["arm_up"]
    q = reference.copy()
    for name, value in home.items():
        joint = model.joints[model.getJointId(name)]
        q[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
    assert (model.lowerPositionLimit <= q).all() and (q <= model.upperPositionLimit).all()
    assert not (model.lowerPositionLimit <= reference).all()
    placements = []
    for each in (q, reference):
        data = model.createData()
        pin.forwardKinematics(model, data, each)
        placements.append(np.array(data.oMi[model.njoints - 1]))
    np.testing.assert_allclose(placements[0], placements[1], atol=1e-12)


@pytest.mark.parametrize("text", ["<!DOCTYPE robot><robot/>", f"<robot>{'<a>' * 600}{'</a>' * 600}</robot>", "<srdf/>"])
def test_an_srdf_is_read_as_a_urdf_is(text, tmp_path, monkeypatch):
    """Without entities, and with limits."""
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path))
    for folder, suffix in (("robots", "urdf"), ("srdf", "srdf")):
        (tmp_path / f"arm/{folder}").mkdir(parents=True)
        (tmp_path / f"arm/{folder}/my_arm.{suffix}").write_text(text)
    shutil.copy(data_file("urdf", "2dof.urdf"), tmp_path / "arm/robots/my_arm.urdf")
    with pytest.raises(twodof.TwoDofError, match=r"my_arm.srdf': the SRDF"):
        twodof.stock_robot("my_arm")
