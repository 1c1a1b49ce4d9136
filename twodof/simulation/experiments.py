"""Checked settings of a run: start values, inputs over time, times and stamps."""

from __future__ import annotations

import csv
import difflib
import logging
import math
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import chain, pairwise
from math import inf, isfinite
from pathlib import Path
from typing import TypedDict

from ..bounds import MAX_CELLS, MAX_TABLE, MIN_STEP
from ..errors import InputError
from ..files import check_file
from ..fmu import Fmu, load_fmu
from ..plant.variables import CONTROLS, GAINS
from ..plant.variables import Value as Value

Setting = object
"""A number, a Boolean, or a sequence or array of them; a dict of several kinds is ``dict[str, object]``."""
Changes = list[tuple[float, dict[str, Value]]]
"""Times in s, ascending, and the inputs that take new values there."""

TIME_TOLERANCE = 1e-9  # of a communication step
NANOSECONDS = 1_000_000_000
LOG = logging.getLogger(__name__)
LATEST_STAMP = (2**31 - 1) * NANOSECONDS  # builtin_interfaces/Time has int32 seconds


@dataclass(frozen=True, repr=False)
class Experiment:
    """A run of an FMU, checked before anything is instantiated; made by ``experiment``.

    Attributes:
        fmu: the FMU.
        start_time, step: s.
        steps: N, the number of communication steps; infinite for a run without end.
        start_values: all inputs and parameters with the values they start with.
        given: those of them that differ from the model description on purpose.
        changes: inputs over time, after the start.
        stamp_start: stamp of the first sample, s since the epoch; None: the wall clock's.
        commanders: times in s, and facts of each third party whose commands are followed from then.
    """

    fmu: Fmu
    start_time: float
    step: float
    steps: float
    start_values: Mapping[str, Value]
    given: Mapping[str, Value]
    changes: Changes
    stamp_start: float | None
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
            InputError: ROS 2 has no such time.
        """
        start = self.stamp_start
        # a fraction: a double of today's nanoseconds is good to 256 only
        first = time.time_ns() if start is None else round(Fraction(start) * NANOSECONDS)
        last = first + (self.steps * self.step * NANOSECONDS if self.steps < inf else 0)
        if not 0 <= first <= last <= LATEST_STAMP:
            whose = "the wall clock" if start is None else f"stamp_start = {start:g} s"
            raise InputError(f"the stamps of a run from {whose} on are not those of 1970 to 2038")
        return first


class ExperimentOptions(TypedDict, total=False):
    """Keywords of ``experiment``."""

    start_time: float
    stop_time: float | None
    step: float | None
    settings: Mapping[str, Setting] | None
    input_file: str | Path | None
    changes: Sequence[tuple[float, Mapping[str, Setting]]] | None
    stamp_start: float | None


def experiment(
    fmu: Fmu | str | Path,
    *,
    start_time: float = 0.0,
    stop_time: float | None = None,
    step: float | None = None,
    settings: Mapping[str, Setting] | None = None,
    input_file: str | Path | None = None,
    changes: Sequence[tuple[float, Mapping[str, Setting]]] | None = None,
    stamp_start: float | None = None,
) -> Experiment:
    """Check the settings of a run.

    Args:
        fmu: the FMU or its path.
        start_time, stop_time, step: s; whole steps, the stop may be infinite. None: the FMU's default, or 5 s, 10 ms.
        settings: start values by name; a vector's name takes one value for all elements or a sequence.
        input_file: CSV of inputs over time (``read_changes``).
        changes: instead of a file, times, s, and the inputs that change then; earlier ones hold at the start.
        stamp_start: stamp of the first sample, s since the epoch; None: the wall clock's.

    Raises:
        InputError, FmuError: naming what is wrong.
    """
    fmu = fmu if isinstance(fmu, Fmu) else load_fmu(fmu)
    step = default(fmu, "stepSize", 0.01) if step is None else step
    if stop_time is None:
        stop_time = start_time + default(fmu, "stopTime", 5.0) - default(fmu, "startTime", 0.0)
    given = resolve(fmu, settings or {})
    due = deque((t, _inputs_at(fmu, t, asked)) for t, asked in changes or [])
    if not all(earlier <= t < inf for (earlier, _), (t, _) in pairwise([(-inf, {}), *due])):
        raise InputError("the times of `changes` are finite and ascend")
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
        changes=[*due],
        stamp_start=stamp_start,
    )
    run.first_stamp()  # which refuses what has none
    _tell_late(run, "`changes`" if input_file is None else f"'{input_file}'")
    return run


def _tell_late(run: Experiment, source: str) -> None:
    """Warn of inputs whose time is after the stop time."""
    end = run.time(run.steps)
    if late := sum(t > end + TIME_TOLERANCE * run.step for t, _ in run.changes):
        LOG.warning(
            f"{source}: {late} of its times are after the run's end at {end:g} s, and their inputs are never set"
        )


def pop_until(t: float, due: deque[tuple[float, dict[str, Value]]]) -> dict[str, Value]:
    """Remove the changes that are due by t, and return the values that they set."""
    values: dict[str, Value] = {}
    while due and due[0][0] <= t:
        values |= due.popleft()[1]
    return values


def _inputs_at(fmu: Fmu, t: float, asked: Mapping[str, Setting]) -> dict[str, Value]:
    """Return the inputs that a change sets."""
    values = resolve(fmu, asked)
    for name in values:
        if fmu.variables[name].causality != "input":
            raise InputError(f"{name} is no input and cannot be changed at {t:g} s")
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
        raise InputError(f"the run of {stop - start:g} s is no whole number of steps of {h:g} s")
    return steps


def default(fmu: Fmu, name: str, fallback: float) -> float:
    """Return a number of the FMU's default experiment."""
    number = getattr(fmu.description.defaultExperiment, name, None)
    return fallback if number is None else float(number)


def resolve(fmu: Fmu, settings: Mapping[str, Setting]) -> dict[str, Value]:
    """Return values by variable name; a group's name sets all of its elements.

    Raises:
        InputError: an unknown name (with the nearest one), an output, or a value of wrong count or kind, or not finite.
    """
    values: dict[str, Value] = {}
    for name, setting in settings.items():
        elements = [name] if name in fmu.variables else fmu.vector(name)
        if not elements:
            raise InputError(_no_variable(fmu, name, "input", "parameter"))
        # arrays give their own kind of numbers
        plain: object = setting.tolist() if hasattr(setting, "tolist") else setting
        given = list(plain) if isinstance(plain, list | tuple) else [plain] * len(elements)
        if len(given) != len(elements):
            raise InputError(f"{name} has {len(elements)} elements, {len(given)} were given")
        for element, value in zip(elements, given, strict=True):
            values[element] = _checked(fmu, element, value)
    return values


def _checked(fmu: Fmu, name: str, value: object) -> Value:
    variable = fmu.variables[name]
    if variable.causality not in ("input", "parameter"):
        raise InputError(f"{name} is of causality '{variable.causality}' and cannot be set")
    if variable.type == "Boolean":
        if not isinstance(value, bool):
            raise InputError(f"{name} = {value!r}: expected true or false")
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{name} = {value!r}: expected a number")
    try:
        number = float(value)
    except OverflowError:  # of a whole number
        number = inf if value > 0 else -inf
    if not isfinite(number):
        raise InputError(f"{name} = {number} is not finite")
    return number


def check_going_on(fmu: Fmu, asked: Mapping[str, Value], held: Mapping[str, Value]) -> None:
    """Refuse inputs that would end a run and may arrive at any time.

    Raises:
        InputError: a gain below 0, or with the others that are held a quaternion of zeros.
    """
    for name, value in asked.items():
        if name.partition("[")[0] in GAINS and value < 0.0:
            raise InputError(f"{name} = {value:g} is less than 0")
    turn = fmu.vector("quat_des")
    if turn and not any({**held, **asked}[name] for name in turn):
        raise InputError("quat_des = 0, 0, 0, 0 is no orientation; (0, 0, 0, 1) turns nothing")


def _of_another(fmu: Fmu, name: str) -> str:
    """Return a vector's length, or the controls that have a variable; "" where there is none."""
    group = name.partition("[")[0]
    having = [c for c, law in CONTROLS.items() if group in (*law.inputs, *law.parameters)]
    elements = fmu.vector(group)
    if elements and fmu.variables[elements[0]].causality in ("input", "parameter"):
        return f": {group} has {len(elements)} elements"
    if not fmu.control or not having:
        return ""
    quoted = " or ".join(f"control '{control}'" for control in having)
    return f": it is of {quoted}; this FMU has control '{fmu.control}'"


def _no_variable(fmu: Fmu, name: str, *causalities: str) -> str:
    """Return the message for an unknown name: its control law, or the nearest names."""
    groups = {g: names for causality in causalities for g, names in fmu.groups(causality).items()}
    known = [*dict.fromkeys([*groups, *chain(*groups.values())])]
    by_lower = {candidate.lower(): candidate for candidate in reversed(known)}
    near = difflib.get_close_matches(name.lower(), list(by_lower), n=1, cutoff=0.4)
    like = f"; did you mean '{by_lower[near[0]]}'?" if near else f"; there are: {', '.join(known)}"
    return f"there is no variable '{name:.50}'{_of_another(fmu, name) or like}"


def read_changes(fmu: Fmu, path: str | Path) -> Changes:
    """Read inputs over time from a CSV in FMPy's form: a column ``time``, and one for each input.

    Columns are named as in settings. A row holds until the next row; before the first, start values hold.

    Raises:
        InputError: naming the file, and the row or column at fault.
    """
    rows = _rows(path)
    _, names = next(rows, (0, None))
    if names is None:
        raise InputError(f"'{path}' is empty")
    header = [cell.strip() for cell in names]
    if "time" not in header:
        raise InputError(f"'{path}' has no column 'time'")
    elements = {name: _inputs(fmu, path, name) for name in header if name != "time"}
    columns = [element for name in header for element in elements.get(name, ["time"])]
    twice = next((element for element, n in Counter(columns).items() if n > 1), None)
    if twice is not None:
        raise InputError(f"'{path}' has two columns for '{twice:.50}'")
    changes: Changes = []
    for number, row in rows:
        if len(row) != len(header):
            raise InputError(f"'{path}' row {number}: {len(row)} cells, expected {len(header)}")
        values: dict[str, Value] = {}
        for name, cell in zip(header, row, strict=True):
            try:
                values[name] = float(cell)
            except ValueError:
                raise InputError(f"'{path}' row {number}: {name} = '{cell:.50}' is not a number") from None
            if not isfinite(values[name]):
                raise InputError(f"'{path}' row {number}: {name} = {cell:.50} is not finite")
        time = values.pop("time")
        if changes and time < changes[-1][0]:
            raise InputError(f"'{path}' row {number}: time {time:g} is before the row above")
        spread = {element: v for name, v in values.items() for element in elements[name]}
        changes.append((time, spread))
    if not changes:
        raise InputError(f"'{path}' has no rows")
    return changes


def _inputs(fmu: Fmu, path: str | Path, name: str) -> list[str]:
    """Return the inputs that a column sets: one, or all elements of a vector."""
    elements = [name] if name in fmu.variables else fmu.vector(name)
    if not elements:
        raise InputError(f"'{path}': {_no_variable(fmu, name, 'input')}")
    if any(fmu.variables[element].causality != "input" for element in elements):
        raise InputError(f"'{path}': {name} is not an input")
    return elements


def _rows(path: str | Path) -> Iterator[tuple[int, list[str]]]:
    """Yield non-empty rows with their line numbers; quotes do not span lines."""
    cells = 0
    try:
        check_file(path, MAX_TABLE)
        with open(path, encoding="utf-8-sig") as file:
            for number, line in enumerate(file, start=1):
                cells += 1 + line.count(",")
                if cells > MAX_CELLS:
                    raise InputError(f"'{path}' has more than {MAX_CELLS} cells")
                for row in csv.reader([line]):
                    if any(map(str.strip, row)):
                        yield number, row
    except OSError as error:
        raise InputError(f"cannot read '{path}': {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"'{path}' is not a CSV file: {error}") from error
