"""Malicious bags: read or refused in bounded time and memory.

MCAP files are made record by record by the specification. test_records.py tests refusals of contents.
"""

import json
import shutil
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from zlib import crc32

import lz4.frame
import mutations
import numpy as np
import pytest
import zstandard
from bags import (
    CHANNEL,
    FOOTER,
    HEADER,
    SCHEMA,
    SECOND,
    channel,
    chunk,
    joint_message,
    message,
    record,
    sample,
    serialised,
    texts,
)
from jail import MIB, SPECIAL, check_reading, without_slow
from jail import jail as jail
from jail import the_jail as the_jail

import twodof

pytestmark = pytest.mark.long


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    without_slow(metafunc, {"hostile_bag": HOSTILE_BAGS}, SLOW)


@pytest.fixture(scope="module")
def bags(tmp_path_factory, native_path):
    """A folder with a good bag in each storage."""
    folder = tmp_path_factory.mktemp("bags")
    run = twodof.experiment(native_path)
    for storage in ("mcap", "sqlite3"):
        with twodof.Bag(folder / storage / "bag", storage=storage).begin(run) as bag:
            for k in range(30):
                bag.write(sample(run, k))
    return folder


def mcap_of(*records: bytes) -> bytes:
    """An MCAP file without an index."""
    return HEADER + b"".join(records) + FOOTER


def zipped(content: bytes, times: int = 1) -> bytes:
    """The same bytes repeated, compressed in one piece."""
    packer = zstandard.ZstdCompressor().compressobj()
    return b"".join([*(packer.compress(content) for _ in range(times)), packer.flush()])


def with_mcap(make: Callable[[], bytes]) -> Callable[[Path], None]:
    def change(bag: Path) -> None:
        (file,) = bag.glob("*.mcap")
        file.write_bytes(make())

    return change


def with_sql(script: str) -> Callable[[Path], None]:
    """The database after some SQL, instead of the MCAP file."""

    def change(bag: Path) -> None:
        (file,) = bag.glob("*.mcap")
        file.unlink()
        data = (bag.parents[1] / "input/good.db3").read_bytes()
        (bag / "bag.db3").write_bytes(mutations.sqlite_after(data, script))

    return change


def instead(name: str, make: Callable[[Path], object]) -> Callable[[Path], None]:
    def change(bag: Path) -> None:
        file = next(bag.glob(name))
        file.unlink()
        make(file)

    return change


def written(content: Callable[[], bytes]) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content())


def many_files(bag: Path) -> None:
    for i in range(5000):
        (bag / f"x_{i}.mcap").write_bytes(b"")


def circle(bag: Path) -> None:
    """Rows for several levels of pages, whose child pages then are all the same full page."""
    with_sql(f"{ENDLESS} INSERT INTO messages SELECT i + 99, 1, i, zeroblob(300) FROM r LIMIT 200000")(bag)
    file = bag / "bag.db3"
    pages = bytearray(file.read_bytes())
    interior = [start for start in range(4096, len(pages), 4096) if pages[start] == 5]
    assert len(interior) > 2
    for start in interior:
        (cells,) = struct.unpack_from(">H", pages, start + 3)
        (last,) = struct.unpack_from(">I", pages, start + 8)
        for i in range(cells):
            (cell,) = struct.unpack_from(">H", pages, start + 12 + 2 * i)
            struct.pack_into(">I", pages, start + cell, last)
    file.write_bytes(pages)


def indexed(index: bytes) -> bytes:
    """An MCAP file of one message, whose summary has an index of chunks; its checksum is right."""
    content = SCHEMA + CHANNEL + message(nothing(1, 1))
    body = HEADER + chunk(content, len(content), "")
    summary = SCHEMA + CHANNEL + index + record(11, struct.pack("<QHIIIIQQI", 1, 1, 1, 0, 0, 100_000, 0, 0, 10), PAIR)
    foot = struct.pack("<BQQQ", 2, 20, len(body), 0)
    return body + summary + foot + struct.pack("<I", crc32(foot, crc32(summary))) + b"\x89MCAP0\r\n"


def with_empty_chunks(count: int) -> bytes:
    """An MCAP file of one message and of empty chunks, which all 999 channels of one topic could be in."""
    content = SCHEMA + CHANNEL + message(nothing(1, 1))
    used, index = chunk(content, len(content), ""), record(7, struct.pack("<HIQQ", 1, 16, 0, 0))
    offset = len(HEADER) + len(used)
    body = HEADER + used + index + bytes(49 * count)
    indexes = record(8, struct.pack("<QQQQIHQQ", 0, 0, len(HEADER), len(used), 10, 1, offset, len(index)))
    empty = (struct.pack("<QQQQIQ", 0, 0, offset + len(index) + 49 * i, 49, 0, 0) for i in range(count))
    same = [channel(i, "/joint_states") for i in range(1, 1000)]
    total = record(11, struct.pack("<QHIIIIQQI", 1, 1, 1, 0, 0, count + 1, 0, 0, 10), PAIR)
    summary = b"".join([SCHEMA, *same, indexes, *(record(8, fields) for fields in empty), total])
    foot = struct.pack("<BQQQ", 2, 20, len(body), 0)
    return body + summary + foot + struct.pack("<I", crc32(foot, crc32(summary))) + b"\x89MCAP0\r\n"


def steered(samples: int, joints: int, changes: int, starts: int) -> Callable[[Path], None]:
    """A bag with many changes of one input."""

    def change(bag: Path) -> None:
        names = [f"j{i}" for i in range(joints)]
        data = serialised(joint_message(0, names, np.zeros(joints)))
        states = (message(data, 10 * SECOND * k) for k in range(samples))
        with_mcap(lambda: mcap_of(SCHEMA, CHANNEL, *states))(bag)
        targets = {f"q_des[{i + 1}]": 0.0 for i in range(joints)}
        known = {"start_values": {**targets, **{f"s{i}": 0.0 for i in range(starts)}}, "joints": names, "urdf": None}
        given = {"input_changes": [[k, {"a": k}] for k in range(changes)], "start_time": 0.0, "step": 1.0, "axes": ""}
        file = bag / "run.json"
        file.write_text(json.dumps({**json.loads(file.read_text()), **known, **given}))

    return change


def forged_log(bag: Path) -> None:
    """A write-ahead log of 33 kB that states 3 million pages, and four texts of a gigabyte in a chain of one page."""
    size, page, texts = 990_000_000, 4096, 4
    next(bag.glob("*.mcap")).unlink()
    file = bag / "bag.db3"
    with closing(sqlite3.connect(file)) as database:
        for pragma in ("page_size = 4096", "journal_mode = WAL", "wal_autocheckpoint = 0"):
            database.execute(f"PRAGMA {pragma}")
        for table in ("topics(id INTEGER PRIMARY KEY, name, type, serialization_format, offered_qos_profiles)", "z(a)"):
            database.execute(f"CREATE TABLE {table}")
        database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        database.execute("INSERT INTO topics VALUES (1, 'a', 'b', 'c', 'd')")
        database.execute("INSERT INTO z VALUES (1)")
        database.commit()
        roots = dict(database.execute("SELECT name, rootpage FROM sqlite_master"))
        log = bytearray(Path(f"{file}-wal").read_bytes())
        plain = file.read_bytes()
    head = b"".join(map(varint, [0, *[13 + 2 * size] * texts]))
    head = varint(len(head) + 1) + head
    payload, least = len(head) + size * texts, (page - 12) * 32 // 255 - 23
    local = least + (payload - least) % (page - 4)
    local = local if local <= page - 35 else least
    chain = struct.pack(">I", roots["z"])
    cell = varint(payload) + varint(1) + head + b"a" * (local - len(head)) + chain
    leaf = struct.pack(">BHHHBH", 13, 0, 1, page - len(cell), 0, page - len(cell))
    sums = struct.unpack_from(">II", log, 24)
    for start in range(32, len(log), page + 24):
        number, commit = struct.unpack_from(">II", log, start)
        if number == roots["topics"]:
            log[start + 24 : start + 24 + page] = leaf.ljust(page - len(cell), b"\0") + cell
        elif number == roots["z"]:
            log[start + 24 : start + 24 + page] = chain.ljust(page, b"a")
        elif number == 1:
            struct.pack_into(">I", log, start + 24 + 28, 3_000_000)
        if commit:
            struct.pack_into(">I", log, start + 4, 3_000_000)
        for part in (log[start : start + 8], log[start + 24 : start + 24 + page]):
            for pair in struct.iter_unpack("<II" if log[3] == 0x82 else ">II", part):
                first = (sums[0] + pair[0] + sums[1]) % 2**32
                sums = first, (sums[1] + pair[1] + first) % 2**32
        struct.pack_into(">II", log, start + 16, *sums)
    file.write_bytes(plain)
    Path(f"{file}-wal").write_bytes(log)


def varint(number: int) -> bytes:
    """An integer of SQLite, with seven bits in each byte."""
    parts = [number >> shift & 127 for shift in range(0, max(7, number.bit_length()), 7)]
    return bytes([*(part | 128 for part in parts[:0:-1]), parts[0]])


def lz4_zeros(size: int) -> bytes:
    packer = lz4.frame.LZ4FrameCompressor()
    parts = [packer.begin(), *(packer.compress(bytes(MIB)) for _ in range(size // MIB))]
    return b"".join([*parts, packer.flush()])


def nothing(positions: int, names: int) -> bytes:
    """A joint state that compresses to almost nothing."""
    return serialised(joint_message(0, ["a"] * names, np.zeros(positions)))


def framed(frame: str) -> bytes:
    return message(serialised(joint_message(0, ["a"], [0.0], frame=frame)))


def interrupted(first: bytes, second: bytes, times: int) -> bytes:
    """An MCAP file of pairs of records in one chunk, and of 3 MB that permits it to unpack to three gigabytes."""
    size = times * len(first + second)
    ballast = record(0x90, np.random.default_rng(1).bytes(3 * MIB))
    return mcap_of(ballast, SCHEMA, CHANNEL, chunk(zipped(first + second, times), size, "zstd"))


def channels(qos: str = "") -> list[bytes]:
    """Almost the largest number of channels, each with its own profile."""
    return [channel(i, f"/t{i}", f"{qos}{i}" if qos else "") for i in range(1, 1000)]


def hollow(size: int, content: bytes) -> Callable[[Path], None]:
    """A file of a given size that unpacks to equal chunks of 32 MiB, at least one."""

    def make() -> bytes:
        chunks = content * (32 * MIB // len(content))
        packed = chunk(zipped(chunks), len(chunks), "zstd")
        return mcap_of(SCHEMA, *(channel(i, f"/t{i}") for i in range(1, 1000)), *[packed] * (size // len(packed)))

    return with_mcap(make)


INDEX, PAIR = struct.pack("<QQQQ", 0, 1, 8, 100), struct.pack("<HQ", 1, 1)
FIELDS = "\n".join(f"float64 a{i}" for i in range(3000))
ENDLESS = "WITH RECURSIVE r(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM r)"
HOSTILE_BAGS: dict[str, Callable[[Path], None]] = {
    **{
        f"{what} instead of {name}": instead(name, SPECIAL[what][0])
        for name in ("*.mcap", "metadata.yaml", "run.json")
        for what in ("a pipe", "3 GB of zeros")
    },
    "5000 files": many_files,
    "10 GB in a chunk of 1 kB": with_mcap(lambda: mcap_of(chunk(zipped(bytes(MIB), 10_000), 1000, "zstd"))),
    "250 MB of zeros in a chunk": with_mcap(lambda: mcap_of(chunk(zipped(bytes(MIB), 250), 250 * MIB, "zstd"))),
    "250 MB of messages in a chunk": with_mcap(
        lambda: mcap_of(SCHEMA, CHANNEL, chunk(zipped(message(bytes(44)) * 1000, 3500), 75 * 3_500_000, "zstd"))
    ),
    "2.5 GB in a chunk of lz4": with_mcap(lambda: mcap_of(chunk(lz4_zeros(2500 * MIB), 1000, "lz4"))),
    "100 kB of joint states of nothing": hollow(100_000, message(nothing(0, 0))),
    "32 MB of joint states of 40,000 joints": hollow(0, message(nothing(40_000, 0))),
    "32 MB of joint states of 80,000 names": hollow(0, message(nothing(0, 80_000))),
    "100 kB of topics of 1 MB": hollow(100_000, channel(1, "/t1", " " * MIB)),
    "a thousand topics with profiles of their own": with_mcap(
        lambda: mcap_of(
            SCHEMA,
            *channels("- {depth: [" + "1," * 200 + "]}#"),
            *(message(bytes(4), number=i) for i in range(1, 1000)),
        )
    ),
    "4 MB of types": with_mcap(
        lambda: mcap_of(
            SCHEMA,
            *(record(3, struct.pack("<H", i), texts(f"a/msg/B{i}", "ros2msg", FIELDS)) for i in range(2, 100)),
            *(record(4, struct.pack("<HH", i, i), texts(f"/t{i}", "cdr"), bytes(4)) for i in range(2, 100)),
            *(message(bytes(4), number=i) for i in range(2, 100)),
        )
    ),
    "a message of 700 MB": with_mcap(lambda: mcap_of(SCHEMA, CHANNEL, message(bytes(700 * MIB)))),
    "100,000 entries in an index": with_mcap(
        lambda: indexed(record(8, INDEX, struct.pack("<IHQ", 10, 1, 0)) * 100_000)
    ),
    "a schema before each of 100,000 messages": with_mcap(lambda: interrupted(SCHEMA, message(nothing(1, 1)), 100_000)),
    "joint states in two frames in turn": with_mcap(lambda: interrupted(framed("a"), framed("b"), 700_000)),
    "5 MB of entries that share their bytes": with_mcap(
        lambda: indexed(record(8, INDEX, struct.pack("<IHQ", 4_000_000, 1, 0)) * 100_000)
    ),
    "300,000 chunks without messages": with_mcap(lambda: with_empty_chunks(300_000)),
    "texts of a gigabyte in a log": forged_log,
    "60 MB of small records": with_mcap(lambda: mcap_of(record(8) * (7 * MIB))),
    "no topic in CDR": with_sql("UPDATE topics SET serialization_format = 'json'; DELETE FROM messages WHERE id = 3"),
    "stamps before 1970": with_sql("UPDATE messages SET timestamp = -1; DELETE FROM messages WHERE id = 3"),
    "pages in a circle": circle,
    "100,000 topics": with_sql(
        f"{ENDLESS} INSERT INTO topics SELECT i + 9, 't' || i, 'x', 'cdr', '', '' FROM r LIMIT 100000"
    ),
    "a message of 300 MB in a database": with_sql("UPDATE messages SET data = zeroblob(300000000) WHERE id = 1"),
    "16 messages of 50 MB in a database": with_sql("UPDATE messages SET data = zeroblob(50000000) WHERE id < 17"),
    "laughing metadata": instead(
        "metadata.yaml",
        written(
            lambda: (
                "l0: &l0 [x]\n"
                + "".join(f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]\n" for i in range(1, 9))
                + "rosbag2_bagfile_information: {compression_format: *l8}"
            ).encode()
        ),
    ),
    "60 MB of metadata": instead("metadata.yaml", written(lambda: b"[" * (60 * MIB))),
    "30 MB of provenance": instead(
        "run.json", written(lambda: b'{"format":1,"fmu":{},"x":[' + b'{"a":10},' * (3 * MIB) + b"0]}")
    ),
    "100,000 changes of an input of 300 joints": steered(3, 300, 100_000, 0),
    "5,000 changes with 5,000 start values": steered(1200, 1, 5000, 5000),
    "60 MB of provenance": instead("run.json", written(lambda: b'{"format":1,"fmu":[' + b"{}," * (20 * MIB) + b"0]}")),
}


def test_hostile_bag(hostile_bag, jail, bags):
    bag = jail.target / "bag"
    shutil.copytree(bags / "mcap/bag", bag)
    shutil.copyfile(bags / "sqlite3/bag/bag.db3", jail.input / "good.db3")
    hostile_bag(bag)
    check_reading(jail, bag)


SLOW = {
    "5000 files",
    "pages in a circle",
    "10 GB in a chunk of 1 kB",
    "2.5 GB in a chunk of lz4",
    "250 MB of zeros in a chunk",
    "250 MB of messages in a chunk",
    "a message of 700 MB",
    "a message of 300 MB in a database",
    "60 MB of small records",
    "60 MB of metadata",
    "30 MB of provenance",
    "60 MB of provenance",
    "a thousand topics with profiles of their own",
    "4 MB of types",
}
