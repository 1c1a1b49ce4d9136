"""Bags with malicious records: refused in one line, or read correctly.

MCAP files are made record by record by the specification. test_hostile_bags.py tests time and memory.
"""

import json
import sqlite3
import struct
import sys
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from bags import (
    CHANNEL,
    FOOTER,
    HEADER,
    MAGIC,
    PERIOD,
    SCHEMA,
    SECOND,
    START,
    channel,
    chunk,
    joint_message,
    message,
    read_ends,
    record,
    sample,
    serialised,
    texts,
)

import twodof
from twodof.bag import joint_states, reader, recording, sqlite
from twodof.bag.contents import read_messages
from twodof.bag.reader import read_bag
from twodof.bag.records import DamageError, ReadBudget
from twodof.cli.main import main
from twodof.errors import BagError
from twodof.simulation.setup import setup as setup_of

JOINT_STATE = "sensor_msgs/msg/JointState"
TOPIC = HEADER + SCHEMA + CHANNEL


MCAPS = {
    "empty": b"",
    "no MCAP": b"PK\x03\x04" + bytes(1000),
    "magic alone": MAGIC,
    "no end": HEADER,
    "record longer than the file": HEADER + struct.pack("<BQ", 4, 2**63) + FOOTER,
    "record of a size that overflows": HEADER + struct.pack("<BQ", 9, 2**64 - 1) + FOOTER,
    "chunk that says it is huge": HEADER + chunk(b"", 2**62, "") + FOOTER,
    "chunk that says it is huge, packed": HEADER + chunk(b"x", 2**62, "zstd") + FOOTER,
    "unknown compression": HEADER + chunk(b"x", 1, "rot13") + FOOTER,
    "text longer than its record": (HEADER + record(3, struct.pack("<HI", 1, 2**31), b"x") + FOOTER),
    "text that is no UTF-8": HEADER + record(3, struct.pack("<H", 1) + texts(b"\xff")),
    "message of an unknown channel": HEADER + message(b"") + FOOTER,
    "message shorter than its head": TOPIC + chunk(record(5, b"\x01"), 10, "") + FOOTER,
    "message of the year 2400": TOPIC + message(bytes(4), stamp=2**63 + 2**62) + FOOTER,
    "channel of two topics": TOPIC + channel(1, "/other") + message(bytes(4)) + FOOTER,
    "channel of an unknown schema": HEADER + CHANNEL + FOOTER,
    "chunk in a chunk": HEADER + chunk(chunk(CHANNEL, 1, ""), 1, "") + FOOTER,
    "joint state that is none": TOPIC + message(b"junk") + FOOTER,
    "joint state with names without end": TOPIC + message(bytes(20) + b"\xff" * 40) + FOOTER,
}


def refused(capsys: pytest.CaptureFixture[str], bag: Path) -> str:
    """Return the error of ``info``: one line that names the bag."""
    assert main(["info", str(bag)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("twodof: error:") and str(bag) in line
    return line


@pytest.fixture
def bag(tmp_path):
    """The folder of a bag without its messages."""
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  message_count: 1\n")
    return bag


@pytest.mark.parametrize("content", MCAPS.values(), ids=MCAPS)
def test_hostile_mcap_is_refused(bag, content, capsys):
    (bag / "bag.mcap").write_bytes(content)
    refused(capsys, bag)


def test_mcap_of_more_topics_than_are_read_is_refused(bag, capsys):
    topics = b"".join(channel(i, f"/t{i}") for i in range(2, 1002))
    (bag / "bag.mcap").write_bytes(TOPIC + topics + FOOTER)
    assert "has more than 1000 topics" in refused(capsys, bag)
    (bag / "bag.mcap").write_bytes(TOPIC + channel(2, "/t" * 10**6) + FOOTER)
    assert "has a topic with a name of more than 1000 characters" in refused(capsys, bag)


COUNT = "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c)"
TOPICS = "(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT"
MESSAGES = "(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
VIEW = f"CREATE VIEW messages AS {COUNT} SELECT n AS id, 1 AS topic_id, n AS timestamp, 1 AS data FROM c"
DATABASES = {
    "a view of messages": (
        "DROP TABLE messages;"
        f"CREATE VIEW messages AS {COUNT} SELECT n AS id, 1 AS topic_id, n AS timestamp,"
        " zeroblob(1000) AS data FROM c",
        "has views, triggers or virtual tables",
    ),
    "a topic with a long name": (
        "UPDATE topics SET name = '/' || hex(zeroblob(1000000))",
        "has a topic with a name of more than 1000 characters",
    ),
    "a view of topics": (
        "DROP TABLE topics;"
        f"CREATE VIEW topics AS {COUNT} SELECT max(n) AS id, 'a' AS name, 'b' AS type,"
        " 'cdr' AS serialization_format FROM c",
        "has views, triggers or virtual tables",
    ),
    "a virtual table": (
        "DROP TABLE messages;CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)",
        "has views, triggers or virtual tables",
    ),
    "two of one name, of which the first is a view": (
        "PRAGMA writable_schema = ON; DELETE FROM sqlite_master WHERE name = 'messages';"
        "INSERT INTO sqlite_master VALUES ('view', 'messages', 'messages', 0,"
        f" 'CREATE VIEW messages AS {COUNT} SELECT n AS id, 1 AS topic_id, n AS timestamp, x''00'' AS data FROM c');"
        "INSERT INTO sqlite_master VALUES ('table', 'messages', 'messages', 3, 'CREATE TABLE other (a)')",
        "has views, triggers or virtual tables",
    ),
    "a view whose statement is bytes": (
        "PRAGMA writable_schema = ON; UPDATE sqlite_master SET type = 'view', rootpage = 0, sql ="
        f" CAST('CREATE VIEW messages AS {COUNT} SELECT n AS id FROM c' AS BLOB) WHERE name = 'messages'",
        "has views, triggers or virtual tables",
    ),
    "a view behind an index of the schema with other rows": (
        "DROP TABLE messages; CREATE TABLE other (name, sql); CREATE INDEX others ON other (name, sql);"
        "INSERT INTO other VALUES ('topics', 'CREATE TABLE a (b)'), ('messages', 'CREATE TABLE a (b)');"
        "PRAGMA writable_schema = ON; UPDATE sqlite_master SET name = 'of_schema', tbl_name = 'sqlite_master',"
        " sql = 'CREATE INDEX of_schema ON sqlite_master (name, sql)' WHERE name = 'others';"
        f"INSERT INTO sqlite_master VALUES ('view', 'messages', 'messages', 0, '{VIEW}')",
        "has views, triggers or virtual tables",
    ),
    "messages that are computed": (
        "DROP TABLE messages;"
        f"CREATE TABLE messages {MESSAGES[:-1]} AS (zeroblob(1000000000)));"
        "INSERT INTO messages (topic_id, timestamp) VALUES (1, 1)",
        "is damaged",
    ),
    "topics that are computed": (
        "DROP TABLE topics;"
        f"CREATE TABLE topics {TOPICS} AS (hex(zeroblob(40000000))));"
        "INSERT INTO topics (name, type) VALUES ('/joint_states', 'x')",
        "is damaged",
    ),
    "messages behind what is computed and stored": (
        "DROP TABLE messages; CREATE TABLE messages (id INTEGER PRIMARY KEY,"
        " junk AS (id) STORED, topic_id INTEGER, timestamp INTEGER, data BLOB)",
        "has messages that are not those of ROS 2",
    ),
    "messages behind others": (
        "ALTER TABLE messages RENAME TO old; CREATE TABLE messages (id INTEGER PRIMARY KEY,"
        " junk BLOB, topic_id INTEGER, timestamp INTEGER, data BLOB)",
        "has messages that are not those of ROS 2",
    ),
    "messages with a thousand constraints, which SQLite compares with each other": (
        f"DROP TABLE messages; CREATE TABLE messages {MESSAGES[:-1]}{', UNIQUE(id)' * 1000})",
        "is damaged",
    ),
    "two hundred tables": ("".join(f"CREATE TABLE t{n} (id);" for n in range(200)), "interrupted"),
    "more topics than are read": (
        f"INSERT INTO topics {COUNT} SELECT n + 9, 't' || n, 'x', 'cdr', '' FROM c LIMIT 1000",
        "has more than 1000 topics",
    ),
    "no messages": ("DROP TABLE messages", "has no messages"),
    "no topics": ("DROP TABLE topics", "has no messages"),
    "messages without data": (
        "DROP TABLE messages; CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp);"
        "INSERT INTO messages VALUES (1, 1, 1)",
        "is damaged",
    ),
    "a message that is a text": ("INSERT INTO messages VALUES (1, 1, 1, 'hello')", "is damaged"),
    "a message that is nothing": ("INSERT INTO messages VALUES (1, 1, 1, NULL)", "is damaged"),
    "a stamp that is a text": ("INSERT INTO messages VALUES (1, 1, 'x', x'0001')", "is damaged"),
    "an unknown topic": ("INSERT INTO messages VALUES (1, 7, 1, x'00010000')", "is damaged"),
    "a topic that is a number": ("UPDATE topics SET name = x'07'", "is damaged"),
    "a joint state that is none": ("INSERT INTO messages VALUES (1, 1, 1, x'0001000001')", "a joint state is damaged"),
}
if sys.version_info < (3, 11):  # its sqlite3 cannot limit SQLite's parser
    del DATABASES["messages with a thousand constraints, which SQLite compares with each other"]


@pytest.mark.parametrize(("script", "reason"), DATABASES.values(), ids=DATABASES)
def test_hostile_database_is_refused(bag, script, reason, capsys):
    """It is a database of rosbag2, changed by some statements."""
    make_database(bag, script)
    assert reason in refused(capsys, bag)
    assert sorted(bag.parent.rglob("*")) == [bag, bag / "bag.db3", bag / "metadata.yaml"]


def test_a_view_that_is_found_late_is_not_read_without_end(bag, monkeypatch, capsys):
    """Each defence works without those before it; the view has no rows, and never ends."""
    make_database(bag, f"DROP TABLE messages; {VIEW} WHERE n < 0")
    assert "has views" in refused(capsys, bag)
    monkeypatch.setattr(sqlite, "PLAIN", ("CREATE ",))
    assert "not authorized" in refused(capsys, bag)
    monkeypatch.setattr(sqlite, "_authorize", lambda *_: sqlite3.SQLITE_OK)
    assert "interrupted" in refused(capsys, bag)


def make_database(bag: Path, script: str) -> None:
    with sqlite3.connect(bag / "bag.db3") as database:
        database.executescript(
            f"BEGIN; CREATE TABLE topics {TOPICS}, offered_qos_profiles TEXT);"
            f"CREATE TABLE messages {MESSAGES};"
            f"INSERT INTO topics VALUES (1, '/joint_states', '{JOINT_STATE}', 'cdr', '');"
            f"{script};COMMIT"
        )


# --- small files of much ---


def test_mcap_with_more_provenance_than_is_read_is_refused(tmp_path, capsys):
    """A single file has in its metadata the provenance that a folder has in run.json."""
    content = '{"format":1,"fmu":{}}' + " " * 32 * 1024**2
    entries = texts("run.json", content)
    file = tmp_path / "one.mcap"
    about = record(12, texts("twodof", entries))
    file.write_bytes(TOPIC + about + message(joint_state(2, START)) + FOOTER)
    assert main(["info", str(file)]) == 1
    assert "has metadata 'twodof' of 335" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("names", "sizes", "said"),
    [
        ("ab", (2, 0, 0), ""),
        ("ab", (2, 2, 2), ""),
        ("", (2, 2, 0), ""),
        ("ab", (1, 1, 0), "has 1 positions for 2 joints"),
        ("ab", (0, 2, 2), "has 0 positions for 2 joints"),
        ("", (0, 0, 0), "has 0 positions for 0 joints"),
        ("ab", (2, 1, 2), "has 1 and 2 velocities and efforts for 2 joints"),
        ("aa", (2, 0, 0), "has two joints 'a'"),
        (["a", "b" * 1001], (2, 0, 0), "has a joint with a name of more than 1000 characters"),
    ],
)
def test_joint_states_have_as_many_numbers_as_joints(bag, names, sizes, said, tmp_path, capsys):
    data = serialised(joint_message(START * SECOND, names, *map(np.zeros, sizes)))
    (bag / "bag.mcap").write_bytes(TOPIC + message(data) * 40 + FOOTER)
    for command in (["info", str(bag)], ["export", str(bag), "-o", str(tmp_path / "x.csv")]):
        assert main(command) == bool(said)
        assert said in capsys.readouterr().err
    if not said:
        assert read_bag(bag).joints == (tuple(names) or ("joint 1", "joint 2"))


def test_topics_that_appear_between_messages_end_no_batch(tmp_path):
    """Recorders write a topic before its first message; a batch for each message would take 0.1 ms."""
    state = serialised(joint_message(0, ["a"], [0.0]))
    content = SCHEMA + CHANNEL + b"".join(channel(i, f"/t{i}") + message(state) for i in range(2, 200))
    (tmp_path / "bag.mcap").write_bytes(HEADER + chunk(content, len(content), "") + FOOTER)
    batches = [*read_messages(tmp_path / "bag.mcap", ReadBudget())]
    assert [(batch.channel.topic, len(batch.stamps)) for batch in batches] == [("/joint_states", 198)]


def test_messages_before_a_damaged_topic_are_read(tmp_path):
    state = serialised(joint_message(0, ["a"], [0.0]))
    content = SCHEMA + CHANNEL + message(state) * 3 + channel(1, "/other") + message(state)
    (tmp_path / "bag.mcap").write_bytes(HEADER + chunk(content, len(content), "") + FOOTER)
    numbers: list[int] = []
    with pytest.raises(DamageError, match="two topics of the number 1"):
        numbers.extend(len(batch.stamps) for batch in read_messages(tmp_path / "bag.mcap", ReadBudget()))
    assert numbers == [3]


def test_joint_states_that_are_decoded_one_by_one_are_limited(bag, monkeypatch):
    """Frames of one length differ; each message takes 20 µs, and with many names milliseconds."""
    monkeypatch.setattr(joint_states, "MAX_ODD", 2000)
    monkeypatch.setattr(joint_states, "ODD", 0)
    for frames in ("", "longer"), ("", "x"):
        data = [serialised(joint_message(t, ["a", "b"], [0.0, 1.0], frame=frames[t % 2])) for t in range(40)]
        (bag / "bag.mcap").write_bytes(TOPIC + b"".join(map(message, data, range(40))) + FOOTER)
        if "longer" in frames:
            assert len(twodof.read_bag(bag).t) == 40
    with pytest.raises(BagError, match="MiB of joint states of changing form"):
        twodof.read_bag(bag)


@pytest.mark.parametrize("command", ["info", "plot"])
def test_robots_of_a_bag_that_are_read_together_are_limited(bag, command, capsys):
    (bag / "bag.mcap").write_bytes(TOPIC + message(joint_state(2, START)) + FOOTER)
    for i in range(33):
        (bag / f"run.r{i:02}.json").write_text("{}")
    assert main([command, str(bag)]) == 1
    one = f"give one, such as '{bag}:r00'"
    assert capsys.readouterr().err == f"twodof: error: the bag '{bag}' is of 33 robots, more than 32 at a time; {one}\n"


@pytest.mark.parametrize("command", [["info"], ["plot", "-o", "x.png"]])
def test_the_provenances_of_all_robots_are_limited_together(bag, tmp_path, monkeypatch, capsys, command):
    topics = b"".join(channel(i, f"/{robot}/joint_states") for i, robot in enumerate(("left", "right")))
    data = [message(joint_state(2, START + t), number=i) for t in range(9) for i in range(2)]
    (bag / "bag.mcap").write_bytes(HEADER + SCHEMA + topics + b"".join(data) + FOOTER)
    for robot in ("left", "right"):
        (bag / f"run.{robot}.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("twodof.bag.provenance.MAX_PROVENANCE", 4)
    assert main([*command, str(bag)]) == 0
    monkeypatch.setattr("twodof.bag.provenance.MAX_PROVENANCE", 3)
    assert main([*command, str(bag)]) == 1
    assert f"MiB together; give one, such as '{bag}:left'" in capsys.readouterr().err
    assert main([*command, f"{bag}:left"]) == 0


@pytest.mark.parametrize(("command", "passes"), [(["info"], 2), (["info", "--json"], 2), (["plot", "-o", "x.png"], 1)])
def test_a_bag_of_several_robots_is_read_once(bag, command, passes, monkeypatch, tmp_path, capsys):
    """``info`` reads the samples again, for the verdicts."""
    robots = [f"r{i}" for i in range(1, 6)]
    topics = b"".join(channel(i, f"/{robot}/joint_states") for i, robot in enumerate(robots))
    data = [message(joint_state(2, START + t), number=i) for t in range(9) for i in range(len(robots))]
    (bag / "bag.mcap").write_bytes(HEADER + SCHEMA + topics + b"".join(data) + FOOTER)
    for robot in robots:
        (bag / f"run.{robot}.json").write_text("{}")
    readings = count(1)
    read = reader.read_messages
    monkeypatch.setattr(reader, "read_messages", lambda *given: [next(readings)] and read(*given))
    monkeypatch.chdir(tmp_path)
    assert main([command[0], str(bag), *command[1:]]) == 0
    said = capsys.readouterr().out
    assert next(readings) == passes + 1 and all(robot in said for robot in robots)


def test_a_single_file_without_chunks_is_read_at_any_length(tmp_path, monkeypatch):
    """As ``ros2 bag record --storage-preset-profile fastwrite`` writes it."""
    monkeypatch.setattr(ReadBudget.__init__, "__defaults__", (10_000,))
    file, stamps = tmp_path / "one.mcap", range(START, START + 300)
    file.write_bytes(TOPIC + b"".join(message(joint_state(2, t), t * SECOND) for t in stamps) + FOOTER)
    assert twodof.read_bag(file).t[-1] == 299.0


def test_mcap_of_records_that_are_all_alike_is_not_read_to_its_end(bag):
    """Each of its chunks has a million empty messages in 3 kB."""
    million = message(b"") * 1_000_000
    packed = chunk(zstandard.compress(million), len(million), "zstd")
    file = bag / "bag.mcap"
    file.write_bytes(TOPIC + packed * 100 + FOOTER)
    numbers = count()
    with pytest.raises(DamageError, match="unpacks to more than 1000 times its size"):
        for _ in read_messages(file, ReadBudget()):
            next(numbers)
    assert next(numbers) < file.stat().st_size


def joint_state(n: int, stamp: int) -> bytes:
    names = [f"joint{i}" for i in range(n)]
    return serialised(joint_message(stamp, names, np.linspace(-1.0, 1.0, n), np.zeros(n)))


AT_REST: dict[str, Callable[[int], bytes]] = {
    "an arm": lambda stamp: joint_state(2, stamp),
    "a humanoid": lambda stamp: joint_state(50, stamp),
    "a heartbeat": lambda stamp: bytes(4),
}
PACKERS: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstandard.ZstdCompressor(level=22).compress,
    "lz4": lz4.frame.compress,
}


@pytest.mark.parametrize(("what", "compression"), [("an arm", "lz4"), ("a humanoid", "zstd"), ("a heartbeat", "zstd")])
def test_mcap_of_a_robot_at_rest_is_read_at_any_length(tmp_path, what, compression):
    """It has the best compression, chunks of 4 MiB, and no index between them.

    No honest file is smaller; each chunk adds enough to the read budget, so a file of a day is read.
    """
    data = AT_REST[what]
    stamps = [START * SECOND + k * PERIOD for k in range(4 * 1024**2 // (31 + len(data(0))))]
    messages = b"".join(message(data(stamp), stamp) for stamp in stamps)
    packed = chunk(PACKERS[compression](messages), len(messages), compression)
    (tmp_path / "x.mcap").write_bytes(TOPIC + packed + FOOTER)
    found = read_messages(tmp_path / "x.mcap", ReadBudget(left=10_000))
    assert np.concatenate([stamps for _, stamps, _ in found]).tolist() == stamps


def test_messages_of_varying_lengths_are_read_in_few_batches(tmp_path):
    """Lengths alternate, repeat in a longer period, and come at random; a batch takes 20 µs."""
    file, rng = tmp_path / "x.mcap", np.random.default_rng(1)
    patterns = [0, 1] * 500, [0, 0, 1] * 300, [0, 1, 1, 0, 2] * 200, [*rng.integers(0, 4, 1000)], [2] * 40 + [1] * 40
    lengths = [int(size) for size in chain(*patterns)]
    written = [message(bytes([k % 251]) * size, k, number=1 + k % 7 // 6) for k, size in enumerate(lengths)]
    file.write_bytes(TOPIC + channel(2, "/x") + chunk(b"".join(written), sum(map(len, written)), "") + FOOTER)
    batches = [*read_messages(file, ReadBudget())]
    found = [(t, rows[i]) for _, stamps, rows in batches for i, t in enumerate(stamps.tolist())]
    assert [k for k, _ in sorted(found, key=lambda each: each[0])] == [*range(len(lengths))]
    assert all(row.tobytes() == bytes([k % 251]) * lengths[k] for k, row in found)
    assert len(batches) < 40


@pytest.mark.parametrize("read", [read_bag, read_ends])
def test_memory_is_that_of_the_numbers(bag, read):
    n = 60_000
    (bag / "bag.mcap").write_bytes(TOPIC + message(joint_state(2, START)) * n + FOOTER)
    tracemalloc.start()
    read(bag)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    numbers = 8 * n * (1 + 2 + 2) if read is read_bag else 0  # stamps, positions, velocities
    assert peak < 1.2 * numbers + 5 * 1024**2


def test_large_records_outside_chunks_are_read_one_after_another(bag):
    (bag / "bag.mcap").write_bytes(TOPIC + channel(2, "/x") + message(bytes(4 * 1024**2), number=2) * 40 + FOOTER)
    tracemalloc.start()
    assert sum(len(stamps) for _, stamps, _ in read_messages(bag / "bag.mcap", ReadBudget())) == 40
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 80 * 1024**2


def test_a_provenance_is_evaluated_once_however_often_samples_are_chosen(bag, monkeypatch):
    """One of some megabytes takes a second."""
    (bag / "bag.mcap").write_bytes(TOPIC + message(joint_state(2, START)) * 60_000 + FOOTER)
    given = {"start_time": 0.0, "step": 0.01, "start_values": {"a": 0.0}, "input_changes": [[0.0, {"a": 1.0}]]}
    readings, schedules = count(), []
    monkeypatch.setattr(reader, "read_provenance", lambda *where: next(readings) or given)

    def lines(part):
        schedules.append(part.schedule[0][1])
        assert replace(part, q=part.q).schedule[0][1] is schedules[0]
        return [part.held("a", 1)]

    drawn = reader.read_downsampled(bag, 1000, lines)
    assert len(schedules) > 5 and {*map(id, [*schedules, drawn.schedule[0][1]])} == {id(schedules[0])}
    assert next(readings) == 1


def test_joint_states_in_memory_are_bounded(bag, monkeypatch):
    (bag / "bag.mcap").write_bytes(TOPIC + message(joint_state(2, START)) * 60_000 + FOOTER)
    monkeypatch.setattr(reader, "MAX_DRAWN", 100_000)
    drawn = reader.read_downsampled(bag, 60_000, lambda part: [])
    assert drawn.count == 60_000 and 0 < len(drawn.t) < 1000
    monkeypatch.setattr(reader, "MAX_SAMPLES", 1024**2)
    with pytest.raises(BagError, match="more than 1 MiB of joint states"):
        read_bag(bag)


def test_a_small_bag_does_not_unpack_to_many_joint_states(bag, monkeypatch):
    records = message(joint_state(2, START)) * 30_000
    loose = TOPIC + records + FOOTER
    packed = zstandard.ZstdCompressor().compress(records)
    monkeypatch.setattr(reader, "MAX_DRAWN", 2**18)
    (bag / "bag.mcap").write_bytes(loose)
    assert read_bag(bag).count == 30_000
    (bag / "bag.mcap").write_bytes(TOPIC + chunk(packed, len(records), "zstd") + FOOTER)
    with pytest.raises(BagError, match="unpacks to more than 0 MiB of joint states"):
        read_bag(bag)


# --- provenance ---


PROVENANCES = {
    "long number": '{"format": 1, "fmu": {}, "step": ' + "9" * 10_000 + "}",
    "pieces missing": '{"format": 1, "fmu": {}}',
    "other types": '{"format": 1, "fmu": {"name": [], "guid": 1, "file": {}}, "joints": 7}',
    "cut": '{"format": 1, "fmu": {"na',
    "no text": "\udcff",
    "10,000 deep": "[" * 10_000,
}


@pytest.mark.parametrize("content", PROVENANCES.values(), ids=PROVENANCES)
def test_hostile_provenance_is_refused(native_path, tmp_path, content, capsys):
    bag = tmp_path / "bag"
    run = twodof.experiment(native_path)
    with twodof.Bag(bag).begin(run) as sink:
        sink.write(sample(run, 0))
    (bag / "run.json").write_bytes(content.encode("utf-8", "surrogateescape"))
    assert "run.json" in refused(capsys, bag)


@pytest.mark.parametrize("change", [{"robot": "r" * 1001}, {"joints": ["j" * 1001, "b"]}, {"fmu": "f" * 1001}])
def test_long_names_in_a_provenance_are_refused(native_path, tmp_path, change, capsys):
    bag = tmp_path / "bag"
    twodof.simulate(native_path, twodof.Bag(bag), stop_time=0.1)
    facts = json.loads((bag / "run.json").read_text())
    (bag / "run.json").write_text(
        json.dumps({**facts, **change, "fmu": {**facts["fmu"], "file": change.get("fmu", "")}})
    )
    assert "run.json': it has a name of more than 1000 characters" in refused(capsys, bag)


def test_a_provenance_with_more_start_values_than_a_system_has_is_refused(native_path, tmp_path, capsys):
    bag = tmp_path / "bag"
    twodof.simulate(native_path, twodof.Bag(bag), stop_time=0.1)
    facts = json.loads((bag / "run.json").read_text())
    facts["start_values"] |= {f"a{i}": 0.0 for i in range(200_000)}
    (bag / "run.json").write_text(json.dumps(facts))
    assert "run.json': it has more than 200000 start values" in refused(capsys, bag)


def test_a_verdict_does_not_copy_the_start_values_for_each_question(native_path, tmp_path, monkeypatch):
    """A bag may have a hundred thousand, and a verdict has hundreds of questions."""
    bag, copies = tmp_path / "bag", count()

    class Starts(dict[str, Any]):
        def __iter__(self):  # with it, a copy takes the keys
            next(copies)
            return super().__iter__()

        def keys(self):
            next(copies)
            return super().keys()

    monkeypatch.setattr(recording, "setup_of", lambda **facts: setup_of(**{**facts, "starts": Starts(facts["starts"])}))
    twodof.simulate(native_path, twodof.Bag(bag), settings={"payload": 3.0, "Kp": 5.0}, stop_time=0.5)
    run = read_bag(bag)
    del run.provenance["verdict"]
    assert "payload of 3 kg" in run.verdict.lines[0] and next(copies) < 20


@pytest.mark.parametrize("command", ["info", "plot"])
def test_a_provenance_without_an_element_of_a_target_is_refused(native_path, tmp_path, command, capsys):
    bag = tmp_path / "bag"
    twodof.simulate(native_path, twodof.Bag(bag), stop_time=0.1)
    facts = json.loads((bag / "run.json").read_text())
    del facts["start_values"]["x_des[2]"]
    (bag / "run.json").write_text(json.dumps(facts | {"verdict": None}))
    assert main([command, str(bag)]) == 1
    assert f"the run.json in '{bag}' does not fit its samples" in capsys.readouterr().err


@pytest.mark.parametrize("output", ["x.html", "x.png"])
def test_a_provenance_may_have_half_characters_and_more_facts(native_path, tmp_path, output, capsys):
    bag = tmp_path / "bag"
    twodof.run(native_path, twodof.Bag(bag), stop_time=0.1)
    facts = json.loads((bag / "run.json").read_text())
    facts["fmu"]["file"] = facts["command_line"] = "\ud800 and \U0001f600"
    facts["verdict"]["later"] = facts["verdict"]["lines"] = ["half a \udc00"]
    facts["verdict"]["causes"] = [
        {"kind": "", "text": "", "joint": "", "share": 0, "point": [], "noted": True, "subject": "", "later": 1}
    ]
    (bag / "run.json").write_text(json.dumps(facts))
    assert main(["plot", str(bag), "-o", str(tmp_path / output)]) == 0
    assert main(["info", str(bag)]) == 0
    said = capsys.readouterr().out
    assert "? and \U0001f600" in said and "half a ?" in said
