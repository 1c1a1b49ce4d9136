"""Run the points of a sweep one after another on one instance of the FMU: a worker's task."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import accumulate, chain
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SimulationError, diverged, step_failure
from ..files import temporary_folder
from ..fmu import Instance, instantiate
from ..simulation.experiments import Experiment, experiment
from ..simulation.input_values import Value, resolve
from ..simulation.master import OUTPUTS, simulate
from ..simulation.peaks import limits_of
from ..simulation.sample import Sample, Sink
from .metrics import METRICS, Array, measure

Point = tuple[int, tuple[float, ...]]
"""Number of a run, and the values of the variables that are varied."""
Row = tuple[Any, ...]
"""Number, values, metrics, end time in s, outcome, message or None; the columns of the table."""


@dataclass(frozen=True)
class Job:
    """Common settings of all runs of a sweep.

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
    bags: Path | None


class Runner:
    """Runs points of a job, as a context that frees the FMU at its end.

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
            self._limits = limits_of(self._base.fmu)
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
            outputs = self._outputs(run, number)
        except SimulationError as error:
            self._drop()  # whatever state it is in
            return lost(point, run.time(error.k), error.outcome, str(error))
        metrics = self._metrics(run, outputs).values()  # in the order of METRICS
        return (number, *values, *metrics, run.time(run.steps), "finished", None)

    def _outputs(self, run: Experiment, number: int) -> Mapping[str, Array]:
        """Simulate, with a bag where the job requests one; return the outputs at all samples."""
        if self._job.bags is None:
            return trace(run, self._fresh())
        from ..bag.writer import Bag  # rosbags takes half a second to import

        kept = _Kept()
        bag = Bag(self._job.bags / f"{number:06d}", overwrite=True)
        simulate(run, kept, bag, instance=self._fresh())
        return {name: np.array([getattr(s, name) for s in kept.samples]) for name in OUTPUTS}

    def _metrics(self, run: Experiment, outputs: Mapping[str, Array]) -> dict[str, float]:
        """Return the metrics of a run."""
        n, m = outputs["q"].shape[1], outputs["x"].shape[1]
        t = run.start_time + np.arange(len(outputs["q"]), dtype=np.float64) * run.step
        sizes = {"x_des": m, "quat_des": 4, "q_des": n, "q_min": n, "q_max": n}
        given = {name: _given(run, name, size) for name, size in sizes.items()}
        return measure(t, {**outputs, **given}, self._limits)

    def run_all(self, points: Iterable[Point]) -> tuple[list[Row], float]:
        """Return the rows of some points, and the time they took, s; errors as of ``run``."""
        begin = time.perf_counter()
        return [self.run(point) for point in points], time.perf_counter() - begin

    def _fresh(self) -> Instance:
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
    """Return the row of an unfinished run."""
    number, values = point
    return (number, *values, *[nan] * len(METRICS), end, outcome, message)


def trace(run: Experiment, instance: Instance) -> dict[str, Array]:
    """Return the outputs q, v, x, tau and quat at all samples of a run without changes, N + 1 × values.

    For whoever needs the numbers alone, without a ``Sample`` for each; errors as of ``samples``.
    """
    instance.initialise(run.start_time, run.time(run.steps), run.given)
    groups = [run.fmu.vector(group) for group in OUTPUTS]
    ends = [*accumulate(map(len, groups))]
    rows, read, step = bytearray(), instance.reader([*chain(*groups)]), instance.step
    start, h = run.start_time, run.step
    rows += read()
    try:
        for k in range(int(run.steps)):
            step(start + k * h, h)
            rows += read()
    except SimulationError as error:
        _finite(run, rows, ends[-1])
        raise step_failure(k, run.time(k), error) from error
    table = _finite(run, rows, ends[-1])
    return dict(zip(OUTPUTS, np.split(table, ends[:-1], axis=1)))


def _finite(run: Experiment, rows: bytearray, width: int) -> Array:
    table = np.asfortranarray(np.frombuffer(rows, np.float64).reshape(-1, width))  # fast along time
    if np.isfinite(table).all():
        return table
    astray = np.flatnonzero(~np.isfinite(table).all(axis=1))
    raise diverged(int(astray[0]), run.time(int(astray[0])))


class _Kept(Sink):
    """A sink that keeps all samples."""

    def __init__(self) -> None:
        self.samples: list[Sample] = []

    def write(self, sample: Sample) -> None:
        self.samples.append(sample)


def _given(run: Experiment, group: str, size: int) -> Array:
    """Return start values of a vector; NaN where the FMU has no such vector."""
    values: Sequence[Value | None]
    values = [run.start_values.get(name) for name in run.fmu.vector(group)]
    if len(values) != size or None in values:
        return np.full(size, nan)
    return np.array(values, dtype=float)
