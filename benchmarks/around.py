"""Cost of a run in addition to the native engine: logging, scenes, sweeps, start-up, large bags.

    python benchmarks/around.py [MESSAGES]

Times are processor times. The compared programs run in turns, so that the machine's noise affects all of them; ratios
are medians over the turns. Processes are measured with their children and with compiled bytecode, as pip installs it.
MESSAGES is the size of the large bag (default: ten million messages, about 1.3 GB of disk during the run).
"""

from __future__ import annotations

import ctypes
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from statistics import median
from time import thread_time
from unittest.mock import patch

import numpy as np
from arms import STEP, STEPS, compiled, shipped_arm
from report import Figure, machine, print_figures, print_rows, spent

import twodof
from twodof.simulation.judge import BLOCK, OUTPUTS, Judge
from twodof.sweeps.runner import Job, Runner

TURNS, SAMPLES, RUNS, SWEPT, BLOCKS, LONG = 5, 50_000, 20, 400, 15, 1_000_000
MESSAGES = 10_000_000
TWODOF = [sys.executable, "-m", "twodof"]


def floor(folder: Path) -> Callable[[int, bool], float]:
    """Return a function that measures a step in C, s, over some steps, logged or bare."""
    cost = compiled(shipped_arm(), folder, "logged_step.c").logged_cost
    cost.argtypes = (ctypes.c_double, ctypes.c_int, ctypes.c_char_p, ctypes.c_int)
    cost.restype = ctypes.c_double
    log = os.fsencode(folder / "log")
    return lambda steps, logs: float(cost(STEP, steps, log, logs))


MEASURE = """
import resource, subprocess, sys
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL).returncode
usage = resource.getrusage(resource.RUSAGE_CHILDREN)
print(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)
sys.exit(code)
"""


def process(*arguments: str, folder: Path) -> tuple[float, float]:
    """Measure the processor time, s, and the peak memory, MB, of a command and its children.

    A small process starts the command, because the memory of a child initially includes that of its parent.
    """
    command = [sys.executable, "-S", "-c", MEASURE, *TWODOF, *arguments]
    caching = {**os.environ, "PYTHONDONTWRITEBYTECODE": ""}
    done = subprocess.run(command, cwd=folder, check=True, stdout=subprocess.PIPE, text=True, env=caching)
    seconds, memory = map(float, done.stdout.split())
    return seconds, memory


def big_bag(fmu: twodof.Fmu, path: Path, messages: int) -> None:
    """Write the first ten seconds repeatedly, which is faster than simulating all."""
    run = twodof.experiment(fmu, stop_time=messages * STEP, step=STEP, stamp_start=1_700_000_000)
    with twodof.Bag(path).begin(run) as bag:
        source = twodof.samples(run)
        some = [next(source) for _ in range(1000)]
        for k in range(messages):
            sample = some[k % len(some)]
            stamp = some[0].stamp + round(k * STEP * 1e9)
            bag.write(sample._replace(k=k, t=k * STEP, stamp=stamp))
        source.close()


def steps_around(fmu: twodof.Fmu, in_c: Callable[[int, bool], float], folder: Path) -> Iterator[Figure]:
    run = twodof.experiment(fmu, stop_time=SAMPLES * STEP, step=STEP)

    def logged(**options: bool) -> float:
        bag = twodof.Bag(folder / "bag", overwrite=True, **options)
        return spent(lambda: twodof.simulate(run, bag))[0] / SAMPLES

    turns = [(in_c(SAMPLES, True), logged(), logged(scene=True)) for _ in range(TURNS)]
    in_c_alone, plain, scene = (1e6 * median(times) for times in zip(*turns))
    print_rows(
        f"A logged sample of a run of {SAMPLES}, default arm",
        ("C: doStep, getReal, CDR, write", f"{in_c_alone:.1f} µs"),
        ("twodof.simulate and its bag", f"{plain:.1f} µs"),
        ("with scene=True", f"{scene:.1f} µs"),
    )
    ratio = median(turn[1] / turn[0] for turn in turns)
    yield Figure(
        f"a sample of a run of {SAMPLES} in twodof.simulate with its bag, MCAP without fsync /"
        " doStep, getReal, CDR and fwrite in a loop of C, flags as in the FMU",
        f"{ratio:.2f}",
        "<= 2.2",
    )
    ratio = median(turn[2] / turn[1] for turn in turns)
    yield Figure("the same with scene=True / without", f"{ratio:.2f}", "<= 2")


def verdict_around(fmu: twodof.Fmu, folder: Path) -> Iterator[Figure]:
    """Compare the verdict of a long run with the run and its bag, and its memory with that of a tenth of it."""
    row = bytes(8 * sum(len(fmu.vector(group)) for group in OUTPUTS))
    flush, flushes = Judge.flush, []

    def timed(judge: Judge) -> None:
        begin = thread_time()
        flush(judge)
        flushes.append(thread_time() - begin)

    def written() -> None:
        write = BytesIO().write
        for _ in range(BLOCK):
            write(row)

    def ran(steps: int) -> tuple[float, float]:
        bag = twodof.Bag(folder / "long", overwrite=True)
        seconds = spent(lambda: twodof.simulate(fmu, bag, stop_time=steps * STEP, step=STEP))[0]
        return seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    _, memory = ran(LONG // 10)
    with patch.object(Judge, "flush", timed):
        seconds, peak = ran(LONG)
    rows = LONG / BLOCK * min(spent(written)[0] for _ in range(BLOCKS))
    what = f"the verdict of a run of {LONG:.0e} samples / the run with its bag".replace("e+0", "e")
    yield Figure(what, f"{100 * (rows + sum(flushes)) / seconds:.1f} %", "<= 2 %")
    yield Figure("peak memory of this run more than that of a tenth of it", f"{peak - memory:.0f} MB", "<= 10 MB")


def sweep_around(fmu: twodof.Fmu, in_c: Callable[[int, bool], float]) -> Iterator[Figure]:
    options = {"stop_time": STEPS * STEP, "step": STEP, "settings": {}}
    job = Job(fmu.path.read_bytes(), fmu.path.name, ("Kp",), options, None)
    points = [(k, (40.0 + k,)) for k in range(RUNS)]
    with Runner(job) as runner:
        runner.run(points[0])
        turns = [
            (RUNS * STEPS * in_c(STEPS * RUNS, False), spent(lambda: runner.run_all(points))[0]) for _ in range(TURNS)
        ]
    bare, swept = (1e3 * median(times) / RUNS for times in zip(*turns))
    ratio = median(turn[1] / turn[0] for turn in turns)
    print_rows(
        f"A run of a sweep, {STEPS} steps",
        ("C: doStep alone", f"{bare:.2f} ms"),
        ("run, metrics and row", f"{swept:.2f} ms"),
    )
    yield Figure(
        f"a run of a sweep, {STEPS} steps with metrics and row, in this process / as many bare"
        " doSteps in a loop of C, flags as in the FMU",
        f"{ratio:.2f}",
        "<= 1.5",
    )


def workers_around(fmu: twodof.Fmu) -> Iterator[Figure]:
    """Compare two workers with one.

    A start is a sweep of one run for each worker; a run is the cost of one more run.
    """
    gains = np.linspace(10.0, 200.0, SWEPT)

    def swept(workers: int, count: int) -> np.ndarray:
        grid = {"Kp": gains[:count], "Kd": [40.0]}
        return np.array(spent(lambda: twodof.sweep(fmu, grid=grid, workers=workers)))

    def start_and_run(workers: int) -> np.ndarray:
        """Measure a start and a run, by coordinator and workers, s."""
        start = swept(workers, workers)
        return np.array([start, (swept(workers, SWEPT) - start) / (SWEPT - workers)])

    start_and_run(1)  # this process has imported all that it needs
    turns = [(start_and_run(1), start_and_run(2)) for _ in range(TURNS)]
    one, two = (np.median(rows, axis=0) for rows in map(np.array, zip(*turns)))
    print_rows(
        f"A sweep of {SWEPT} runs",
        ("", "start", "run", "of that the coordinator"),
        *(
            (name, f"{start.sum():.2f} s", f"{1e3 * run.sum():.2f} ms", f"{1e3 * run[0]:.3f} ms")
            for name, (start, run) in (("1 worker", one), ("2 workers", two))
        ),
    )
    shared = median(2 * turn[0][1][1] / turn[1][1].sum() for turn in turns)
    yield Figure("a run more of a sweep: 2 workers on two free cores / 1, in speed", f"{shared:.2f}", ">= 1.7")


def processes(folder: Path, messages: int) -> Iterator[Figure]:
    bag, count = "big", f"{messages:.0e} messages".replace("e+0", "e")
    gains = ("--grid", "Kp=10:200:20", "--grid", "Kd=5:80:16")
    process("run", "--native", "-o", "run", folder=folder)  # which builds the FMU
    rows = {
        "twodof --version": (("--version",), 5, ""),
        "run --native, 5 s": (("run", "--native", "-o", "run", "--overwrite"), 5, "0.25 s"),
        "sweep of 320 runs": (("sweep", *gains), 3, "3 s"),
        f"info of {count}": (("info", bag), 3, "0.5 s, 100 MB"),
        f"plot of {count}": (("plot", bag, "-o", "big.png"), 1, "15 s, 400 MB"),
    }
    printed = []
    for name, (arguments, times, wanted) in rows.items():
        costs = [process(*arguments, folder=folder) for _ in range(times)]
        seconds, memory = (median(column) for column in zip(*costs))
        printed.append((name, f"{seconds:.2f} s", f"{memory:.0f} MB"))
        if wanted:
            measured = f"{seconds:.2f} s" + f", {memory:.0f} MB" * ("MB" in wanted)
            yield Figure(f"process 'twodof {name}', with its children", measured, f"<= {wanted}")
    print_rows("A process as a whole", *printed)


def main(messages: int = MESSAGES) -> list[Figure]:
    """Measure and print; return the figures that have a bound."""
    with tempfile.TemporaryDirectory(prefix="twodof_") as name:
        folder = Path(name)
        options = twodof.FmuOptions(native=True)
        fmu = twodof.load_fmu(twodof.build_fmu(folder / "Native.fmu", options))
        in_c = floor(folder)
        figures = [
            *steps_around(fmu, in_c, folder),
            *verdict_around(fmu, folder),
            *sweep_around(fmu, in_c),
            *workers_around(fmu),
        ]
        big_bag(fmu, folder / "big", messages)
        return [*figures, *processes(folder, messages)]


if __name__ == "__main__":
    print(machine())
    print_figures(main(*map(int, sys.argv[1:])))
