"""The table of a sweep: content, resumption and refusals."""

import json
import os
import random
import re
import signal
import struct
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event
from typing import Any

import duckdb
import numpy as np
import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from harness import forged, python
from tables import COMMAND, SMALL, same, table_of

import twodof
from twodof import TwoDofError, sweep
from twodof.cli.main import main
from twodof.simulation.verdict import METRICS
from twodof.sweeps.results import read_sweep


def test_table_is_parquet_with_units_and_provenance(native_path, tmp_path):
    table = sweep(native_path, grid=SMALL, stop_time=0.5, output=tmp_path / "s", command_line="by hand")
    (file,) = (tmp_path / "s").iterdir()
    assert file.name == "runs.parquet"
    same(table_of(tmp_path / "s"), table)
    unsettled = f"select count(*) from '{file}' where settling_time is null"
    ((count,),) = duckdb.execute(unsettled).fetchall()
    assert count == table["settling_time"].isna().sum() > 0
    pairs = duckdb.execute(f"select key, value from parquet_kv_metadata('{file}')").fetchall()
    provenance = json.loads(dict(pairs)[b"twodof"])
    assert provenance["fmu"]["guid"] == twodof.load_fmu(native_path).guid
    assert provenance["command_line"] == "by hand"
    assert provenance["design"]["grids"] == {name: list(SMALL[name]) for name in SMALL}
    assert provenance["versions"]["twodof"] == twodof.__version__
    described = duckdb.execute(f"describe select * from '{file}'").fetchall()
    types = {name: str(kind) for name, kind, *_ in described}
    assert types["run"] == "BIGINT" and types["outcome"] == types["message"] == "VARCHAR"
    assert {types[name] for name in ("Kp", "Kd", *METRICS, "end_time")} == {"DOUBLE"}
    assert table.attrs["units"]["Kp"] == "1/s2" and table.attrs["units"]["overshoot"] == ""


GRIDS = ["--grid", "Kp=10:200:20", "--grid", "Kd=5:80:16", "--stop-time", "40"]


def begin(fmu: Path, output: Path, *options: str) -> subprocess.Popen[str]:
    command = [*COMMAND, "sweep", str(fmu), *GRIDS, "-o", str(output), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)


@pytest.fixture(scope="module")
def undisturbed(native_path, tmp_path_factory):
    """An undisturbed sweep of 320 runs."""
    path = tmp_path_factory.mktemp("sweep") / "whole"
    done = begin(native_path, path)
    out, err = done.communicate(timeout=120)
    assert (done.returncode, err) == (0, "")
    assert "320 of 320 runs: 320 finished" in out and f"twodof plot {path}" in out
    return path


@pytest.mark.long
def test_an_interrupted_sweep_is_resumed(native_path, undisturbed, tmp_path, length):
    """The interrupt is Ctrl-C to all processes of the terminal, or the death of the sweep's own process."""
    rng = random.Random(3)
    expected = table_of(undisturbed)
    kept = []
    for i in range(length(20, 2)):
        path = tmp_path / f"s{i}"
        process = begin(native_path, path, "--workers", "1")
        while not (path / "part-000001.parquet").exists():
            assert process.poll() is None, process.communicate()
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 0.5))
        if i % 2:
            process.kill()
            process.communicate()
        else:
            os.killpg(process.pid, signal.SIGINT)
            out, err = process.communicate(timeout=120)
            assert err == "", err
            if len(table_of(path)) < 320:
                assert process.returncode == 130
                assert re.search(r"^  twodof sweep .* --resume$", out, re.M)
        kept.append(len(table_of(path)))
        os.utime(path)
        again = begin(native_path, path, "--resume")
        out, err = again.communicate(timeout=120)
        assert (again.returncode, err) == (0, ""), err
        same(table_of(path), expected)
        assert [file.name for file in path.iterdir()] == ["runs.parquet"]
    print(f"rows kept of 320 when interrupted: {kept}")
    assert 0 < min(kept) < 320


def test_resuming_repeats_nothing(native_path, tmp_path):
    stop = Event()
    path, done = tmp_path / "s", []

    def progress(count: int, runs: int) -> None:
        done.append(count)
        if count >= 3:
            stop.set()

    options: dict[str, Any] = {"grid": {"Kp": np.linspace(10, 90, 40)}, "stop_time": 20.0, "output": path}
    table = sweep(native_path, workers=1, progress=progress, stop=stop.is_set, **options)
    assert 3 <= len(table) < 40
    parts = {file: file.read_bytes() for file in path.iterdir()}
    counts: list[int] = []
    resumed = sweep(native_path, resume=True, progress=lambda count, runs: counts.append(count), **options)
    assert counts[0] == len(table) and len(parts) > 1
    same(resumed, sweep(native_path, **{**options, "output": None}))
    made = {file.name: file.read_bytes() for file in path.iterdir()}
    sweep(native_path, resume=True, **options)  # is finished: nothing is run, nothing changes
    assert {file.name: file.read_bytes() for file in path.iterdir()} == made


def test_another_sweep_is_not_resumed(native_path, tmp_path, fmu_path):
    path = tmp_path / "s"
    options: dict[str, Any] = {"grid": {"Kp": [1.0, 2.0]}, "stop_time": 0.05, "output": path, "resume": True}
    sweep(native_path, **{**options, "resume": False})
    before = {file.name: file.read_bytes() for file in path.iterdir()}
    for change, said in (
        ({"grid": {"Kp": [1.0, 3.0]}}, r'was begun with grids {"Kp": \[1.0, 2.0\]};'),
        ({"stop_time": 0.06}, "was begun with stop time 0.05; give another `output`"),
        ({"bags": True}, "was begun with `bags=False`;"),
        ({"resume": False}, "exists; resume it with `resume=True`, or choose another `output`"),
    ):
        with pytest.raises(TwoDofError, match=said):
            sweep(native_path, **{**options, **change})
    with pytest.raises(TwoDofError, match=r"was begun with another FMU, TwoDof-native.fmu \("):
        sweep(fmu_path, **options)
    assert {file.name: file.read_bytes() for file in path.iterdir()} == before


def test_damaged_and_foreign_tables_get_one_line(native_path, tmp_path):
    for name, content in (("cut", None), ("empty", b""), ("other", b"PAR1 no")):
        path = tmp_path / name
        sweep(native_path, grid={"Kp": [1.0]}, stop_time=0.02, output=path)
        file = path / "runs.parquet"
        file.write_bytes(file.read_bytes()[:-100] if content is None else content)
        with pytest.raises(TwoDofError, match=f"cannot read '.*{name}/runs.parquet'"):
            read_sweep(path)
    pandas.DataFrame({"run": [1]}).to_parquet(tmp_path / "cut/runs.parquet")
    with pytest.raises(TwoDofError, match="was not written by twodof"):
        read_sweep(tmp_path / "cut")
    with pytest.raises(TwoDofError, match="is not a sweep"):
        read_sweep(tmp_path)
    with pytest.raises(TwoDofError, match=r"no sweep '.*none'; make one with 'twodof sweep'"):
        read_sweep(tmp_path / "none")


@pytest.mark.parametrize("name", ["", "run", "outcome", "settling_time", "cost"])
def test_a_variable_with_the_name_of_a_column_is_refused(name, native_path, tmp_path):
    fmu = forged(native_path, tmp_path, 'name="payload"', f'name="{name or "payload"}"')
    if name:
        with pytest.raises(TwoDofError, match=f"{name} cannot be varied: a sweep's table has a column of its own"):
            sweep(fmu, grid={name: [0.0, 0.1]}, output=tmp_path / "refused")
        assert not (tmp_path / "refused").exists()
    sweep(native_path, grid={"payload": [0.0]}, stop_time=0.02, output=tmp_path / "s")
    file = tmp_path / "s/runs.parquet"
    table = pq.read_table(file)
    text = table.schema.metadata[b"twodof"].replace(b'"payload": [0', f'"{name}": [0'.encode())
    renamed = table.rename_columns([name if column == "payload" else column for column in table.column_names])
    pq.write_table(renamed.replace_schema_metadata({b"twodof": text}), file)
    with pytest.raises(TwoDofError, match=r"runs\.parquet.: it is damaged"):
        read_sweep(tmp_path / "s")


def endless(table: pa.Table) -> pa.Table:
    """Two million rows in some kilobytes."""
    return table.take(pa.array(np.zeros(2_000_000, dtype=np.int64)))


def of_one_text(table: pa.Table) -> pa.Table:
    """A text of a megabyte, stored once, in each of a thousand rows."""
    provenance = json.loads(table.schema.metadata[b"twodof"])
    provenance["design"]["draws"] = 1000
    rows = table.take(pa.array(np.zeros(1000, dtype=np.int64)))
    rows = changed(rows, "run", pa.array(range(1000)))
    text = pa.array(["x" * 1024**2])
    rows = changed(rows, "message", pa.DictionaryArray.from_arrays(np.zeros(1000, np.int32), text))
    return rows.replace_schema_metadata({b"twodof": json.dumps(provenance)})


def of_equal_numbers(table: pa.Table) -> pa.Table:
    """Hundreds of columns of one number, which take no room in the file and more in memory than a table may have."""
    runs = 120_000
    made = varying(table, 300)
    schema = described(made, "design", {**json.loads(made.schema.metadata[b"twodof"])["design"], "draws": runs}).schema
    one, text = pa.array(np.ones(runs)), pa.array(["finished"]).take(pa.array(np.zeros(runs, np.int32)))
    kinds = {pa.int64(): pa.array(range(runs)), pa.string(): text}
    return pa.Table.from_arrays([kinds.get(field.type, one) for field in schema], schema=schema)


def store(table: pa.Table, path: Path) -> None:
    """Write a table as another writer without Arrow's dictionaries does."""
    with pq.ParquetWriter(path, table.schema, store_schema=False) as writer:
        writer.add_key_value_metadata(table.schema.metadata)
        writer.write_table(table)


def changed(table: pa.Table, name: str, values: pa.Array) -> pa.Table:
    place = table.schema.get_field_index(name)
    field = table.schema.field(name)
    return table.set_column(place, field.with_type(values.type), values)


def described(table: pa.Table, key: str, value: object) -> pa.Table:
    provenance = {**json.loads(table.schema.metadata[b"twodof"]), key: value}
    return table.replace_schema_metadata({b"twodof": json.dumps(provenance)})


def not_utf8() -> pa.Array:
    return pa.array([b"fin\xff"] * 2, pa.binary()).view(pa.string())


def varying(table: pa.Table, count: int, name: str = "v") -> pa.Table:
    design = {"grids": {f"{name}{i}": [1.0] for i in range(count)}, "ranges": {}, "draws": 1, "seed": 0}
    columns = [table.schema.field("Kp").with_name(f"{name}{i}") for i in range(count)]
    fields = [table.schema.field(0), *columns, *[*table.schema][2:]]
    made = described(pa.schema(fields, table.schema.metadata).empty_table(), "design", design)
    return pa.Table.from_pylist([], made.schema)


HOSTILE_TABLES: dict[str, Callable[[pa.Table], pa.Table]] = {
    "without outcomes": lambda table: table.drop(["outcome"]),
    "without runs": lambda table: table.drop(["run"]),
    "runs beyond the design": lambda table: changed(table, "run", pa.array([0, 10**9])),
    "runs before the first": lambda table: changed(table, "run", pa.array([0, -1])),
    "a run twice": lambda table: changed(table, "run", pa.array([1, 1])),
    "text for numbers": lambda table: changed(table, "settling_time", pa.array(["a", "b"])),
    "not finite": lambda table: changed(table, "Kp", pa.array([1.0, np.inf])),
    "numbers whose difference overflows": lambda table: changed(table, "overshoot", pa.array([1e308, -1e308])),
    "no design": lambda table: described(table, "design", []),
    "no FMU": lambda table: described(table, "fmu", {}),
    "a long number": lambda table: described(table, "options", {"stop_time": 10**400, "step": 1, "settings": {}}),
    "values that are not in the grid": lambda table: changed(table, "Kp", pa.array([1.0, 1.5])),
    "many varied variables": lambda table: varying(table, 301),
    "many settings": lambda table: described(
        table, "options", {"stop_time": 1, "step": 1, "settings": dict.fromkeys(map(str, range(10_001)), 1)}
    ),
    "a long provenance": lambda table: described(table, "command_line", "a" * 2**25),
    "no word about bags": lambda table: described(table, "bags", None),
    "a long name": lambda table: described(table, "fmu", {"file": "a" * 1001, "name": "", "guid": ""}),
    "a long version": lambda table: described(table, "versions", {"twodof": "9" * 1001}),
    "a long name of a variable": lambda table: varying(table, 1, "v" * 1001),
    "an outcome of its own": lambda table: changed(table, "outcome", pa.array(["finished", "x" * 1000])),
    "an outcome that is not UTF-8": lambda table: changed(table, "outcome", not_utf8()),
    "a message that is not UTF-8": lambda table: changed(table, "message", not_utf8()),
    "endless": endless,
    "one text for all": of_one_text,
    "one number for all": of_equal_numbers,
}


READING = pa.proxy_memory_pool(pa.default_memory_pool())  # which outlives what lies in it


@pytest.fixture(scope="module")
def sound(native_path, tmp_path_factory):
    path = tmp_path_factory.mktemp("sound") / "s"
    sweep(native_path, grid={"Kp": [1.0, 2.0]}, stop_time=0.02, output=path, workers=1)
    return path / "runs.parquet"


@pytest.mark.parametrize("make", HOSTILE_TABLES.values(), ids=HOSTILE_TABLES)
def test_hostile_table_gets_one_line_in_little_memory(sound, tmp_path, make):
    store(pq.read_table(sound), tmp_path / "runs.parquet")
    assert len(read_sweep(tmp_path)) == 2
    store(make(pq.read_table(sound)), tmp_path / "runs.parquet")
    refusal = r"runs\.parquet' (was not written|has more than 300|has a name)|it is damaged|Invalid UTF8"
    usual = pa.default_memory_pool()
    pa.set_memory_pool(READING)
    try:
        with pytest.raises(TwoDofError, match=refusal):
            read_sweep(tmp_path)
    finally:
        pa.set_memory_pool(usual)
    assert READING.max_memory() < 64 * 1024**2


def footer(schema: bytes, elements: int, groups: int, columns: int) -> bytes:
    """A Parquet file of a schema, and of groups of columns without any fact, by Thrift's compact protocol."""

    def number(value: int) -> bytes:
        head = b""
        while value > 127:
            head, value = head + bytes([value & 127 | 128]), value >> 7
        return head + bytes([value])

    root = b"\x48\x01r\x15" + number(2 * elements) + b"\0"
    group = b"\x19\xfc" + number(columns) + b"\x26\0\0" * columns + b"\x16\0\x16\0\0"
    content = b"\x15\x02\x19\xfc" + number(elements + 1) + root + schema * elements
    content += b"\x16\0\x19\xfc" + number(groups) + group * groups + b"\0"
    return b"PAR1" + content + struct.pack("<I", len(content)) + b"PAR1"


COLUMN = b"\x15\0\x25\x02\x18\x01a\0"
FOOTERS = {"columns": (900_000, 1, 1), "columns of groups": (1, 4, 900_000), "groups": (1, 4_000_000, 0)}


@pytest.mark.parametrize("shape", FOOTERS.values(), ids=FOOTERS)
def test_the_footer_of_a_table_takes_little_memory(shape, tmp_path):
    """Each of these files has some megabytes; Arrow takes gigabytes, or aborts."""
    (tmp_path / "runs.parquet").write_bytes(footer(COLUMN, *shape))
    program = (
        f"import re, twodof\ntry: twodof.read_sweep({str(tmp_path)!r})\n"
        "except twodof.TwoDofError as error: print(error)\n"
        "print(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])"
    )
    done = python("-c", program)
    assert done.returncode == 0, done.stderr
    refusal, peak = done.stdout.splitlines()
    assert "cannot read" in refusal and int(peak) < 400_000  # KiB


def links(folder: Path, victims: Path) -> dict[str, tuple[Path, Path]]:
    """Links in a sweep's folder, by their kind, and the files outside of it that they name."""
    return {
        "the whole table": (folder / "runs.parquet", victims / "new.parquet"),
        "the next part": (folder / "part-000001.parquet", victims / "file"),
        "the bags": (folder / "bags", victims),
        "a bag": (folder / "bags/000001", victims / "bag"),
    }


@pytest.mark.parametrize("kind", links(Path(), Path()))
def test_links_in_a_sweep_are_not_followed(native_path, sound, tmp_path, kind):
    folder, victims = tmp_path / "s", tmp_path / "victims"
    (folder / "bags").mkdir(parents=True)
    (victims / "bag").mkdir(parents=True)
    (victims / "file").write_text("precious")
    store(described(pq.read_table(sound).slice(0, 1), "bags", True), folder / "part-000000.parquet")
    link, victim = links(folder, victims)[kind]
    if link == folder / "bags":
        link.rmdir()
    link.symlink_to(victim)
    with pytest.raises(TwoDofError, match="is a link, and links in a sweep are not followed"):
        sweep(native_path, grid={"Kp": [1.0, 2.0]}, stop_time=0.02, output=folder, resume=True, bags=True, workers=1)
    assert (victims / "file").read_text() == "precious" and {p.name for p in victims.iterdir()} == {"bag", "file"}
    assert not [*(victims / "bag").iterdir()]


def test_a_sweep_with_the_last_part_of_six_digits_is_resumed(native_path, sound, tmp_path):
    store(pq.read_table(sound).slice(0, 1), tmp_path / "part-999999.parquet")
    table = sweep(native_path, grid={"Kp": [1.0, 2.0]}, stop_time=0.02, output=tmp_path, resume=True, workers=1)
    assert len(table) == 2 and [file.name for file in tmp_path.iterdir()] == ["runs.parquet"]


def test_a_run_in_two_parts_is_refused_before_the_other_runs(native_path, sound, tmp_path):
    for part in ("part-000000.parquet", "part-000001.parquet"):
        store(pq.read_table(sound).slice(0, 1), tmp_path / part)
    with pytest.raises(TwoDofError, match=r"part-000001\.parquet': it is damaged"):
        sweep(native_path, grid={"Kp": [1.0, 2.0]}, stop_time=0.02, output=tmp_path, resume=True, workers=1)
    assert len([*tmp_path.iterdir()]) == 2


def test_the_provenances_of_all_parts_are_limited(sound, tmp_path, monkeypatch):
    table = described(pq.read_table(sound), "command_line", "x" * 100_000)
    for i in range(10):
        store(table.slice(0, 2 * (i == 0)), tmp_path / f"part-{i:06d}.parquet")
    monkeypatch.setattr("twodof.sweeps.stored_table.MAX_SWEEP", 1_020_000)
    assert len(read_sweep(tmp_path)) == 2
    monkeypatch.setattr("twodof.sweeps.stored_table.MAX_SWEEP", 980_000)
    with pytest.raises(TwoDofError, match=r"part-000009\.parquet': it is damaged"):
        read_sweep(tmp_path)


@pytest.mark.parametrize("picture", ["x.html", "x.png"])
def test_half_characters_in_a_provenance_are_replaced(sound, tmp_path, picture, capsys):
    half = {"file": "\ud800.fmu", "name": "\udfff", "guid": ""}
    store(described(pq.read_table(sound), "fmu", half), tmp_path / "runs.parquet")
    assert main(["plot", str(tmp_path), "-o", str(tmp_path / picture)]) == 0
    assert main(["info", str(tmp_path)]) == 0
    assert "?.fmu (?, )" in capsys.readouterr().out


def zigzag(number: int) -> bytes:
    """An integer of Thrift's compact protocol."""
    number, parts = 2 * number, []
    while number > 127:
        parts.append(number & 127 | 128)
        number >>= 7
    return bytes([*parts, number])


def test_a_page_that_is_larger_than_stated_is_not_read(sound, tmp_path):
    """The text of 200 MB takes 6 kB; the sizes at the end of the file state 100 bytes."""
    table, file = pq.read_table(sound).slice(0, 1), tmp_path / "runs.parquet"
    k = table.column_names.index("message")
    table = table.set_column(k, table.field(k), pa.array(["a" * 200_000_000]))
    pq.write_table(table, file, compression="zstd", use_dictionary=False, write_statistics=False)
    group = pq.ParquetFile(file).metadata.row_group(0)
    content = file.read_bytes()
    length = int.from_bytes(content[-8:-4], "little")
    body, foot = content[: -8 - length], content[-8 - length :]
    for size in {group.column(k).total_uncompressed_size, group.total_byte_size}:
        known = zigzag(size)
        assert known in foot
        small = bytearray(zigzag(100))
        while len(small) < len(known):
            small[-1] |= 128
            small.append(0)
        foot = foot.replace(known, small)
    file.write_bytes(body + foot)
    code = """
import resource, sys
import pyarrow as pa
from twodof.errors import SweepError
from twodof.sweeps import results, stored_table
stored_table.MAX_SWEEP = 10_000_000
before = resource.getrlimit(resource.RLIMIT_AS)
try:
    results.read_sweep(sys.argv[1])
except SweepError as error:
    print(str(error).endswith("it is damaged"), pa.default_memory_pool().max_memory() < 100_000_000)
print(resource.getrlimit(resource.RLIMIT_AS) == before)
"""
    own = {**os.environ, "ARROW_DEFAULT_MEMORY_POOL": "system"}  # an allocator of its own may have 1 GiB in reserve
    done = python("-c", code, str(tmp_path), check=True, env=own)
    assert done.stdout.split() == ["True"] * 3


@pytest.mark.long
def test_memory_of_the_coordinator_is_flat(native_path, tmp_path, length):
    """It is measured after pyarrow has written its first rows, for which it takes some 15 MiB."""
    code = """
import sys, twodof
from pathlib import Path
from sinks import resident
def look(done, runs):
    seen.append((len(list(Path(output).glob("part-*"))), done, resident() / 2**20))
if __name__ == "__main__":
    fmu, output, runs = sys.argv[1], sys.argv[2], int(sys.argv[3])
    seen = []
    twodof.sweep(fmu, ranges={"Kp": (10, 90)}, random=runs, stop_time=0.5, output=output,
                 workers=1, progress=look)
    late = [row for row in seen if row[0] >= 2]
    halves = late[: len(late) // 2], late[len(late) // 2 :]
    before, after = (max(row[2] for row in half) for half in halves)
    print(late[0][1], after - before, seen[-1][2] - seen[1][2])
"""
    runs = length(10_000, 5_000)
    here = Path(__file__).parent
    done = python("-c", code, native_path, tmp_path / "s", str(runs), cwd=here, check=True, timeout=500)
    first, growth, all_growth = map(float, done.stdout.split())
    print(f"coordinator: {growth:.1f} MiB from run {first:.0f} to {runs}; {all_growth:.1f} in all")
    assert first < 0.9 * runs
    assert growth < 6.0  # between the peaks of both halves: memory goes up and down by 8
