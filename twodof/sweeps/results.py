"""The table of a sweep: a folder of Parquet files that any reader opens as one table.

During the sweep, rows are stored in parts. At its end, the parts become one file, in the order of the runs. An
untrusted table is read in bounded memory, or refused. All uses of pyarrow are here.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Iterable, Iterator, Sequence
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bounds import MAX_NUMBER, MAX_PROVENANCE, MAX_RUNS, MAX_SETTINGS, MAX_SWEEP, MAX_VARIED
from ..children import memory_for
from ..errors import SweepError, no_such
from ..files import NUMBER, VALUES, check_file, fits, is_being_written, lock, parsed, refusing, write_file
from ..notebook import card, picture
from ..simulation.verdict import METRICS
from ..version import needing
from .ranking import RANKED, candidates
from .runner import Row

with needing(SweepError, "store a table", "sweep"):
    import pandas
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

WHOLE = "runs.parquet"
PART = re.compile(r"part-(\d{6})\.parquet")
KEY = b"twodof"
PERIOD = 1.0  # s between two parts
COMPARED = ("fmu", "design", "options", "bags")
"""Keys that must be equal to resume a sweep, as must the version of this package."""

SHAPE = {
    "fmu": {"file": str, "name": str, "guid": str},
    "design": {"grids": {str: [NUMBER]}, "ranges": {str: [NUMBER]}, "draws": int},
    "options": {"stop_time": NUMBER, "step": NUMBER, "settings": VALUES},
    "versions": {"twodof": str},
    "command_line": str,
}
"""Shape of a valid provenance."""
TEXTS = ["outcome", "message"]


class Results:
    """The table of a sweep in progress.

    Args:
        path: the folder; without ``resume``, it must not exist.
        names, units: varied variables and their units.
        runs: number of runs.
        provenance: provenance of the numbers.
        resume: continue the sweep in the folder.

    Attributes:
        done: for each run, whether its row is stored.

    Raises:
        SweepError: the folder exists; or with ``resume``, it does not exist or belongs to another sweep.
    """

    def __init__(
        self,
        path: str | Path,
        names: Sequence[str],
        units: Sequence[str],
        runs: int,
        provenance: dict[str, object],
        *,
        resume: bool = False,
    ) -> None:
        self.path = _named(Path(path))
        self._schema = _schema(names, units, provenance)
        self._rows: list[Row] = []
        self._part = 0
        self.done: NDArray[np.bool_] = np.zeros(runs, dtype=bool)
        if resume:
            self._resume(provenance)
        elif self.path.exists():
            raise self._taken()

    def __enter__(self) -> Results:
        if not self._part:
            self._begin()
        try:
            self._lock = lock(self.path)
        except BlockingIOError:
            raise SweepError(f"'{self.path}' is being written by another process") from None
        self._stored = time.monotonic()
        return self

    def __exit__(self, *exception: object) -> None:
        try:
            self._store()
            if self.done.all():
                self._unite()
        finally:
            os.close(self._lock)

    def _begin(self) -> None:
        """Write a part without rows, which identifies the sweep from the start."""
        with refusing(SweepError, f"make '{self.path}'"):
            try:
                self.path.mkdir(parents=True)
            except FileExistsError:
                raise self._taken() from None
        self._write_part([])

    def _taken(self) -> SweepError:
        known = self.path.is_dir() and _files(self.path)
        what = "exists; resume it with `resume=True`, or" if known else "exists and is not a sweep;"
        return SweepError(f"'{self.path}' {what} choose another `output`")

    def _resume(self, provenance: dict[str, object]) -> None:
        if not self.path.is_dir():
            raise SweepError(f"there is no sweep '{self.path}' to resume")
        if is_being_written(self.path):
            raise SweepError(f"'{self.path}' is being written by another process")
        for file, table in _read(_files(self.path)):
            _check_same(self.path, _provenance(file, table.schema), provenance)
            self._schema = table.schema
            self.done[table.column("run").to_numpy()] = True
            number = PART.fullmatch(file.name)
            self._part = int(number[1]) + 1 if number else 1
        if not self._part:
            raise SweepError(f"'{self.path}' is not a sweep; there is nothing to resume")

    def add(self, rows: Iterable[Row]) -> None:
        """Add rows, stored within a second or two."""
        for row in rows:
            self._rows.append(row)
            self.done[row[0]] = True
        if time.monotonic() - self._stored > PERIOD:
            self._store()

    def _store(self) -> None:
        if self._rows:
            self._write_part(self._rows)
        self._rows = []
        self._stored = time.monotonic()

    def _write_part(self, rows: Sequence[Row]) -> None:
        frame = pandas.DataFrame(rows, columns=self._schema.names)  # NaN becomes null
        table = pa.Table.from_pandas(frame, self._schema, preserve_index=False)
        _write(self.path / f"part-{self._part:06d}.parquet", table.cast(self._schema))
        self._part += 1

    def _unite(self) -> None:
        """Write one file with all rows, then remove the parts."""
        parts = [file for file in _files(self.path) if file.name != WHOLE]
        if parts:
            tables = pa.concat_tables(table for _, table in _read(parts))
            _write(self.path / WHOLE, tables.sort_by("run").combine_chunks())
        for file in filter(_is_part, self.path.iterdir()):
            file.unlink()


class SweepTable(pandas.DataFrame):  # type: ignore[misc]
    """The table of a sweep; a notebook shows it with a picture of the runs."""

    def _repr_html_(self) -> str:
        varied, runs = self.columns[1], candidates(self)
        metric = next((name for name in RANKED if runs[name].notna().any()), "end_time")
        title = METRICS[metric].title if metric in METRICS else metric
        plot = picture([(runs[varied], runs[metric])], varied, title, dots=True)
        outcomes = self["outcome"].value_counts().to_dict()
        return card(f"Sweep of {len(self)} runs", outcomes, plot) + (super()._repr_html_() or "")


def read_sweep(path: str | Path) -> pandas.DataFrame:
    """Return the table of a finished or unfinished sweep, in the order of the runs.

    ``attrs["units"]`` of the table has the units of the columns, "" for a number without a unit.
    ``attrs["provenance"]`` has the FMU, the design and the settings.

    Raises:
        SweepError: the table cannot be read.
    """
    path = Path(path)
    with refusing(SweepError, f"read '{path}'"):
        files = _files(path) if path.is_dir() else []
    if not files:
        raise SweepError(no_such("sweep", path))
    table = pa.concat_tables(table for _, table in _read(files)).sort_by("run")
    rows = SweepTable(table.to_pandas())
    units = {field.name: (field.metadata or {}).get(b"unit", b"") for field in table.schema}
    rows.attrs["units"] = {name: unit.decode("utf-8", "replace") for name, unit in units.items()}
    rows.attrs["provenance"] = _provenance(files[0], table.schema)
    return rows


def _schema(names: Sequence[str], units: Sequence[str], provenance: dict[str, object]) -> pa.Schema:
    def number(name: str, unit: str, text: str) -> pa.Field:
        return pa.field(name, pa.float64(), metadata={"unit": unit, "description": text})

    return pa.schema(
        [
            pa.field("run", pa.int64(), nullable=False),
            *(number(name, unit, "varied") for name, unit in zip(names, units)),
            *(number(name, metric.unit, metric.text) for name, metric in METRICS.items()),
            number("end_time", "s", "time of the last communication point that was reached"),
            pa.field("outcome", pa.string(), nullable=False),
            pa.field("message", pa.string()),
        ],
        metadata={KEY: json.dumps(provenance)},
    )


def _files(path: Path) -> list[Path]:
    """Return the file of the whole table, or the parts if there is none."""
    if (path / WHOLE).exists():
        return [path / WHOLE]
    return sorted(filter(_is_part, path.iterdir()))


def _named(path: Path) -> Path:
    """Name the path in errors of pyarrow."""
    try:
        path.as_posix().encode()
    except UnicodeEncodeError as error:
        raise SweepError(f"'{path}' is not UTF-8 text, which the name of a sweep must be") from error
    return path


def _is_part(file: Path) -> bool:
    return PART.fullmatch(file.name) is not None


def _read(files: Iterable[Path]) -> Iterator[tuple[Path, pa.Table]]:
    """Yield each file with its table."""
    room = MAX_SWEEP
    for file in files:
        try:
            check_file(_named(file), MAX_SWEEP)
            schema = pq.read_schema(file)
            runs = _check_schema(file, schema)
            with pq.ParquetFile(file, read_dictionary=TEXTS) as stored:
                _check_size(file, stored.metadata, runs, room)
                with memory_for(3 * MAX_SWEEP):  # a page may have more than the file states
                    table = stored.read(use_threads=False)
            room -= table.nbytes + sum(_expanded(table.column(name)) for name in TEXTS)
            if room < 0:
                raise _damaged(file)
            _check_values(file, table, runs)
            yield file, table.cast(schema)
        except MemoryError:
            raise _damaged(file) from None
        except (OSError, pa.ArrowException) as error:
            reason = " ".join(str(error).split())
            raise SweepError(f"cannot read '{file}': {reason:.300}") from error


def _check_schema(file: Path, schema: pa.Schema) -> int:
    """Refuse a table without a sweep's columns; return the number of runs of its design."""
    design = _provenance(file, schema)["design"]
    names = [*design["grids"], *design["ranges"]]
    runs: int = prod(map(len, design["grids"].values())) * design["draws"]
    if runs > MAX_RUNS or not schema.equals(_schema(names, names, {})):
        raise _damaged(file)
    return runs


def _check_size(file: Path, content: pq.FileMetaData, runs: int, room: int) -> None:
    """Refuse a table whose stated size exceeds the limit, before reading it."""
    groups = [content.row_group(i) for i in range(content.num_row_groups)]
    size = sum(g.column(j).total_uncompressed_size for g in groups for j in range(g.num_columns))
    if size > room or sum(group.num_rows for group in groups) > runs:
        raise _damaged(file)


def _expanded(texts: pa.ChunkedArray) -> int:
    """Return the bytes that dictionary-encoded texts would have if each row stored its own copy."""
    lengths = (pc.binary_length(chunk.dictionary).take(chunk.indices) for chunk in texts.chunks)
    return sum(pc.sum(of, min_count=0).as_py() for of in lengths)


def _check_values(file: Path, table: pa.Table, count: int) -> None:
    """Refuse runs and values outside the design, and invalid numbers."""
    runs, grids = table.column("run"), _provenance(file, table.schema)["design"]["grids"]
    numbers = [column for column in table.columns if pa.types.is_float64(column.type)]
    if len(table) and not (
        len(runs.unique()) == len(runs)
        and 0 <= pc.min(runs).as_py() <= pc.max(runs).as_py() < count
        and all(pc.all(pc.less(pc.abs(column), MAX_NUMBER), min_count=0).as_py() for column in numbers)
        and all(pc.all(pc.is_in(table.column(n), pa.array(grids[n], pa.float64()))).as_py() for n in grids)  # of a map
    ):
        raise _damaged(file)


def _damaged(file: Path) -> SweepError:
    return SweepError(f"cannot read '{file}': it is damaged")


def _provenance(file: Path, schema: pa.Schema) -> dict[str, Any]:
    try:
        text = (schema.metadata or {})[KEY]
        provenance: dict[str, Any] = parsed(text) if len(text) <= MAX_PROVENANCE else {}
        if not fits(provenance, SHAPE):
            raise ValueError
        design = provenance["design"]
        varied, settings = len(design["grids"]) + len(design["ranges"]), len(provenance["options"]["settings"])
        if varied > MAX_VARIED or settings > MAX_SETTINGS:
            raise SweepError(f"'{file}' has more than {MAX_VARIED} varied variables or {MAX_SETTINGS} settings")
    except (KeyError, ValueError, RecursionError):
        raise SweepError(f"'{file}' was not written by twodof") from None
    return provenance


def _check_same(path: Path, there: dict[str, Any], wanted: dict[str, Any]) -> None:
    wanted = json.loads(json.dumps(wanted))
    for key in COMPARED:
        if there[key] != wanted[key]:
            other = {
                "fmu": f"another FMU, {there['fmu']['file']} ({there['fmu']['guid']})",
                "bags": f"`bags={there['bags']}`",
            }
            raise SweepError(
                f"'{path}' was begun with {other.get(key) or _differing(there[key], wanted[key])};"
                " begin this sweep in another `output`, or resume that one as it was begun"
            )
    if there["versions"]["twodof"] != wanted["versions"]["twodof"]:
        raise SweepError(f"'{path}' was begun by twodof {there['versions']['twodof']}; continue with that version")


def _differing(there: dict[str, object], wanted: dict[str, object]) -> str:
    """Return the stored settings that differ from the wanted ones, as text."""
    return ", ".join(
        f"{key.replace('_', ' ')} {json.dumps(value):.200}" for key, value in there.items() if value != wanted.get(key)
    )


def _write(path: Path, table: pa.Table) -> None:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    with refusing(SweepError, f"write '{path}'"):
        write_file(path, sink.getvalue().to_pybytes())
