"""Runs that fail on purpose, with their causes, and runs that succeed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from native_models import robots_folder
from scratch import run_folder

import twodof
from twodof.plant.urdf import read_urdf

UR5, PANDA = "ur_description/urdf/ur5_robot.urdf", "panda_description/urdf/panda.urdf"
AT_UR5, AT_PANDA = (0.1, -1.2, 1.4, 0.2, -1.0, 0.3), (0.0, -0.6, 0.0, -2.2, 0.0, 1.7, 0.8)
FINGERS = {"panda_finger_joint1": 0.0}
LARGE_STEPS = {"max_step": 0.01}
COARSE = {"control_period": 0.001, "q_resolution": (0.05, 0.05), "v_from_q": True}


class Failure(NamedTuple):
    """A run, and the expected content of its verdict."""

    robot: str
    control: str
    settings: Mapping[str, Any]
    kinds: tuple[str, ...]
    words: str
    stop_time: float = 5.0


FAILURES = {
    "out of reach": Failure("arm", "task", {"x_des": (0.5, 0.1)}, ("reach",), "out of reach by 0.2099 m"),
    "a target in millimetres": Failure("arm", "task", {"x_des": (200.0, 50.0)}, ("reach",), "in millimetres?", 0.1),
    "degrees": Failure("arm", "joint", {"q_des": (90.0, 0.35)}, ("degrees",), "did you mean 90°, which is 1.5708 rad?"),
    "degrees beyond the limits": Failure(
        "arm", "joint", {"q_des": (90.0, 0.35), "q_max": (1.0, 3.0)}, ("reach",), "is 1 rad; is it in degrees?"
    ),
    "beyond a joint limit": Failure(
        "arm", "joint", {"q_des": (0.5, 0.8), "q_max": (1.0, 0.6)}, ("reach",), "'joint2' is out of reach by 0.2 rad"
    ),
    "a joint in the way": Failure(
        "arm", "task", {"q_min": (0.2, -3.0)}, ("limit",), "'joint1' stood at its lower limit"
    ),
    "a slow orientation": Failure(
        "panda",
        "pose",
        {"quat_des": (0.3, 0.9, 0.1, 0.2), "Kp_rot": 1.0},
        ("time",),
        "the orientation still approaches",
    ),
    "a slow orientation of five joints": Failure(
        "so100",
        "pose",
        {"x_des": (0.168754, -0.165877, 0.205062), "quat_des": (-0.323431, 0.840547, 0.43215, 0.046039), "Kp_rot": 1.0},
        ("time",),
        "the orientation still approaches",
    ),
    "a saturated motor": Failure(
        "ur5", "joint", {"payload": 40.0, "payload_known": True, "limit_effort": True}, ("saturation",), "saturated at"
    ),
    "an unknown load": Failure("ur5", "joint", {"payload": 5.0, "Kp": 20.0}, ("load",), "the payload of 5 kg"),
    "a push": Failure("arm", "task", {"f_ext": (0.0, 3.0, 0.0)}, ("load",), "not know f_ext = (0, 3, 0) N"),
    "no gain": Failure("arm", "task", {"Kp[2]": 0.0}, ("gain",), "Kp[2] (along y) = 0"),
    "a feedforward that stays": Failure(
        "arm", "task", {"xdd_des": (0.0, 1.0)}, ("feedforward",), "xdd_des = (0, 1) is not 0, while the target rests"
    ),
    "damping of the joints": Failure(
        "arm",
        "joint",
        {"damping": 20.0, "q_des": (0.8, 0.65)},
        ("load",),
        "not know the damping of joints 'joint1', 'joint2'",
    ),
    "too much damping": Failure(
        "arm", "task", {"Kp": 10.0, "Kd": 200.0}, ("time",), "raise Kp, or lower Kd, or stop later"
    ),
    "no damping": Failure("arm", "task", {"Kd": 0.0, "Kp": 20.0}, ("damping",), "damps Kp = 20"),
    "no damping of the orientation": Failure(
        "panda", "pose", {"Kd_rot": 0.0, "x_des": (0.3554, -0.0699, 0.5369)}, ("damping",), "Kd_rot = 0 s⁻¹ damps"
    ),
    "a joint that sticks": Failure(
        "arm",
        "joint",
        {"friction": (0.3, 0.1), "q_des": (1.2, 0.1), "Kd": (0.0, 1.0)},
        ("friction",),
        "'joint1' sticks: its friction of 0.3 N·m holds it from 0.44 s on",
    ),
    "a singular pose": Failure(
        "arm", "task", {"q_start": (0.0, 0.0), "x_des": (0.2, 0.0), "Kp": 20.0}, ("singularity",), "near a singularity"
    ),
    "an effort that the motor has not": Failure(
        "ur5",
        "joint",
        {"q_des": (0.9, -1.2, 1.4, 0.2, -1.0, 0.3), "Kp": 4000.0},
        ("effort",),
        "beyond the URDF's limit",
    ),
    "a slow controller": Failure(
        "ur5",
        "joint",
        {"control_period": 0.04, "Kp": 300.0, "Kd": 50.0, "q_des": (0.4, -0.9, 1.7, 0.5, -1.3, 0.6)},
        ("unstable",),
        "too high for control_period = 0.04 s: the loop is at its limit of stability",
    ),
    "a late controller": Failure(
        "arm",
        "joint",
        {"control_period": 0.004, "control_delay": 0.03, "Kp": 400.0, "q_des": (0.8, 0.65)},
        ("unstable",),
        "too high for control_period = 0.004 s and control_delay = 0.03 s: the loop is close to unstable",
    ),
    "a late controller that throws joints to their limits": Failure(
        "arm",
        "task",
        {"control_period": 0.005, "control_delay": 0.0489, "Kp": 342.4, "Kd": 30.82, "x_des": (-0.107, 0.2)},
        ("unstable", "limit"),
        "control_delay = 0.0489 s: the loop is unstable, an error doubles in 0.14 s",
    ),
    "a slow controller with limited motors": Failure(
        "ur5",
        "joint",
        {
            "control_period": 0.08,
            "Kp": 300.0,
            "Kd": 35.0,
            "limit_effort": True,
            "q_des": (0.2, -1.1, 1.5, 0.3, -0.9, 0.4),
        },
        ("unstable", "saturation"),
        "too high for control_period = 0.08 s",
    ),
    "a stiff law without damping": Failure(
        "ur5",
        "joint",
        {"Kp": 8000.0, "Kd": 0.5, "q_des": (0.2, -1.1, 1.5, 0.3, -0.9, 0.4)},
        ("damping",),
        "Kd = 0.5 s⁻¹ damps Kp = 8000 s⁻² too little",
    ),
    "a load that presses a leg to a limit": Failure(
        "a1", "task", {"Kp": 30.0, "Kd": 11.0, "payload": 5.0}, ("load", "limit"), "the payload of 5 kg"
    ),
    "a coarse encoder": Failure(
        "arm",
        "joint",
        {**COARSE, "Kp": 400.0, "Kd": 60.0, "q_des": (0.2, 0.05)},
        ("sampling",),
        "q_resolution[1] = 0.05 rad, so velocities in steps of 50 rad/s",
    ),
    "a load too heavy for the motors": Failure(
        "panda",
        "task",
        {
            "limit_effort": True,
            "payload": 30.0,
            "payload_known": True,
            "x_des": (0.328, 0.0563, 0.5176),
            "damping": 20.0,  # without it the motion is chaotic, and so are its causes
        },
        ("saturation",),
        "of the time, with the payload of 30 kg",
    ),
    "a direction without a gain, and a target just out of reach": Failure(
        "arm", "task", {"Kp": (0.0, 50.0), "x_des": (0.3, 0.05)}, ("gain", "reach"), "Kp[1] (along x) = 0"
    ),
    "a load and a target just out of reach": Failure(
        "panda", "task", {"payload": 3.0, "x_des": (0.75, 0.5, 0.7)}, ("load", "reach"), "the payload of 3 kg"
    ),
    "gains just below the limit of stability": Failure(
        "arm",
        "task",
        {"control_period": 0.01, "control_delay": 0.02, "Kp": 480.0, "Kd": 13.85},
        ("unstable",),
        "close to unstable, an error takes 39 s to decay to 2 %; at the same damping ratio it is quickest with",
    ),
    "a self-motion that is damped too strongly": Failure(
        "panda",
        "task",
        {"control_period": 0.05, "Kp": 30.0, "Kd": 11.0, "Kn": 45.0, "x_des": (0.4, 0.2, 0.5)},
        ("unstable",),
        "Kn = 45 s⁻¹ is too high for control_period = 0.05 s: the loop of the self-motion is unstable",
        2.0,
    ),
    "an orientation that is damped too strongly": Failure(
        "panda",
        "pose",
        {"control_period": 0.05, "Kp": 40.0, "Kd": 15.0, "x_des": (0.4, 0.1, 0.4), "quat_des": (0.0, 1.0, 0.0, 0.0)},
        ("unstable",),
        "Kp_rot = 50 s⁻² and Kd_rot = 40 s⁻¹ are too high for control_period = 0.05 s: the loop is at its limit",
        2.0,  # later the joints are thrown against their limits, which rounding decides
    ),
    "an unknown load, and friction that is too small to matter": Failure(
        "arm", "joint", {"q_des": (0.9, 0.8), "friction": 1e-9, "payload": 0.2}, ("load",), "payload of 0.2 kg", 20.0
    ),
    "a torque, and friction that is too small to matter": Failure(
        "arm", "joint", {"q_des": (0.9, 0.8), "friction": 1e-4, "tau_ext": (0.05, 0.0)}, ("load",), "know tau_ext", 20.0
    ),
    "friction of a joint that does not move the target, and a load": Failure(
        "ur5",
        "task",
        {"q_start": (0.0, -1.0, 1.5, -0.5, 1.5, 0.0), "x_des": (0.45, 0.25, 0.4), "friction[6]": 0.5, "payload": 3.0},
        ("load",),
        "the payload of 3 kg",
    ),
    "close to a singularity that does not matter, and too short": Failure(
        "arm",
        "task",
        {"q_start": (0.3, 0.07), "x_des": (0.28714, 0.0866)},
        ("time",),
        "the position still approaches",
        2.0,
    ),
    "a limit that does not matter, and too short": Failure(
        "ur5",
        "task",
        {
            "q_start": (0.0, -1.0, 1.5, -0.5, 1.5, 0.0),
            "x_des": (0.45, 0.25, 0.4),
            "q_max": (6.0, 6.0, 6.0, -0.4, 6.0, 6.0),
        },
        ("time",),
        "the position still approaches",
        2.0,
    ),
    "a negligible torque, and too short": Failure(
        "arm", "task", {"tau_ext": (1e-6, 0.0)}, ("time",), "time constant of 0.774 s: within 2 % after", 2.0
    ),
    "a feedforward that leaves no error, and too short": Failure(
        "arm", "task", {"xdd_des": (1e-3, 0.0)}, ("time",), "raise Kp, or lower Kd, or stop later", 2.0
    ),
    "no gain where there is no error": Failure(
        "arm", "joint", {"Kp": (0.0, 1.0), "q_des": (0.5, 0.9)}, ("time",), "time constant of 40 s"
    ),
    "a payload under gains that are unstable without it": Failure(
        "arm", "task", {"control_period": 0.05, "Kd": 42.0, "payload": 0.5}, ("load",), "the payload of 0.5 kg"
    ),
    "too little damping, seen in the first swing": Failure(
        "arm", "joint", {"Kp": 1.0, "Kd": 0.2, "q_des": (0.8, 0.6)}, ("damping",), "Kd = 0.2 s⁻¹ damps Kp = 1 s⁻²", 1.3
    ),
    "an unstable loop that has hardly grown": Failure(
        "arm",
        "joint",
        {"control_period": 0.05, "Kd": (45.0, 30.0), "q_des": (0.5, 0.6)},
        ("unstable",),
        "Kd[1] (of joint 'joint1') = 45 s⁻¹ are too high",
        1.0,
    ),
    "too little damping, and a load that does not matter": Failure(
        "arm", "task", {"Kd": 1.0, "f_ext": (0.0, 0.0, 5.0)}, ("damping",), "Kd = 1 s⁻¹ damps", 2.0
    ),
    "too little damping, and a small payload": Failure(
        "arm", "task", {"Kd": 1.0, "payload": 0.003}, ("damping",), "Kd = 1 s⁻¹ damps", 2.0
    ),
    "too little damping, and friction": Failure(
        "ur5",
        "task",
        {"q_start": (0.0, -1.0, 1.5, -0.5, 1.5, 0.0), "x_des": (0.45, 0.25, 0.4), "friction": 0.05, "Kd": 1.0},
        ("damping",),
        "Kd = 1 s⁻¹ damps",
        3.0,
    ),
    "too short": Failure("arm", "task", {}, ("time",), "the position still approaches", 1.0),
    "degrees and a saturated motor": Failure(
        "ur5",
        "joint",
        {"q_des": (-90.0, -1.2, 1.4, 0.2, -1.0, 0.3), "limit_effort": True, "payload": 40.0, "payload_known": True},
        ("degrees", "saturation"),
        "q_des[1] is -90 rad; did you mean -90°",
    ),
    "a load and a joint at its limit": Failure(
        "ur5",
        "joint",
        {"payload": 5.0, "Kp": 2.0, "q_max": (6.0, -1.1, 1.6, 6.0, 6.0, 6.0)},
        ("load", "limit"),
        "the payload of 5 kg",
    ),
    "out of reach and slow": Failure(
        "panda",
        "pose",
        {"x_des": (1.5, 0.0, 0.5), "Kp_rot": 1.0, "quat_des": (0.3, 0.9, 0.1, 0.2)},
        ("reach",),
        "out of",
    ),
}


ROBOTS = {
    "arm": ("", ""),
    "ur5": (UR5, "ee_link"),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", "ee_link"),
    "ur3": ("ur_description/urdf/ur3_robot.urdf", "ee_link"),
    "panda": (PANDA, "panda_hand_tcp"),
    "a1": ("a1_description/urdf/a1.urdf", "FR_foot"),
    "kinova": ("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "anymal": ("anymal_c_simple_description/urdf/anymal.urdf", "LF_FOOT"),
    "so100": ("so_arm_description/urdf/so100.urdf", "gripper"),
    "solo": ("solo_description/robots/solo12.urdf", "FL_FOOT"),
}
RADIUS, PERIOD = 0.02, 2.0  # m, s: of a circle that is followed
FIRM = {"Kp": 100.0, "Kd": 20.0, **LARGE_STEPS}


@cache
def fmu_of(robot: str, control: str) -> Path:
    """Build a Python FMU, once per process, that starts away from limits and singularities."""
    folder = run_folder() / "verdict"
    folder.mkdir(exist_ok=True)
    options: dict[str, Any] = {"control": control, "meshes": False}
    file, frame = ROBOTS[robot]
    if file:
        urdf = robots_folder() / file
        start = {"ur5": AT_UR5, "panda": AT_PANDA}.get(robot) or bent(urdf.read_text("utf-8"))
        options |= {"urdf": urdf, "frame": frame, "q_start": start, "lock": FINGERS if robot == "panda" else {}}
    return twodof.build_fmu(folder / f"{robot}-{control}.fmu", twodof.FmuOptions(**options), overwrite=True)


def bent(text: str) -> tuple[float, ...]:
    """Return a position of all joints of a URDF within their limits."""
    joints = [joint for joint in read_urdf(text).joints.values() if joint.moves and joint.leader == joint.name]
    bends = [0.4 + 0.35 * (-1) ** k for k in range(len(joints))]
    return tuple(
        float(np.clip(bend if joint.low + 0.3 < bend < joint.high - 0.3 else 0.5 * (joint.low + joint.high), -3.0, 3.0))
        for joint, bend in zip(joints, bends)
    )


def good_runs(robot: str) -> Iterator[twodof.Experiment]:
    """Yield runs to a near position, to joint positions, at rest, and along a circle."""
    task, joint = twodof.load_fmu(fmu_of(robot, "task")), twodof.load_fmu(fmu_of(robot, "joint"))
    starts = task.start_values
    x = np.array(next(twodof.samples(task)).x)
    q = np.array([joint.start_values[name] for name in joint.vector("q_des")], float)
    ahead = np.eye(len(x))[-1] * (-0.03 if robot == "arm" else 0.03)
    near = np.array([starts[name] for name in task.vector("q_max")], float) - q > 0.2
    yield twodof.experiment(task, settings={**FIRM, "x_des": x + ahead}, stop_time=2.0)
    yield twodof.experiment(joint, settings={**FIRM, "q_des": q + np.where(near, 0.05, -0.05)}, stop_time=2.0)
    yield twodof.experiment(task, settings={**LARGE_STEPS, "x_des": x}, stop_time=2.0)
    changes = []
    for t in np.arange(0.02, 2.0, 0.02):
        w = 2.0 * np.pi / PERIOD
        turn = np.zeros((2, len(x)))
        turn[:, 0] = np.cos(w * t) - 1.0, -w * np.sin(w * t)
        turn[:, 1] = np.sin(w * t), w * np.cos(w * t)
        changes.append((float(t), {"x_des": x - RADIUS * turn[0], "xd_des": -RADIUS * turn[1]}))
    if robot == "arm":  # the circle would leave its reach
        x = x - 0.05
        changes = [(t, {**values, "x_des": values["x_des"] - 0.05}) for t, values in changes]
    yield twodof.experiment(task, settings={**FIRM, "x_des": x}, changes=changes, stop_time=2.0)


def run(failure: Failure, *sinks: twodof.Sink) -> twodof.Summary:
    """Run a failure."""
    settings = {**LARGE_STEPS, **failure.settings}
    fmu = fmu_of(failure.robot, failure.control)
    return twodof.simulate(fmu, *sinks, settings=settings, stop_time=failure.stop_time)
