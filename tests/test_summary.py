"""The summary of an MCAP file is used only if its checksum and its numbers are right."""

import random
import shutil
import struct
from contextlib import nullcontext
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
from bags import START, joint_message, read_ends, serialised
from mcap.reader import make_reader
from mcap.writer import Writer

import twodof
from twodof.bag.contents import read_messages
from twodof.bag.mcap import CHANNEL
from twodof.bag.records import DamageError, ReadBudget
from twodof.bag.summary import McapSummary, _chunk, read_summaries
from twodof.bounds import MAX_TOPICS
from twodof.cli.main import main

JOINT_STATE = "sensor_msgs/msg/JointState"
FOOTER = 20 + 8  # its fields, and the magic behind it


@pytest.fixture(scope="module")
def original(native_path, tmp_path_factory):
    """A bag with several chunks of a scene's topics."""
    bag = twodof.Bag(tmp_path_factory.mktemp("original") / "bag", scene=True)
    twodof.simulate(native_path, bag, stop_time=30.0, stamp_start=START)
    return bag.path


@pytest.fixture
def bag(original, tmp_path):
    return Path(shutil.copytree(original, tmp_path / "bag"))


def file_of(bag: Path) -> Path:
    return bag / f"{bag.name}.mcap"


def statistics_of(content: bytes | bytearray) -> tuple[int, int]:
    """Return the offsets of the summary and of its statistics."""
    (start,) = struct.unpack_from("<Q", content, len(content) - FOOTER)
    place = start
    while content[place] != 11:
        place += 9 + struct.unpack_from("<Q", content, place + 1)[0]
    return start, place


def ends(bag: Path) -> list[object]:
    recording = read_ends(bag)
    parts = (recording.stamps, recording.q, recording.v, recording.tau)
    return [recording.count, recording.joints, recording.topics, *(part.tolist() for part in parts)]


def seal(file: Path, content: bytearray, start: int) -> None:
    """Write a file whose summary was changed, with a valid checksum."""
    content[-12:-8] = struct.pack("<I", crc32(content[start:-12]))
    file.write_bytes(content)


def read_summary(file: Path) -> McapSummary | None:
    summaries = read_summaries([file])
    return None if summaries is None else summaries[0]


def without_checksum(file: Path) -> None:
    content = file.read_bytes()
    file.write_bytes(content[:-12] + bytes(4) + content[-8:])


def test_summaries_of_all_files_are_limited(bag, monkeypatch):
    content = file_of(bag).read_bytes()
    size = len(content) - statistics_of(content)[0] - 37  # without the footer
    monkeypatch.setattr("twodof.bag.summary.MAX_SUMMARY", 2 * size)
    assert read_summaries([file_of(bag)] * 2) is not None
    assert read_summaries([file_of(bag)] * 3) is None


def test_summary_is_that_of_the_mcap_project(bag):
    with file_of(bag).open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        theirs = reader.get_summary()
        read = sum(1 for _ in reader.iter_messages())
    ours = read_summary(file_of(bag))
    assert ours is not None and theirs is not None and theirs.statistics is not None
    assert ours.counts == theirs.statistics.channel_message_counts
    assert sum(ours.counts.values()) == read == 4 * 3001 + 2
    assert {n: c.topic for n, c in ours.channels.items()} == {n: c.topic for n, c in theirs.channels.items()}
    assert [c.offset for c in ours.chunks] == [c.chunk_start_offset for c in theirs.chunk_indexes]
    assert len(ours.chunks) > 2


def test_a_summary_equals_a_full_read(bag):
    by_summary = ends(bag)
    without_checksum(file_of(bag))
    assert read_summary(file_of(bag)) is None
    assert ends(bag) == by_summary
    whole = twodof.read_bag(bag)
    assert by_summary[3] == [whole.stamps[0], whole.stamps[-1]]
    assert by_summary[4] == [whole.q[0].tolist(), whole.q[-1].tolist()]


def test_a_summary_is_not_read_with_all_that_comes_before(bag):
    expected, file = ends(bag), file_of(bag)
    summary, content = read_summary(file), bytearray(file.read_bytes())
    assert summary is not None
    middle = summary.chunks[len(summary.chunks) // 2]
    content[middle.offset + 200 : middle.offset + middle.length] = bytes(middle.length - 200)
    file.write_bytes(content)
    assert ends(bag) == expected
    with pytest.raises(twodof.TwoDofError, match="damaged"):
        twodof.read_bag(bag)


def test_a_summary_with_a_flipped_bit_is_not_used(bag):
    file, chance = file_of(bag), random.Random(17)
    content = file.read_bytes()
    (start,) = struct.unpack_from("<Q", content, len(content) - FOOTER)
    for _ in range(100):
        damaged = bytearray(content)
        damaged[chance.randrange(start, len(content))] ^= 1 << chance.randrange(8)
        file.write_bytes(damaged)
        assert read_summary(file) is None
    for size in (*range(40), start, len(content) - 1):
        file.write_bytes(content[:size])
        assert read_summary(file) is None


@pytest.mark.parametrize("field", [0, 22], ids=["messages", "chunks"])
def test_a_summary_of_contradictory_numbers_is_not_used(bag, field):
    """The checksum is valid; messages and those by channel, or chunks and their index, contradict each other."""
    file = file_of(bag)
    content = bytearray(file.read_bytes())
    start, place = statistics_of(content)
    content[place + 9 + field] ^= 1
    seal(file, content, start)
    assert read_summary(file) is None


def test_a_chunk_index_has_no_more_channels_than_a_file():
    """Each takes memory before any of them is checked."""
    for channels, valid in ((MAX_TOPICS, True), (MAX_TOPICS + 1, False)):
        offsets = b"".join(struct.pack("<HQ", n, 100 + 15 * n) for n in range(channels))
        record = struct.pack("<QQQQI", 0, 1, 50, 50, len(offsets)) + offsets + struct.pack("<Q", 15 * channels)
        with nullcontext() if valid else pytest.raises(DamageError, match="damaged summary"):
            assert len(_chunk(Path("a.mcap"), record).counts) == channels


def test_a_summary_that_counts_messages_of_an_unknown_channel_is_not_used(bag):
    """The checksum is valid, and a channel has another number."""
    file = file_of(bag)
    content = bytearray(file.read_bytes())
    start, _ = statistics_of(content)
    place = start
    while content[place] != CHANNEL:
        place += 9 + struct.unpack_from("<Q", content, place + 1)[0]
    content[place + 9] ^= 0xFF
    seal(file, content, start)
    assert read_summary(file) is None


def test_counts_that_the_index_contradicts_are_not_used(bag, capsys, caplog):
    """The checksum is valid, and the statistics lack a message; the file has 12,006."""
    file = file_of(bag)
    content = bytearray(file.read_bytes())
    start, place = statistics_of(content)
    for at in (place + 9, place + 9 + 46 + 2):  # of all messages, and of the first channel
        struct.pack_into("<Q", content, at, struct.unpack_from("<Q", content, at)[0] - 1)
    seal(file, content, start)
    assert read_summary(file) is None
    assert main(["info", str(bag)]) == 0
    assert not caplog.messages
    assert "3001 joint states" in capsys.readouterr().out


@pytest.mark.parametrize("times", [1, 2])
def test_a_chunk_is_named_once(bag, times):
    """The checksum is valid, and index and statistics have a chunk twice."""
    file = file_of(bag)
    content = bytearray(file.read_bytes())
    start, _ = statistics_of(content)
    summary = read_summary(file)
    assert summary is not None
    chunk = start
    while content[chunk] != 8:
        chunk += 9 + struct.unpack_from("<Q", content, chunk + 1)[0]
    size = 9 + struct.unpack_from("<Q", content, chunk + 1)[0]
    content[chunk:chunk] = content[chunk : chunk + size] * (times - 1)
    _, place = statistics_of(content)
    added = {number: count * (times - 1) for number, count in summary.chunks[0].counts.items()}
    stated, *fields = struct.unpack_from("<QHIII", content, place + 9)
    struct.pack_into("<QHIII", content, place + 9, stated + sum(added.values()), *fields)
    struct.pack_into("<I", content, place + 9 + 22, len(summary.chunks) + times - 1)
    for at in range(place + 9 + 46, place + 9 + struct.unpack_from("<Q", content, place + 1)[0], 10):
        number, count = struct.unpack_from("<HQ", content, at)
        struct.pack_into("<Q", content, at + 2, count + added.get(number, 0))
    seal(file, content, start)
    assert (read_summary(file) is None) == (times > 1)
    assert ends(bag)[0] == 3001


def test_a_chunk_with_fewer_messages_than_its_index_is_refused(bag):
    """The checksum is valid; the last chunk is empty, and its index has the old messages."""
    file = file_of(bag)
    content = bytearray(file.read_bytes())
    summary = read_summary(file)
    assert summary is not None
    last = summary.chunks[-1]
    place = last.offset + 9 + 32 + 8
    while place < last.offset + last.length:  # messages become records of another kind
        content[place] = 200
        place += 9 + struct.unpack_from("<Q", content, place + 1)[0]
    file.write_bytes(content)
    with pytest.raises(twodof.TwoDofError, match="has 0 messages on /joint_states at byte"):
        read_ends(bag)


def test_a_file_that_contradicts_metadata_is_reported_and_repaired(bag, capsys, caplog):
    """The file has 12,006 messages."""
    yaml = bag / "metadata.yaml"
    text = yaml.read_text("utf-8")
    yaml.write_text(text.replace("message_count: 12006", "message_count: 12007"), "utf-8")
    assert main(["info", str(bag)]) == 0
    (line,) = caplog.messages
    assert "has 12007 messages according to its metadata.yaml, and 12006 in" in line
    assert f"'twodof recover {bag}'" in line
    assert main(["recover", str(bag)]) == 0
    caplog.clear()
    assert main(["info", str(bag)]) == 0
    assert not caplog.messages
    assert "3001 joint states" in capsys.readouterr().out


def test_a_chunk_that_is_not_at_its_offset_in_the_summary_is_refused(bag):
    file = file_of(bag)
    summary, content = read_summary(file), bytearray(file.read_bytes())
    assert summary is not None
    content[summary.chunks[-1].offset] = 7
    file.write_bytes(content)
    with pytest.raises(twodof.TwoDofError, match="is damaged at byte"):
        read_ends(bag)


def test_a_summary_with_another_name_of_a_topic_is_refused(tmp_path):
    """Its checksum is valid, and its only chunk has the topic under another name."""
    file = tmp_path / "bag" / "bag.mcap"
    file.parent.mkdir()
    (file.parent / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(JOINT_STATE, "ros2msg", b"")
        writer.add_message(
            writer.register_channel("/joint_states", "cdr", schema), 1, serialised(joint_message(0, "j", [0.0])), 1
        )
        writer.finish()
    content = bytearray(file.read_bytes())
    start, _ = statistics_of(content)
    content[start:] = content[start:].replace(b"/joint_states", b"/joint_statex")
    seal(file, content, start)
    with pytest.raises(twodof.TwoDofError, match="has two topics of the number 1"):
        read_ends(file.parent)


def test_messages_that_the_summary_alone_has_are_missed(tmp_path):
    """Its checksum is valid, and it has the topic under another name and number than the only chunk."""
    file = tmp_path / "bag" / "bag.mcap"
    file.parent.mkdir()
    (file.parent / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    with file.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(JOINT_STATE, "ros2msg", b"")
        number = writer.register_channel("/joint_states", "cdr", schema)
        writer.add_message(number, 1, serialised(joint_message(0, "j", [0.0])), 1)
        writer.finish()
    content = bytearray(file.read_bytes())
    start, _ = statistics_of(content)
    place = start
    while place < len(content) - 37:  # the footer and the magic
        opcode, length = struct.unpack_from("<BQ", content, place)
        number_at = {4: 0, 8: 36, 11: 46}.get(opcode)  # in a channel, a chunk's index and the statistics
        if number_at is not None:
            struct.pack_into("<H", content, place + 9 + number_at, 2)
        place += 9 + length
    content[start:] = content[start:].replace(b"/joint_states", b"/joint_statex")
    seal(file, content, start)
    with pytest.raises(twodof.TwoDofError, match="has 0 messages on /joint_statex at byte"):
        read_ends(file.parent)


@pytest.mark.parametrize("name", ["/joint_states", "/other"])
def test_ends_of_another_writer_in_any_order(tmp_path, name):
    """Small chunks have overlapping stamps; some have another topic too."""
    stamps = np.random.default_rng(3).permutation(400)
    file = tmp_path / "bag" / "bag.mcap"
    file.parent.mkdir()
    (file.parent / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    with file.open("wb") as stream:
        writer = Writer(stream, chunk_size=1500)
        writer.start()
        schemas = {k: writer.register_schema(k, "ros2msg", b"") for k in (JOINT_STATE, "x/msg/Y")}
        told = writer.register_channel(name, "cdr", schemas[JOINT_STATE])
        other = writer.register_channel("/talk", "cdr", schemas["x/msg/Y"])
        for stamp in stamps.tolist():
            data = serialised(joint_message(0, "j", [stamp], [stamp]))
            writer.add_message(told, stamp, data, stamp)
            if stamp % 3 == 0:
                writer.add_message(other, stamp + 7, bytes(4 + stamp), stamp + 7)
        writer.finish()
    assert read_summary(file) is not None
    recording = read_ends(file.parent)
    assert (recording.count, recording.q.tolist()) == (400, [[0.0], [399.0]])


def test_messages_of_equal_length_that_come_in_turns_or_not_keep_their_order(tmp_path):
    """Messages have three channels and a few lengths at random, with periodic runs among them."""
    chance, file = random.Random(5), tmp_path / "x.mcap"
    parts = [
        [(chance.randrange(3), chance.choice((4, 8, 9))) for _ in range(chance.randrange(1, 7))]
        * chance.choice((1, 1, 2, 50))
        for _ in range(300)
    ]
    said = [
        (channel, k, chance.randbytes(size))
        for k, (channel, size) in enumerate(pair for part in parts for pair in part)
    ]
    with file.open("wb") as stream:
        writer = Writer(stream, chunk_size=30_000)
        writer.start()
        schema = writer.register_schema("x/msg/Y", "ros2msg", b"")
        channels = [writer.register_channel(f"/{i}", "cdr", schema) for i in range(3)]
        for i, k, data in said:
            writer.add_message(channels[i], k, data, k)
        writer.finish()
    read: list[tuple[int, int, bytes]] = []
    for channel, stamps, messages in read_messages(file, ReadBudget()):
        for stamp, message in zip(stamps.tolist(), messages, strict=True):
            read.append((int(channel.topic[1:]), stamp, message.tobytes()))
    ours, theirs = (sorted(each, key=lambda one: (one[0], len(one[2]))) for each in (read, said))  # stable
    assert ours == theirs
