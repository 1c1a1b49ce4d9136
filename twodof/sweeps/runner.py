"""One run of a sweep after the other, on one instance of the FMU: what a worker does."""

from __future__ import annotations

import time
from array import array
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SimulationError
from ..experiments import Experiment, Value, experiment, resolve
from ..files import temporary_folder
from ..fmu import Instance, instantiate
from ..master import Sample, Sink, simulate
from .metrics import METRICS, measure

Point = tuple[int, tuple[float, ...]]
"""Number of a run, and the values of the variables that are varied."""
Row = tuple[Any, ...]
"""Number, values, metrics, end time in s, outcome, message or None; the columns of the table."""


@dataclass(frozen=True)
class Job:
    """What all runs of a sweep share.

    Attributes:
        content: the FMU file's bytes.
        file: its name.
        names: variables that are varied.
        options: of ``experiment``: stop_time, step, settings.
        bags: folder for a bag of each run; None: no bags.
    """

    content: bytes
    file: str
    names: tuple[str, ...]
    options: dict[str, Any]
    bags: str | None


class Runner:
    """Runs points of a job; a context that frees the FMU at its end.

    Raises:
        InputError, FmuError: the job cannot be run.
    """

    def __init__(self, job: Job) -> None:
        self._job = job
        self._instance: Instance | None = None
        self._used = ExitStack()  # what the instance needs
        with ExitStack() as stack:
            folder = stack.enter_context(temporary_folder())
            path = folder / job.file
            path.write_bytes(job.content)
            self._base = experiment(path, **job.options)
            self._folder = stack.pop_all()

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *exception: object) -> None:
        self._drop()
        self._folder.close()

    def run(self, point: Point) -> Row:
        """Simulate one point; its row.

        Raises:
            FmuError: the FMU cannot be loaded.
            BagError: the run's bag cannot be written.
        """
        number, values = point
        settings = resolve(self._base.fmu, dict(zip(self._job.names, values)))
        given = {**self._base.given, **settings}
        run = replace(self._base, start_values={**self._base.start_values, **given}, given=given)
        trace = _Trace()
        sinks: list[Sink] = [trace]
        if self._job.bags is not None:
            from ..bag.writer import Bag  # rosbags takes half a second to import

            sinks.append(Bag(Path(self._job.bags) / f"{number:06d}", overwrite=True))
        try:
            simulate(run, *sinks, instance=self._fresh())
        except SimulationError as error:
            self._drop()  # whatever state it is in
            nothing = [nan] * len(METRICS)
            return (number, *values, *nothing, run.time(error.k), error.outcome, str(error))
        metrics = trace.metrics().values()  # in the order of METRICS
        return (number, *values, *metrics, run.time(run.steps), "finished", None)

    def run_all(self, points: Iterable[Point]) -> tuple[list[Row], float]:
        """Rows of some points, and the time they took, s; errors as of ``run``."""
        begin = time.perf_counter()
        return [self.run(point) for point in points], time.perf_counter() - begin

    def _fresh(self) -> Instance:
        """The instance as it was instantiated."""
        if self._instance is None:
            self._instance = self._used.enter_context(instantiate(self._base.fmu))
        else:
            self._instance.reset()
        return self._instance

    def _drop(self) -> None:
        self._instance = None
        self._used.close()


class _Trace(Sink):
    """A sink that keeps all samples as numbers."""

    def __init__(self) -> None:
        self._values = array("d")

    def begin(self, run: Experiment) -> _Trace:
        """Take the experiment."""
        self._run = run
        return self

    def write(self, sample: Sample) -> None:
        """Keep one sample."""
        self._values.extend((sample.t, *sample.q, *sample.v, *sample.x, *sample.tau))

    def metrics(self) -> dict[str, float]:
        """What the run is judged by."""
        run = self._run
        sizes = [1, *(len(run.fmu.vector(group)) for group in ("q", "v", "x", "tau"))]
        table = np.frombuffer(self._values).reshape(-1, sum(sizes))
        t, q, v, x, tau = np.split(table, np.cumsum(sizes)[:-1], axis=1)
        target = _given(run, "x_des", len(x[0]))
        limits = [_given(run, name, len(q[0])) for name in ("q_min", "q_max")]
        return measure(t[:, 0], q, v, x, tau, target, *limits)


def _given(run: Experiment, group: str, size: int) -> NDArray[np.float64]:
    """Start values of a vector; NaN where the FMU does not have it so."""
    values: Sequence[Value | None]
    values = [run.start_values.get(name) for name in run.fmu.vector(group)]
    if len(values) != size or None in values:
        return np.full(size, nan)
    return np.array(values, dtype=float)
