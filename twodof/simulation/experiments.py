"""Checked settings of a run: start values, inputs over time, times and stamps."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import chain, pairwise
from math import inf, isfinite
from numbers import Real
from pathlib import Path
from typing import TypedDict

from ..bounds import MIN_STEP
from ..errors import InputError
from ..fmu import Fmu, System, load_fmu
from .input_values import Changes, Setting, Value, read_changes, resolve, resolve_all
from .setup import unconnected

TIME_TOLERANCE = 1e-9  # fraction of a communication step
NANOSECONDS = 1_000_000_000
LOG = logging.getLogger(__name__)
LATEST_STAMP = (2**31 - 1) * NANOSECONDS  # builtin_interfaces/Time has int32 seconds


@dataclass(frozen=True, repr=False)
class Experiment:
    """Checked settings of a run, made by ``experiment``.

    Attributes:
        fmu: the FMU.
        start_time, step: s.
        steps: N, the number of communication steps; infinite for a run without end.
        start_values: start values of all inputs and parameters.
        given: start values that the settings give.
        changes: times, s, and the inputs that change at them, after the start.
        stamp_start: stamp of the first sample, s since the epoch; None: the wall clock's time.
        signals: names of the Real outputs that samples have as ``signals``.
        texts: given start values of variables of type String.
        commanders: times in s, and facts of each node whose commands are followed from that time on.
    """

    fmu: Fmu
    start_time: float
    step: float
    steps: float
    start_values: Mapping[str, Value]
    given: Mapping[str, Value]
    changes: Changes
    stamp_start: float | None
    signals: tuple[str, ...] = ()
    texts: Mapping[str, str] = field(default_factory=dict)
    commanders: list[tuple[float, dict[str, str]]] = field(default_factory=list)

    def __repr__(self) -> str:
        end = "without end" if self.steps == inf else f"to {self.time(self.steps):g} s"
        return f"<Experiment: {self.fmu.path.name} from {self.start_time:g} s {end} in steps of {self.step:g} s>"

    def time(self, k: float) -> float:
        """Return the time after k steps, s; never accumulated."""
        return self.start_time + k * self.step

    def first_stamp(self) -> int:
        """Return the stamp of the first sample if the run began now, ns since the epoch.

        Raises:
            InputError: ROS 2's messages cannot express this time.
        """
        start = self.stamp_start
        # a fraction, because doubles of today's time in ns are multiples of 256
        first = time.time_ns() if start is None else round(Fraction(min(start, LATEST_STAMP)) * NANOSECONDS)
        last = first + (self.steps * self.step * NANOSECONDS if self.steps < inf else 0)
        if not 0 <= first <= last <= LATEST_STAMP:
            whose = "the wall clock" if start is None else f"stamp_start = {start:g} s"
            span = f" with a duration of {(last - first) / NANOSECONDS:.6g} s" if last > first else ""
            raise InputError(f"the stamps of a run from {whose} on{span} are not within 1970 to 2038")
        return first


class ExperimentOptions(TypedDict, total=False):
    """Keywords of ``experiment``."""

    start_time: float | None
    stop_time: float | None
    step: float | None
    settings: Mapping[str, Setting] | None
    input_file: str | Path | None
    changes: Sequence[tuple[float, Mapping[str, Setting]]] | None
    stamp_start: float | None
    signals: bool


def experiment(
    fmu: Fmu | str | Path,
    *,
    start_time: float | None = None,
    stop_time: float | None = None,
    step: float | None = None,
    settings: Mapping[str, Setting] | None = None,
    input_file: str | Path | None = None,
    changes: Sequence[tuple[float, Mapping[str, Setting]]] | None = None,
    stamp_start: float | None = None,
    signals: bool = False,
) -> Experiment:
    """Check the settings of a run.

    Args:
        fmu: the FMU or its path.
        start_time, stop_time, step: s; the stop time may be infinite. None: the FMU's default, or 0, 5 s and 10 ms.
        settings: start values by name; a vector has one value for all elements, or a sequence.
        input_file: CSV of inputs over time (``read_changes``).
        changes: times, s, and the inputs that change, instead of a file; changes before the start apply at it.
        stamp_start: stamp of the first sample, s since the epoch; None: the wall clock's time.
        signals: whether samples and bags have all Real outputs, in a system those of all FMUs.

    Raises:
        InputError, FmuError: an argument or the FMU is invalid; the message names it.
    """
    fmu = fmu if isinstance(fmu, Fmu) else load_fmu(fmu)
    start_time, stop_time, step = _times(fmu, start_time, stop_time, step)
    given, texts = resolve_all(fmu, settings or {})
    due = _due(fmu, changes or [])
    given = {**pop_until(math.nextafter(start_time, -inf), due), **given}
    if input_file is not None:
        if changes is not None:
            raise InputError("`input_file` and `changes` are both inputs over time; give one")
        due = deque(read_changes(fmu, input_file))
        for name in due[0][1]:
            if name in given:
                raise InputError(f"{name} is both set and in '{input_file}'; leave one out")
        given |= pop_until(start_time + TIME_TOLERANCE * step, due)
    if stamp_start is not None and not isfinite(stamp_start):
        raise InputError(f"stamp_start = {stamp_start} is not finite")
    run = Experiment(
        fmu=fmu,
        start_time=start_time,
        step=step,
        steps=_steps(start_time, stop_time, step),
        start_values={**fmu.start_values, **given},
        given=given,
        texts=texts,
        changes=[*due],
        stamp_start=stamp_start,
        signals=fmu.real_outputs if signals else (),
    )
    loose = unconnected(fmu, chain(given, *(inputs for _, inputs in due))) if isinstance(fmu, System) else []
    for line in [*fmu.remarks(settings or ()), *loose]:
        LOG.warning(f"'{fmu.path}': {line}")
    run.first_stamp()  # raises for a time that ROS 2 cannot express
    _report_late(run, "`changes`" if input_file is None else f"'{input_file}'")
    _report_times_between_steps(run)
    return run


def _report_late(run: Experiment, source: str) -> None:
    end = run.time(run.steps)
    if late := sum(t > end + TIME_TOLERANCE * run.step for t, _ in run.changes):
        LOG.warning(
            f"{source}: {late} of its times are after the run's end at {end:g} s, and their inputs are never set"
        )


def _report_times_between_steps(run: Experiment) -> None:
    """Warn of a controller in a system whose efforts change between communication steps."""
    for name, value in run.start_values.items():
        part, _, kind = name.rpartition(".")
        steps = value / run.step
        if (
            kind in ("control_period", "control_delay")
            and f"{part}.tau_cmd[1]" in run.fmu.variables
            and run.fmu.variables[f"{part}.tau_cmd[1]"].causality == "output"
            and abs(steps - round(steps)) > TIME_TOLERANCE
        ):
            LOG.warning(
                f"{name} = {value:g} s is not a whole number of communication steps of {run.step:g} s:"
                " the plant receives efforts later than the controller gives them"
            )


def _times(fmu: Fmu, start: float | None, stop: float | None, step: float | None) -> tuple[float, float, float]:
    """Return start time, stop time and step, by default those of the FMU."""
    for name, seconds in {"start_time": start, "stop_time": stop, "step": step}.items():
        if not isinstance(seconds, Real | None):
            raise InputError(f"`{name}` is {seconds!r:.50}, not a number of seconds")
    first = default(fmu, "startTime", 0.0)
    start = first if start is None else start
    stop = start + default(fmu, "stopTime", first + 5.0) - first if stop is None else stop
    return start, stop, default(fmu, "stepSize", 0.01) if step is None else step


def pop_until(t: float, due: deque[tuple[float, dict[str, Value]]]) -> dict[str, Value]:
    """Remove the changes that are due at t; return the values that they set."""
    values: dict[str, Value] = {}
    while due and due[0][0] <= t:
        values |= due.popleft()[1]
    return values


def _due(fmu: Fmu, changes: Iterable[tuple[float, Mapping[str, Setting]]]) -> deque[tuple[float, dict[str, Value]]]:
    """Return the checked changes of inputs over time."""
    try:
        asked = [(float(t), inputs) for t, inputs in changes]
    except (TypeError, ValueError) as error:
        reason = f"`changes` is {changes!r:.50}; give times with their inputs, as [(0.5, {{'Kp': 80}})]"
        raise InputError(reason) from error
    if not all(earlier <= t < inf for (earlier, _), (t, _) in pairwise([(-inf, {}), *asked])):
        raise InputError("the times of `changes` must be finite and ascend")
    return deque((t, _inputs_at(fmu, t, inputs)) for t, inputs in asked)


def _inputs_at(fmu: Fmu, t: float, asked: Mapping[str, Setting]) -> dict[str, Value]:
    """Return the inputs that a change sets."""
    values = resolve(fmu, asked)
    for name in values:
        if fmu.variables[name].causality != "input":
            raise InputError(f"{name} is not an input and cannot be changed at {t:g} s")
    return values


def _steps(start: float, stop: float, h: float) -> float:
    if not (h > 0.0 and isfinite(h)):
        raise InputError(f"step {h:g} s must be > 0")
    if h < MIN_STEP:
        raise InputError(f"step {h!r} s must be at least {MIN_STEP:g} s")
    if stop == inf and isfinite(start):
        return inf
    if not (isfinite(start) and isfinite(stop) and stop > start):
        raise InputError(f"stop time {stop:g} s must be after the start time {start:g} s")
    if not isfinite((stop - start) / h):
        raise InputError(f"step {h!r} s is too small for a run of {stop - start:g} s")
    steps = round((stop - start) / h)
    if abs(steps * h - (stop - start)) > TIME_TOLERANCE * h * max(1, steps):
        fitting, last = (stop - start) / max(1, steps), start + max(1, steps) * h
        remedy = f"take steps of {fitting:.9g} s, or end at {last:.9g} s"
        raise InputError(f"the run of {stop - start:g} s is not a whole number of steps of {h:g} s; {remedy}")
    return steps


def default(fmu: Fmu, name: str, fallback: float) -> float:
    """Return a number of the FMU's default experiment."""
    number = getattr(fmu.description.defaultExperiment, name, None)
    return fallback if number is None else float(number)
