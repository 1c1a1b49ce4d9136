"""Files that mean harm: read or refused in one line, with bounded processor time and memory.

MCAP files are made record by record after the specification, with the mcap project's own writer
where it can write them.
"""

from __future__ import annotations

import os
import sqlite3
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from bags import both_storages, sample

import twodof

MAGIC = b"\x89MCAP0\r\n"
JOINT_STATE = "sensor_msgs/msg/JointState"


def text(content: str | bytes) -> bytes:
    raw = content.encode() if isinstance(content, str) else content
    return struct.pack("<I", len(raw)) + raw


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def chunk(records: bytes, size: int, compression: str) -> bytes:
    head = struct.pack("<QQQI", 0, 1, size, 0) + text(compression)
    return record(6, head + struct.pack("<Q", len(records)) + records)


HEADER = MAGIC + record(1, text("ros2") + text(""))
FOOTER = record(2, bytes(20)) + MAGIC
SCHEMA = record(3, struct.pack("<H", 1) + text(JOINT_STATE) + text("ros2msg") + text(""))
CHANNEL = record(4, struct.pack("<HH", 1, 1) + text("/joint_states") + text("cdr") + text(b""))


def channel(number: int, qos: str = "") -> bytes:
    metadata = text("offered_qos_profiles") + text(qos)
    return record(
        4,
        struct.pack("<HH", number % 65536, 1) + text(f"/t{number}") + text("cdr") + text(metadata),
    )


def zstd_bomb() -> bytes:
    """A few hundred KB that are 2.5 GB when unpacked."""
    packer = zstandard.ZstdCompressor(level=1).compressobj()
    parts = [packer.compress(bytes(64 * 1024**2)) for _ in range(40)]
    return b"".join([*parts, packer.flush()])


def lz4_bomb() -> bytes:
    packer = lz4.frame.LZ4FrameCompressor()
    parts = [packer.begin()] + [packer.compress(bytes(64 * 1024**2)) for _ in range(40)]
    return b"".join([*parts, packer.flush()])


MCAPS: dict[str, Callable[[], bytes]] = {
    "empty": lambda: b"",
    "no MCAP": lambda: b"PK\x03\x04" + bytes(1000),
    "magic alone": lambda: MAGIC,
    "no end": lambda: HEADER,
    "record longer than the file": lambda: HEADER + struct.pack("<BQ", 4, 2**63) + FOOTER,
    "record of a size that overflows": lambda: HEADER + struct.pack("<BQ", 9, 2**64 - 1) + FOOTER,
    "chunk that says it is huge": lambda: HEADER + chunk(b"", 2**62, "") + FOOTER,
    "chunk that says it is huge, packed": lambda: HEADER + chunk(b"x", 2**62, "zstd") + FOOTER,
    "zstd bomb": lambda: HEADER + chunk(zstd_bomb(), 1000, "zstd") + FOOTER,
    "zstd bomb that says so": lambda: (
        HEADER + chunk(zstd_bomb(), 40 * 64 * 1024**2, "zstd") + FOOTER
    ),
    "lz4 bomb": lambda: HEADER + chunk(lz4_bomb(), 1000, "lz4") + FOOTER,
    "unknown compression": lambda: HEADER + chunk(b"x", 1, "rot13") + FOOTER,
    "text longer than its record": lambda: (
        HEADER + record(3, struct.pack("<HI", 1, 2**31) + b"x") + FOOTER
    ),
    "text that is no UTF-8": lambda: HEADER + record(3, struct.pack("<H", 1) + text(b"\xff")),
    "message of an unknown channel": lambda: HEADER + record(5, bytes(22)) + FOOTER,
    "message shorter than its head": lambda: (
        HEADER + SCHEMA + CHANNEL + chunk(record(5, b"\x01"), 10, "") + FOOTER
    ),
    "channel of an unknown schema": lambda: HEADER + CHANNEL + FOOTER,
    "chunk in a chunk": lambda: HEADER + chunk(chunk(CHANNEL, 1, ""), 1, "") + FOOTER,
    "a million topics": lambda: HEADER + SCHEMA + b"".join(map(channel, range(1_000_000))) + FOOTER,
    "joint state that is none": lambda: (
        HEADER + SCHEMA + CHANNEL + record(5, struct.pack("<HIQQ", 1, 0, 1, 1) + b"junk") + FOOTER
    ),
    "joint state with names without end": lambda: (
        HEADER
        + SCHEMA
        + CHANNEL
        + record(5, struct.pack("<HIQQ", 1, 0, 1, 1) + bytes(20) + b"\xff" * 40)
        + FOOTER
    ),
}

COMMAND = """
import resource, sys
import twodof
from twodof.cli.main import main
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
import twodof.bag
status = main(sys.argv[1:])
used = resource.getrusage(resource.RUSAGE_SELF)
print(used.ru_maxrss - before, used.ru_utime + used.ru_stime, file=sys.stderr)
raise SystemExit(status)
"""


def refused(verb: str, bag: Path, folder: Path) -> str:
    """What the command says: one line, for ten seconds and half a gigabyte, leaving nothing."""
    before = sorted(folder.rglob("*"))
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, verb, str(bag)], capture_output=True, text=True, timeout=300
    )
    *lines, used = done.stderr.splitlines()
    assert done.returncode == 1, (done.stdout, lines)
    (line,) = lines
    assert line.startswith("twodof: error:")
    memory, processor = used.split()
    assert int(memory) < 1024**2 // 2  # KiB
    assert float(processor) < 10.0  # s
    assert sorted(folder.rglob("*")) == before
    return line


@pytest.mark.parametrize("make", MCAPS.values(), ids=MCAPS)
def test_hostile_mcap_is_refused(tmp_path: Path, make: Callable[[], bytes]) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  message_count: 1\n")
    (bag / "bag.mcap").write_bytes(make())
    assert str(bag) in refused("info", bag, tmp_path)


def database(path: Path, *statements: str) -> Path:
    """A bag whose database is what rosbag2 writes, changed by some statements."""
    run = path.parent
    with sqlite3.connect(path) as connection:
        connection.executescript(
            "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT,"
            " serialization_format TEXT, offered_qos_profiles TEXT);"
            "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
            " data BLOB);"
            f"INSERT INTO topics VALUES (1, '/joint_states', '{JOINT_STATE}', 'cdr', '');"
        )
        for statement in statements:
            connection.executescript(statement)
    (run / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  message_count: 1\n")
    return run


COUNT = "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c WHERE n < 1000000)"
DATABASES = {
    "a million topics": (f"{COUNT} INSERT INTO topics SELECT n + 1, n, 'x', 'cdr', '' FROM c",),
    "a view that never ends": (
        "DROP TABLE messages;"
        "CREATE VIEW messages AS WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c)"
        " SELECT n AS id, 1 AS topic_id, n AS timestamp, zeroblob(1000) AS data FROM c",
    ),
    "a column that computes a gigabyte": (
        "DROP TABLE messages;"
        "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
        " data BLOB AS (zeroblob(1000000000)));"
        f"{COUNT} INSERT INTO messages (topic_id, timestamp) SELECT 1, n FROM c WHERE n < 1000",
    ),
    "a topic that computes": (
        "DROP TABLE topics;"
        "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT,"
        " serialization_format TEXT AS (hex(zeroblob(400000000))));"
        "INSERT INTO topics (name, type) VALUES ('/joint_states', 'x')",
    ),
    "a virtual table": (
        "DROP TABLE messages;"
        "CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)",
    ),
    "no messages": ("DROP TABLE messages",),
    "no topics": ("DROP TABLE topics",),
    "messages without data": (
        "DROP TABLE messages; CREATE TABLE messages (topic_id, timestamp);"
        "INSERT INTO messages VALUES (1, 1)",
    ),
    "a message that is a text": ("INSERT INTO messages VALUES (1, 1, 1, 'hello')",),
    "a message that is nothing": ("INSERT INTO messages VALUES (1, 1, 1, NULL)",),
    "a stamp that is a text": ("INSERT INTO messages VALUES (1, 1, 'now', x'00010000')",),
    "a message of an unknown topic": ("INSERT INTO messages VALUES (1, 7, 1, x'00010000')",),
    "a topic that is a number": ("UPDATE topics SET name = 7",),
    "a joint state that is none": ("INSERT INTO messages VALUES (1, 1, 1, x'0001000001')",),
}


@pytest.mark.parametrize("statements", DATABASES.values(), ids=DATABASES)
def test_hostile_database_is_refused(tmp_path: Path, statements: tuple[str, ...]) -> None:
    (tmp_path / "bag").mkdir()
    bag = database(tmp_path / "bag" / "bag.db3", *statements)
    assert str(bag) in refused("info", bag, tmp_path)


def test_database_whose_pages_go_in_a_circle_is_refused(tmp_path: Path) -> None:
    """An interior page whose children are all the same full page, level over level."""
    (tmp_path / "bag").mkdir()
    file = tmp_path / "bag" / "bag.db3"
    row = "zeroblob(300)"
    bag = database(file, f"{COUNT} INSERT INTO messages SELECT n, 1, n, {row} FROM c LIMIT 200000")
    pages = bytearray(file.read_bytes())
    size = struct.unpack_from(">H", pages, 16)[0]
    interior = [
        start for start in range(size, len(pages), size) if pages[start] == 5 and start + size
    ]
    assert len(interior) > 2
    for start in interior:
        (cells,) = struct.unpack_from(">H", pages, start + 3)
        (last,) = struct.unpack_from(">I", pages, start + 8)
        for i in range(cells):
            (cell,) = struct.unpack_from(">H", pages, start + 12 + 2 * i)
            struct.pack_into(">I", pages, start + cell, last)
    file.write_bytes(pages)
    refused("info", bag, tmp_path)


@pytest.mark.parametrize("name", ["bag.mcap", "bag.db3"])
@pytest.mark.parametrize("kind", ["pipe", "endless device", "folder", "link to nothing"])
@pytest.mark.parametrize("verb", ["info", "recover"])
def test_what_is_no_file_is_not_read(tmp_path: Path, name: str, kind: str, verb: str) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    if kind == "pipe":
        os.mkfifo(bag / name)
    elif kind == "folder":
        (bag / name).mkdir()
    else:
        (bag / name).symlink_to("/dev/zero" if kind == "endless device" else "nowhere")
    assert "has no .mcap or .db3 file" in refused(verb, bag, tmp_path)


PROVENANCES = {
    "deep": "[" * 100_000,
    "long number": '{"format": 1, "fmu": {}, "step": ' + "9" * 10_000 + "}",
    "pieces missing": '{"format": 1, "fmu": {}}',
    "other types": '{"format": 1, "fmu": {"name": [], "guid": 1, "file": {}}, "joints": 7}',
    "cut": '{"format": 1, "fmu": {"na',
    "no text": "\udcff",
}


@pytest.mark.parametrize("content", PROVENANCES.values(), ids=PROVENANCES)
def test_hostile_provenance_is_refused(fmu_path: Path, tmp_path: Path, content: str) -> None:
    bag = tmp_path / "bag"
    run = twodof.experiment(fmu_path)
    with twodof.Bag(bag).begin(run) as sink:
        sink.write(sample(run, 0))
    (bag / "run.json").write_bytes(content.encode("utf-8", "surrogateescape"))
    assert "run.json" in refused("info", bag, tmp_path)


def test_provenance_without_end_is_refused(fmu_path: Path, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    run = twodof.experiment(fmu_path)
    with twodof.Bag(bag).begin(run) as sink:
        sink.write(sample(run, 0))
    (bag / "run.json").unlink()
    with (bag / "run.json").open("wb") as file:
        file.truncate(10**12)
    assert "too large, 1000000000000 bytes" in refused("info", bag, tmp_path)


@both_storages
def test_recover_of_a_million_topics_takes_seconds_of_the_processor(
    tmp_path: Path, storage: str
) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    if storage == "mcap":
        qos = "- {depth: [" + "1," * 200 + "]}"
        topics = b"".join(channel(n, f"{qos}#{n}") for n in range(1, 1000))
        data = b"".join(
            record(5, struct.pack("<HIQQ", n, 0, 1, 1) + bytes(4)) for n in range(1, 1000)
        )
        (bag / "bag.mcap").write_bytes(HEADER + SCHEMA + topics + data)
    else:
        database(bag / "bag.db3", *DATABASES["a million topics"])
        (bag / "metadata.yaml").unlink()
    begin = time.process_time()
    done = twodof.recover(bag)
    assert time.process_time() - begin < 10.0
    assert len(done.counts) == (999 if storage == "mcap" else 0)
