"""Run the points of a sweep one after another on one instance of the FMU, as a worker's task; batches for workers."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import islice
from math import isfinite, nan
from pathlib import Path
from typing import Any

from ..errors import SimulationError
from ..files import temporary_folder
from ..fmu import Instance, SystemInstance, instantiate
from ..signatures import ignore, never
from ..simulation.experiments import Experiment, ExperimentOptions, experiment
from ..simulation.input_values import resolve
from ..simulation.judge import Judge
from ..simulation.master import simulate
from ..simulation.setup import robot_of
from ..simulation.stepping import judge_of, stepped
from ..simulation.verdict import METRICS

Point = tuple[int, tuple[float, ...]]  # number of a run, and the values of the varied variables
Row = tuple[Any, ...]  # the columns of the table: number, values, metrics, end time in s, outcome, and message or None

BATCH_TIME = 0.25  # s, of one batch
MAX_BATCH = 256
MOST_DEATHS = 3  # deaths of a run's worker, two of them while it ran this run alone
GIVEN_UP = "the process that ran it died, repeatedly"
LOOK = 0.2  # s between two checks of ``stop``


@dataclass(frozen=True)
class Job:
    """Common settings of all runs of a sweep."""

    content: bytes  # bytes of the FMU's file
    file: str  # name of the FMU's file
    names: tuple[str, ...]
    options: ExperimentOptions  # options of ``experiment``: stop_time, step, settings
    bags: Path | None  # folder for a bag of each run; None: no bags


class Runner:
    """Runs points of a job, as a context that frees the FMU at its end."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._instance: Instance | SystemInstance | None = None
        self._used = ExitStack()  # contexts that the instance needs
        with ExitStack() as stack:
            folder = stack.enter_context(temporary_folder())
            path = folder / job.file
            path.write_bytes(job.content)
            self._base = experiment(path, **job.options)
            self._robot = robot_of(self._base.fmu.urdf)
            self._folder = stack.pop_all()

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *exception: object) -> None:
        self._drop()
        self._folder.close()

    def run(self, point: Point) -> Row:
        """Simulate one point; return its row.

        Raises:
            FmuError: the FMU cannot be loaded.
            BagError: the run's bag cannot be written.
        """
        number, values = point
        settings = resolve(self._base.fmu, dict(zip(self._job.names, values)))
        given = {**self._base.given, **settings}
        run = replace(self._base, start_values={**self._base.start_values, **given}, given=given)
        try:
            judge = self._judged(run, number)
        except SimulationError as error:
            self._drop()  # the instance may be in any state
            return lost(point, run.time(error.k), error.outcome, str(error))
        found = judge.metrics()
        metrics = (found.get(name, nan) for name in METRICS)
        return (
            number,
            *values,
            *(value if isfinite(value) else nan for value in metrics),
            run.time(run.steps),
            "finished",
            None,
        )

    def _judged(self, run: Experiment, number: int) -> Judge:
        """Simulate, with a bag if the job requests one; return the judge of all samples."""
        if self._job.bags is not None:
            from ..bag.writer import Bag  # rosbags takes half a second to import

            bag = Bag(self._job.bags / f"{number:06d}", overwrite=True)
            return simulate(run, bag, instance=self._fresh()).judge
        judge = judge_of(run, self._robot)
        deque(stepped(run, judge, None, never, ignore, ignore, self._fresh(), ()), maxlen=0)  # makes no samples
        return judge

    def run_all(self, points: Iterable[Point]) -> tuple[list[Row], float]:
        """Return the rows of some points, and their duration, s; errors as in ``run``."""
        begin = time.perf_counter()
        return [self.run(point) for point in points], time.perf_counter() - begin

    def _fresh(self) -> Instance | SystemInstance:
        """Return the instance in its state after instantiation."""
        if self._instance is None:
            self._instance = self._used.enter_context(instantiate(self._base.fmu))
        else:
            self._instance.reset()
        return self._instance

    def _drop(self) -> None:
        self._instance = None
        self._used.close()


def lost(point: Point, end: float, outcome: str, message: str) -> Row:
    """Return the row of a run that was not finished."""
    number, values = point
    return (number, *values, *[nan] * len(METRICS), end, outcome, message)


class Batches:
    """Divides points into batches of about a quarter of a second.

    If a worker dies, each unfinished run of its batch is repeated in a batch of its own. A run that kills two more
    workers has the outcome "crashed".

    Args:
        left: number of runs that have no row yet.
    """

    def __init__(self, points: Iterator[Point], left: int) -> None:
        self._points, self.left = points, left
        self._size = 1
        self._suspects: deque[Point] = deque()
        self._deaths: Counter[int] = Counter()

    def next(self, *, alone: bool) -> list[Point]:
        """Return the next batch; empty if all runs are taken, or if the rest must run alone and cannot yet."""
        batch = list(islice(self._points, self._size))
        return [self._suspects.popleft()] if not batch and alone and self._suspects else batch

    def done(self, rows: list[Row], duration: float) -> list[Row]:
        """Return the rows of a batch, and adapt the batch size to its time, s."""
        self.left -= len(rows)
        if duration > 0.0:
            fitting = int(BATCH_TIME * len(rows) / duration)
            self._size = max(1, min(MAX_BATCH, fitting, 4 * self._size))
        return rows

    def died(self, batch: list[Point]) -> list[Row]:
        """Return the rows of runs that are given up after the death of a worker."""
        self._deaths.update(number for number, _ in batch)
        self._suspects.extend(p for p in batch if self._deaths[p[0]] < MOST_DEATHS)
        given_up = [p for p in batch if self._deaths[p[0]] >= MOST_DEATHS]
        return self.done([lost(p, nan, "crashed", GIVEN_UP) for p in given_up], 0.0)
