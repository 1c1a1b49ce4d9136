"""Export bags as tables, one MCAP file or a dataset, for tools that cannot open a rosbag2 folder."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np

from ..bounds import MIB
from ..errors import BagError, path_of
from ..files import refusing, temporary_folder, write_file
from ..plant.urdf import RobotError, read_urdf
from ..version import needing
from .contents import storage_files
from .lerobot import write_dataset
from .provenance import robot_in
from .reader import read_bag, whole_bag
from .recording import Array, Recording
from .recovery import copy_messages

PART = 100_000  # cells of a CSV file that are written at a time
FORMULA = re.compile(r"(?:^|[;,|\"\t\r\n])\s*(?=[=+@＝＋－＠-])")
"""Position before a character that begins a formula in a spreadsheet, whatever separates its cells."""
ENDINGS = (".csv", ".parquet", ".mcap", ".lerobot")


def export_bag(bag: str | Path | Sequence[str | Path], output: str | Path) -> Path:
    """Write a bag as a table, as one MCAP file or as a dataset, by the output's suffix; return its path.

    A table has one row for each sample. Its columns are "time"; for a joint "elbow", "elbow.position",
    "elbow.velocity" and "elbow.effort"; and for a task axis "y", "x.y" and "x_des.y". Unknown quantities have no
    column. Units are in the header of a CSV file, "elbow.position [rad]", and in the pandas attributes of a Parquet
    file. In a CSV file an apostrophe precedes a name that a spreadsheet would read as a formula. Values are in SI
    units, in full precision. An MCAP file has all messages, with the provenance as metadata. A folder with the suffix
    .lerobot is a LeRobot dataset (``lerobot.write_dataset``) with an episode for each bag.

    Raises:
        BagError: the bag is incomplete, the suffix is unknown, pandas or pyarrow is missing, or the file cannot be
            written.
    """
    bags = [path_of(each, "bag") for each in ([bag] if isinstance(bag, str | Path) else bag)]
    path = path_of(output, "export")
    if path.suffix not in ENDINGS:
        raise BagError(f"'{path}': the name of an export ends in {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}")
    if {*path.resolve().parents} & {robot_in(each)[0].resolve() for each in bags}:
        raise BagError(f"'{path}' is in the bag, whose files are not replaced; give another `output`")
    if path.suffix == ".lerobot":
        write_dataset(bags, path)
        return path
    if len(bags) > 1:
        raise BagError(f"'{path}' holds one bag; several become the episodes of a folder that ends in .lerobot")
    if path.suffix == ".mcap":
        content: Iterable[bytes] = _mcap(bags[0])
    else:
        columns = _columns(read_bag(bags[0]))
        content = _csv(columns) if path.suffix == ".csv" else [_parquet(columns)]
    with refusing(BagError, f"write '{path}'"):
        write_file(path, content)
    return path


def _columns(run: Recording) -> dict[str, tuple[str, Array]]:
    """Return the unit ("" if unknown) and the N values of each column, by name."""
    try:
        known = read_urdf(run.provenance.get("urdf") or "").joints
    except RobotError:
        known = {}
    columns = {"time": ("s", run.t)}
    for i, name in enumerate(run.joints):
        joint = known.get(name)
        units = ("m", "m/s", "N") if joint and joint.prismatic else ("rad", "rad/s", "N·m") if joint else ("", "", "")
        parts = zip(("position", "velocity", "effort"), units, (run.q, run.v, run.tau))
        columns |= {f"{name}.{part}": (unit, values[:, i]) for part, unit, values in parts if values.size}
    for group, values in (("x", run.x), ("x_des", run.target)):
        columns |= {f"{group}.{axis}": ("m", values[:, i]) for i, axis in enumerate(run.axes or "xyz") if values.size}
    return columns


def _csv(columns: dict[str, tuple[str, Array]]) -> Iterator[bytes]:
    rows: Iterable[Sequence[object]] = [
        [FORMULA.sub(r"\g<0>'", f"{name} [{unit}]" if unit else name) for name, (unit, _) in columns.items()]
    ]
    part = max(1, PART // len(columns))
    for k in count(0, part):
        file = io.StringIO()
        csv.writer(file, lineterminator="\n").writerows(rows)
        yield file.getvalue().encode()
        rows = np.column_stack([values[k : k + part] for _, values in columns.values()]).tolist()  # shortest exact text
        if not rows:
            return


def _parquet(columns: dict[str, tuple[str, Array]]) -> bytes:
    with needing(BagError, "write a Parquet file", "sweep"):
        import pandas as pd

        table = pd.DataFrame({name: values for name, (_, values) in columns.items()})
        table.attrs["units"] = {name: unit for name, (unit, _) in columns.items()}
        return bytes(table.to_parquet(index=False))


def _mcap(bag: Path) -> Iterator[bytes]:
    folder, _ = robot_in(bag)
    whole_bag(folder)
    with temporary_folder() as temporary:
        _, damage = copy_messages(folder, storage_files(folder), temporary / "bag", "mcap")
        if damage:
            raise BagError(f"cannot export '{bag}': {damage}; 'twodof recover {folder}' saves what can be read")
        (file,) = storage_files(temporary / "bag")
        with file.open("rb") as whole:
            yield from iter(partial(whole.read, MIB), b"")
