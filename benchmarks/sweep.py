"""How well ``twodof sweep`` uses two workers, and what it adds to a run.

    python benchmarks/sweep.py [RUNS] [STOP_TIME]

Sweeps the native default arm with one local worker and with two, in turns, and runs points through
the bare master in this process: a new instance each, no bag, no metrics. Wall times of whole calls,
with the start of the workers and the last byte of the table.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import twodof

TURNS = 3
SINGLE = 300  # runs of the bare master


def timed(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def main() -> None:
    """Measure and print."""
    runs = int(sys.argv[1]) if sys.argv[1:] else 2000
    stop_time = float(sys.argv[2]) if sys.argv[2:] else 5.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "TwoDof-native.fmu"
        fmu = twodof.load_fmu(twodof.build_fmu(path, twodof.FmuOptions(native=True)))
        ranges = {"Kp": (10.0, 200.0), "Kd": (5.0, 80.0)}

        def swept(workers: int) -> None:
            twodof.sweep(fmu, ranges=ranges, random=runs, stop_time=stop_time, workers=workers)

        def bare() -> None:
            for k in range(SINGLE):
                settings = {"Kp": 10.0 + 190.0 * k / SINGLE, "Kd": 40.0}
                twodof.simulate(fmu, stop_time=stop_time, settings=settings)

        turns = [
            (timed(lambda: swept(1)), timed(lambda: swept(2)), timed(bare)) for _ in range(TURNS)
        ]
    one, two, single = map(median, zip(*turns))
    speed_up = median(turn[0] / turn[1] for turn in turns)
    ratio = median((turn[0] / runs) / (turn[2] / SINGLE) for turn in turns)
    print(f"{runs} runs of {stop_time:g} s, native flavour, medians of {TURNS} turns\n")
    print(f"  1 worker       {one:6.2f} s  {1e3 * one / runs:6.2f} ms a run")
    print(f"  2 workers      {two:6.2f} s  {1e3 * two / runs:6.2f} ms a run")
    print(f"  bare master            {1e3 * single / SINGLE:9.2f} ms a run\n")
    print(f"  2 workers against 1: {speed_up:.2f} times; wanted >= 1.7")
    print(f"  a run of 1 worker against the bare master: {ratio:.2f}; wanted <= 2")


if __name__ == "__main__":
    main()
