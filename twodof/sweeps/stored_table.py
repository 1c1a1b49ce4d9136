"""Read the Parquet files of a sweep's table, which are untrusted, in bounded memory."""

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from math import prod
from pathlib import Path

import numpy as np

from ..bounds import MAX_NAME, MAX_NUMBER, MAX_PROVENANCE, MAX_RUNS, MAX_SETTINGS, MAX_SWEEP, MAX_VARIED
from ..children import memory_for
from ..errors import SweepError
from ..files import NUMBER, VALUES, JsonObject, check_file, fits, parsed
from ..simulation.verdict import METRICS
from ..version import needing
from .design import OWN_COLUMNS

with needing(SweepError, "read or write tables of sweeps", "sweep"):
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

WHOLE = "runs.parquet"
PART = re.compile(r"part-(\d{6,})\.parquet")
KEY = b"twodof"
SHAPE = {
    "fmu": {"file": str, "name": str, "guid": str},
    "design": {"grids": {str: [NUMBER]}, "ranges": {str: [NUMBER]}, "draws": int},
    "options": {"stop_time": NUMBER, "step": NUMBER, "settings": VALUES},
    "bags": bool,
    "versions": {"twodof": str},
    "command_line": str,
}
"""Shape of a valid provenance."""
OUTCOMES = ("finished", "discarded", "diverged", "failed", "crashed")
TEXTS = ["outcome", "message"]
NUMBER_SIZE = 8  # bytes in memory
FOOTER = {"thrift_string_size_limit": 2 * MAX_PROVENANCE, "thrift_container_size_limit": 1000}
"""Limits of texts and of lists, such as columns, in a footer. Without them Arrow aborts where it has too many."""


def schema_of(names: Sequence[str], units: Sequence[str], provenance: dict[str, object]) -> pa.Schema:
    """Return the schema of a table with these varied variables."""

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


def files_of(path: Path) -> list[Path]:
    """Return the file of the whole table, or the parts if there is none; refuse links, which could name any file."""
    if link := next(filter(Path.is_symlink, chain(path.iterdir(), (path / "bags").glob("*"))), None):
        raise SweepError(f"'{link}' is a link, and links in a sweep are not followed; copy what it names")
    if (path / WHOLE).exists():
        return [path / WHOLE]
    return sorted(file for file in path.iterdir() if PART.fullmatch(file.name))


def named(path: Path) -> Path:
    """Name the path in errors of pyarrow."""
    try:
        path.as_posix().encode()
    except UnicodeEncodeError as error:
        raise SweepError(f"'{path}' is not UTF-8 text, which the name of a sweep must be") from error
    return path


def read_tables(files: Iterable[Path]) -> Iterator[tuple[Path, pa.Table]]:
    """Yield each file with its table."""
    room, seen = MAX_SWEEP, np.zeros(MAX_RUNS, dtype=bool)
    for file in files:
        try:
            check_file(named(file), MAX_SWEEP)
            with memory_for(3 * MAX_SWEEP):  # a footer takes 240 times its size; a page may have more than it states
                with pq.ParquetFile(file, **FOOTER) as stored:
                    schema = stored.schema_arrow
                runs = _check_schema(file, schema)
                with pq.ParquetFile(file, read_dictionary=TEXTS, **FOOTER) as stored:
                    _check_size(file, stored.metadata, runs, room)
                    table = stored.read(use_threads=False)
            room -= len(schema.metadata[KEY]) + table.nbytes + sum(_expanded(table.column(name)) for name in TEXTS)
            if room < 0:
                raise _damaged(file)
            table.validate(full=True)  # texts may be any bytes
            _check_values(file, table, runs)
            numbers = table.column("run").to_numpy()
            if seen[numbers].any():
                raise _damaged(file)
            seen[numbers] = True
            yield file, table.cast(schema)
        except MemoryError:
            raise _damaged(file) from None
        except (OSError, pa.ArrowException) as error:
            reason = " ".join(str(error).split())
            raise SweepError(f"cannot read '{file}': {reason:.300}") from error


def _check_schema(file: Path, schema: pa.Schema) -> int:
    """Refuse a table without a sweep's columns; return the number of runs of its design."""
    design = provenance_in(file, schema)["design"]
    names = [*design["grids"], *design["ranges"]]
    runs: int = prod(map(len, design["grids"].values())) * design["draws"]
    unclear = len({*names, *OWN_COLUMNS, ""}) < len(names) + len(OWN_COLUMNS) + 1
    if runs > MAX_RUNS or unclear or not schema.equals(schema_of(names, names, {})):
        raise _damaged(file)
    return runs


def _check_size(file: Path, content: pq.FileMetaData, runs: int, room: int) -> None:
    """Refuse a table whose stated size exceeds the limit, before reading it; equal values are stored once."""
    groups = [content.row_group(i) for i in range(content.num_row_groups)]
    size = sum(g.column(j).total_uncompressed_size for g in groups for j in range(g.num_columns))
    rows = sum(group.num_rows for group in groups)
    if max(size, NUMBER_SIZE * rows * content.num_columns) > room or rows > runs:
        raise _damaged(file)


def _expanded(texts: pa.ChunkedArray) -> int:
    """Return the bytes that dictionary-encoded texts would have if each row stored its own copy."""
    lengths = (pc.binary_length(chunk.dictionary).take(chunk.indices) for chunk in texts.chunks)
    return sum(pc.sum(of, min_count=0).as_py() for of in lengths)


def _check_values(file: Path, table: pa.Table, count: int) -> None:
    """Refuse runs and values outside the design, and invalid numbers."""
    runs, grids = table.column("run"), provenance_in(file, table.schema)["design"]["grids"]
    numbers = [column for column in table.columns if pa.types.is_float64(column.type)]
    if len(table) and not (
        len(runs.unique()) == len(runs)
        and 0 <= pc.min(runs).as_py() <= pc.max(runs).as_py() < count
        and pc.all(pc.is_in(table.column("outcome"), pa.array(OUTCOMES))).as_py()
        and all(pc.all(pc.less(pc.abs(column), MAX_NUMBER), min_count=0).as_py() for column in numbers)
        and all(pc.all(pc.is_in(table.column(n), pa.array(grids[n], pa.float64()))).as_py() for n in grids)  # of a map
    ):
        raise _damaged(file)


def _damaged(file: Path) -> SweepError:
    return SweepError(f"cannot read '{file}': it is damaged")


def provenance_in(file: Path, schema: pa.Schema) -> JsonObject:
    """Return the provenance in a table's schema; raise SweepError if it is not valid."""
    try:
        text = (schema.metadata or {})[KEY]
        provenance: JsonObject = parsed(text) if len(text) <= MAX_PROVENANCE else {}
        if not fits(provenance, SHAPE):
            raise ValueError
        design = provenance["design"]
        varied, settings = [*design["grids"], *design["ranges"]], provenance["options"]["settings"]
        if len(varied) > MAX_VARIED or len(settings) > MAX_SETTINGS:
            raise SweepError(f"'{file}' has more than {MAX_VARIED} varied variables or {MAX_SETTINGS} settings")
        names = [
            *varied,
            *settings,
            *(provenance["fmu"][key] for key in ("file", "name", "guid")),
            provenance["versions"]["twodof"],
        ]
        if max(map(len, names)) > MAX_NAME:
            raise SweepError(f"'{file}' has a name of more than {MAX_NAME} characters")
    except (KeyError, ValueError, RecursionError):
        raise SweepError(f"'{file}' was not written by twodof") from None
    return provenance
