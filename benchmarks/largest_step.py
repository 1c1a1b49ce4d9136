"""Measure error and cost of `max_step` on chosen robots: the reason for its default of 1 ms.

    python benchmarks/largest_step.py [ROBOT …]      about a minute for panda, ur5_robot and kinova

Each robot starts at its home pose with up to 1 rad/s in each joint, under each control, and is sampled every 10 ms for
2 s. Targets are up to 0.1 m from home along each axis under task control, and up to 0.5 rad in each joint under joint
control; the bare plant falls. "error" is the largest difference of a joint, rad or m, at the default tolerances, from
the same motion at rtol 1e-11 and atol 1e-13. "time" is the processor time of the run without a bag, relative to that
with 1 ms; runs take turns.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from report import machine, print_rows, spent

import twodof

STEP, STOP, MOTIONS = 0.01, 2.0, 4
CAPS = (1e-3, 2e-3, 5e-3, 1e-2)
EXACT = {"rtol": 1e-11, "atol": 1e-13}


def motions(fmu: Path, control: str) -> list[dict[str, float]]:
    """Return the settings of random motions."""
    first, draw = next(iter(twodof.samples(fmu, step=STEP, stop_time=STEP))), np.random.default_rng(7)

    def settings(group: str, centre: tuple[float, ...], reach: float) -> dict[str, float]:
        return {f"{group}[{i}]": value + draw.uniform(-reach, reach) for i, value in enumerate(centre, 1)}

    def motion() -> dict[str, float]:
        start = settings("v_start", (0.0,) * len(first.q), 1.0)
        wanted = {"task": ("x_des", first.x, 0.1), "joint": ("q_des", first.q, 0.5)}.get(control)
        return start | (settings(*wanted) if wanted else {})

    return [motion() for _ in range(MOTIONS)]


def run(fmu: Path, settings: Mapping[str, float]) -> tuple[np.ndarray, float]:
    """Return q of all samples, and the processor time, s."""
    q: list[tuple[float, ...]] = []
    samples = twodof.samples(fmu, step=STEP, stop_time=STOP, settings=settings)
    own, _ = spent(lambda: q.extend(sample.q for sample in samples))
    return np.array(q), own


def measure(fmu: Path, control: str) -> list[str]:
    """Return, for each cap, the largest error and the median time relative to that of the first cap."""
    errors, times = np.empty((MOTIONS, len(CAPS))), np.empty((MOTIONS, len(CAPS)))
    for i, settings in enumerate(motions(fmu, control)):
        exact, _ = run(fmu, settings | EXACT)
        for j, cap in enumerate(CAPS):
            q, times[i, j] = run(fmu, settings | {"max_step": cap})
            errors[i, j] = np.abs(q - exact).max()
    ratios = np.median(times / times[:, :1], axis=0)
    return [f"{error:.0e}, {ratio:.2f}" for error, ratio in zip(errors.max(axis=0), ratios)]


def main(robots: list[str]) -> None:
    rows: list[list[str]] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in robots:
            for control in ("task", "joint", "effort"):
                for native in (True, False):
                    own = twodof.stock_robot(name)
                    options = replace(own, control=control, native=native, meshes=False)
                    flavour = "native" if native else "Python"
                    fmu = twodof.build_fmu(Path(folder) / f"{name}-{control}-{flavour}.fmu", options)
                    rows.append([f"{name}, {control}, {flavour}", *measure(fmu, control)])
    print(machine())
    print_rows("error and time by max_step", ["", *(f"{1e3 * cap:g} ms" for cap in CAPS)], *rows)


if __name__ == "__main__":
    main(sys.argv[1:] or ["panda", "ur5_robot", "kinova"])
