"""What ``twodof sweep`` adds to a run, what its start costs, and how well two workers share.

    python benchmarks/sweep.py [RUNS] [STOP_TIME]

Sweeps the native default arm with one local worker and with two, in turns with a loop of the bare
master in this process, on one instance that is reset between runs. All times are processor time of
all processes together, so that what else the machine does counts little. A start is a sweep of
one run for each worker, with all imports but those of this process; a run is what a run more costs.
"""

from __future__ import annotations

import resource
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import numpy as np  # noqa: E402
from steps import Figure  # noqa: E402

import twodof  # noqa: E402
from twodof.fmu import instantiate  # noqa: E402

TURNS = 7
STEP = 0.01


def cost(work: Callable[[], object]) -> np.ndarray:
    """Processor time of this process, and of those that it has started and that have ended, s."""

    def spent() -> np.ndarray:
        usages = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        return np.array([usage.ru_utime + usage.ru_stime for usage in usages])

    before = spent()
    work()
    return spent() - before


def main(runs: int = 400, stop_time: float = 5.0) -> list[Figure]:
    """Measure and print; the figures of which something is wanted."""
    times = {"stop_time": stop_time, "step": STEP}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "TwoDof-native.fmu"
        fmu = twodof.load_fmu(twodof.build_fmu(path, twodof.FmuOptions(native=True)))
        gains = {"Kp": np.linspace(10.0, 200.0, runs), "Kd": [40.0]}

        def swept(workers: int, count: int) -> np.ndarray:
            grid = {**gains, "Kp": gains["Kp"][:count]}
            return cost(lambda: twodof.sweep(fmu, grid=grid, workers=workers, **times))

        def start_and_run(workers: int) -> np.ndarray:
            """Of a start and of a run, by coordinator and workers, s."""
            start = swept(workers, workers)
            return np.array([start, (swept(workers, runs) - start) / (runs - workers)])

        def bare() -> float:
            """Of a run, s."""
            experiments = [
                twodof.experiment(fmu, settings={"Kp": kp, "Kd": 40.0}, **times)
                for kp in gains["Kp"]
            ]

            def loop() -> None:
                for experiment in experiments:
                    instance.reset()
                    twodof.simulate(experiment, instance=instance)

            with instantiate(fmu) as instance:
                return float(cost(loop).sum() / runs)

        start_and_run(1)  # this process has imported all that it needs
        turns = [(start_and_run(1), start_and_run(2), bare()) for _ in range(TURNS)]
    one, two, single = (np.median(rows, axis=0) for rows in map(np.array, zip(*turns)))
    added = median(turn[0][1].sum() / turn[2] for turn in turns)
    shared = median(2 * turn[0][1][1] / turn[1][1].sum() for turn in turns)
    print(f"{runs} runs of {stop_time:g} s in steps of {STEP:g} s, native flavour, one thread;")
    print("sweep: metrics and table; bare master: neither; one instance a process in both.")
    print(f"Processor time, medians of {TURNS} turns\n")
    print("                  start       run   of that the coordinator")
    for name, (start, run) in (("1 worker ", one), ("2 workers", two)):
        print(f"  {name}    {start.sum():7.2f} s {1e3 * run.sum():6.2f} ms  {1e3 * run[0]:6.3f} ms")
    print(f"  bare master            {1e3 * single:6.2f} ms\n")
    print(f"  a run in 1 worker against the bare master: {added:.2f}; wanted <= 1.25")
    print(f"  2 workers on two free cores are {shared:.2f} times as fast as 1; wanted >= 1.7")
    print(f"  the coordinator can keep {one[1, 1] / one[1, 0]:.0f} workers busy")
    run = f"a run more of a sweep, {stop_time:g} s in steps of {STEP:g} s, with metrics and table"
    return [
        Figure(f"{run}, by 1 worker / by twodof.simulate alone", f"{added:.2f}", "<= 1.25"),
        Figure(f"{run}: 2 workers on two free cores / 1, in speed", f"{shared:.2f}", ">= 1.7"),
    ]


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]), *map(float, sys.argv[2:3]))
