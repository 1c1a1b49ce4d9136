"""Stock robots with unchanged URDFs: locked joints, last links, missing meshes, impossible inertias."""

from __future__ import annotations

import logging
import re
import zipfile
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

import twodof
from twodof.cli.main import main
from twodof.export.fmu_options import FmuOptions
from twodof.export.package import build_fmu
from twodof.export.urdf_source import end_effector, lock_joints, without_meshes
from twodof.files import data_file
from twodof.plant.robot import load_robot
from twodof.plant.urdf import RobotError, read_urdf


@pytest.fixture(scope="module")
def panda_file(robots: Path) -> Path:
    return robots / "panda_description/urdf/panda.urdf"


@pytest.mark.parametrize("locks", [{"panda_joint7": 0.7}, {"panda_joint[24]": -0.5}, {"*": 0.0, "panda_joint4": -1.0}])
def test_locked_joints_are_pinocchios_reduced_model(panda_file: Path, locks: dict[str, float]) -> None:
    """M, h and the frame's position agree; the fingers, one of which mimics the other, are always locked."""
    text = panda_file.read_text()
    full = pin.buildModelFromXML(text)
    positions = {"panda_finger_joint?": 0.02}
    if "*" in locks:
        positions |= {f"panda_joint{i}": 0.0 for i in (1, 2, 3, 5, 6)}
        positions["panda_joint4"] = locks["panda_joint4"]
    else:
        positions |= locks
    robot = load_robot(lock_joints(text, positions), "panda_hand_tcp", "xyz")
    held = [name for name in list(full.names)[1:] if name not in robot.joints]
    q0 = pin.neutral(full)
    for name in held:
        (value,) = {v for pattern, v in positions.items() if Path(name).match(pattern)}
        q0[full.joints[full.getJointId(name)].idx_q] = value
    reduced = pin.buildReducedModel(full, [full.getJointId(name) for name in held], q0)
    assert robot.joints == tuple(reduced.names)[1:]
    data, ours = reduced.createData(), robot.model.createData()
    rng = np.random.default_rng(1)
    for _ in range(20):
        q, v, a = (rng.normal(size=reduced.nv) for _ in "qva")
        expected = pin.rnea(reduced, data, q, v, a)
        np.testing.assert_allclose(pin.rnea(robot.model, ours, q, v, a), expected, atol=1e-11)
        pin.framesForwardKinematics(reduced, data, q)
        pin.framesForwardKinematics(robot.model, ours, q)
        place = data.oMf[reduced.getFrameId("panda_hand_tcp")].translation
        np.testing.assert_allclose(ours.oMf[robot.frame_id].translation, place, atol=1e-12)


MIMIC = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1"/></joint><joint name="k" type="prismatic"><parent link="b"/>
<child link="c"/><axis xyz="1 0 0"/><limit lower="-1" upper="1"/>
<mimic joint="j" multiplier="{factor}" offset="0.1"/></joint></robot>"""


@pytest.mark.parametrize("control", ["task", "joint", "effort"])
def test_a_joint_of_the_shipped_arm_is_locked(control: str, tmp_path: Path) -> None:
    options = twodof.FmuOptions(native=True, control=control, lock={"joint1": 0.3})
    summary = twodof.simulate(twodof.build_fmu(tmp_path / "one.fmu", options), stop_time=0.1)
    assert len(summary.last.q) == 1 and (control == "effort" or summary.last.q[0] == 0.35)


def test_the_mimic_of_a_locked_joint_is_locked_at_the_matching_position() -> None:
    joints = read_urdf(lock_joints(MIMIC.format(factor=0.5), {"j": 0.4})).joints
    assert {joint.type for joint in joints.values()} == {"fixed"}
    assert joints["j"].rpy == pytest.approx((0, 0, 0.4), abs=1e-15)
    assert joints["k"].xyz == pytest.approx((0.3, 0.0, 0.0))


@pytest.mark.parametrize(
    ("factor", "lock", "message"),
    [
        ("abc", "j", "'k': its <mimic> has a factor or offset that is not a number"),
        ("nan", "j", "'k': its <mimic> has"),
        ("1_0", "j", "'k': its <mimic> has"),
        ("2", "k", "'k' mimics 'j', which moves: lock 'j'"),
    ],
)
def test_a_mimic_that_cannot_be_followed_is_refused(factor: str, lock: str, message: str) -> None:
    with pytest.raises(RobotError, match=message):
        lock_joints(MIMIC.format(factor=factor), {lock: 0.3})


@pytest.mark.parametrize(
    ("locks", "message"),
    [
        ({"elbow": 0.0}, r"no joint 'elbow' to lock; there are: joint1, joint2"),
        ({"joint1": 4.0}, r"joint 'joint1' cannot be locked at 4: its limits are"),
    ],
)
def test_a_lock_that_cannot_be_is_refused(locks: dict[str, float], message: str) -> None:
    with pytest.raises(twodof.TwoDofError, match=message):
        build_fmu(None, FmuOptions(lock=locks))


def test_of_several_last_links_one_must_be_named(panda_file: Path) -> None:
    with pytest.raises(RobotError, match=r"`frame`; last links are: panda_.*; other links are: "):
        end_effector(read_urdf(panda_file.read_text()), None)


def test_a_mesh_that_is_not_there_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    shipped = data_file("urdf", "2dof.urdf")
    text = shipped.read_text().replace("link1.stl", "gone.stl")
    (tmp_path / "arm.urdf").write_text(text.replace("link2.stl", "lost.stl"))
    with caplog.at_level(logging.WARNING, "twodof"):
        path = build_fmu(tmp_path / "arm.fmu", FmuOptions(urdf=tmp_path / "arm.urdf"))
    (record,) = caplog.records
    assert "meshes are left out" in record.getMessage() and "gone.stl" in record.getMessage()
    twodof.simulate(path, twodof.Bag(tmp_path / "bag", scene=True), stop_time=0.05)
    assert len(twodof.read_bag(tmp_path / "bag").t) == 6


def test_meshes_can_be_left_out(tmp_path: Path) -> None:
    path = build_fmu(tmp_path / "arm.fmu", FmuOptions(meshes=False))
    with zipfile.ZipFile(path) as archive:
        assert not [name for name in archive.namelist() if name.startswith("resources/meshes")]
        assert b"<mesh" not in archive.read("resources/robot.urdf")


def test_inertias_that_no_body_has_are_named_in_one_line() -> None:
    shipped = data_file("urdf", "2dof.urdf").read_text()
    robot = load_robot(re.sub(r'izz="[^"]*"', 'izz="1.0"', shipped), "EndEffector", "xy")
    (line,) = robot.warnings
    assert "'link1', 'link2'" in line and "used unchanged" in line


def test_a_urdf_is_run_by_one_command(
    robots: Path, panda_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They have one last link, which is controlled; for others, `build` names the missing option."""
    monkeypatch.chdir(tmp_path)
    xarm = robots / "xarm_description/urdf/xarm7.urdf"
    assert main(["run", str(xarm), "-o", "bag", "--stop-time", "0.1"]) == 0
    assert twodof.load_fmu("xarm7.fmu").frame == "link_eef"
    options = ["--no-meshes", "--frame", "panda_hand_tcp", "--lock", "panda_finger*"]
    assert main(["build", str(panda_file), *options, "-o", "panda.fmu"]) == 0
    assert main(["run", "panda.fmu", "-o", "bag2", "--stop-time", "0.1"]) == 0
    assert len(twodof.read_bag("bag2").joints) == 7


def test_a_urdf_of_several_ends_is_run_by_one_command_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The option in the message exists."""
    monkeypatch.chdir(tmp_path)
    arm = without_meshes(data_file("urdf", "2dof.urdf").read_text()).replace("EndEffector", "tip")
    side = '<link name="side"/><joint name="fork" type="fixed"><parent link="link1"/>'
    Path("fork.urdf").write_text(arm.replace("</robot>", f'{side}<child link="side"/></joint></robot>'))
    command = ["run", "fork.urdf", "--native", "-o", "bag", "--stop-time", "0.1"]
    assert main(command) == 1
    assert "name the controlled link with --frame" in capsys.readouterr().err
    assert main([*command, "--frame", "tip"]) == 0
    assert twodof.load_fmu("fork-native.fmu").frame == "tip"
    assert main(["page", "fork.urdf", "--frame", "tip", "-o", "fork.html"]) == 0
    for fmu in (["fork-native.fmu"], []):
        assert main(["run", *fmu, "--frame", "tip", "-o", "none"]) != 0
        assert "--frame applies to a URDF; name one, or leave it out" in capsys.readouterr().err


BALL = """<robot name="top"><link name="base"/><link name="a"/><link name="b"/><link name="top">
<inertial><mass value="2"/><inertia ixx="0.2" ixy="0" ixz="0" iyy="0.3" iyz="0" izz="0.4"/>
</inertial></link>{}</robot>""".format(
    "".join(
        f'<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/></joint>'
        for name, parent, child, axis in (
            ("z", "base", "a", "0 0 1"),
            ("y", "a", "b", "0 1 0"),
            ("x", "b", "top", "1 0 0"),
        )
    )
)


@pytest.mark.parametrize("native", [False, True], ids=["python", "native"])
def test_links_without_mass_make_a_ball_joint(native: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A body that rotates about its centre without torque keeps its angular momentum."""
    (tmp_path / "top.urdf").write_text(BALL)
    options = FmuOptions(urdf=tmp_path / "top.urdf", control="effort", native=native)
    fmu = build_fmu(tmp_path / "top.fmu", options)
    assert "moving links have no mass: 'a', 'b'" in caplog.text
    settings = {"v_start": (1.0, 0.3, 2.0), "rtol": 1e-11, "atol": 1e-13}
    momenta = []
    for sample in twodof.samples(fmu, stop_time=2.0, settings=settings):
        turns = Rotation.from_euler("ZYX", sample.q)
        z, y = Rotation.from_euler("Z", sample.q[0]), Rotation.from_euler("ZY", sample.q[:2])
        axes = np.column_stack([[0, 0, 1], z.apply([0, 1, 0]), y.apply([1, 0, 0])])
        inertia = turns.as_matrix() @ np.diag([0.2, 0.3, 0.4]) @ turns.as_matrix().T
        momenta.append(inertia @ axes @ sample.v)
    assert np.ptp(np.array(sample.q)) > 1.0
    np.testing.assert_allclose(momenta, [momenta[0]] * len(momenta), atol=1e-9)
