"""Measure how often the 95 % intervals of fits contain the true values, and how well fitted robots predict.

    python benchmarks/fit.py [SEEDS]                 the default arm; SEEDS seeds of the noise (200), about 3 minutes
    python benchmarks/fit.py sysid [SEEDS] [ROBOT]   held-out errors, also of MuJoCo's identification, for 3 seeds of
                                                     the default arm, 1.5 minutes each, or ROBOT: UR5, Panda or xArm7,
                                                     about 10 minutes each; needs `pip install 'mujoco[sysid]>=4'`

MuJoCo makes the recordings of 60 s, in steps of 0.1 ms, with friction, damping, armature and a payload that the URDF
does not have. Positions have noise of 1e-4 rad, efforts of 2 %. The motion is recorded once; each seed draws its noise.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

import twodof
from twodof.identification.fitting import read_model
from twodof.identification.prediction import WINDOW, deviation, predict
from twodof.identification.stretches import Stretch, stretches
from twodof.plant.robot import load_robot
from twodof.plant.urdf import read_urdf

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from motions import bag_of, move, mujoco_model, noisy
from test_fit import ARM, FREE, GRAVITY, HIDDEN, JOINTS, TRUTH
from test_fit_robots import ARMS, without_fingers


class Task(NamedTuple):
    """A robot with hidden parameters, and its motion by MuJoCo."""

    urdf: Path
    text: str
    """The URDF with its locked joints fixed, for MuJoCo."""
    options: dict[str, Any]
    end: str
    joints: Sequence[str]
    truth: dict[str, float]
    motion: Any
    largest: tuple[float, float]
    """Upper bounds of friction, damping and the payload, and of armatures, for MuJoCo's identification."""


def default_arm() -> Task:
    """Return the motion of the default arm."""
    text = ARM.read_text("utf-8")
    model = mujoco_model(text, payload=TRUTH["payload"], end="EndEffector", **HIDDEN)
    motion = move(model, [-0.5, 0.6], 0.8, 60.0, fastest=2.0)
    return Task(ARM, text, {"gravity": GRAVITY}, "EndEffector", JOINTS, TRUTH, motion, (1.0, 0.1))


def arm_of(name: str) -> Task:
    """Return the motion of a robot of example-robot-data, with a payload of 1.5 kg."""
    urdf, end, home, lock, hidden = ARMS[name]
    groups, text = dict(zip(("friction", "damping", "armature"), hidden)), without_fingers(urdf.read_text("utf-8"))
    model = mujoco_model(text, payload=1.5, end=end, **groups)
    truth = {f"{group}[{i}]": value for group, values in groups.items() for i, value in enumerate(values, 1)}
    joints = [model.joint(i).name for i in range(model.njnt)]
    options = {"frame": end, "lock": lock}
    return Task(urdf, text, options, end, joints, {**truth, "payload": 1.5}, move(model, home, 0.9, 60.0), (50.0, 5.0))


def main(seeds: int) -> None:
    """Print how often the intervals contain the true values."""
    motion = default_arm().motion
    truth, errors, flagged, begin = np.array([*TRUTH.values()]), [], 0, time.process_time()
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as folder:
            bag = bag_of(Path(folder) / "bag", JOINTS, *noisy(motion, seed))
            result = twodof.fit(ARM, bag, FREE, gravity=GRAVITY)
        errors.append([(p.after - t) / p.deviation for p, t in zip(result.parameters, truth)])
        flagged += not result.explains
    z = np.array(errors)
    print("| parameter | truth | in its 95 % interval | mean error, σ |\n| --- | --- | --- | --- |")
    for name, value, column in zip(TRUTH, truth, z.T):
        held = 100.0 * np.mean(np.abs(column) < 1.96)
        print(f"| {name} | {value:g} | {held:.1f} % | {column.mean():+.2f} |")
    seconds = (time.process_time() - begin) / seeds
    print(f"all: {100.0 * np.mean(np.abs(z) < 1.96):.1f} %; {flagged} of {seeds} are not explained by the model")
    print(f"{seconds:.2f} s of processor time a fit, the writing of the bag included")


def compare(task: Task, seeds: int) -> None:
    """Print the held-out errors of the true parameters, of fits, and of MuJoCo's identification, of all seeds."""
    model = read_model(task.urdf, FREE, **task.options)
    parameters = model.parameters(task.options.get("gravity", (0.0, 0.0, -9.81)))
    squares, seconds = defaultdict[str, Any](list), defaultdict[str, float](float)
    for seed in range(seeds):
        begin = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            bag = bag_of(Path(folder) / "bag", task.joints, *noisy(task.motion, seed))
            result = twodof.fit(task.urdf, bag, FREE, **task.options)
            fitted, held = stretches([twodof.read_bag(bag)], model.robot)
        seconds["fit"] += time.process_time() - begin
        begin = time.process_time()
        theirs = sysid(task, fitted)
        seconds["sysid"] += time.process_time() - begin
        exact = [part._replace(tau=task.motion[2][np.rint(part.t / part.step).astype(int)]) for part in held]
        ours = [p.after for p in result.parameters]
        # the recorded controller holds each effort for 1 ms, which is a delay of 0.5 ms
        found = {"true": ([*task.truth.values()], 5e-4), "fit": (ours, result.delay[0]), "sysid": (theirs, 0.0)}
        for name, (x, delay) in found.items():
            values = parameters.dynamics(parameters.values(np.array(x)))
            every = [[predict(model.robot, values, delay, part) for part in parts] for parts in (held, exact)]
            squares[name].append([np.mean(deviation(held, each) ** 2) for each in every])
    print(f"windows of {WINDOW:g} s; sysid fits positions in such windows, from the same states, in steps of 1 ms\n")
    print("| parameters | held-out error, mrad | ratio | with exact efforts, mrad | processor time a seed, s |")
    print("| --- | --- | --- | --- | --- |")
    rms = {name: 1e3 * np.sqrt(np.mean(each, axis=0)) for name, each in squares.items()}
    for name, (error, quiet) in rms.items():
        print(f"| {name} | {error:.1f} | {error / rms['true'][0]:.2f} | {quiet:.1f} | {seconds[name] / seeds:.0f} |")


def sysid(task: Task, fitted: Sequence[Stretch]) -> list[float]:
    """Return the parameters, in the order of the truth, that MuJoCo's identification finds from windows of stretches.

    It begins at one fiftieth of their largest values, which is 0.02 N·m of friction for the default arm.
    """
    from mujoco import sysid as own

    gravity, n = task.options.get("gravity", (0.0, 0.0, -9.81)), len(task.joints)
    with tempfile.NamedTemporaryFile(suffix=".xml") as file:
        mujoco.mj_saveLastXML(file.name, mujoco_model(task.text, gravity=gravity))
        spec = mujoco.MjSpec.from_file(file.name)
    spec.option.timestep, spec.option.integrator = 1e-3, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    point: Any = {"mass": 1e-3, "inertia": [1e-9] * 3, "ipos": [0.0] * 3, "explicitinertial": True}
    # the frame of the payload on the link that the last joint moves, whose body MuJoCo has named after it
    frame = load_robot(task.text, task.end, "xyz")
    end = frame.model.frames[frame.model.getFrameId(task.end)]
    link = read_urdf(task.text).joints[frame.model.names[end.parentJoint]].child
    spec.body(link).add_body(name="payload", pos=end.placement.translation, **point)
    for joint in task.joints:
        spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)

    def robot(parameters: Any, spec: Any) -> Any:
        x, model = parameters.as_vector(), spec.compile()
        model.dof_frictionloss[:], model.dof_damping[:], model.dof_armature[:] = x[: 3 * n].reshape(3, n)
        model.body("payload").mass[:] = x[-1]
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    free = own.ParameterDict({})
    for name in task.truth:
        most = task.largest["armature" in name]
        free.add(own.Parameter(name, 0.02 * most, 1e-6, most))
    model, windows, size = robot(free, spec), [], round(WINDOW / fitted[0].step)
    for part in fitted:
        for k in range(0, len(part.t) - size, size):
            t, rows = part.t[k : k + size + 1] - part.t[k], slice(k, k + size + 1)
            names = [f"{joint}_qpos" for joint in task.joints]
            measured = own.TimeSeries.from_names(t, part.measured[rows], model, names)
            state = own.create_initial_state(model, part.q[k], part.v[k])
            windows.append((f"{len(windows)}", state, own.TimeSeries(t, part.tau[rows]), measured))
    data = own.ModelSequences("robot", spec, *map(list, zip(*windows)), allow_missing_sensors=True)
    misfit = own.build_residual_fn(models_sequences=[data], build_model=robot, n_threads=1)
    found, _ = own.optimize(free, misfit, verbose=False, max_iters=50)
    return [*map(float, found.as_vector())]


if __name__ == "__main__":
    if sys.argv[1:2] == ["sysid"]:
        compare(arm_of(sys.argv[3]) if sys.argv[3:] else default_arm(), int(sys.argv[2]) if sys.argv[2:] else 3)
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
