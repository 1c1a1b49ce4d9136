"""What a user sets: names and values of FMU variables, at the start and over time."""

from __future__ import annotations

import csv
import difflib
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from .errors import InputError
from .files import check_file
from .fmu import Fmu

Value = float | bool
Setting = Any
"""A number, a Boolean, or a sequence or array of numbers; checked by ``resolve``."""
Changes = list[tuple[float, dict[str, Value]]]
"""Times in s, ascending, and the inputs that take new values there."""

MAX_TABLE = 64 * 1024**2
MAX_CELLS = 1_000_000  # all of them go into the bag's run.json


def parse_settings(texts: Iterable[str]) -> dict[str, Setting]:
    """NAME=VALUE texts of a command line: ``Kp=80``, ``x_des=0.25,0.1``, ``limit_effort=true``."""
    settings: dict[str, Setting] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        name = name.strip()
        if not equals or not name:
            raise InputError(f"--set {text}: expected NAME=VALUE")
        if name in settings:
            raise InputError(f"--set {name} is given twice")
        settings[name] = _parse_value(name, value.strip())
    return settings


def _parse_value(name: str, text: str) -> Setting:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"--set {name}={text}: '{text}' is not a number") from None
    return numbers[0] if len(numbers) == 1 else numbers


def resolve(fmu: Fmu, settings: Mapping[str, Setting]) -> dict[str, Value]:
    """Values by variable name; a group's name sets all of its elements.

    Raises:
        InputError: an unknown name (with the nearest that exists), an output, a wrong count or
            kind of value, or a value that is not finite.
    """
    values: dict[str, Value] = {}
    for name, setting in settings.items():
        elements = [name] if name in fmu.variables else fmu.vector(name)
        if not elements:
            settable = {**fmu.groups("input"), **fmu.groups("parameter")}
            known = [*settable, *(element for group in settable.values() for element in group)]
            raise InputError(f"there is no variable '{name}'{_suggestion(name, known)}")
        # arrays give their own kind of numbers
        plain = setting.tolist() if hasattr(setting, "tolist") else setting
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
    if not math.isfinite(value):
        raise InputError(f"{name} = {value} is not finite")
    return float(value)


def _suggestion(name: str, known: Iterable[str]) -> str:
    known = list(known)
    near = [f"{name}[1]"] if f"{name}[1]" in known else _nearest(name, known)
    return f"; did you mean '{near[0]}'?" if near else f"; there are: {', '.join(known)}"


def _nearest(name: str, known: list[str]) -> list[str]:
    by_lower = {candidate.lower(): candidate for candidate in reversed(known)}
    near = difflib.get_close_matches(name.lower(), list(by_lower), n=1, cutoff=0.4)
    return [by_lower[match] for match in near]


def read_changes(fmu: Fmu, path: str | Path) -> Changes:
    """Inputs over time from a CSV in FMPy's form: a column ``time`` and one for each input.

    A row's values hold from its time until the next row's; before the first row the start
    values hold.

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
    for i, name in enumerate(header):
        if name in header[:i]:
            raise InputError(f"'{path}' has two columns '{name:.50}'")
        if name == "time":
            continue
        if name not in fmu.variables:
            known = [element for group in fmu.groups("input").values() for element in group]
            suggestion = _suggestion(name, known)
            raise InputError(f"'{path}': there is no variable '{name:.50}'{suggestion}")
        if fmu.variables[name].causality != "input":
            raise InputError(f"'{path}': {name} is not an input")
    changes: Changes = []
    for number, row in rows:
        if len(row) != len(header):
            raise InputError(f"'{path}' row {number}: {len(row)} cells, expected {len(header)}")
        values: dict[str, Value] = {}
        for name, cell in zip(header, row, strict=True):
            try:
                values[name] = float(cell)
            except ValueError:
                raise InputError(
                    f"'{path}' row {number}: {name} = '{cell:.50}' is not a number"
                ) from None
            if not math.isfinite(values[name]):
                raise InputError(f"'{path}' row {number}: {name} = {cell:.50} is not finite")
        time = values.pop("time")
        if changes and time < changes[-1][0]:
            raise InputError(f"'{path}' row {number}: time {time:g} is before the row above")
        changes.append((time, values))
    if not changes:
        raise InputError(f"'{path}' has no rows")
    return changes


def _rows(path: str | Path) -> Iterator[tuple[int, list[str]]]:
    """Rows that are not empty, with their line numbers: a line is a row, also inside quotes."""
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
