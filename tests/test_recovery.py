"""Bags whose writer died: the saved messages, and the recovered bag."""

import errno
import os
import random
import shutil
import signal
import sqlite3
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import (
    BATCH,
    CHANNEL,
    FOOTER,
    HEADER,
    SCHEMA,
    START,
    STORE,
    assert_consistent,
    both_storages,
    channel,
    content,
    joint_message,
    joint_state,
    logging,
    message,
    metadata,
    read_with_mcap,
    read_with_rosbags,
    read_with_sqlite3,
    record,
    sample,
    serialised,
    texts,
    unfinished,
)
from harness import python
from mcap.exceptions import McapError
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer

import twodof
from twodof.bag import recovery
from twodof.bag.storage import profile
from twodof.cli.main import main
from twodof.errors import BagError
from twodof.ros.messages import LATCHED

PAGE = 4096  # bytes, of SQLite


def streamed(file: Path) -> int:
    """Messages that the MCAP project's reader reads from a file that ends at any byte."""
    count = 0
    with file.open("rb") as stream:
        try:
            for record in StreamReader(stream).records:
                count += isinstance(record, McapMessage)
        except (McapError, struct.error):
            pass
    return count


# --- killed ---


@pytest.mark.long
@both_storages
def test_killed_run_loses_a_second_at_most(native_path, tmp_path, storage, length):
    """The bag has the time at which the run was recorded."""
    options = ["--stamp-start", str(START), "--storage", storage]
    undisturbed = tmp_path / "undisturbed"
    assert main(["run", str(native_path), "-o", str(undisturbed), "--stop-time=60", *options]) == 0
    whole = read_with_rosbags(undisturbed)
    read_with_another = {"mcap": read_with_mcap, "sqlite3": read_with_sqlite3}[storage]
    rng = random.Random(storage)
    lost = []
    for first in range(0, length(200, 2), 2):
        bags = [tmp_path / f"bag{i}" for i in range(first, first + 2)]
        runs = [logging(native_path, bag, storage) for bag in bags]
        for bag, run in zip(bags, runs, strict=True):
            time.sleep(rng.uniform(0.0, 1.5))
            run.process.kill()
            run.process.communicate()
            killed = content(bag)
            assert main(["recover", str(bag)]) == 0
            kept = assert_consistent(bag, storage)
            assert read_with_rosbags(bag) == read_with_another(bag) == whole[:kept]
            assert content(bag.with_name(f"{bag.name}.unfinished")) == killed
            lost.append(run.lost(kept))
    print(f"{len(lost)} kills, {storage}: lost {np.mean(lost):.3f} s, at most {max(lost):.3f} s")
    assert max(lost) <= 1.0
    assert max(lost) > 0.0  # else nothing was tried


# --- what was lost is the end alone ---


def test_mcap_cut_anywhere_keeps_the_messages_before(run, tmp_path):
    bag = unfinished(tmp_path, run, "mcap", 200, scene=True)
    whole = (bag / "bag.mcap").read_bytes()
    everything = [joint_state(k, sample(run, k)) for k in range(200)]
    rng = np.random.default_rng(0)
    counts = set()
    for size in [len(whole), len(whole) - 1, *rng.integers(8, len(whole), 12).tolist()]:
        cut = tmp_path / f"cut{size}"
        shutil.copytree(bag, cut)
        (cut / "bag.mcap").write_bytes(whole[:size])
        there = streamed(cut / "bag.mcap")
        if there == 0:
            with pytest.raises(BagError, match="no message"):
                twodof.recover(cut)
            counts.add(0)
            continue
        done = twodof.recover(cut)
        assert sum(done.counts.values()) == assert_consistent(cut, "mcap") == there
        kept = read_with_rosbags(cut)
        assert read_with_mcap(cut) == kept == everything[: len(kept)]
        counts.add(len(kept))
    assert max(counts) > 150 and len(counts) > 3


def test_mcap_ending_in_zeros_after_a_power_loss_is_recovered(run, tmp_path):
    bag = unfinished(tmp_path, run, "mcap", 200)
    file = bag / "bag.mcap"
    there = streamed(file)
    file.write_bytes(file.read_bytes() + bytes(8192))
    done = twodof.recover(bag)
    assert done.counts == {"/joint_states": there}
    assert assert_consistent(bag, "mcap") == there


@pytest.mark.parametrize("part", [0.95, 0.5])
def test_sqlite3_file_without_its_end_keeps_the_messages_before(run, tmp_path, part):
    """The reference is SQLite, given a header with the right number of pages."""
    bag = tmp_path / "bag"
    with twodof.Bag(bag, storage="sqlite3").begin(run) as sink:
        for k in range(3000):
            sink.write(sample(run, k))
    file = bag / "bag.db3"
    pages = int(part * file.stat().st_size / PAGE)
    os.truncate(file, pages * PAGE)
    mended = bytearray(file.read_bytes())
    mended[28:32] = struct.pack(">I", pages)
    (tmp_path / "mended.db3").write_bytes(mended)
    there, database = [], sqlite3.connect(tmp_path / "mended.db3")
    database.execute("PRAGMA writable_schema = ON")  # SQLite 3.53 refuses an index whose root is cut off, without it
    with pytest.raises(sqlite3.DatabaseError):
        for row in database.execute("SELECT timestamp, data FROM messages NOT INDEXED"):
            there.append(row)
    database.close()
    done = twodof.recover(bag)
    assert "malformed" in done.damage and len(there) > 1000
    with Reader(bag) as reader:
        assert [(stamp, data) for _, stamp, data in reader.messages()] == there


@pytest.mark.parametrize("table", ["messages", "topics", "message_definitions"])
def test_a_table_whose_columns_are_damaged_is_not_an_empty_one(run, tmp_path, table):
    bag = tmp_path / "bag"
    with twodof.Bag(bag, storage="sqlite3").begin(run) as sink:
        sink.write(sample(run, 0))
    with sqlite3.connect(bag / "bag.db3") as database:
        database.execute("PRAGMA writable_schema = ON")
        database.execute("UPDATE sqlite_master SET sql = 'CREATE TABLE x(' WHERE name = ?", [table])
    database.close()
    with pytest.raises(BagError, match="damaged"):
        twodof.read_bag(bag)
    with pytest.raises(BagError, match="no message"):
        twodof.recover(bag)


def test_a_bag_of_which_nothing_can_be_read_stays(run, tmp_path, capsys):
    bag = tmp_path / "bag"
    with twodof.Bag(bag, storage="sqlite3").begin(run) as sink:
        sink.write(sample(run, 0))
    file = bag / "bag.db3"
    os.truncate(file, 2 * PAGE)
    before = file.read_bytes()
    assert main(["recover", str(bag)]) == 1
    told = capsys.readouterr()
    assert "no message of the bag" in told.err and "next" not in told.out
    assert file.read_bytes() == before and [*tmp_path.iterdir()] == [bag]


@pytest.mark.parametrize("named", ["", "a file", "nothing"])
def test_sqlite3_transaction_that_was_cut_is_rolled_back(run, tmp_path, named):
    """Its journal may name a super-journal of several databases, which SQLite would delete."""
    bag = unfinished(tmp_path, run, "sqlite3", 200)
    file = bag / "bag.db3"
    committed = len(read_with_sqlite3(bag))
    database = sqlite3.connect(file)
    database.execute("PRAGMA cache_size = 2")  # so that pages are written before the commit
    database.execute("UPDATE messages SET data = zeroblob(length(data))")
    database.executemany(
        "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, zeroblob(1000))", [(k,) for k in range(1000)]
    )
    cut = tmp_path / "cut"
    shutil.copytree(bag, cut)
    database.rollback()
    database.close()
    assert (cut / "bag.db3-journal").stat().st_size > 0
    (cut / "bag.db3").rename(cut / "cut.db3")
    (cut / "bag.db3-journal").rename(cut / "cut.db3-journal")
    victim = tmp_path / "victim"
    if named:
        with (cut / "cut.db3-journal").open("ab") as journal:
            journal.write(super_journal(victim))
    if named == "a file":
        victim.write_text("precious")
    (cut / "metadata.yaml").touch()
    before = content(cut)
    assert len(twodof.read_bag(cut).t) == committed
    twodof.recover(cut)
    assert read_with_rosbags(cut) == [joint_state(k, sample(run, k)) for k in range(committed)]
    assert content(tmp_path / "cut.unfinished") == before
    assert victim.exists() == (named == "a file")
    assert assert_consistent(cut, "sqlite3") == committed > 100


def super_journal(path: Path) -> bytes:
    """Return the end of the journal of a transaction over several databases, by SQLite's pager.c."""
    name = os.fsencode(path)
    magic = bytes.fromhex("d9d505f920a163d7")
    return struct.pack(">I", 0) + name + struct.pack(">II", len(name), sum(name)) + magic


@both_storages
def test_recovered_bag_is_the_one_that_closing_makes(run, tmp_path, storage):
    bag = unfinished(tmp_path, run, storage, 2 * BATCH + 1, scene=True)
    with twodof.Bag(tmp_path / "closed" / "bag", storage=storage, scene=True).begin(run) as closed:
        for k in range(2 * BATCH + 1):
            closed.write(sample(run, k))
    twodof.recover(bag)
    found, expected = metadata(bag), metadata(closed.path)
    for told in (found, expected):
        told["topics_with_message_count"].sort(key=lambda topic: topic["topic_metadata"]["name"])
    assert found == expected
    assert (bag / "run.json").read_bytes() == (closed.path / "run.json").read_bytes()
    assert {p.name for p in bag.iterdir()} == {p.name for p in closed.path.iterdir()}
    assert messages(bag) == messages(closed.path)
    back, expected_back = twodof.read_bag(bag), twodof.read_bag(closed.path)
    assert back.topics == expected_back.topics
    assert back.provenance == expected_back.provenance


def messages(bag: Path) -> list[tuple[object, ...]]:
    with Reader(bag) as reader:
        return sorted((c.topic, c.msgtype, c.ext, stamp, bytes(data)) for c, stamp, data in reader.messages())


DEFINITION = "# a comment\nfloat64[] readings\nstring unit\n"


@pytest.mark.parametrize("compression", [CompressionMode.NONE, CompressionMode.STORAGE])
def test_mcap_of_another_writer_keeps_types_definitions_and_qos(tmp_path, compression):
    """A recorder has split it into two files, the last of which lacks its end."""
    from twodof.ros.messages import LATCHED

    text = STORE.types["std_msgs/msg/String"]
    expected = []
    for number, folder in enumerate(("rec_9", "rec_10")):
        writer = Writer(tmp_path / folder, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(compression, CompressionFormat.ZSTD)
        with writer:
            talk = writer.add_connection(
                "/talk", "std_msgs/msg/String", typestore=STORE, offered_qos_profiles=[LATCHED]
            )
            mine = writer.add_connection(
                "/mine", "my_msgs/msg/Readings", msgdef=DEFINITION, rihs01="RIHS01_" + "a" * 64
            )
            for k in range(300):
                stamp = 1000 * number + k
                data = bytes(STORE.serialize_cdr(text(f"{number} {k}"), "std_msgs/msg/String"))
                for connection in (talk, mine):
                    writer.write(connection, stamp, data)
                    expected.append((connection.topic, connection.msgtype, stamp, data))
    bag = tmp_path / "rec"
    bag.mkdir()
    for folder in ("rec_9", "rec_10"):
        shutil.copy(tmp_path / folder / f"{folder}.mcap", bag)
    whole = (bag / "rec_10.mcap").read_bytes()
    (bag / "rec_10.mcap").write_bytes(whole[: len(whole) - 600])
    twodof.recover(bag)
    with Reader(bag) as reader:
        found = [(c.topic, c.msgtype, stamp, bytes(data)) for c, stamp, data in reader.messages()]
        connections = {connection.topic: connection for connection in reader.connections}
    assert sorted(found) == sorted(expected)
    ext = connections["/talk"].ext
    assert isinstance(ext, ConnectionExtRosbag2) and ext.offered_qos_profiles == [LATCHED]
    assert connections["/mine"].msgdef.data == DEFINITION
    assert connections["/talk"].digest == STORE.hash_rihs01("std_msgs/msg/String")


def test_no_more_profiles_are_read_than_take_no_time(tmp_path, monkeypatch):
    """Each topic has its own profile in YAML, which is slow to parse."""
    (tmp_path / "bag").mkdir()
    profiles = ["- {depth: [" + "1," * 300 + f"]}}#{i:02}" for i in range(50)]
    channels = [channel(i, f"/t{i}", qos) for i, qos in enumerate(profiles)]
    messages = [message(bytes(4), number=i) for i in range(50)]
    content = b"".join([HEADER, SCHEMA, *channels, *messages, FOOTER])
    (tmp_path / "bag/bag.mcap").write_bytes(content)
    read: list[str] = []

    def parse(text: str) -> list[Any]:
        read.append(text)
        return []

    monkeypatch.setattr("twodof.bag.recovery.parse_qos", parse)
    monkeypatch.setattr("twodof.bag.recovery.MAX_PROFILES", 2000)
    assert set(twodof.recover(tmp_path / "bag").counts.values()) == {1}
    assert read == profiles[:3]


def test_a_file_is_recovered_in_a_folder_of_its_own(tmp_path):
    """A bag may be a single MCAP file, and its refusal names a remedy that works."""
    file = tmp_path / "cut.mcap"
    file.write_bytes(HEADER + SCHEMA + CHANNEL + message(serialised(joint_message(1, ["a"], [0.0]))))
    with pytest.raises(BagError, match="move it into a folder of its own, and 'twodof recover' of that folder"):
        twodof.read_bag(file)
    with pytest.raises(BagError, match="is a file; move it into a folder of its own, and recover that folder"):
        twodof.recover(file)
    (tmp_path / "bag").mkdir()
    file.rename(tmp_path / "bag/cut.mcap")
    assert twodof.recover(tmp_path / "bag").counts == {"/joint_states": 1}


def test_no_more_profiles_are_written_than_readers_parse_in_time(tmp_path, monkeypatch):
    """Many topics have one long profile, which metadata.yaml states for each of them."""
    (tmp_path / "bag").mkdir()
    text = profile(LATCHED)
    topics = b"".join(channel(i, f"/t{i}", text) + message(bytes(4), number=i) for i in range(3))
    (tmp_path / "bag/bag.mcap").write_bytes(HEADER + SCHEMA + topics + FOOTER)
    monkeypatch.setattr("twodof.bag.recovery.MAX_WRITTEN_PROFILES", 2 * len(text), raising=False)
    twodof.recover(tmp_path / "bag")
    with Reader(tmp_path / "bag") as reader:
        known = [it.ext for it in reader.connections if isinstance(it.ext, ConnectionExtRosbag2)]
    assert [len(it.offered_qos_profiles) for it in known] == [1, 1, 0]


MERGED = "- &a0 {history: 1}\n" + "".join(f"- &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 20))
LONG = "- {history: 1, depth: 0x" + "f" * 5000 + ", reliability: 1, durability: 1}"


@pytest.mark.parametrize("profile", [MERGED, LONG], ids=["merge keys", "long number"])
def test_profiles_that_yaml_cannot_read_in_time_are_left_out(tmp_path, profile):
    """Merge keys take ten times as long with each line; Python does not print numbers of thousands of digits."""
    (tmp_path / "bag").mkdir()
    content = b"".join([HEADER, SCHEMA, channel(1, "/t", profile), message(bytes(4)), FOOTER])
    (tmp_path / "bag/bag.mcap").write_bytes(content)
    assert twodof.recover(tmp_path / "bag").counts == {"/t": 1}


def test_messages_in_another_form_are_left_out_and_named(tmp_path):
    (tmp_path / "bag").mkdir()
    other = record(4, struct.pack("<HH", 2, 1), texts("/text", "json", ""))
    content = b"".join([HEADER, SCHEMA, CHANNEL, other, message(bytes(4)), message(b"{}", number=2)])
    (tmp_path / "bag/bag.mcap").write_bytes(content + FOOTER)
    done = twodof.recover(tmp_path / "bag")
    assert done.counts == {"/joint_states": 1}
    assert done.damage == "messages in another form than CDR, on /text"


# --- what is said, and what is refused ---


def test_unfinished_bag_is_named_with_the_command(run, tmp_path, capsys):
    bag = unfinished(tmp_path, run, "mcap", 10)
    assert main(["info", str(bag)]) == 1
    said = capsys.readouterr().err
    assert "unfinished" in said and f"twodof recover {bag}" in said
    assert main(["recover", str(bag)]) == 0
    assert f"{bag}.unfinished" in capsys.readouterr().out
    assert main(["info", str(bag)]) == 0


def test_bag_that_is_being_written_is_left_alone(run, tmp_path):
    with twodof.Bag(tmp_path / "bag", storage="sqlite3").begin(run) as bag:
        bag.write(sample(run, 0))
        for refused in (twodof.recover, twodof.read_bag):
            with pytest.raises(BagError, match="still being written"):
                refused(bag.path)
        (bag.path / "metadata.yaml").write_text("rosbag2_bagfile_information:")
        with pytest.raises(BagError, match="being written"):
            twodof.Bag(bag.path, overwrite=True)
    assert assert_consistent(bag.path, "sqlite3") == 1


def test_complete_bag_is_left_as_it_is(run, tmp_path, capsys):
    with twodof.Bag(tmp_path / "bag", storage="sqlite3").begin(run) as bag:
        bag.write(sample(run, 0))
    before = content(tmp_path)
    assert main(["recover", str(bag.path)]) == 0
    assert "is complete" in capsys.readouterr().out
    assert content(tmp_path) == before


@pytest.mark.parametrize("damage", ["metadata.yaml", "short metadata", "mcap"])
def test_damaged_bag_is_written_again(run, tmp_path, damage):
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        for k in range(20):
            bag.write(sample(run, k))
    file = bag.path / ("bag.mcap" if damage == "mcap" else "metadata.yaml")
    before = file.read_bytes()
    file.write_bytes({"metadata.yaml": b"hello", "mcap": before[:-50]}.get(damage, before[:300]))
    if damage == "mcap":
        with pytest.raises(BagError, match="twodof recover"):
            twodof.read_bag(bag.path)
    twodof.recover(bag.path)
    assert read_with_rosbags(bag.path) == [joint_state(k, sample(run, k)) for k in range(20)]
    assert assert_consistent(bag.path, "mcap") == 20


def test_a_bag_that_unpacks_to_much_more_than_its_size_is_left_as_it_is(run, tmp_path, monkeypatch):
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        for k in range(20):
            bag.write(sample(run, k))
    (bag.path / "metadata.yaml").unlink()
    before = content(tmp_path)
    monkeypatch.setattr(recovery, "MAX_COPY", 1024)
    monkeypatch.setattr(recovery, "MAX_COPY_RATIO", 0)
    with pytest.raises(BagError, match="bag' unpacks to more than 0 MiB of messages; cut its files"):
        twodof.recover(bag.path)
    assert content(tmp_path) == before


def test_damaged_provenance_does_not_keep_the_messages(run, tmp_path):
    bag = unfinished(tmp_path, run, "mcap", 10)
    (bag / "run.json").write_text('{"format": 1, "fmu": {"na')
    twodof.recover(bag)
    assert assert_consistent(bag, "mcap") > 0
    assert (bag / "run.json").read_text() == '{"format": 1, "fmu": {"na'


def test_the_provenance_of_many_robots_is_not_held_without_a_limit(run, tmp_path, monkeypatch):
    """The messages are saved, and what is left out is named."""
    damaged = unfinished(tmp_path, run, "mcap", 3)
    for name in ("a", "b", "c"):
        (damaged / f"run.{name}.json").write_bytes(b" " * 1000)
    (damaged / "run.json").unlink(missing_ok=True)
    monkeypatch.setattr(recovery, "MAX_PROVENANCES", 2000)
    found = twodof.recover(damaged)
    assert "'run.c.json', because files" in found.damage and "run.b" not in found.damage
    assert sorted(file.name for file in damaged.glob("*.json")) == ["run.a.json", "run.b.json"]
    assert sum(found.counts.values()) > 0


@pytest.mark.parametrize("place", ["nowhere", "file", "empty", "no bag", "both", "taken"])
def test_an_unrecoverable_bag_is_refused_and_left_alone(run, tmp_path, place):
    bag = unfinished(tmp_path, run, "mcap", 10)
    if place == "taken":
        (tmp_path / "bag.unfinished").mkdir()
    elif place == "both":
        (bag / "bag.db3").touch()
    else:
        shutil.rmtree(bag)
        if place == "file":
            bag.write_text("hello")
        elif place != "nowhere":
            bag.mkdir()
    if place == "no bag":
        (bag / "notes.txt").write_text("precious")
    before = content(tmp_path)
    with pytest.raises(BagError) as caught:
        twodof.recover(bag)
    assert str(bag) in str(caught.value) and "\n" not in str(caught.value)
    assert content(tmp_path) == before


def test_bag_on_a_disk_without_room_for_another_stays_as_it_was(run, tmp_path, disk):
    big = unfinished(tmp_path, run, "mcap", 4000)
    folder = disk(content_size(big) // 1024 + 200)
    shutil.copytree(big, folder / "bag")
    before = content(folder)
    with pytest.raises(BagError, match=r"cannot recover .*; nothing is lost"):
        twodof.recover(folder / "bag")
    assert content(folder) == before


def content_size(folder: Path) -> int:
    return sum(p.stat().st_size for p in folder.iterdir())


KILLED_ANYWHERE = """
import os, signal, sys
from twodof.bag.recovery import recover
bags = sys.argv[1:]
for last, bag in enumerate(bags):
    if os.fork() == 0:
        changes = 0

        def count(event, arguments):
            global changes
            if event in ("os.mkdir", "os.rename", "os.remove", "os.rmdir"):
                changes += 1
                if changes > last:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(count)
        recover(bag)
        os._exit(0)
    _, status = os.wait()
    print(os.waitstatus_to_exitcode(status))
"""


def test_recovery_killed_before_any_of_its_changes_is_finished_by_the_next(run, tmp_path):
    """It is killed at each of its changes to folders."""
    living = unfinished(tmp_path, run, "mcap", 200)
    before = content(living)
    bags = [tmp_path / str(last) / "bag" for last in range(9)]
    for bag in bags:
        shutil.copytree(living, bag)
    done = python("-c", KILLED_ANYWHERE, *bags, check=True)
    ends = [int(line) for line in done.stdout.split()]
    assert {*ends[:5]} == {-signal.SIGKILL} and ends[-1] == 0
    gone = 0
    for bag in bags:
        gone += not bag.exists()
        twodof.recover(bag)
        assert {path.name for path in bag.parent.iterdir()} == {"bag", "bag.unfinished"}
        assert content(bag.with_name("bag.unfinished")) == before
        kept = assert_consistent(bag, "mcap")
        assert read_with_rosbags(bag) == [joint_state(k, sample(run, k)) for k in range(kept)]
        assert kept > 150
    assert gone == 1  # between two renames


@pytest.mark.parametrize("failing", [1, 2])
def test_recovery_that_cannot_rename_leaves_the_bag_as_it_was(run, tmp_path, failing, monkeypatch):
    bag = unfinished(tmp_path, run, "mcap", 10)
    before = content(tmp_path)
    rename, calls = os.rename, []

    def failing_rename(*paths: Path) -> None:
        calls.append(paths)
        if len(calls) == failing:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))
        rename(*paths)

    monkeypatch.setattr(os, "rename", failing_rename)
    with pytest.raises(BagError, match="not permitted; nothing is lost"):
        twodof.recover(bag)
    assert content(tmp_path) == before


def test_bag_that_is_being_recovered_is_left_alone(run, tmp_path, monkeypatch):
    """Another recovery and a run with --overwrite refuse it at any moment."""
    bag = unfinished(tmp_path, run, "mcap", 10)
    rename, said = os.rename, []

    def slow_rename(*paths: Path) -> None:
        for intruder in (twodof.recover, lambda path: twodof.Bag(path, overwrite=True)):
            if bag.exists() or intruder is twodof.recover:
                with pytest.raises(BagError) as caught:
                    intruder(bag)
                said.append(str(caught.value))
        rename(*paths)

    monkeypatch.setattr(os, "rename", slow_rename)
    twodof.recover(bag)
    assert len(said) == 3 and all("being written" in line for line in said)
    assert assert_consistent(bag, "mcap") > 0
    assert {path.name for path in tmp_path.iterdir()} == {"bag", "bag.unfinished"}


def test_bag_is_recovered_from_within(run, tmp_path, monkeypatch):
    bag = unfinished(tmp_path, run, "mcap", 10)
    monkeypatch.chdir(bag)
    assert twodof.recover(".").original == tmp_path / "bag.unfinished"
    assert assert_consistent(bag, "mcap") > 0
