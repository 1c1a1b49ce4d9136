"""Bags, read back by readers and compared with truths that this package did not write.

Readers are rosbags', the MCAP project's own and the standard library's sqlite3; the end effector's
path is a closed form; type hashes are those that ROS 2 publishes.
"""

from __future__ import annotations

import fcntl
import importlib.metadata
import json
import math
import os
import re
import shutil
import sqlite3
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Timer
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import oracles
import pytest
from bags import (
    PERIOD,
    SECOND,
    START,
    STORAGES,
    STORE,
    JointState,
    assert_consistent,
    both_storages,
    foreign_readers,
    joint_state,
    metadata,
    read_with_rosbags,
    read_with_sqlite3,
    sample,
)
from harness import wait_until
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionMode
from rosbags.rosbag2.storage_mcap import McapWriter
from ruamel.yaml import YAML
from sinks import Collector

import twodof
from twodof.bag.reader import read_ends
from twodof.bag.storage import BagWriter, McapStorage
from twodof.errors import BagError, InputError
from twodof.files import is_being_written
from twodof.simulation.experiments import Experiment
from twodof.simulation.sample import Sample

KIB, MIB = 1024, 1024**2

# As in the code that ROS 2 generates from the definitions: *__description.c of each message.
TYPE_HASHES = {
    "sensor_msgs/msg/JointState": (
        "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
    ),
    "std_msgs/msg/String": (
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    ),
    "tf2_msgs/msg/TFMessage": (
        "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
    ),
    "geometry_msgs/msg/PointStamped": (
        "RIHS01_4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897"
    ),
}


class Recording(NamedTuple):
    run: Experiment
    samples: list[Sample]
    folder: Path

    def bag(self, storage: str, kind: str = "plain") -> Path:
        return self.folder / f"{storage}_{kind}"


KINDS: dict[str, dict[str, Any]] = {
    "plain": {},
    "effort": {"effort": True},
    "scene": {"scene": True},
}


@pytest.fixture(scope="module")
def recording(fmu_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The default run, written to all kinds of bags at once."""
    run = twodof.experiment(fmu_path, stamp_start=START)
    recording = Recording(run, Collector(), tmp_path_factory.mktemp("bags"))
    bags = [
        twodof.Bag(recording.bag(storage, kind), storage=storage, **options)
        for storage in STORAGES
        for kind, options in KINDS.items()
    ]
    twodof.simulate(run, recording.samples, *bags)
    return recording


@pytest.fixture(scope="module")
def run(fmu_path: Path) -> Experiment:
    return twodof.experiment(fmu_path)


# --- messages ---


@foreign_readers
def test_bag_has_every_sample_bit_for_bit(
    recording: Recording, storage: str, read: Callable[[Path], list[JointState]]
) -> None:
    expected = [joint_state(k, s) for k, s in enumerate(recording.samples)]
    assert len(expected) == 501
    assert read(recording.bag(storage)) == expected


@foreign_readers
def test_effort_is_that_of_the_samples_where_asked_for(
    recording: Recording, storage: str, read: Callable[[Path], list[JointState]]
) -> None:
    expected = [joint_state(k, s, effort=True) for k, s in enumerate(recording.samples)]
    assert len(expected[0].effort) == 16
    assert read(recording.bag(storage, "effort")) == expected


@foreign_readers
def test_end_effector_follows_the_closed_form(
    recording: Recording, storage: str, read: Callable[[Path], list[JointState]]
) -> None:
    states = read(recording.bag(storage))
    q = np.array([np.frombuffer(state.position) for state in states])
    t = np.array([state.stamp - START * SECOND for state in states]) / SECOND
    target = np.array([0.2, 0.05])
    error = oracles.task_error(target - oracles.position(np.array([0.5, 0.35])), 50.0, 40.0, t)
    np.testing.assert_allclose(oracles.position(q), target - error, rtol=0.0, atol=1e-9)


def test_first_stamp_is_the_wall_clock_by_default(native_path: Path, tmp_path: Path) -> None:
    before = time.time_ns()
    twodof.simulate(native_path, twodof.Bag(tmp_path / "bag"), stop_time=0.01)
    first, second = (state.stamp for state in read_with_rosbags(tmp_path / "bag"))
    assert before <= first <= time.time_ns()
    assert second - first == PERIOD


def test_start_of_the_stamps_is_exact(native_path: Path, tmp_path: Path) -> None:
    bag = twodof.Bag(tmp_path / "bag")
    twodof.simulate(native_path, bag, stop_time=0.01, stamp_start=START + 0.25)
    assert read_with_rosbags(tmp_path / "bag")[0].stamp == START * SECOND + SECOND // 4


@pytest.mark.parametrize("start", [-1.0, 2.0**31, float("nan"), float("inf")])
def test_stamp_out_of_the_range_of_ros_is_refused(native_path: Path, start: float) -> None:
    with pytest.raises(InputError, match="stamp"):
        twodof.experiment(native_path, stamp_start=start)


def test_run_whose_last_stamp_is_out_of_range_is_refused(native_path: Path) -> None:
    with pytest.raises(InputError, match="stamp"):
        twodof.experiment(native_path, stop_time=5.0, stamp_start=2**31 - 3)


@pytest.mark.parametrize("now", [-1, (2**31) * SECOND, 2**63, 2**70])
def test_wall_clock_out_of_the_range_of_ros_is_refused(
    native_path: Path, now: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "time_ns", lambda: now)
    with pytest.raises(InputError, match="from the wall clock on are not those of 1970 to 2038"):
        twodof.experiment(native_path)


# --- metadata and storages ---


@both_storages
def test_metadata_describes_the_bag(recording: Recording, storage: str) -> None:
    found = metadata(recording.bag(storage))
    suffix = {"mcap": "mcap", "sqlite3": "db3"}[storage]
    assert found["version"] == 8
    assert found["storage_identifier"] == storage
    assert found["relative_file_paths"] == [f"{storage}_plain.{suffix}"]
    assert found["duration"] == {"nanoseconds": 5 * SECOND}
    assert found["starting_time"] == {"nanoseconds_since_epoch": START * SECOND}
    assert found["message_count"] == 501
    assert found["compression_format"] == found["compression_mode"] == ""
    assert found["files"] == [
        {
            "path": f"{storage}_plain.{suffix}",
            "duration": {"nanoseconds": 5 * SECOND},
            "starting_time": {"nanoseconds_since_epoch": START * SECOND},
            "message_count": 501,
        }
    ]
    (topic,) = found["topics_with_message_count"]
    assert topic["message_count"] == 501
    assert topic["topic_metadata"]["name"] == "/joint_states"
    assert topic["topic_metadata"]["serialization_format"] == "cdr"


@both_storages
def test_bag_folder_has_nothing_else(recording: Recording, storage: str) -> None:
    data = {"mcap": "mcap_plain.mcap", "sqlite3": "sqlite3_plain.db3"}[storage]
    files = {path.name for path in recording.bag(storage).iterdir()}
    assert files == {data, "metadata.yaml", "run.json"}


@both_storages
def test_topics_have_the_type_hashes_that_ros_publishes(recording: Recording, storage: str) -> None:
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
def test_topics_have_the_quality_of_service_that_subscribers_expect(
    recording: Recording, storage: str
) -> None:
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


def test_mcap_has_the_profile_and_the_index_that_rosbag2_expects(recording: Recording) -> None:
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


def test_sqlite3_has_the_tables_that_rosbag2_expects(recording: Recording) -> None:
    # schema 4 of rosbag2_storage_sqlite3
    columns = {
        "schema": ["schema_version", "ros_distro"],
        "metadata": ["id", "metadata_version", "metadata"],
        "topics": [
            "id",
            "name",
            "type",
            "serialization_format",
            "offered_qos_profiles",
            "type_description_hash",
        ],
        "message_definitions": [
            "id",
            "topic_type",
            "encoding",
            "encoded_message_definition",
            "type_description_hash",
        ],
        "messages": ["id", "topic_id", "timestamp", "data"],
    }
    with sqlite3.connect(recording.bag("sqlite3") / "sqlite3_plain.db3") as database:
        names = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        tables = [name for (name,) in names if not name.startswith("sqlite_")]
        found = {
            table: [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
            for table in tables
        }
        versions = database.execute("SELECT schema_version FROM schema").fetchall()
        ((version, embedded),) = database.execute("SELECT metadata_version, metadata FROM metadata")
    assert found == columns
    assert versions == [(4,)]
    assert version == 8
    assert YAML(typ="safe").load(embedded) == metadata(recording.bag("sqlite3"))


# --- provenance ---


@both_storages
def test_provenance_is_complete(fmu_path: Path, tmp_path: Path, storage: str) -> None:
    inputs = tmp_path / "inputs.csv"
    inputs.write_text("time,x_des[1],x_des[2]\n0.02,0.25,0.1\n0.05,0.2,0.05\n")
    run = twodof.experiment(
        fmu_path, stop_time=0.1, step=0.005, settings={"Kp": 80.0}, input_file=inputs
    )
    command_line = "twodof run --set Kp=80 --input inputs.csv"
    bag = twodof.Bag(tmp_path / "bag", storage=storage, command_line=command_line)
    twodof.simulate(run, bag)

    with zipfile.ZipFile(fmu_path) as fmu:
        description = ET.fromstring(fmu.read("modelDescription.xml"))
        urdf = fmu.read("resources/robot.urdf").decode()
    starts: dict[str, float | bool] = {}
    for variable in description.iter("ScalarVariable"):
        if variable.get("causality") in ("input", "parameter"):
            text = variable[0].get("start", "")
            starts[variable.get("name", "")] = (
                text == "true" if variable[0].tag == "Boolean" else float(text)
            )
    assert {"x_des[1]", "Kd[2]", "tau_ext[1]", "Kn", "q_max[2]", "limit_effort"} <= set(starts)

    found = json.loads((tmp_path / "bag" / "run.json").read_text("utf-8"))
    versions = found.pop("versions")
    assert versions.pop("twodof") == twodof.__version__
    assert set(versions) >= {"fmpy", "numpy", "pin", "rosbags"}
    assert versions == {name: importlib.metadata.version(name) for name in versions}
    assert found == {
        "format": 1,
        "fmu": {"name": "TwoDof", "guid": description.get("guid"), "file": fmu_path.name},
        "robot": "2dof",
        "frame": "EndEffector",
        "root": "world",
        "axes": "xy",
        "joints": ["joint1", "joint2"],
        "start_time": 0.0,
        "step": 0.005,
        "start_values": {**starts, "Kp[1]": 80.0, "Kp[2]": 80.0},
        "input_changes": [
            [0.02, {"x_des[1]": 0.25, "x_des[2]": 0.1}],
            [0.05, {"x_des[1]": 0.2, "x_des[2]": 0.05}],
        ],
        "command_line": command_line,
        "urdf": urdf,
    }


ANSWERS = {2: {"x_des": (0.1, 0.2)}, 4: {"Kp[2]": 80.0}, 5: {"Kp[2]": 80.0}}
CHANGES = [[0.02, {"x_des[1]": 0.1, "x_des[2]": 0.2}], [0.04, {"Kp[2]": 80.0}]]


@both_storages
@pytest.mark.parametrize("every", [1, 3], ids=["every sample", "every third"])
def test_provenance_has_each_change_of_an_input_that_a_loop_sends(
    native_path: Path, tmp_path: Path, storage: str, every: int
) -> None:
    run = twodof.experiment(native_path, stop_time=math.inf)
    steps = twodof.samples(run)
    with twodof.Bag(tmp_path / "bag", storage=storage).begin(run) as bag:
        sample = next(steps)
        while sample.k < 9:
            if sample.k % every == 0:
                bag.write(sample)
            sample = steps.send(ANSWERS.get(sample.k))
    provenance = twodof.read_bag(tmp_path / "bag").provenance
    assert provenance == json.loads(metadata(tmp_path / "bag")["custom_data"]["twodof"])
    assert provenance["input_changes"] == CHANGES


def test_changes_of_inputs_are_stored_with_the_messages_that_they_caused(
    native_path: Path, tmp_path: Path
) -> None:
    """At each flush, so that they survive the death of the process."""
    run = twodof.experiment(native_path, stop_time=math.inf)
    steps = twodof.samples(run)
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        sample = next(steps)
        for k in range(9):
            bag.write(sample)
            sample = steps.send(ANSWERS.get(k))
        shutil.copytree(bag.path, tmp_path / "early")
        there = bag.path / "run.json"
        wait_until(lambda: json.loads(there.read_text())["input_changes"] == CHANGES)
    assert json.loads((tmp_path / "early" / "run.json").read_text())["input_changes"] in (
        CHANGES[:0], CHANGES[:1], CHANGES,
    )  # fmt: skip


def test_provenance_says_where_it_was_full(
    run: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twodof.bag.provenance.MAX_SIZE", 20_000)
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        for k in range(1000):
            inputs = {"x_des[1]": k / 7}
            bag.write(sample(run, k)._replace(inputs=inputs, since=(k - 1) / 100))
            if k % 250 == 0:
                time.sleep(0.6)  # a flush
    text = (tmp_path / "bag" / "run.json").read_text()
    provenance = json.loads(text)
    changes = provenance["input_changes"]
    assert len(text) <= 20_000
    assert 0 < len(changes) < 999
    assert provenance["inputs_known_until"] == round(changes[-1][0] * 100 + 1) / 100


def test_custom_data_leaves_out_changes_that_take_yaml_minutes(
    run: Experiment, tmp_path: Path
) -> None:
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        for k in range(20_000):
            inputs = {"x_des[1]": k / 7}
            bag.write(sample(run, k)._replace(inputs=inputs, since=(k - 1) / 100))
    custom = json.loads(metadata(tmp_path / "bag")["custom_data"]["twodof"])
    assert (custom["input_changes"], custom["inputs_known_until"]) == ([], 0.0)
    assert len(twodof.read_bag(tmp_path / "bag").provenance["input_changes"]) == 20_000


def test_custom_data_is_the_provenance_wherever_yaml_breaks_its_lines(
    run: Experiment, tmp_path: Path
) -> None:
    damaged = []
    for n in range(0, 80, 3):
        path = tmp_path / f"bag{n}"
        with twodof.Bag(path, command_line=f"{'x' * n} --set 'Kp=80'").begin(run) as bag:
            bag.write(sample(run, 0))
        custom = metadata(path)["custom_data"]["twodof"]
        try:
            equal = json.loads(custom) == json.loads((path / "run.json").read_text("utf-8"))
        except ValueError:
            equal = False
        if not equal:
            damaged.append(n)
    assert damaged == []


@both_storages
def test_provenance_is_there_before_the_first_message(
    run: Experiment, tmp_path: Path, storage: str
) -> None:
    file = tmp_path / "bag" / "run.json"
    with twodof.Bag(tmp_path / "bag", storage=storage).begin(run) as bag:
        before = file.read_bytes()
        bag.write(sample(run, 0))
    assert json.loads(before)["fmu"]["guid"] == run.fmu.guid
    assert file.read_bytes() == before


# --- reading back ---


@both_storages
def test_read_bag_gives_back_what_was_written(recording: Recording, storage: str) -> None:
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


def test_read_bag_gives_no_effort_where_there_is_none(recording: Recording) -> None:
    assert twodof.read_bag(recording.bag("mcap")).tau.shape == (501, 0)


def write_elsewhere(
    path: Path, states: Sequence[tuple[Sequence[str], Sequence[float]]], topic: str
) -> None:
    """A bag written with rosbags alone: names and positions of each joint state."""
    header = STORE.types["std_msgs/msg/Header"]
    stamp_type = STORE.types["builtin_interfaces/msg/Time"]
    kind = "sensor_msgs/msg/JointState"
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        text = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=STORE)
        hello = STORE.types["std_msgs/msg/String"]("hello")
        writer.write(text, 1, STORE.serialize_cdr(hello, "std_msgs/msg/String"))
        if topic:
            connection = writer.add_connection(topic, kind, typestore=STORE)
        for k, (names, position) in enumerate(states):
            message = STORE.types[kind](
                header=header(stamp=stamp_type(sec=k, nanosec=5), frame_id="base"),
                name=list(names),
                position=np.array(position, dtype=np.float64),
                velocity=np.zeros(len(position)),
                effort=np.array([]),
            )
            writer.write(connection, k * SECOND + 5, STORE.serialize_cdr(message, kind))


def test_bag_from_elsewhere_is_read_without_provenance(tmp_path: Path) -> None:
    names = ["a", "b", "c"]
    states = [(names, [k, k + 0.1, k + 0.2]) for k in range(4)]
    write_elsewhere(tmp_path / "bag", states, "/robot/joint_states")
    found = twodof.read_bag(tmp_path / "bag")
    assert found.provenance == {}
    assert found.joints == ("a", "b", "c")
    np.testing.assert_array_equal(found.stamps, [5, SECOND + 5, 2 * SECOND + 5, 3 * SECOND + 5])
    np.testing.assert_array_equal(found.q, [position for _, position in states])
    assert [topic.name for topic in found.topics] == ["/chatter", "/robot/joint_states"]


@pytest.mark.parametrize("other", [["a", "b", "c"], ["b", "a"], ["c", "d"]])
def test_bag_whose_joint_states_name_different_joints_is_refused(
    tmp_path: Path, other: list[str]
) -> None:
    states = [(["a", "b"], [0.0, 1.0]), (other, [2.0] * len(other))]
    write_elsewhere(tmp_path / "bag", states, "/joint_states")
    with pytest.raises(BagError, match="bag"):
        twodof.read_bag(tmp_path / "bag")


def joint_states_of_another_writer(rng: np.random.Generator) -> Iterator[tuple[int, bytes]]:
    """Of three joints, in frames of any length, with stamps in any order, either byte order, and
    anything in the gaps that CDR leaves: for these, the bytes that two serialisations differ in."""
    kind = "sensor_msgs/msg/JointState"
    header, time = STORE.types["std_msgs/msg/Header"], STORE.types["builtin_interfaces/msg/Time"]
    for k in rng.permutation(60).tolist():
        frame, names = "x" * (k // 10), ["a", "joint2", "ö"]
        state = STORE.types[kind](
            header(time(k, 0), frame), names, rng.random(3), rng.random(3), np.array([])
        )
        data = bytearray(STORE.serialize_cdr(state, kind, little_endian=k % 7 != 0))
        end = 16 + len(frame) + 1
        for text in ("", *names):  # the frame is before the list, whose length needs no gap
            end += (4 + len(text.encode()) + 1) if text else 0
            gap = -end % 4
            data[end : end + gap] = rng.bytes(gap)
            end += gap + (0 if text else 4)
        yield k * SECOND, bytes(data)


def test_joint_states_are_read_as_rosbags_reads_them_in_whatever_form(tmp_path: Path) -> None:
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


def test_bag_without_joint_states_topic_is_refused(tmp_path: Path) -> None:
    write_elsewhere(tmp_path / "bag", [], "")
    with pytest.raises(BagError, match="has no joint states"):
        twodof.read_bag(tmp_path / "bag")


def test_bag_without_messages_is_refused(tmp_path: Path) -> None:
    write_elsewhere(tmp_path / "bag", [], "/joint_states")
    with pytest.raises(BagError, match="has no joint states"):
        twodof.read_bag(tmp_path / "bag")


@pytest.mark.parametrize("content", [None, "folder", "file", "nonsense"])
def test_what_is_no_bag_is_refused(tmp_path: Path, content: str | None) -> None:
    path = tmp_path / "bag"
    if content == "file":
        path.write_text("hello")
    elif content is not None:
        path.mkdir()
    if content == "nonsense":
        (path / "metadata.yaml").write_text("hello: [")
    with pytest.raises(BagError, match="cannot read the bag"):
        twodof.read_bag(path)


@both_storages
def test_damaged_bag_is_read_or_refused(run: Experiment, tmp_path: Path, storage: str) -> None:
    with twodof.Bag(tmp_path / "bag", storage=storage).begin(run) as bag:
        for k in range(200):
            bag.write(sample(run, k))
    (file,) = [*(tmp_path / "bag").glob("*.mcap"), *(tmp_path / "bag").glob("*.db3")]
    whole = file.read_bytes()
    random = np.random.default_rng(0)
    damaged = [whole[: len(whole) * i // 10] for i in range(10)]
    for _ in range(40):
        content = bytearray(whole)
        for position in random.integers(0, len(whole), 20):
            content[position] ^= 0xFF
        damaged.append(bytes(content))
    surprises = []
    for content in damaged:
        file.write_bytes(content)
        try:
            twodof.read_bag(tmp_path / "bag")
        except BagError:
            pass
        except Exception as error:
            surprises.append(f"{type(error).__module__}.{type(error).__name__}: {error}")
    assert surprises == []


# --- where a bag may be written ---


@both_storages
def test_existing_bag_is_kept_unless_told_otherwise(
    run: Experiment, tmp_path: Path, storage: str
) -> None:
    path = tmp_path / "bag"
    with twodof.Bag(path, storage=storage).begin(run) as bag:
        bag.write(sample(run, 0))
    with pytest.raises(BagError, match="exists already"):
        twodof.Bag(path, storage=storage)
    assert len(read_with_rosbags(path)) == 1
    with twodof.Bag(path, storage=storage, overwrite=True).begin(run) as bag:
        for k in range(3):
            bag.write(sample(run, k))
    assert len(read_with_rosbags(path)) == 3


@pytest.mark.parametrize("moment", ["remove", "open", "add_connection"])
def test_of_two_that_overwrite_a_bag_at_once_one_is_refused(
    run: Experiment, tmp_path: Path, moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second comes just before the first removes the old bag, opens its own, adds a topic."""
    path = tmp_path / "bag"
    with twodof.Bag(path).begin(run):
        pass
    first, second = (twodof.Bag(path, overwrite=True).begin(run) for _ in range(2))
    place, name = (shutil, "rmtree") if moment == "remove" else (BagWriter, moment)
    original, begun = getattr(place, name), []

    def begin(bag: twodof.Bag) -> None:
        with suppress(BagError):
            begun.append(bag.__enter__())

    def intruded(*arguments: Any, **named: Any) -> Any:
        monkeypatch.setattr(place, name, original)
        begin(second)
        return original(*arguments, **named)

    monkeypatch.setattr(place, name, intruded)
    begin(first)
    (winner,) = begun
    for k in range(3):
        winner.write(sample(run, k))
    winner.__exit__(None, None, None)
    assert assert_consistent(path, "mcap") == 3


def test_bag_is_locked_though_another_looks_whether_it_is(
    run: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = BagWriter.open

    def looked_at(writer: BagWriter) -> None:
        opened(writer)
        folder = os.open(writer.path, os.O_RDONLY)
        fcntl.flock(folder, fcntl.LOCK_SH)
        Timer(0.2, os.close, [folder]).start()

    monkeypatch.setattr(BagWriter, "open", looked_at)
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        assert is_being_written(bag.path)


@pytest.mark.parametrize(
    "files",
    [
        {},
        {"notes.txt": "precious"},
        {"run.json": '{"learning_rate": 0.1}', "notes.txt": "precious"},
        {"metadata.yaml": "title: precious\n", "notes.txt": "precious"},
    ],
    ids=["empty", "other files", "another run.json", "another metadata.yaml"],
)
def test_folder_that_is_no_bag_is_never_overwritten(
    run: Experiment, tmp_path: Path, files: dict[str, str]
) -> None:
    path = tmp_path / "folder"
    path.mkdir()
    for name, text in files.items():
        (path / name).write_text(text)
    with (
        pytest.raises(BagError, match="not a bag"),
        twodof.Bag(path, overwrite=True).begin(run) as bag,
    ):
        bag.write(sample(run, 0))
    assert {file.name: file.read_text() for file in path.iterdir()} == files


def test_file_is_never_overwritten(run: Experiment, tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("precious")
    with pytest.raises(BagError, match="not a bag"):
        twodof.Bag(path, overwrite=True)
    assert path.read_text() == "precious"


@pytest.mark.parametrize("overwrite", [False, True])
def test_folder_that_appears_before_the_first_sample_is_kept(
    run: Experiment, tmp_path: Path, overwrite: bool
) -> None:
    path = tmp_path / "bag"
    bag = twodof.Bag(path, overwrite=overwrite).begin(run)
    path.mkdir()
    (path / "notes.txt").write_text("precious")
    with pytest.raises(BagError, match="bag"), bag:
        pass
    assert [file.name for file in path.iterdir()] == ["notes.txt"]


def test_bag_behind_a_link_is_not_lost(run: Experiment, tmp_path: Path) -> None:
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        bag.write(sample(run, 0))
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "bag")
    try:
        with twodof.Bag(link, overwrite=True).begin(run) as bag:
            bag.write(sample(run, 0))
    except BagError:
        pass  # refused, and fine so
    assert len(read_with_rosbags(tmp_path / "bag")) == 1


@both_storages
@pytest.mark.parametrize("place", ["below a file", "read-only", "long"])
def test_folder_that_cannot_be_written_is_refused(
    run: Experiment, tmp_path: Path, disk: Callable[..., Path], storage: str, place: str
) -> None:
    if place == "below a file":
        (tmp_path / "file").write_text("precious")
        path = tmp_path / "file" / "bag"
    elif place == "read-only":
        path = disk(4096, "ro") / "bag"
    else:
        path = tmp_path / ("x" * 300)
    before = sorted(tmp_path.rglob("*"))
    with (
        pytest.raises(BagError, match=re.escape(str(path))),
        twodof.Bag(path, storage=storage).begin(run),
    ):
        pass
    assert sorted(tmp_path.rglob("*")) == before


# --- runs that end early ---


@both_storages
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("n", [0, 137])
def test_exception_leaves_a_bag_with_every_sample_so_far(
    run: Experiment, tmp_path: Path, storage: str, error: type[BaseException], n: int
) -> None:
    path = tmp_path / "bag"
    bag = twodof.Bag(path, storage=storage).begin(run)
    with pytest.raises(error, match="enough"), bag:
        for k in range(n):
            bag.write(sample(run, k))
        raise error("enough")
    assert assert_consistent(path, storage) == n
    assert read_with_rosbags(path) == [joint_state(k, sample(run, k)) for k in range(n)]


def fill(bag: twodof.Bag, run: Experiment) -> tuple[str, int]:
    """Write until the disk is full; what the error says, and how many samples were taken."""
    taken = 0
    with pytest.raises(BagError) as caught, bag.begin(run):
        for k in range(200_000):
            bag.write(sample(run, k))
            taken += 1
    return str(caught.value), taken


@both_storages
@pytest.mark.parametrize("size", [2252, 2560, 3072, 4096])  # KiB: 2.2, 2.5, 3 and 4 MiB
def test_full_disk_ends_in_a_closed_bag_with_every_sample(
    run: Experiment, disk: Callable[..., Path], storage: str, size: int
) -> None:
    path = disk(size) / "bag"
    said, taken = fill(twodof.Bag(path, storage=storage), run)
    assert "disk is full" in said
    kept = assert_consistent(path, storage)
    assert taken - 1 <= kept <= taken  # one may be handed over while the bag is being closed
    assert f"closed with its first {kept} samples" in said
    assert read_with_rosbags(path) == [joint_state(k, sample(run, k)) for k in range(kept)]


@both_storages
def test_disk_too_small_to_begin_with_is_left_as_it_was(
    run: Experiment, disk: Callable[..., Path], storage: str
) -> None:
    refused = 0
    for size in (4, 8, 12, 16, 32, 512, *range(2048, 2128, 4)):
        path = disk(size) / "bag"
        try:
            with twodof.Bag(path, storage=storage).begin(run):
                pass
        except BagError as error:
            refused += 1
            assert re.search(r"full|No space", str(error))
            assert not path.exists()
        else:
            assert_consistent(path, storage)
    assert refused > 1


@both_storages
def test_reserve_is_room_to_close_a_run_that_was_never_flushed(
    run: Experiment, disk: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, storage: str
) -> None:
    monkeypatch.setattr("twodof.bag.store.FLUSH_PERIOD", 1e6)
    path = disk(2140) / "bag"  # 92 KiB beside the reserve; the messages take 140
    with twodof.Bag(path, storage=storage).begin(run) as bag:
        for k in range(1000):
            bag.write(sample(run, k))
    assert assert_consistent(path, storage) == 1000


# --- long runs ---


def test_messages_reach_the_disk_while_the_run_goes_on(run: Experiment, tmp_path: Path) -> None:
    mcap, sqlite = tmp_path / "mcap", tmp_path / "sqlite3"
    streamed, stored = [], []
    with (
        twodof.Bag(mcap).begin(run) as first,
        twodof.Bag(sqlite, storage="sqlite3").begin(run) as second,
    ):
        for k in range(2000):  # fewer than fill a buffer
            first.write(sample(run, k))
            second.write(sample(run, k))
            time.sleep(0.005)
            if k % 50 == 0:
                streamed = list(stream(mcap / "mcap.mcap"))
                stored = read_with_sqlite3(sqlite)
                if len(streamed) > 1 and len(stored) > 1:  # the first goes at once
                    break
        else:
            pytest.fail("nothing has reached the disk in 10 s")
    assert streamed == [START * SECOND + i * PERIOD for i in range(len(streamed))]
    assert stored == [joint_state(i, sample(run, i)) for i in range(len(stored))]


def stream(file: Path) -> Iterator[int]:
    """Log times of the messages of an MCAP file that may end anywhere."""
    with file.open("rb") as content:
        try:
            for record in StreamReader(content).records:
                if isinstance(record, McapMessage):
                    yield record.log_time
        except EndOfFile:
            return


MEMORY = """
import sys
import twodof
from sinks import Memory
from twodof.simulation.sample import Sample

fmu, path, storage = sys.argv[1:]
run = twodof.experiment(fmu)
inputs = {n: v for n, v in run.start_values.items() if run.fmu.variables[n].causality == "input"}
memory = Memory(1000)
with twodof.Bag(path, storage=storage).begin(run) as bag:
    for k in range(20_000):
        numbers = (0.1, 0.2), (0.3, 0.4), (0.5, 0.6), (0.7, 0.8)
        sample = Sample(k, run.time(k), *numbers, inputs, 0.0, k * 10_000_000)
        bag.write(sample)
        memory.write(sample)
print(memory.growth)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@both_storages
def test_memory_does_not_grow_with_the_run(fmu_path: Path, tmp_path: Path, storage: str) -> None:
    command = [sys.executable, "-c", MEMORY, str(fmu_path), str(tmp_path / "bag"), storage]
    done = subprocess.run(
        command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 5 * MIB
    assert assert_consistent(tmp_path / "bag", storage) == 20_000


def test_definitions_are_those_of_humble() -> None:
    from twodof.ros.messages import DEFINITIONS, store_of

    for name in reversed(DEFINITIONS):  # what is made of others first
        ours = store_of(name)
        assert ours.fielddefs[name][1] == STORE.fielddefs[name][1]
        assert ours.hash_rihs01(name) == STORE.hash_rihs01(name)
        assert ours.generate_msgdef(name) == STORE.generate_msgdef(name)


def test_a_chunk_and_its_index_are_those_of_rosbags(tmp_path: Path) -> None:
    written = []
    for kind in (McapWriter, McapStorage):
        folder = tmp_path / kind.__name__ / "bag"
        folder.mkdir(parents=True)
        storage = kind(folder, CompressionMode.NONE)
        storage.channel_stats = {1: 0, 2: 0}
        for chunk in range(2):
            for k in range(7):
                topic = SimpleNamespace(id=1 + k % 2)
                storage.write(topic, START + 100 * chunk + k, b"message" * k)
            storage.close_chunk()
        storage.bio.close()
        indices = [index.getvalue() for index in storage.chunks]
        written.append((storage.path.read_bytes(), indices))
        assert [index.tell() for index in storage.chunks] == [*map(len, indices)]
    assert written[0] == written[1]
