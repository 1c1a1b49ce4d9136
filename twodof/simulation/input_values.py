"""Settings of a run: values by name, and CSV files of inputs over time, checked against an FMU."""

import csv
import logging
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from math import isfinite
from pathlib import Path

from ..bounds import MAX_CELLS, MAX_TABLE
from ..errors import InputError, kind_of, no_such
from ..files import check_file
from ..fmu import Fmu, no_variable
from ..fmu import Setting as Setting
from ..fmu import resolve as resolve
from ..fmu import resolve_all as resolve_all
from ..plant.numerals import number, whole_number
from ..plant.variables import GAINS
from ..plant.variables import Value as Value

LOG = logging.getLogger(__name__)

Changes = list[tuple[float, dict[str, Value]]]  # ascending times, s, and the new values of inputs at these times
KINDS: dict[str, tuple[Callable[[str], Value], str]] = {
    "Real": (number, "a number"),
    "Integer": (lambda cell: array("i", [whole_number(cell)])[0], "a whole number of 32 bits"),
    "Boolean": ({"true": True, "false": False}.__getitem__, "true or false"),
}
"""Functions that read the cells of a type, and what they expect."""


def check_going_on(fmu: Fmu, asked: Mapping[str, Value], held: Mapping[str, Value]) -> None:
    """Refuse inputs that would end the run, for sources that may send them at any time.

    Raises:
        InputError: a gain is negative, or the target quaternion would be zero.
    """
    for name, value in asked.items():
        if name.partition("[")[0] in GAINS and value < 0.0:
            raise InputError(f"{name} = {value:g} is less than 0")
    turn = fmu.vector("quat_des")
    if turn and not any({**held, **asked}[name] for name in turn):
        raise InputError("quat_des = 0, 0, 0, 0 is not an orientation; the identity is (0, 0, 0, 1)")


def read_changes(fmu: Fmu, path: str | Path) -> Changes:
    """Read inputs over time from a CSV in FMPy's form: a column ``time``, and one for each input.

    Columns have the names of settings. A row applies until the next row. Start values apply before the first row.

    Raises:
        InputError: the file is invalid; the message names the file and the row or column.
    """
    rows = _rows(path)
    _, names = next(rows, (0, None))
    if names is None:
        raise InputError(f"'{path}' is empty")
    header = [cell.strip() for cell in names]
    if "time" not in header:
        raise InputError(f"'{path}' has no column 'time'; {_header_remedy(names)}")
    elements = {name: _inputs(fmu, path, name) for name in header if name != "time"}
    if not elements:
        raise InputError(f"'{path}' has no column except 'time'; add one for each input")
    for name, own in elements.items():
        if len(own) > 1:
            LOG.info(f"'{path}': the column '{name}' sets all {len(own)} elements")
    columns = [element for name in header for element in elements.get(name, ["time"])]
    twice = next((element for element, n in Counter(columns).items() if n > 1), None)
    if twice is not None:
        raise InputError(f"'{path}' has two columns for '{twice:.50}'")
    kinds = {name: KINDS[fmu.variables[own[0]].type] for name, own in elements.items()} | {"time": KINDS["Real"]}
    changes: Changes = []
    for line, row in rows:
        if (len(changes) + 1) * len(columns) > MAX_CELLS:
            raise InputError(f"'{path}' has more than {MAX_CELLS} cells; a vector's column counts for each element")
        if len(row) != len(header):
            raise InputError(f"'{path}' row {line}: {len(row)} cells, expected {len(header)}")
        values: dict[str, Value] = {}
        for name, cell in zip(header, row, strict=True):
            read, expected = kinds[name]
            try:
                values[name] = read(cell.strip())
            except (ValueError, LookupError, OverflowError):
                raise InputError(f"'{path}' row {line}: {name} = '{cell:.50}' is not {expected}") from None
            if not isfinite(values[name]):
                raise InputError(f"'{path}' row {line}: {name} = {cell:.50} is not finite")
        time = values.pop("time")
        if changes and time < changes[-1][0]:
            raise InputError(f"'{path}' row {line}: time {time:g} is before the row above")
        spread = {element: v for name, v in values.items() for element in elements[name]}
        changes.append((time, spread))
    if not changes:
        raise InputError(f"'{path}' has no rows")
    return changes


def _header_remedy(cells: list[str]) -> str:
    """Return a remedy for the first line of a CSV file."""
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
        raise InputError(f"'{path}': {no_variable(fmu, name, 'input')}")
    variables = [fmu.variables[element] for element in elements]
    if variables[0].causality == "parameter":
        raise InputError(f"'{path}': {name} is a parameter, which cannot change during a run; give it as a setting")
    if any(variable.causality != "input" or variable.type not in KINDS for variable in variables):
        raise InputError(f"'{path}': {name} is not an input that is a number or a Boolean")
    return elements


def _rows(path: str | Path) -> Iterator[tuple[int, list[str]]]:
    """Yield non-empty rows with their line numbers; a quoted cell must not span lines."""
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
    except UnicodeDecodeError as error:
        other = Path(path).suffix != ".csv" and kind_of(Path(path))
        raise InputError(
            no_such("CSV", Path(path)) if other else f"'{path}' is not UTF-8 text; save it as CSV UTF-8"
        ) from error
    except csv.Error as error:
        raise InputError(f"'{path}' is not a CSV file: {error}") from error
