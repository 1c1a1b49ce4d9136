"""The master: steps an FMU at a fixed communication step and yields one sample a step.

    for k in 0..N-1:   t = start + k·h        never accumulated
        set the inputs at t; doStep(t, h); read the outputs; one sample at start + (k+1)·h

The initial state is the first sample, so N steps give N + 1 samples.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass, replace
from itertools import accumulate
from math import dist, isfinite
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from .errors import InputError, SimulationError
from .fmu import Fmu, Instance, instantiate, load_fmu
from .inputs import Changes, Setting, Value, read_changes, resolve

TIME_TOLERANCE = 1e-9
LONGEST = 1e7  # s: no run that anybody watches is longer
OUTPUTS = ("q", "v", "x", "tau")


class Sample(NamedTuple):
    """What is known at one communication point.

    Attributes:
        k: communication steps done so far.
        t: time, s.
        q, v: joint positions (rad, m) and velocities, n values each.
        x: position of the end effector along the task axes, m; empty if the FMU has none.
        tau: control effort applied, N·m or N; empty if the FMU has none.
        inputs: values of all inputs by name, as they are at t.
    """

    k: int
    t: float
    q: tuple[float, ...]
    v: tuple[float, ...]
    x: tuple[float, ...]
    tau: tuple[float, ...]
    inputs: Mapping[str, Value]


class Sink(Protocol):
    """Consumer of samples: a context manager with ``write``."""

    def __enter__(self) -> Any: ...
    def __exit__(self, *exception: Any) -> Any: ...
    def write(self, sample: Sample) -> None:
        """Take one sample."""


@dataclass(frozen=True)
class Experiment:
    """One run of an FMU, checked before anything is instantiated; made by ``experiment``.

    Attributes:
        fmu: the FMU.
        start_time, step: s.
        steps: N, the number of communication steps.
        start_values: all inputs and parameters with the values they start with.
        given: those of them that differ from the model description on purpose.
        changes: inputs over time.
    """

    fmu: Fmu
    start_time: float
    step: float
    steps: int
    start_values: Mapping[str, Value]
    given: Mapping[str, Value]
    changes: Changes

    def time(self, k: int) -> float:
        """Time after k steps, s; never accumulated."""
        return self.start_time + k * self.step


def experiment(
    fmu: Fmu | str | Path,
    *,
    start_time: float = 0.0,
    stop_time: float = 5.0,
    step: float = 0.01,
    settings: Mapping[str, Setting] | None = None,
    input_file: str | Path | None = None,
) -> Experiment:
    """Check what a run is asked to do.

    Args:
        fmu: the FMU or its path.
        start_time, stop_time, step: s; the stop a whole number of steps after the start.
        settings: start values of inputs and parameters by name; a vector's name takes one value
            for all elements or a sequence.
        input_file: CSV of inputs over time (``inputs.read_changes``).

    Raises:
        InputError, FmuError: naming what is wrong.
    """
    fmu = fmu if isinstance(fmu, Fmu) else load_fmu(fmu)
    given = resolve(fmu, settings or {})
    changes = [] if input_file is None else read_changes(fmu, input_file)
    for name in changes[0][1] if changes else ():
        if name in given:
            raise InputError(f"{name} is both set and in '{input_file}'; leave one out")
    return Experiment(
        fmu=fmu,
        start_time=start_time,
        step=step,
        steps=_steps(start_time, stop_time, step),
        start_values={**_declared_starts(fmu), **given},
        given=given,
        changes=changes,
    )


def endless(fmu: Fmu | str | Path, *, step: float, **options: Any) -> Experiment:
    """An experiment without end; arguments and errors as of ``experiment``."""
    run = experiment(fmu, step=step, stop_time=step, **options)
    return replace(run, steps=round(LONGEST / step))


def _steps(start: float, stop: float, h: float) -> int:
    if not (h > 0.0 and isfinite(h)):
        raise InputError(f"step {h:g} s must be > 0")
    if not (isfinite(start) and isfinite(stop) and stop > start):
        raise InputError(f"stop time {stop:g} s must be after the start time {start:g} s")
    if not isfinite((stop - start) / h):
        raise InputError(f"step {h!r} s is too small for a run of {stop - start:g} s")
    steps = round((stop - start) / h)
    if abs(steps * h - (stop - start)) > TIME_TOLERANCE * h * max(1, steps):
        raise InputError(f"the run of {stop - start:g} s is no whole number of steps of {h:g} s")
    return steps


def _declared_starts(fmu: Fmu) -> dict[str, Value]:
    starts: dict[str, Value] = {}
    for name, variable in fmu.variables.items():
        if variable.causality in ("input", "parameter") and variable.start is not None:
            if variable.type == "Boolean":
                starts[name] = variable.start in ("true", "1")
            elif variable.type == "Real":
                starts[name] = float(variable.start)
    return starts


class RealTime:
    """Paces a run to the wall clock.

    Attributes:
        missed: samples that were ready only after their time.
        worst: the largest delay, s.
    """

    def __init__(self) -> None:
        self.missed = 0
        self.worst = 0.0
        self._start: float | None = None

    def restart(self) -> None:
        """The next sample is due at once, and those after it by that."""
        self._start = None

    def wait(self, elapsed: float) -> None:
        """Wait until the wall clock is ``elapsed`` s after the first call."""
        now = time.perf_counter()
        if self._start is None:
            self._start = now - elapsed
        left = self._start + elapsed - now
        if left > 0.0:
            time.sleep(left)
        elif left < 0.0:
            self.missed += 1
            self.worst = max(self.worst, -left)


def samples(
    run: Experiment | Fmu | str | Path,
    *,
    pace: RealTime | None = None,
    stop: Callable[[], bool] | None = None,
    instance: Instance | None = None,
    **options: Any,
) -> Generator[Sample, Mapping[str, Setting] | None, None]:
    """Run an FMU; the initial state, then one sample a communication step.

    A loop of one's own may answer a sample with new inputs, ``run.send({"x_des": (0.2, 0.1)})``,
    which hold from that sample's time on.

    Args:
        run: the experiment, or an FMU with the options of ``experiment`` beside it.
        pace: waits before each sample until its time has come.
        stop: asked between two steps; True ends the run.
        instance: one of that FMU which is as instantiated, and stays when the run has ended;
            None: an own one.

    Raises:
        FmuError, InputError: before the first sample.
        SimulationError: the FMU refused or failed a call, or gave a value that is not finite.
    """
    if not isinstance(run, Experiment):
        run = experiment(run, **options)
    fmu = run.fmu
    names = [name for group in OUTPUTS for name in fmu.vector(group)]
    ends = list(accumulate(len(fmu.vector(group)) for group in OUTPUTS))
    slices = [slice(a, b) for a, b in zip([0, *ends], ends)]
    inputs = {n: v for n, v in run.start_values.items() if fmu.variables[n].causality == "input"}
    due = deque(run.changes)

    def changes_until(t: float) -> dict[str, Value]:
        latest: dict[str, Value] = {}
        while due and due[0][0] <= t + TIME_TOLERANCE * run.step:
            latest.update(due.popleft()[1])
        return latest

    with instantiate(fmu) if instance is None else nullcontext(instance) as instance:
        first = changes_until(run.start_time)
        inputs.update(first)
        instance.initialise(run.start_time, run.time(run.steps), {**run.given, **first})
        read = instance.reader(names)
        for k in range(run.steps + 1):
            t = run.time(k)
            values = read()
            if not all(map(isfinite, values)):
                text = f"the FMU gave a value that is not finite at t = {t:g} s"
                raise SimulationError(text, k, "diverged")
            if pace is not None:
                pace.wait(t - run.start_time)
            q, v, x, tau = (values[part] for part in slices)
            answer = yield Sample(k, t, q, v, x, tau, inputs)
            if k == run.steps or (stop is not None and stop()):
                return
            latest = {**changes_until(t), **(resolve(fmu, answer) if answer else {})}
            try:
                if latest:
                    instance.set(latest)
                    inputs = {**inputs, **latest}
                instance.step(t, run.step)
            except SimulationError as error:
                text = f"step {k + 1} at t = {t:g} s: {error}"
                raise SimulationError(text, k, error.outcome) from error


@dataclass(frozen=True)
class Summary:
    """How a run went.

    Attributes:
        last: the last sample.
        wall_time: s, without loading and initialisation.
        stopped: whether it was asked to end before its stop time.
    """

    last: Sample
    wall_time: float
    stopped: bool

    @property
    def error(self) -> float | None:
        """Distance of the end effector from its target, m; None where the FMU has no x_des."""
        target = [self.last.inputs.get(f"x_des[{k + 1}]") for k in range(len(self.last.x))]
        if not target or None in target:
            return None
        return dist(self.last.x, target)  # type: ignore[arg-type]


def simulate(
    run: Experiment | Fmu | str | Path,
    sinks: Iterable[Sink] = (),
    *,
    pace: RealTime | None = None,
    stop: Callable[[], bool] | None = None,
    instance: Instance | None = None,
    steer: Callable[[], Mapping[str, Setting] | None] = lambda: None,
    **options: Any,
) -> Summary:
    """Run an FMU and hand every sample to every sink.

    Other arguments and errors as in ``samples``.

    Args:
        steer: asked after each sample for new inputs, which hold from that sample's time on.
    """
    if not isinstance(run, Experiment):
        run = experiment(run, **options)
    with ExitStack() as stack:
        source = stack.enter_context(closing(samples(run, pace=pace, stop=stop, instance=instance)))
        sample = next(source)
        writes = [stack.enter_context(sink).write for sink in sinks]
        if pace is not None:  # what the sinks took to open is not the run's
            pace.restart()
            pace.wait(0.0)
        begin = time.perf_counter()
        while True:
            for write in writes:
                write(sample)
            answer = steer()
            try:
                sample = source.send(answer)
            except StopIteration:
                break
        return Summary(sample, time.perf_counter() - begin, sample.k < run.steps)
