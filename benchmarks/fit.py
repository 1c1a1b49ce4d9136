"""Measure how often the 95 % intervals of fits contain the true values, and how well fitted robots predict.

    python benchmarks/fit.py [SEEDS]         the default arm, 60 s; SEEDS seeds of the noise (200), about 3 minutes
    python benchmarks/fit.py sysid [SEEDS]   held-out errors, also of MuJoCo's identification, 1.5 minutes a seed (3);
                                             needs `pip install 'mujoco[sysid]>=4'`

MuJoCo makes the recordings, in steps of 0.1 ms, with friction, damping, armature and a payload that the URDF does not
have. Positions have noise of 1e-4 rad, efforts of 2 %. The motion is recorded once; each seed draws its noise.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import twodof
from twodof.identification.fitting import read_model
from twodof.identification.prediction import WINDOW, deviation, predict
from twodof.identification.stretches import Stretch, stretches

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from motions import bag_of, move, mujoco_model, noisy
from test_fit import ARM, FREE, GRAVITY, HIDDEN, JOINTS, TRUTH


def recorded_motion() -> Any:
    """Return MuJoCo's motion of the default arm with hidden parameters."""
    model = mujoco_model(ARM.read_text("utf-8"), payload=TRUTH["payload"], end="EndEffector", **HIDDEN)
    return move(model, [-0.5, 0.6], 0.8, 60.0, fastest=2.0)


def main(seeds: int) -> None:
    """Print how often the intervals contain the true values."""
    motion = recorded_motion()
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
    print(f"all: {100.0 * np.mean(np.abs(z) < 1.96):.1f} %; {flagged} of {seeds} said to be unexplained")
    print(f"{seconds:.2f} s of processor time a fit, the writing of the bag included")


def compare(seeds: int) -> None:
    """Print the held-out errors of the true parameters, of fits, and of MuJoCo's identification, of all seeds."""
    motion, model = recorded_motion(), read_model(ARM, FREE, gravity=GRAVITY)
    parameters, squares = model.parameters(GRAVITY), defaultdict[str, Any](list)
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as folder:
            bag = bag_of(Path(folder) / "bag", JOINTS, *noisy(motion, seed))
            result = twodof.fit(ARM, bag, FREE, gravity=GRAVITY)
            fitted, held = stretches([twodof.read_bag(bag)], model.robot)
        exact = [part._replace(tau=motion[2][np.rint(part.t / part.step).astype(int)]) for part in held]
        ours = [p.after for p in result.parameters]
        # the recorded controller holds each effort for 1 ms, which is a delay of 0.5 ms
        found = {"true": ([*TRUTH.values()], 5e-4), "fit": (ours, result.delay[0]), "sysid": (sysid(fitted), 0.0)}
        for name, (x, delay) in found.items():
            values = parameters.dynamics(parameters.values(np.array(x)))
            every = [[predict(model.robot, values, delay, part) for part in parts] for parts in (held, exact)]
            squares[name].append([np.mean(deviation(held, each) ** 2) for each in every])
    print(f"windows of {WINDOW:g} s; sysid fits positions in such windows, from the same states, in steps of 1 ms\n")
    print("| parameters | held-out error, mrad | ratio | with exact efforts, mrad |\n| --- | --- | --- | --- |")
    rms = {name: 1e3 * np.sqrt(np.mean(each, axis=0)) for name, each in squares.items()}
    for name, (error, quiet) in rms.items():
        print(f"| {name} | {error:.1f} | {error / rms['true'][0]:.2f} | {quiet:.1f} |")


def sysid(fitted: Sequence[Stretch]) -> list[float]:
    """Return the parameters, in the order of TRUTH, that MuJoCo's identification finds from windows of stretches."""
    from mujoco import sysid as own

    with tempfile.NamedTemporaryFile(suffix=".xml") as file:
        mujoco.mj_saveLastXML(file.name, mujoco_model(ARM.read_text("utf-8"), gravity=GRAVITY))
        spec = mujoco.MjSpec.from_file(file.name)
    spec.option.timestep, spec.option.integrator = 1e-3, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    point: Any = {"mass": 1e-3, "inertia": [1e-9] * 3, "ipos": [0.0] * 3, "explicitinertial": True}
    spec.body("link2").add_body(name="payload", pos=[0.15, 0, 0], **point)
    for joint in JOINTS:
        spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)

    def arm(parameters: Any, spec: Any) -> Any:
        x, model = parameters.as_vector(), spec.compile()
        model.dof_frictionloss[:], model.dof_damping[:], model.dof_armature[:] = x[:2], x[2:4], x[4:6]
        model.body("payload").mass[:] = x[6]
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    free = own.ParameterDict({})
    for name in TRUTH:
        start, most = (5e-4, 0.1) if "armature" in name else (0.02, 1.0)
        free.add(own.Parameter(name, start, 1e-6, most))
    model, windows, size = arm(free, spec), [], round(WINDOW / fitted[0].step)
    for part in fitted:
        for k in range(0, len(part.t) - size, size):
            t, rows = part.t[k : k + size + 1] - part.t[k], slice(k, k + size + 1)
            measured = own.TimeSeries.from_names(t, part.measured[rows], model, [f"{joint}_qpos" for joint in JOINTS])
            state = own.create_initial_state(model, part.q[k], part.v[k])
            windows.append((f"{len(windows)}", state, own.TimeSeries(t, part.tau[rows]), measured))
    data = own.ModelSequences("arm", spec, *map(list, zip(*windows)), allow_missing_sensors=True)
    misfit = own.build_residual_fn(models_sequences=[data], build_model=arm, n_threads=1)
    found, _ = own.optimize(free, misfit, verbose=False, max_iters=50)
    return [*map(float, found.as_vector())]


if __name__ == "__main__":
    if sys.argv[1:2] == ["sysid"]:
        compare(int(sys.argv[2]) if len(sys.argv) > 2 else 3)
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
