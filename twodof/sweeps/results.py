"""The table of a sweep: a folder of Parquet files that any reader opens as one table.

During the sweep, rows are stored in parts. At its end, the parts become one file, in the order of the runs. All uses of
pyarrow are here and in ``stored_table.py``.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import SweepError, no_such
from ..files import JsonObject, is_being_written, lock, parsed, refusing, write_file
from ..notebook import card, picture
from ..simulation.verdict import METRICS
from ..version import needing
from .ranking import RANKED, candidates
from .runner import Row
from .stored_table import PART, WHOLE, files_of, named, provenance_in, read_tables, schema_of

with needing(SweepError, "read or write tables of sweeps", "sweep"):
    import pandas
    import pyarrow as pa
    import pyarrow.parquet as pq

PERIOD = 1.0  # s between two parts
COMPARED = ("fmu", "design", "options", "bags")
"""Keys that must be equal to resume a sweep, as must the version of this package."""


class Results:
    """The table of a sweep in progress.

    Args:
        names, units: varied variables and their units.
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
        self.path = named(Path(path))
        self._schema = schema_of(names, units, provenance)
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
        known = self.path.is_dir() and files_of(self.path)
        what = "exists; resume it with `resume=True`, or" if known else "exists and is not a sweep;"
        return SweepError(f"'{self.path}' {what} choose another `output`")

    def _resume(self, provenance: dict[str, object]) -> None:
        if not self.path.is_dir():
            raise SweepError(f"there is no sweep '{self.path}' to resume")
        if is_being_written(self.path):
            raise SweepError(f"'{self.path}' is being written by another process")
        for file, table in read_tables(files_of(self.path)):
            _check_same(self.path, provenance_in(file, table.schema), provenance)
            self._schema = table.schema
            self.done[table.column("run").to_numpy()] = True
            number = PART.fullmatch(file.name)
            self._part = max(self._part, int(number[1]) + 1 if number else 1)
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
        parts = [file for file in files_of(self.path) if file.name != WHOLE]
        if parts:
            tables = pa.concat_tables(table for _, table in read_tables(parts))
            _write(self.path / WHOLE, tables.sort_by("run").combine_chunks())
        for file in self.path.iterdir():
            if PART.fullmatch(file.name):
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
        files = files_of(path) if path.is_dir() else []
    if not files:
        raise SweepError(no_such("sweep", path))
    table = pa.concat_tables(table for _, table in read_tables(files)).sort_by("run")
    rows = SweepTable(table.to_pandas())
    units = {field.name: (field.metadata or {}).get(b"unit", b"") for field in table.schema}
    rows.attrs["units"] = {name: unit.decode("utf-8", "replace") for name, unit in units.items()}
    rows.attrs["provenance"] = provenance_in(files[0], table.schema)
    return rows


def _check_same(path: Path, there: JsonObject, wanted: JsonObject) -> None:
    wanted = parsed(json.dumps(wanted).encode())
    for key in COMPARED:
        if there[key] != wanted[key]:
            if key == "fmu":
                other = f"another FMU, {there['fmu']['file']} ({there['fmu']['guid']})"
            elif key == "bags":
                other = f"`bags={there['bags']}`"
            else:
                differing = {name: value for name, value in there[key].items() if value != wanted[key].get(name)}
                texts = (f"{name.replace('_', ' ')} {json.dumps(value):.200}" for name, value in differing.items())
                other = ", ".join(texts)
            remedy = "give another `output`, or the options of the first run"
            raise SweepError(f"'{path}' was begun with {other}; {remedy}")
    if there["versions"]["twodof"] != wanted["versions"]["twodof"]:
        raise SweepError(f"'{path}' was begun by twodof {there['versions']['twodof']}; continue with that version")


def _write(path: Path, table: pa.Table) -> None:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    with refusing(SweepError, f"write '{path}'"):
        write_file(path, sink.getvalue().to_pybytes())
