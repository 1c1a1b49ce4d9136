"""Control of a frame's orientation: against a closed form, SciPy's Rotation and DOP853."""

from __future__ import annotations

import logging
import math
import os
import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from harness import Driver, in_child_process, wait_until
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from native_models import robots_folder
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import twodof
from twodof import FmuOptions
from twodof.plant.orientation import quaternion, rotation_error
from twodof.plant.robot import load_robot

BENT = (0.3, -1.2, 1.4, -0.7, 1.1, 0.2)
FLAVOURS = pytest.mark.parametrize("native", [False, True], ids=["python", "native"])
TIGHT = {"rtol": 1e-11, "atol": 1e-13}
UR = "ur_description/urdf/ur10_joint_limited_robot.urdf"
PANDA = "panda_description/urdf/panda.urdf"
BENT_PANDA = (0.1, -0.5, 0.2, -2.0, 0.3, 1.6, 0.5, 0.02)


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, bool], twodof.Fmu]:
    folder = tmp_path_factory.mktemp("pose")
    of = {"ur10": (UR, "tool0", BENT), "panda": (PANDA, "panda_hand_tcp", BENT_PANDA)}
    return {
        (name, native): twodof.load_fmu(
            twodof.build_fmu(
                folder / f"{name}{native:d}.fmu",
                FmuOptions(
                    urdf=robots_folder() / urdf, frame=frame, control="pose", native=native, meshes=False, q_start=start
                ),
            )
        )
        for name, (urdf, frame, start) in of.items()
        for native in (False, True)
    }


def starts(fmu: twodof.Fmu, group: str) -> np.ndarray:
    return np.array([float(str(fmu.variables[name].start)) for name in fmu.vector(group)])


def orientations(run: twodof.Experiment) -> list[Rotation]:
    """Orientations by Pinocchio at the samples' joint positions."""
    assert run.fmu.urdf is not None
    robot = load_robot(run.fmu.urdf, run.fmu.frame, "xyz")
    data, G = robot.model.createData(), robot.coupling
    turns = []
    for sample in twodof.samples(run):
        q = np.array(sample.q) if G is None else G @ sample.q + robot.offset
        pin.framesForwardKinematics(robot.model, data, q)
        turns.append(Rotation.from_matrix(data.oMf[robot.frame_id].rotation))
    return turns


def errors_after_a_turn(fmu: twodof.Fmu, turn: np.ndarray, sign: float = 1.0) -> np.ndarray:
    """log(R_des Rᵀ) over 0.5 s; at the start the target is rotated by a rotation vector."""
    target = Rotation.from_rotvec(turn) * Rotation.from_quat(starts(fmu, "quat_des"))
    settings = {"quat_des": tuple(sign * target.as_quat()), "Kp_rot": 30.0, "Kd_rot": 7.0, **TIGHT}
    settings |= {"q_min[6]": -7.0, "q_max[6]": 7.0}
    run = twodof.experiment(fmu, stop_time=0.5, settings=settings)
    return np.array([(target * R.inv()).as_rotvec() for R in orientations(run)])


@FLAVOURS
def test_a_turn_about_a_fixed_axis_obeys_the_closed_form(fmus, native: bool) -> None:
    """φ'' + Kd φ' + Kp φ = 0 from rest: φ = φ₀ e^(−Kd t/2) (cos ωt + Kd/(2ω) sin ωt)."""
    turn = np.array([0.5, -0.6, 0.7])
    found = errors_after_a_turn(fmus["ur10", native], turn)
    np.testing.assert_allclose(found, closed_form(turn), atol=1e-9)


def closed_form(turn: np.ndarray) -> np.ndarray:
    t, half = 0.01 * np.arange(51), 3.5
    omega = math.sqrt(30.0 - half**2)
    share = np.exp(-half * t) * (np.cos(omega * t) + half / omega * np.sin(omega * t))
    return share[:, None] * turn


@FLAVOURS
@pytest.mark.parametrize("name", ["ur10", "panda"])
def test_a_pose_target_against_an_integration_of_its_own(fmus, name: str, native: bool) -> None:
    """The Panda has its damping, and fingers of which one mimics the other."""
    fmu = fmus[name, native]
    goal = Rotation.from_rotvec([0.4, 0.3, -0.5]) * Rotation.from_quat(starts(fmu, "quat_des"))
    place = starts(fmu, "x_des") + np.array([0.05, -0.04, -0.06])
    settings = {"x_des": tuple(place), "quat_des": tuple(goal.as_quat()), **TIGHT}
    run = twodof.experiment(fmu, stop_time=0.15, settings=settings)
    samples = list(twodof.samples(run))

    robot = load_robot(fmu.urdf, fmu.frame, "xyz")
    model, n = robot.model, len(robot.joints)
    model.gravity.linear = starts(fmu, "gravity")
    data, frame = model.createData(), robot.frame_id
    G = np.eye(n) if robot.coupling is None else robot.coupling
    Kn = starts(fmu, "Kn") if fmu.vector("Kn") else float(fmu.variables["Kn"].start)
    still = np.zeros(model.nv)

    def motion(t: float, y: np.ndarray) -> np.ndarray:
        q, v = y[:n], y[n:]
        Q, V = G @ q + robot.offset, G @ v
        pin.forwardKinematics(model, data, Q, V, still)
        J = pin.computeFrameJacobian(model, data, Q, frame, pin.LOCAL_WORLD_ALIGNED) @ G
        drift = pin.getFrameClassicalAcceleration(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
        at = data.oMf[frame]
        turn = pin.log3(goal.as_matrix() @ at.rotation.T)
        wanted = -40.0 * J @ v + 50.0 * np.concatenate([place - at.translation, turn])
        inverse = np.linalg.pinv(J, rcond=0.01)
        a = inverse @ (wanted - drift.vector) - Kn * (v - inverse @ (J @ v))
        M = pin.crba(model, data, Q)
        M = G.T @ (np.triu(M) + np.triu(M, 1).T) @ G
        return np.concatenate([v, a - np.linalg.solve(M, np.array(robot.damping) * v)])

    y0 = np.concatenate([starts(fmu, "q_start"), np.zeros(n)])
    times = [sample.t for sample in samples]
    exact = solve_ivp(motion, (0, times[-1]), y0, "DOP853", times, rtol=1e-12, atol=1e-13).y.T
    np.testing.assert_allclose([(*s.q, *s.v) for s in samples], exact, rtol=0.0, atol=1e-9)


@FLAVOURS
def test_almost_half_a_turn_is_finite_and_the_short_way(fmus, native: bool) -> None:
    axis = Rotation.from_quat(starts(fmus["ur10", native], "quat_des")).apply([0.0, 0.0, 1.0])
    for degrees, way in ((179.999, 179.999), (180.0, None), (180.001, -179.999)):
        found = errors_after_a_turn(fmus["ur10", native], math.radians(degrees) * axis)
        short = np.sign(found[1] @ axis) * 180.0 if way is None else way
        np.testing.assert_allclose(found[1:], closed_form(math.radians(short) * axis)[1:], atol=1e-9)


@FLAVOURS
def test_a_quaternion_and_its_negative_are_one_target_and_its_length_is_none(fmus, native) -> None:
    turn = np.array([0.5, -0.6, 0.7])
    found = errors_after_a_turn(fmus["ur10", native], turn)
    for factor in (1e-200, -3.0, 1e150):
        again = errors_after_a_turn(fmus["ur10", native], turn, factor)
        np.testing.assert_allclose(again, found, atol=1e-12)


@FLAVOURS
def test_the_present_pose_as_target_moves_nothing(fmus, native: bool) -> None:
    run = twodof.experiment(fmus["ur10", native], stop_time=0.2)
    for sample in twodof.samples(run):
        np.testing.assert_allclose(sample.q, BENT, atol=1e-12)


@FLAVOURS
def test_outputs_are_the_frames_orientation_and_angular_velocity(fmus, native: bool) -> None:
    fmu, rng = fmus["ur10", native], np.random.default_rng(5)
    robot = load_robot(fmu.urdf, fmu.frame, "xyz")
    data = robot.model.createData()
    names = (*fmu.vector("q_start"), *fmu.vector("v_start"))
    with twodof.fmu.instantiate(fmu) as instance:
        read = instance.reader((*fmu.vector("quat"), *fmu.vector("omega")))
        for _ in range(50):
            q, v = rng.uniform(-3.0, 3.0, 6), rng.normal(size=6)
            instance.reset()
            instance.initialise(0.0, math.inf, dict(zip(names, map(float, (*q, *v)))))
            found = read()
            pin.forwardKinematics(robot.model, data, q, v)
            turned = pin.updateFramePlacement(robot.model, data, robot.frame_id).rotation
            spin = pin.getFrameVelocity(robot.model, data, robot.frame_id, pin.LOCAL_WORLD_ALIGNED).angular
            np.testing.assert_allclose(
                [*found], [*Rotation.from_matrix(turned).as_quat(canonical=True), *spin], atol=1e-12
            )


def test_the_error_is_scipys_rotation_vector() -> None:
    rng = np.random.default_rng(6)
    half = [Rotation.from_rotvec(math.pi * axis) for axis in np.eye(3)]
    for k in range(500):
        R = half[k] if k < 3 else Rotation.random(random_state=rng)
        target = Rotation.random(random_state=rng).as_quat()
        expected = (Rotation.from_quat(target) * R.inv()).as_rotvec()
        error = rotation_error((rng.choice([-2.0, 3.0]) * target).tolist(), R.as_matrix())
        np.testing.assert_allclose(error, expected, atol=1e-12)
        own = quaternion(R.as_matrix())
        assert own[3] >= 0.0 and abs(np.dot(own, R.as_quat())) == pytest.approx(1.0, abs=1e-14)


@FLAVOURS
@in_child_process
def test_a_zero_quaternion_is_refused_wherever_it_would_be_followed(fmus, native: bool) -> None:
    message = "quat_des = 0, 0, 0, 0 is not an orientation; the identity is (0, 0, 0, 1)"
    driver = Driver(fmus["ur10", native].path).initialise()
    assert driver.step(0.0) == 0
    before = driver.get("q", "v", "x", "quat", "omega", "tau")
    driver.set(quat_des=(0.0, 0.0, 0.0, 0.0))
    driver.call("getReal", driver.references("tau"))
    assert any(message in text for _, text in driver.log)
    assert driver.get("q", "v", "x", "quat", "omega") == before[:-6], "these do not depend on it"
    driver.log.clear()
    assert driver.step(0.01) != 0 and any(message in text for _, text in driver.log)
    driver.set(quat_des=(0.0, 0.0, 0.0, 2.0))
    assert driver.step(0.01) == 0
    with pytest.raises(twodof.TwoDofError, match=re.escape(message)):
        run = twodof.experiment(fmus["ur10", native], settings={"quat_des": 0.0})
        list(twodof.samples(run))


def test_few_joints_are_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "twodof"):
        fmu = twodof.build_fmu(tmp_path / "arm.fmu", FmuOptions(control="pose"))
    (record,) = caplog.records
    assert "only 2 joints move 'EndEffector': it cannot reach every position" in record.getMessage()
    samples = list(twodof.samples(twodof.experiment(fmu, stop_time=0.2)))
    assert all(np.isfinite((*s.q, *s.v, *s.tau)).all() for s in samples)


# --- the bag and the network ---


@pytest.fixture(scope="module")
def bag(fmus, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose target orientation, not a unit quaternion, changes after 0.1 s."""
    folder = tmp_path_factory.mktemp("bag")
    run = twodof.experiment(fmus["ur10", True], stop_time=0.2)
    change: dict = {"quat_des": (0.0, 2.0, 0.0, 0.0), "x_des": (0.5, 0.2, 0.7)}
    asked = iter([None] * 10 + [change] + [None] * 20)
    twodof.simulate(run, twodof.Bag(folder / "bag", scene=True), steer=partial(next, asked))
    return folder / "bag"


def poses(bag: Path, topic: str) -> np.ndarray:
    """Position and orientation of each PoseStamped of a topic, by another reader."""
    with (bag / "bag.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        rows = []
        for schema, _, _, message in reader.iter_decoded_messages(topics=[topic]):
            assert schema is not None and schema.name == "geometry_msgs/msg/PoseStamped"
            p, q = message.pose.position, message.pose.orientation
            rows.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    return np.array(rows)


def test_target_and_end_effector_are_poses_in_the_bag(fmus, bag: Path) -> None:
    fmu, recording = fmus["ur10", True], twodof.read_bag(bag)
    target, end = poses(bag, "/target"), poses(bag, "/end_effector")
    assert len(target) == len(end) == 21
    first = [*starts(fmu, "x_des"), *starts(fmu, "quat_des")]
    np.testing.assert_allclose(target[:11], [first] * 11, atol=1e-15)
    np.testing.assert_allclose(target[11:], [(0.5, 0.2, 0.7, 0.0, 1.0, 0.0, 0.0)] * 10, atol=0)
    np.testing.assert_allclose(end[:, :3], recording.x, atol=1e-14)
    robot = load_robot(fmu.urdf, fmu.frame, "xyz")
    data = robot.model.createData()
    for q, quat in zip(recording.q, end[:, 3:]):
        pin.framesForwardKinematics(robot.model, data, q)
        turned = Rotation.from_matrix(data.oMf[robot.frame_id].rotation)
        np.testing.assert_allclose(quat, turned.as_quat(canonical=True), atol=1e-12)
    np.testing.assert_allclose(recording.target, target[:, :3])
    np.testing.assert_allclose(recording.target_quat[11:], [(0.0, 2.0, 0.0, 0.0)] * 10)


def test_without_provenance_the_target_is_that_of_the_poses(bag: Path, tmp_path: Path) -> None:
    shutil.copytree(bag, tmp_path / "bag")
    (tmp_path / "bag" / "run.json").unlink()
    metadata = (tmp_path / "bag/metadata.yaml").read_text()
    (tmp_path / "bag/metadata.yaml").write_text(re.sub("custom_data:.*", "custom_data: {}", metadata, flags=re.S))
    found = twodof.read_bag(tmp_path / "bag").target
    np.testing.assert_allclose(found, twodof.read_bag(bag).target, atol=1e-15)


def test_errors_of_a_sample_are_distance_and_angle(fmus) -> None:
    turn = Rotation.from_rotvec([0.3, -0.4, 1.2])
    goal = turn * Rotation.from_quat(starts(fmus["ur10", True], "quat_des"))
    settings = {"quat_des": tuple(-2.0 * goal.as_quat())}
    run = twodof.experiment(fmus["ur10", True], settings=settings, stop_time=0.1)
    numbers = twodof.verdict([next(twodof.samples(run))], run).numbers
    assert numbers["final_turn_error"] == pytest.approx(turn.magnitude(), abs=1e-12)
    assert numbers["final_error"] == pytest.approx(0.0, abs=1e-12)


TALKER = """
import sys, time
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
import numpy as np
from twodof.ros.cdr import Layout, Numbers, Stamp
from twodof.ros.messages import POSE, STREAM
from twodof.ros.network import network_of_environment, open_domain
from twodof.ros.network import dds_qos, dds_type

domain = open_domain(network_of_environment())
participant = DomainParticipant(network_of_environment().domain)
writer = DataWriter(
    participant, Topic(participant, "rt/target_command", dds_type(POSE)), dds_qos(STREAM, POSE)
)
said = [eval(line) for line in sys.stdin]
print("ready", flush=True)
while not writer.get_matched_subscriptions():
    time.sleep(0.01)
for frame, xyz, quat in said:
    said = Layout(Stamp(), frame, Numbers(7)).pack(np.array([0]), np.array([[*xyz, *quat]]))
    time.sleep(0.3)  # that it is heard, and after the one before
    writer.write(writer.data_type(said.tobytes()))
time.sleep(60)
"""


@pytest.mark.needs("cyclonedds")
def test_a_pose_on_the_network_is_the_target(
    fmus, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four arrive: one is in another frame, one has no orientation, one is not finite."""
    from twodof.ros.publisher import Publisher

    monkeypatch.setenv("ROS_DOMAIN_ID", str(101 + os.getpid() % 100))
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    run = twodof.experiment(fmus["ur10", True], stop_time=math.inf)
    root, asked = run.fmu.root, []
    messages = [
        ("elsewhere", (9.0, 9.0, 9.0), (0.0, 0.0, 0.0, 1.0)),
        (root, (9.0, 9.0, 9.0), (0.0, 0.0, 0.0, 0.0)),
        (root, (9.0, 9.0, 9.0), (0.0, 0.0, math.inf, 0.0)),
        ("", (0.5, 0.2, 0.7), (0.0, 2.0, 0.0, 0.0)),
    ]
    text = "".join(f"({f!r}, {p!r}, {q!r})\n".replace("inf", "float('inf')") for f, p, q in messages)

    def hears() -> Any:
        asked.append(publisher.command())
        return asked[-1]

    with (
        caplog.at_level(logging.WARNING, "twodof"),
        Publisher(scene=True).begin(run) as publisher,
        subprocess.Popen([sys.executable, "-c", TALKER], stdin=subprocess.PIPE, text=True) as talker,
    ):
        assert talker.stdin is not None
        talker.stdin.write(text)
        talker.stdin.close()
        publisher.write(next(twodof.samples(run)))
        wait_until(hears)
        talker.kill()
    assert [command for command in asked if command] == [
        {
            "x_des[1]": 0.5,
            "x_des[2]": 0.2,
            "x_des[3]": 0.7,
            "quat_des[1]": 0.0,
            "quat_des[2]": 2.0,
            "quat_des[3]": 0.0,
            "quat_des[4]": 0.0,
        }
    ]
    told = [record.getMessage() for record in caplog.records]
    assert "a pose on /target_command is in frame 'elsewhere'" in told[0]
    assert "has the orientation 0, 0, 0, 0: ignored" in told[1] and "not finite" in told[2]
