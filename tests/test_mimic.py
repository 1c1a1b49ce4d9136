"""Joints that mimic others, against Pinocchio's own mimic joints and against reductions by hand."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

import twodof
from twodof import FmuOptions
from twodof.geometry.kinematics import Kinematics
from twodof.plant.mechanism import Mechanism
from twodof.plant.robot import load_robot
from twodof.plant.urdf import read_urdf

PANDA = "panda_description/urdf/panda.urdf"
# Talos is left out: Pinocchio's reader wants a leader's joint before those that follow
WITH_MIMIC = {
    PANDA: "panda_rightfinger",
    "baxter_description/urdf/baxter.urdf": "l_gripper_r_finger",
    "pr2_description/urdf/pr2.urdf": "r_gripper_r_finger_tip_link",
    "tiago_pro_description/robots/tiago_pro.urdf": "gripper_left_fingertip_left_link",
}
IDS = [Path(name).stem for name in WITH_MIMIC]
DOWN = (0.3, -2.0, -9.81)


def own_model(robots: Path, name: str) -> pin.Model:
    """Pinocchio's model, whose mimic joints have no velocity of their own, with angles instead of cos and sin."""
    tree = ET.parse(robots / name)
    for joint in tree.iter("joint"):
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")
            if joint.find("limit") is None:
                ET.SubElement(joint, "limit", effort="1", velocity="1")
    return pin.buildModelFromXML(ET.tostring(tree.getroot(), encoding="unicode"), mimic=True)


@pytest.mark.parametrize(("name", "frame"), WITH_MIMIC.items(), ids=IDS)
def test_dynamics_are_those_of_pinocchios_mimic_joints(robots: Path, name: str, frame: str) -> None:
    robot = load_robot((robots / name).read_text(), frame, "xyz")
    own = own_model(robots, name)
    own.gravity.linear = np.array(DOWN)
    data, mechanism = own.createData(), Mechanism(robot, DOWN, 0.0, (0.0,) * 3, (0.0,) * len(robot.joints))
    ours = [own.joints[own.getJointId(joint)].idx_v for joint in robot.joints]
    assert len(robot.joints) == own.nv < robot.model.nv
    rng = np.random.default_rng(1)
    for _ in range(20):
        q, v, a = (rng.normal(size=own.nv) for _ in "qva")
        M = pin.crba(own, data, q)
        M = np.triu(M) + np.triu(M, 1).T
        h = pin.rnea(own, data, q, v, np.zeros(own.nv))
        mass_matrix = mechanism.mass_matrix(q[ours])
        np.testing.assert_allclose(mass_matrix, M[np.ix_(ours, ours)], atol=1e-11 * abs(M).max())
        tau = mechanism.inverse_dynamics(q[ours], v[ours], a[ours])
        bound = 1e-11 * max(abs(h).max(), abs(tau).max())
        np.testing.assert_allclose(tau, (M @ a + h)[ours], atol=bound)
        back = mechanism.forward_dynamics(q[ours], v[ours], tau)
        np.testing.assert_allclose(back, a[ours], rtol=1e-9, atol=1e-9)


HAND = """<robot name="hand"><link name="base"/><link name="a"><inertial><origin xyz="0.1 0 0"/>
<mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
</link><link name="b"><inertial><mass value="2"/><inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02"
iyz="0" izz="0.02"/></inertial></link><link name="tip"><inertial><mass value="0.5"/><inertia
ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial></link>
<joint name="slide" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="1 0 0"/>
<origin xyz="0.2 0 0"/><limit lower="-0.3" upper="0.1" effort="5"/><dynamics damping="3"/>
<mimic joint="copy" multiplier="-0.5" offset="0.1"/></joint>
<joint name="copy" type="revolute"><parent link="b"/><child link="tip"/><axis xyz="0 0 1"/>
<limit lower="-9" upper="9"/><mimic joint="turn" multiplier="2" offset="-0.4"/></joint>
<joint name="turn" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="2" effort="7"/><dynamics damping="0.5"/></joint></robot>"""
"""A joint that turns; one that turns twice as far, -0.4; and one that slides by half of that."""


def test_a_mimic_of_a_mimic_follows_the_joint_that_moves() -> None:
    """slide = 0.1 - copy/2 = 0.3 - turn; its range, -0.3 to 0.1, limits turn to 0.2 to 0.6."""
    robot = load_robot(HAND, "tip", "xyz")
    assert (robot.joints, robot.prismatic, robot.effort) == (("turn",), (False,), (7.0,))
    assert (*robot.q_min, *robot.q_max) == pytest.approx((0.2, 0.6), abs=1e-15)
    assert robot.damping == pytest.approx((0.5 + 3.0,))
    rough = HAND.replace("<dynamics ", '<dynamics friction="0.25" ').replace(
        '<mimic joint="turn"', '<dynamics friction="2"/><mimic joint="turn"'
    )
    assert load_robot(rough, "tip", "xyz").friction == pytest.approx((0.25 + 0.25 + 2.0 * 2.0,))
    q, v = 0.35, 1.7
    mechanism = Mechanism(robot, (0.0, -9.81, 0.0), 0.0, (0.0,) * 3, (0.0,))
    place, J, drift = mechanism.observe(np.array([q]), np.array([v]))
    r, along, across = 0.5 - q, np.array([np.cos(q), np.sin(q)]), np.array([-np.sin(q), np.cos(q)])
    np.testing.assert_allclose(place[:2], r * along, atol=1e-15)
    turned = Rotation.from_rotvec([0.0, 0.0, q + 2.0 * q - 0.4]).as_matrix()
    np.testing.assert_allclose(mechanism.rotation, turned, atol=1e-15)
    np.testing.assert_allclose(np.ravel(J)[:2], r * across - along, atol=1e-15)
    assert J[5] == pytest.approx([3.0])
    expected = -2.0 * v**2 * across - r * v**2 * along
    np.testing.assert_allclose(drift[:2], expected, atol=1e-14)
    turning = 0.01 + 0.01 + 0.02 + 3.0**2 * 0.001  # a about its end, b, the tip thrice as fast
    M = turning + (2.0 + 0.5) * (r**2 + 1.0)
    assert mechanism.mass_matrix(np.array([q])) == pytest.approx(np.array([[M]]), rel=1e-14)


@pytest.mark.parametrize("native", [False, True], ids=["python", "native"])
def test_the_bag_of_either_flavour_moves_all_joints(tmp_path: Path, native: bool) -> None:
    """The robot swings freely; /tf has the transforms of mimic joints."""
    (tmp_path / "hand.urdf").write_text(HAND)
    options = FmuOptions(urdf=tmp_path / "hand.urdf", control="effort", native=native)
    fmu = twodof.build_fmu(tmp_path / "hand.fmu", options)
    settings = {"q_start": 0.3, "gravity": (0.0, -3.0, 0.0)}
    run = twodof.experiment(fmu, stop_time=0.5, settings=settings)
    twodof.simulate(run, twodof.Bag(tmp_path / "bag", scene=True))
    bag = twodof.read_bag(tmp_path / "bag")
    assert bag.joints == ("turn",) and np.ptp(bag.q) > 0.01
    q = bag.q[:, 0]
    tip = (0.5 - q)[:, None] * np.column_stack([np.cos(q), np.sin(q)])
    np.testing.assert_allclose(bag.x[:, :2], tip, atol=1e-14)
    placed: dict[str, list[tuple[float, float]]] = {"b": [], "tip": []}
    with (tmp_path / "bag/bag.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, _, _, message in reader.iter_decoded_messages(topics=["/tf"]):
            for found in message.transforms:
                if found.child_frame_id in placed:
                    turn, x = found.transform.rotation, found.transform.translation.x
                    placed[found.child_frame_id].append((x, 2.0 * np.arctan2(turn.z, turn.w)))
    np.testing.assert_allclose(np.array(placed["b"])[:, 0], 0.5 - q, atol=1e-14)
    np.testing.assert_allclose(np.array(placed["tip"])[:, 1], 2.0 * q - 0.4, atol=1e-14)


@pytest.mark.parametrize("control", ["task", "effort"])
def test_flavours_are_equal_under_limits_damping_and_a_payload(tmp_path: Path, control: str) -> None:
    rows = []
    (tmp_path / "hand.urdf").write_text(HAND)
    settings = {"tau_ext": 4.0, "limit_effort": True, "payload": 1.0, "q_start": 0.25}
    settings |= {"q_des": 0.9} if control == "joint" else {}
    for native in (False, True):
        options = FmuOptions(urdf=tmp_path / "hand.urdf", control=control, native=native)
        fmu = twodof.build_fmu(tmp_path / f"hand{native:d}.fmu", options)
        run = twodof.experiment(fmu, stop_time=1.0, settings=settings)
        rows.append([(*s.q, *s.v, *s.tau) for s in twodof.samples(run)])
    np.testing.assert_allclose(rows[0], rows[1], rtol=0.0, atol=1e-9)
    assert control == "task" or rows[0][-1][0] == pytest.approx(0.6, abs=1e-15)


def test_geometry_of_many_samples_is_that_of_the_plant(robots: Path) -> None:
    text, frame = (robots / PANDA).read_text(), "panda_rightfinger"
    robot = load_robot(text, frame, "xyz")
    kinematics = Kinematics(read_urdf(text), robot.joints)
    mechanism = Mechanism(robot, DOWN, 0.0, (0.0,) * 3, (0.0,) * len(robot.joints))
    q = np.random.default_rng(3).normal(size=(20, len(robot.joints)))
    for row, path, jacobian in zip(q, kinematics.path(frame, q), kinematics.jacobian(frame, q)):
        place, J, _ = mechanism.observe(row, np.zeros(len(row)))
        np.testing.assert_allclose(path, place, atol=1e-13)
        np.testing.assert_allclose(jacobian, J, atol=1e-13)
        follows = jacobian[:, robot.joints.index("panda_finger_joint1")]
        assert np.linalg.norm(follows) == pytest.approx(1.0)


@pytest.mark.parametrize("known", ["leader", "both"])
def test_pictures_of_a_bag_follow_the_leader_unless_the_bag_has_other_positions(robots: Path, known: str) -> None:
    from twodof.plots.linkage import load_linkage

    text, frame = (robots / PANDA).read_text(), "panda_rightfinger"
    names = ["panda_finger_joint1", *(["panda_finger_joint2"] if known == "both" else [])]
    linkage = load_linkage(text, frame, "xyz", names)
    q = np.zeros((3, len(linkage.moving)))
    index = [joint.name for joint in linkage.moving].index(names[-1])
    q[:, index] = (0.0, 0.01, 0.02)
    path = linkage.motion(q).path
    np.testing.assert_allclose(np.linalg.norm(path - path[0], axis=1), (0, 0.01, 0.02), atol=1e-15)
