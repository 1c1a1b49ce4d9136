"""Settings of a run: values by name, and CSV files of inputs over time, checked against an FMU."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import chain
from math import inf, isfinite
from pathlib import Path

from ..bounds import MAX_CELLS, MAX_TABLE
from ..errors import InputError, choice, no_such
from ..files import check_file
from ..fmu import Fmu
from ..plant.variables import CONTROLS, GAINS
from ..plant.variables import Value as Value

Setting = object
"""A number, a Boolean, or a sequence or array of them; a dict of several kinds is ``dict[str, object]``."""
Changes = list[tuple[float, dict[str, Value]]]
"""Times in s, ascending, and the inputs that take new values there."""


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
        start = name.replace(group := name.partition("[")[0], f"{group}_start", 1)
        remedy = f"; set {start}" if start in fmu.variables else ""
        raise InputError(f"{name} is of causality '{variable.causality}' and cannot be set{remedy}")
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
    indexed = re.sub(r"_?(\d+)$", r"[\1]", name)  # x_des_1 and x_des1 as x_des[1]
    known = [*dict.fromkeys([*groups, *chain(*groups.values())])]
    like = f"; did you mean '{indexed}'?" if indexed in known else choice(name, known, cutoff=0.4)
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
        raise InputError(f"'{path}' has no column 'time'; {_header_remedy(names)}")
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


def _header_remedy(cells: list[str]) -> str:
    """Return what to change in a CSV's first line."""
    line = ",".join(cells)
    if mark := next((mark for mark in (";", "\t") if mark in line), None):
        kind = "semicolons" if mark == ";" else "tabs"
        return f"it has {kind} between its cells: write commas there, and decimal points in numbers"
    near = next((cell for cell in cells if cell.strip().lower() in ("time", "t", "times", "time [s]", "time_s")), None)
    return (
        f"rename the column '{near:.50}'"
        if near
        else f"its first line is '{line:.80}': name the columns there, the time first"
    )


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
    except FileNotFoundError as error:
        raise InputError(no_such("CSV", Path(path))) from error
    except OSError as error:
        raise InputError(f"cannot read '{path}': {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"'{path}' is not a CSV file: {error}") from error
