"""Errors at the default tolerances against an implicit solver, and the cost of damping.

    python benchmarks/stiff.py [ROBOT …]      about half an hour, or robots whose path has one of these words
    python benchmarks/stiff.py --damping      about a minute

Errors: each robot moves for 0.1 s in steps of 10 ms under each control, without limits and friction. It starts at
random within 1 rad of the middle of its limits, with up to 1 rad/s or m/s in each joint. Targets are up to 0.1 m or 0.5
rad away, joint efforts up to 0.3 N·m or 0.3 N. "automatic" is the largest difference of a joint from SciPy's Radau at
rtol 1e-12 and atol 1e-13, with Pinocchio's dynamics, over all samples and both motions, rad or m. "explicit" is that of
Dormand–Prince alone. Motions in which the rank of J⁺ changes do not count. A discarded step is "refused", an error
above BOUND and above that of Dormand–Prince is wrong: exit status 1.

Damping: the largest processor time of the first ten steps of 10 ms from 0.5 rad/s in every joint in C, relative to that
without damping, under effort control and for the default arm under task control.
"""

from __future__ import annotations

import ctypes
import math
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pinocchio as pin
from arms import ROBOTS, URDF, Arm, chain, compiled, panda, shipped_arm
from report import machine, print_judged, print_rows
from robots import frame_of
from scipy.integrate import solve_ivp

import twodof
from twodof.plant.plant import Plant
from twodof.plant.robot import load_robot
from twodof.plant.variables import CONTROLS, variable_table

STEP, STEPS, MOTIONS, BOUND = 0.01, 10, 2, 1e-5
CHOSEN = (
    "allegro_left_hand",
    "tiago_no_hand",
    "tiago_pro",
    "icub_reduced",
    "kinova",
    "pr2",
    "hyq",
    "b1-z1",
    "baxter",
    "panda.urdf",
    "ur5_robot",
    "so100",
    "solo12",
    "double_pendulum_continuous",
    "finger_edu",
    "anymal-kinova",
)
DAMPING = (0.0, 0.1, 1.0, 10.0, 100.0, 1e3, 1e4, 1e5, 1e6)
Rates = Callable[[float, np.ndarray], np.ndarray]


def equations(plant: Plant, ratios: list[np.ndarray]) -> Rates:
    """Return ẏ of a plant by Pinocchio; append the singular values of J relative to the largest to a list."""
    robot, control = plant.robot, plant.control
    n, model = len(robot.joints), robot.model.copy()
    model.gravity.linear = np.array(plant.gravity)
    data, frame, D = model.createData(), robot.frame_id, np.array(plant.damping)
    G = np.eye(n) if robot.coupling is None else robot.coupling
    rows = ["xyz".index(axis) for axis in robot.axes] + [3, 4, 5] * (control == "pose")

    def commanded(Q: np.ndarray, V: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        if control == "joint":
            return np.array(plant.Kp) * (plant.q_des - q) - np.array(plant.Kd) * v
        pin.forwardKinematics(model, data, Q, V, np.zeros(model.nv))
        J = pin.computeFrameJacobian(model, data, Q, frame, pin.LOCAL_WORLD_ALIGNED)[rows] @ G
        drift = pin.getFrameClassicalAcceleration(model, data, frame, pin.LOCAL_WORLD_ALIGNED).vector[rows]
        at = data.oMf[frame]
        error, Kp, Kd = plant.x_des - at.translation[rows[: len(robot.axes)]], [*plant.Kp], [*plant.Kd]
        if control == "pose":
            wanted = pin.Quaternion(np.array(plant.quat_des)).normalized().matrix()
            error = np.concatenate([error, pin.log3(wanted @ at.rotation.T)])
            Kp, Kd = [*Kp, *plant.Kp_rot], [*Kd, *plant.Kd_rot]
        sigma = np.linalg.svd(J, compute_uv=False)
        ratios.append(sigma / sigma[0])
        a = np.array(Kp) * error - np.array(Kd) * (J @ v) - drift
        return np.linalg.pinv(J, plant.rcond) @ (a + plant.Kn * J @ v) - plant.Kn * v

    def rates(_: float, y: np.ndarray) -> np.ndarray:
        q, v = y[:n], y[n:]
        Q, V = G @ q + (robot.offset if robot.coupling is not None else 0.0), G @ v
        M = pin.crba(model, data, Q)
        M = G.T @ (np.triu(M) + np.triu(M, 1).T) @ G
        if control == "effort":
            effort, a = plant.tau_cmd - G.T @ pin.nonLinearEffects(model, data, Q, V), 0.0
        else:
            effort, a = 0.0, commanded(Q, V, q, v)
        return np.concatenate([v, a + np.linalg.solve(M, effort - D * v)])

    return rates


def moving(plant: Plant, draw: np.random.Generator) -> dict[str, list[float]]:
    """Set a random start and target of a plant; return them by group."""
    n = len(plant.q)
    limits = [(low, high) if high - low < 20.0 else (-1.0, 1.0) for low, high in zip(plant.q_min, plant.q_max)]
    start = [0.5 * (low + high) + draw.uniform(-1, 1) * min(1.0, 0.4 * (high - low)) for low, high in limits]
    plant.q_start, plant.v_start = start, draw.uniform(-1, 1, n).tolist()
    plant.q_min, plant.q_max, plant.friction = [-1e9] * n, [1e9] * n, [0.0] * n
    plant.initialise()
    inputs = {}
    if plant.control in ("task", "pose"):
        inputs["x_des"] = (plant.x + draw.uniform(-0.1, 0.1, len(plant.x))).tolist()
    if plant.control == "pose":
        turn = pin.Quaternion(pin.exp3(draw.uniform(-0.3, 0.3, 3)))
        inputs["quat_des"] = (turn * pin.Quaternion(np.array(plant.quat))).coeffs().tolist()
    if plant.control == "joint":
        inputs["q_des"] = (start + draw.uniform(-0.5, 0.5, n)).tolist()
    if plant.control == "effort":
        inputs["tau_cmd"] = draw.uniform(-0.3, 0.3, n).tolist()
    for name, value in inputs.items():
        setattr(plant, name, value)
    groups = ("q_start", "v_start", "q_min", "q_max", "friction", *inputs)
    return {group: list(getattr(plant, group)) for group in groups}


def sampled(fmu: Path, groups: dict[str, list[float]], integrator: int) -> np.ndarray | None:
    """Return q at all samples by an FMU; None if it discards a step."""
    settings = {f"{group}[{i}]": value for group, row in groups.items() for i, value in enumerate(row, 1)}
    settings["integrator"] = integrator
    try:
        return np.array([s.q for s in twodof.samples(fmu, step=STEP, stop_time=STEPS * STEP, settings=settings)])
    except twodof.TwoDofError:
        return None


def errors_of(urdf: Path, control: str, folder: Path) -> tuple[str, str, str, bool]:
    """Return the number of motions that count, both errors, and whether they are right."""
    shipped = urdf == URDF
    frame, axes = ("EndEffector", "xy") if shipped else (frame_of(urdf.read_text("utf-8")), "xyz")
    options = twodof.FmuOptions(
        urdf=None if shipped else urdf, frame=frame, control=control, native=True, meshes=False, name="robot"
    )
    fmu = twodof.build_fmu(folder / "robot.fmu", options, overwrite=True)
    robot = load_robot(urdf.read_text("utf-8"), frame, axes)
    zero, gravity = (0.0,) * len(robot.joints), (0.0, -9.81, 0.0) if shipped else (0.0, 0.0, -9.81)
    starts = {"q_start": zero, "x_des": zero[:1] * len(axes), "quat_des": (0.0, 0.0, 0.0, 1.0), "gravity": gravity}
    draw, found = np.random.default_rng(11), []
    for _ in range(MOTIONS):
        plant = Plant(robot, variable_table(robot, starts, control), control)
        groups, ratios = moving(plant, draw), list[np.ndarray]()
        rates, times = equations(plant, ratios), np.arange(STEPS + 1) * STEP
        y0 = [*plant.q, *plant.v]
        exact = solve_ivp(rates, (0.0, times[-1]), y0, "Radau", times, rtol=1e-12, atol=1e-13)
        if np.ptp([(row > plant.rcond).sum() for row in ratios] or [0]):
            continue
        runs = [sampled(fmu, groups, integrator) for integrator in (0, 1)]
        n = len(robot.joints)
        found.append([math.inf if q is None else float(np.abs(q - exact.y[:n].T).max()) for q in runs])
    worst = np.max(found, axis=0) if found else np.full(2, math.nan)
    right = all(mine <= max(BOUND, other if math.isfinite(other) else 0.0) for mine, other in found)
    words = ("refused" if math.isinf(x) else "" if math.isnan(x) else f"{x:.0e}" for x in worst)
    return str(len(found)), *words, right


def error_rows(words: list[str], folder: Path) -> Iterator[tuple[list[str], bool]]:
    """Yield rows of the table, each with True if it is right."""
    yield ["URDF", "joints", "control", "motions", "automatic", "explicit"], True
    chosen = words or CHOSEN
    for urdf in (URDF, *sorted(ROBOTS.rglob("*.urdf"))):
        if not any(word in str(urdf) for word in (*chosen, URDF.name) if not words or word in words):
            continue
        joints = str(len(load_robot(urdf.read_text("utf-8"), frame_of(urdf.read_text("utf-8")), "xyz").joints))
        for control in CONTROLS:
            motions, mine, explicit, right = errors_of(urdf, control, folder)
            yield [urdf.name, joints, control, motions, mine, explicit], right


def damped(arm: Arm, folder: Path) -> np.ndarray:
    """Return the largest processor time of a step for each damping, s."""
    names = [variable.name for variable in variable_table(arm.robot, arm.starts, arm.control)]
    first = {"DAMPING": "damping[1]", "SPEED": "v_start[1]"}
    flags = [f"-DFIRST_{what}={names.index(variable) + 1}" for what, variable in first.items()]
    step_costs = compiled(arm, folder, "damped_step.c", flags=flags).step_costs
    step_costs.argtypes = [ctypes.c_double, ctypes.c_double, ctypes.c_int, ctypes.c_int, ctypes.c_void_p]
    step_costs.restype = None
    costs = np.empty((len(DAMPING), 3, STEPS))
    for turn in range(3):
        for of, damping in zip(costs, DAMPING):
            step_costs(damping, 0.5, STEPS, 50, of[turn].ctypes.data)
    return costs.min(axis=1).max(axis=1)


def main() -> int:
    """Print a table; return 1 if a result is wrong."""
    print(machine(), flush=True)
    with tempfile.TemporaryDirectory(prefix="twodof_") as folder:
        if "--damping" in sys.argv:
            arms = {"default arm": shipped_arm(), "Panda": panda("effort"), "chain of 5": chain(5, "effort")}
            costs = {name: damped(arm, Path(folder)) for name, arm in arms.items()}
            rows = [(name, *(f"{x:.1f}" for x in cost / cost[0])) for name, cost in costs.items()]
            print_rows("times of the largest step", ("damping", *(f"{D:g}" for D in DAMPING)), *rows)
            return 0
        return print_judged(error_rows([w for w in sys.argv[1:] if w[:2] != "--"], Path(folder)))


if __name__ == "__main__":
    sys.exit(main())
