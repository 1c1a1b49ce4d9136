"""Measure how often the 95 % intervals of fits contain the true values.

    python benchmarks/fit.py [SEEDS]         the default arm, 60 s; SEEDS seeds of the noise (200), about 3 minutes

MuJoCo makes the recordings, in steps of 0.1 ms, with friction, damping, armature and a payload that the URDF does not
have. Positions have noise of 1e-4 rad, efforts of 2 %. The motion is recorded once; each seed draws its noise.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import twodof

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from motions import bag_of, move, mujoco_model, noisy
from test_fit import ARM, FREE, GRAVITY, HIDDEN, JOINTS, TRUTH


def main(seeds: int) -> None:
    """Print how often the intervals contain the true values."""
    model = mujoco_model(ARM.read_text("utf-8"), payload=TRUTH["payload"], end="EndEffector", **HIDDEN)
    motion = move(model, [-0.5, 0.6], 0.8, 60.0, fastest=2.0)
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


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
