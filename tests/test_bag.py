"""Bags, read by independent readers and compared with independent results.

Readers are rosbags', the MCAP project's own and the standard library's sqlite3. The path of the end effector is a
closed form, and type hashes are those that ROS 2 publishes.
"""

import json
import sqlite3
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from bags import (
    PERIOD,
    SECOND,
    START,
    STORAGES,
    STORE,
    both_storages,
    foreign_readers,
    header,
    joint_message,
    joint_state,
    metadata,
    read_ends,
    read_with_rosbags,
    serialised,
    write_third_party,
)
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionMode
from rosbags.rosbag2.storage_mcap import McapWriter
from ruamel.yaml import YAML
from sinks import Collector

import twodof
from twodof.bag.storage import McapStorage
from twodof.errors import BagError, InputError
from twodof.simulation.experiments import Experiment

KIB, MIB = 1024, 1024**2

# As in the code that ROS 2 generates from the definitions: *__description.c of each message.
TYPE_HASHES = {
    "sensor_msgs/msg/JointState": ("RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"),
    "std_msgs/msg/String": ("RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
    "tf2_msgs/msg/TFMessage": ("RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"),
    "geometry_msgs/msg/PointStamped": ("RIHS01_4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897"),
}


class Recording(NamedTuple):
    run: Experiment
    samples: Collector
    folder: Path

    def bag(self, storage: str, kind: str = "plain") -> Path:
        return self.folder / f"{storage}_{kind}"


KINDS: dict[str, dict[str, Any]] = {"plain": {}, "effort": {"effort": True}, "scene": {"scene": True}}


@pytest.fixture(scope="module")
def recording(native_path, tmp_path_factory):
    """The default run, written to all kinds of bags at once."""
    run = twodof.experiment(native_path, stamp_start=START)
    recording = Recording(run, Collector(), tmp_path_factory.mktemp("bags"))
    bags = [
        twodof.Bag(recording.bag(storage, kind), storage=storage, **options)
        for storage in STORAGES
        for kind, options in KINDS.items()
    ]
    twodof.simulate(run, recording.samples, *bags)
    return recording


# --- messages ---


@foreign_readers
@pytest.mark.parametrize("kind", ["plain", "effort"])
def test_bag_has_every_sample_bit_for_bit(recording, storage, read, kind):
    """It includes efforts if requested."""
    effort = kind == "effort"
    expected = [joint_state(k, s, effort=effort) for k, s in enumerate(recording.samples)]
    assert (len(expected), len(expected[0].effort)) == (501, 16 * effort)
    assert read(recording.bag(storage, kind)) == expected


class Pause(twodof.Sink):
    def write(self, sample: twodof.Sample) -> None:
        if sample.k == 100:
            time.sleep(0.2)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_reproducible_bytes_are_as_documented(storage, native_path, tmp_path, monkeypatch):
    """More flushes change only the storage file."""
    bags = []
    for name, period in (("seldom", 60.0), ("often", 0.01)):
        monkeypatch.setattr("twodof.bag.store.FLUSH_PERIOD", period)
        bags.append(tmp_path / name / "bag")
        bags[-1].parent.mkdir()
        bag = twodof.Bag(bags[-1], storage=storage, scene=True)
        twodof.simulate(native_path, Pause(), bag, stop_time=2.0, stamp_start=START)
    read = []
    for path in bags:
        with Reader(path) as reader:
            read.append([(c.topic, t, bytes(data)) for c, t, data in reader.messages()])
    assert read[0] == read[1] and len(read[0]) > 800
    files = {path.name: path.read_bytes() for path in bags[0].iterdir()}
    differing = {name for name in files if files[name] != (bags[1] / name).read_bytes()}
    assert {path.name for path in bags[1].iterdir()} == files.keys()
    assert differing == {"bag.mcap" if storage == "mcap" else "bag.db3"}


def test_first_stamp_is_the_wall_clock_by_default(native_path, tmp_path):
    before = time.time_ns()
    twodof.simulate(native_path, twodof.Bag(tmp_path / "bag"), stop_time=0.01)
    first, second = (state.stamp for state in read_with_rosbags(tmp_path / "bag"))
    assert before <= first <= time.time_ns()
    assert second - first == PERIOD


def test_start_of_the_stamps_is_exact(native_path, tmp_path):
    bag = twodof.Bag(tmp_path / "bag")
    twodof.simulate(native_path, bag, stop_time=0.01, stamp_start=START + 0.25)
    assert read_with_rosbags(tmp_path / "bag")[0].stamp == START * SECOND + SECOND // 4


@pytest.mark.parametrize("start", [-1.0, 2.0**31 - 3, float("nan"), float("inf"), 1e308])
def test_stamp_out_of_the_range_of_ros_is_refused(native_path, start):
    """This includes the last sample's stamp."""
    with pytest.raises(InputError, match="stamp"):
        twodof.experiment(native_path, stop_time=5.0, stamp_start=start)


@pytest.mark.parametrize("now", [-1, (2**31) * SECOND])
def test_wall_clock_out_of_the_range_of_ros_is_refused(native_path, now, monkeypatch):
    monkeypatch.setattr(time, "time_ns", lambda: now)
    with pytest.raises(InputError, match="from the wall clock on with a duration of 5 s are not within 1970 to 2038"):
        twodof.experiment(native_path)


# --- metadata and storages ---


@both_storages
def test_metadata_describes_the_bag(recording, storage):
    found = metadata(recording.bag(storage))
    file = f"{storage}_plain.{'mcap' if storage == 'mcap' else 'db3'}"
    whole = {
        "duration": {"nanoseconds": 5 * SECOND},
        "starting_time": {"nanoseconds_since_epoch": START * SECOND},
        "message_count": 501,
    }
    files = {path.name for path in recording.bag(storage).iterdir()}
    assert files == {file, "metadata.yaml", "run.json"}
    assert found["version"] == 8
    assert found["storage_identifier"] == storage
    assert found["relative_file_paths"] == [file]
    assert {key: found[key] for key in whole} == whole
    assert found["compression_format"] == found["compression_mode"] == ""
    assert found["files"] == [{"path": file, **whole}]
    (topic,) = found["topics_with_message_count"]
    assert topic["message_count"] == 501
    assert topic["topic_metadata"]["name"] == "/joint_states"
    assert topic["topic_metadata"]["serialization_format"] == "cdr"


@both_storages
def test_topics_have_the_type_hashes_that_ros_publishes(recording, storage):
    bag = recording.bag(storage, "scene")
    topics = [topic["topic_metadata"] for topic in metadata(bag)["topics_with_message_count"]]
    assert {topic["type"] for topic in topics} == set(TYPE_HASHES)
    for topic in topics:
        assert topic["type_description_hash"] == TYPE_HASHES[topic["type"]]
    if storage == "sqlite3":
        with sqlite3.connect(bag / f"{bag.name}.db3") as database:
            for table, kind in (("topics", "type"), ("message_definitions", "topic_type")):
                rows = database.execute(f"SELECT {kind}, type_description_hash FROM {table}")
                assert dict(rows.fetchall()) == TYPE_HASHES


@both_storages
def test_topics_have_the_quality_of_service_that_subscribers_expect(recording, storage):
    # numbers of rmw/types.h: keep last 1, reliable 1, transient local 1, volatile 2
    expected = {
        "/joint_states": {"history": 1, "depth": 10, "reliability": 1, "durability": 2},
        "/robot_description": {"history": 1, "depth": 1, "reliability": 1, "durability": 1},
        "/tf_static": {"history": 1, "depth": 1, "reliability": 1, "durability": 1},
        "/tf": {"history": 1, "depth": 100, "reliability": 1, "durability": 2},
        "/target": {"history": 1, "depth": 10, "reliability": 1, "durability": 2},
        "/end_effector": {"history": 1, "depth": 10, "reliability": 1, "durability": 2},
    }
    bag = recording.bag(storage, "scene")
    texts = {
        topic["topic_metadata"]["name"]: topic["topic_metadata"]["offered_qos_profiles"]
        for topic in metadata(bag)["topics_with_message_count"]
    }
    found = {}
    for topic, text in texts.items():
        (profile,) = YAML(typ="safe").load(text)  # a text up to version 8, a list from 9 on
        found[topic] = {key: profile[key] for key in expected["/joint_states"]}
    assert found == expected

    if storage == "mcap":
        with (bag / f"{bag.name}.mcap").open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        channels = summary.channels.values()
        stored = {c.topic: c.metadata["offered_qos_profiles"] for c in channels}
    else:
        with sqlite3.connect(bag / f"{bag.name}.db3") as database:
            rows = database.execute("SELECT name, offered_qos_profiles FROM topics")
            stored = dict(rows.fetchall())
    assert stored == texts


def test_mcap_has_the_profile_and_the_index_that_rosbag2_expects(recording):
    with (recording.bag("mcap") / "mcap_plain.mcap").open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        records = {record.name: record.metadata for record in reader.iter_metadata()}
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == 501
    assert summary.statistics.message_start_time == START * SECOND
    assert summary.statistics.message_end_time == (START + 5) * SECOND
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 0
    (channel,) = summary.channels.values()
    assert (channel.topic, channel.message_encoding) == ("/joint_states", "cdr")
    schema = summary.schemas[channel.schema_id]
    assert (schema.name, schema.encoding) == ("sensor_msgs/msg/JointState", "ros2msg")
    embedded = YAML(typ="safe").load(records["rosbag2"]["serialized_metadata"])
    assert embedded == metadata(recording.bag("mcap"))


def test_sqlite3_has_the_tables_that_rosbag2_expects(recording):
    # schema 4 of rosbag2_storage_sqlite3
    columns = {
        "schema": ["schema_version", "ros_distro"],
        "metadata": ["id", "metadata_version", "metadata"],
        "topics": ["id", "name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash"],
        "message_definitions": ["id", "topic_type", "encoding", "encoded_message_definition", "type_description_hash"],
        "messages": ["id", "topic_id", "timestamp", "data"],
    }
    with sqlite3.connect(recording.bag("sqlite3") / "sqlite3_plain.db3") as database:
        names = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        tables = [name for (name,) in names if not name.startswith("sqlite_")]
        found = {table: [row[1] for row in database.execute(f"PRAGMA table_info({table})")] for table in tables}
        versions = database.execute("SELECT schema_version FROM schema").fetchall()
        ((version, embedded),) = database.execute("SELECT metadata_version, metadata FROM metadata")
    assert found == columns
    assert versions == [(4,)]
    assert version == 8
    assert YAML(typ="safe").load(embedded) == metadata(recording.bag("sqlite3"))


# --- reading back ---


@both_storages
def test_read_bag_returns_the_written_samples(recording, storage):
    found = twodof.read_bag(recording.bag(storage, "effort"))
    assert found.joints == ("joint1", "joint2")
    np.testing.assert_array_equal(found.stamps, START * SECOND + PERIOD * np.arange(501))
    np.testing.assert_array_equal(found.t, np.arange(501) / 100)
    np.testing.assert_array_equal(found.q, [s.q for s in recording.samples])
    np.testing.assert_array_equal(found.v, [s.v for s in recording.samples])
    np.testing.assert_array_equal(found.tau, [s.tau for s in recording.samples])
    text = (recording.bag(storage, "effort") / "run.json").read_text("utf-8")
    assert found.provenance == json.loads(text)
    assert [(topic.name, topic.type, topic.count) for topic in found.topics] == [
        ("/joint_states", "sensor_msgs/msg/JointState", 501)
    ]


def test_read_bag_gives_no_effort_where_there_is_none(recording):
    assert twodof.read_bag(recording.bag("mcap")).tau.shape == (501, 0)


def write_states(path: Path, states: Sequence[tuple[Sequence[str], Sequence[float]]]) -> Path:
    """Write joint states with names and positions, a little more than a second apart."""
    times = [k * SECOND + 5 for k in range(len(states))]
    messages = [joint_message(t, *state, [0.0] * len(state[0])) for t, state in zip(times, states)]
    hello = STORE.types["std_msgs/msg/String"]("hello")
    given = [("/robot/joint_states", t, message) for t, message in zip(times, messages)]
    return write_third_party(path, [("/chatter", 1, hello), *given], storage_plugin=StoragePlugin.SQLITE3)


def test_third_party_bag_is_read_without_provenance(tmp_path):
    states = [(["a", "b", "c"], [k, k + 0.1, k + 0.2]) for k in range(4)]
    found = twodof.read_bag(write_states(tmp_path / "bag", states))
    assert found.provenance == {}
    assert found.joints == ("a", "b", "c")
    np.testing.assert_array_equal(found.stamps, [5, SECOND + 5, 2 * SECOND + 5, 3 * SECOND + 5])
    np.testing.assert_array_equal(found.q, [position for _, position in states])
    assert [topic.name for topic in found.topics] == ["/chatter", "/robot/joint_states"]


@pytest.mark.parametrize("other", [["a", "b", "c"], ["b", "a"], ["c", "d"]])
def test_bag_whose_joint_states_name_different_joints_is_refused(tmp_path, other):
    states = [(["a", "b"], [0.0, 1.0]), (other, [2.0] * len(other))]
    with pytest.raises(BagError, match="joint states of different joints"):
        twodof.read_bag(write_states(tmp_path / "bag", states))


@pytest.mark.parametrize(("frames", "known"), [("aaa", "a"), (["a", "a", "bb"], ""), (["a", "a", "b" * 9], "")])
def test_targets_are_known_where_they_are_in_one_frame(tmp_path, frames, known):
    point = STORE.types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0)
    targets = [STORE.types["geometry_msgs/msg/PointStamped"](header(0, f), point) for f in frames]
    states = [joint_message(0, "j", [0.0], [0.0]) for _ in frames]
    messages = [
        (topic, k, message)
        for topic, parts in (("/joint_states", states), ("/target", targets))
        for k, message in enumerate(parts)
    ]
    heard = twodof.read_bag(write_third_party(tmp_path / "bag", messages)).received
    assert (heard.frame if heard else "") == known


def joint_states_of_another_writer(rng: np.random.Generator) -> Iterator[tuple[int, bytes]]:
    """Make messages of three joints with frames of any length, stamps in any order and either byte order.

    CDR's padding is random; it is the bytes in which two serialisations differ.
    """
    for k in rng.permutation(60).tolist():
        frame, names = "x" * (k // 10), ["a", "joint2", "ö"]
        state = joint_message(k * SECOND, names, rng.random(3), rng.random(3), frame=frame)
        data = bytearray(serialised(state, little_endian=k % 7 != 0))
        end = 16 + len(frame) + 1
        for text in ("", *names):  # the frame is before the list, whose length needs no gap
            end += (4 + len(text.encode()) + 1) if text else 0
            gap = -end % 4
            data[end : end + gap] = rng.bytes(gap)
            end += gap + (0 if text else 4)
        yield k * SECOND, bytes(data)


def test_joint_states_of_any_form_are_read_as_by_rosbags(tmp_path):
    kind = "sensor_msgs/msg/JointState"
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/joint_states", kind, typestore=STORE)
        for stamp, data in joint_states_of_another_writer(np.random.default_rng(0)):
            writer.write(connection, stamp, data)
    expected = read_with_rosbags(tmp_path / "bag")
    found = twodof.read_bag(tmp_path / "bag")
    assert found.joints == ("a", "joint2", "ö") and len(expected) == 60
    for i, state in enumerate(sorted(expected)):
        q, v = found.q[i].tobytes(), found.v[i].tobytes()
        assert (found.stamps[i], q, v) == (state.log_time, state.position, state.velocity)
    ends = read_ends(tmp_path / "bag")
    assert ends.count == found.count == 60
    np.testing.assert_array_equal(ends.stamps, found.stamps[[0, -1]])
    np.testing.assert_array_equal(ends.q, found.q[[0, -1]])
    np.testing.assert_array_equal(ends.v, found.v[[0, -1]])


def test_bag_without_joint_states_is_refused(tmp_path):
    with pytest.raises(BagError, match="has no joint states"):
        twodof.read_bag(write_states(tmp_path / "bag", []))


@pytest.mark.parametrize("content", [None, "folder", "file", "nonsense"])
def test_a_path_that_is_not_a_bag_is_refused(tmp_path, content):
    path = tmp_path / "bag"
    if content == "file":
        path.write_text("hello")
    elif content is not None:
        path.mkdir()
    if content == "nonsense":
        (path / "metadata.yaml").write_text("hello: [")
    with pytest.raises(
        BagError, match=r"cannot read the bag '.*bag'|there is no bag '.*bag'|bag' is not a bag(: it is|; make one)"
    ):
        twodof.read_bag(path)


def test_definitions_are_those_of_humble():
    from twodof.ros.messages import DEFINITIONS, store_of

    foreign = [name for name in DEFINITIONS if name.startswith("pal_")]  # those of PAL are in no distribution
    for name in reversed([name for name in DEFINITIONS if name not in foreign]):  # what is made of others first
        ours = store_of(name)
        assert ours.fielddefs[name][1] == STORE.fielddefs[name][1]
        assert ours.hash_rihs01(name) == STORE.hash_rihs01(name)
        assert ours.generate_msgdef(name) == STORE.generate_msgdef(name)


def test_a_chunk_and_its_index_are_those_of_rosbags(tmp_path):
    written = []
    for kind in (McapWriter, McapStorage):
        folder = tmp_path / kind.__name__ / "bag"
        folder.mkdir(parents=True)
        storage = kind(folder, CompressionMode.NONE)
        storage.channel_stats = {1: 0, 2: 0}
        for chunk in range(2):
            for k in range(7):
                topic: Any = SimpleNamespace(id=1 + k % 2)
                storage.write(topic, START + 100 * chunk + k, b"message" * k)
            storage.close_chunk()
        storage.bio.close()
        indices = [index.getvalue() for index in storage.chunks]
        written.append((storage.path.read_bytes(), indices))
        assert [index.tell() for index in storage.chunks] == [*map(len, indices)]
    assert written[0] == written[1]
