"""Writers of bags with artificial samples, and independent readers of bags.

Readers are rosbags', the MCAP project's own and the standard library's sqlite3.
"""

import shutil
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from harness import wait_until
from mcap.reader import make_reader
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from numpy.typing import NDArray
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, Writer
from rosbags.typesys import Stores, get_typestore

import twodof
from twodof.bag.reader import read_all_ends
from twodof.simulation.experiments import Experiment
from twodof.simulation.sample import Sample

STORAGES = ("mcap", "sqlite3")
START = 1_700_000_000  # s since the epoch
SECOND = 1_000_000_000  # ns
PERIOD = 10_000_000  # ns, the default communication step
STORE = get_typestore(Stores.ROS2_HUMBLE)


LOGGER = """
import mmap, sys, time
import numpy as np
import twodof

fmu, bag, storage, clock, start = sys.argv[1:]

class Clock(twodof.Sink):
    \"""When there was each sample, by the time in which the process ran, where it outlives it.

    What is longer than two periods from one to the next is no pace of it, but the machine's.
    \"""

    def __enter__(self):
        self.times, self.t, self.before = np.memmap(clock, "<f8", "r+"), 1.0, time.monotonic()
        return self

    def write(self, sample):
        now = time.monotonic()
        self.t, self.before = self.t + min(now - self.before, 0.02), now
        self.times[sample.k] = self.t

try:
    twodof.simulate(
        fmu, twodof.Bag(bag, storage=storage), Clock(), pace=twodof.RealTime(),
        stop_time=1e5, stamp_start=int(start),
    )
except twodof.TwoDofError as error:
    raise SystemExit(str(error))
"""


class Logging(NamedTuple):
    """A run in real time, in its own process, that records the times of its samples."""

    process: subprocess.Popen[str]
    clock: Path

    @property
    def times(self) -> NDArray[np.float64]:
        """Return, for each sample, the time in s for which the process had run."""
        times = np.fromfile(self.clock, "<f8")
        return times[times > 0.0]

    def lost(self, kept: int) -> float:
        """Return the age of the first lost sample at the time of the last one, s."""
        times = self.times
        return float(times[-1] - times[kept]) if kept < len(times) else 0.0


def read_ends(path: str | Path) -> twodof.Recording:
    """The first and the last joint state of a bag of one robot."""
    return read_all_ends([Path(path)])[0]


def logging(fmu: Path, bag: Path, storage: str) -> Logging:
    """Start a run without end, and wait for its first sample."""
    clock = bag.with_name(f"{bag.name}.clock")
    clock.write_bytes(bytes(8 * 100_000))
    command = [sys.executable, "-c", LOGGER, *map(str, (fmu, bag, storage, clock, START))]
    run = Logging(subprocess.Popen(command, stderr=subprocess.PIPE, text=True), clock)
    wait_until(lambda: len(run.times) > 0 or run.process.poll() is not None)
    assert run.process.poll() is None
    return run


BATCH = 40  # samples between two flushes of one that is left unfinished


def unfinished(folder: Path, run: Experiment, storage: str, n: int, **options: Any) -> Path:
    """A bag of n samples in the state in which a killed process leaves it."""
    living = folder / "living" / "bag"
    with twodof.Bag(living, storage=storage, **options).begin(run) as bag:
        for k in range(n):
            bag.write(sample(run, k))
            if k % BATCH == 0:
                bag._store.flush()
        shutil.copytree(living, folder / "bag")
    shutil.rmtree(living.parent)
    return folder / "bag"


def content(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() if p.is_file() else b"folder" for p in folder.rglob("*")}


class JointState(NamedTuple):
    """A message as a reader returns it; numbers are bytes, so that equal means bit-identical."""

    log_time: int
    stamp: int
    frame: str
    names: list[str]
    position: bytes
    velocity: bytes
    effort: bytes


@pytest.fixture(scope="session")
def run(native_path: Path) -> Experiment:
    """The default experiment of the default arm."""
    return twodof.experiment(native_path)


def sample(run: Experiment, k: int) -> Sample:
    """An artificial sample, identified by its numbers."""
    inputs = {n: v for n, v in run.start_values.items() if run.fmu.variables[n].causality == "input"}
    numbers = (k / 7, -k / 3), (k / 11, -k), (k, k), (k / 13, k / 17)
    return Sample(k, run.time(k), *numbers, inputs, 0.0, START * SECOND + k * PERIOD)


def joint_state(k: int, sample: Sample, effort: bool = False) -> JointState:
    stamp = START * SECOND + k * PERIOD
    tau = sample.tau if effort else ()
    numbers = (doubles(sample.q), doubles(sample.v), doubles(tau))
    return JointState(stamp, stamp, "", ["joint1", "joint2"], *numbers)


def doubles(values: Sequence[float]) -> bytes:
    return np.array(values, dtype="<f8").tobytes()


def from_message(log_time: int, message: Any) -> JointState:
    stamp = message.header.stamp
    return JointState(
        log_time,
        stamp.sec * SECOND + stamp.nanosec,
        message.header.frame_id,
        list(message.name),
        *map(doubles, (message.position, message.velocity, message.effort)),
    )


def read_with_rosbags(bag: Path) -> list[JointState]:
    with Reader(bag) as reader:
        chosen = [c for c in reader.connections if c.topic == "/joint_states"]
        return [
            from_message(stamp, STORE.deserialize_cdr(data, connection.msgtype))
            for connection, stamp, data in reader.messages(chosen)
        ]


def read_with_mcap(bag: Path) -> list[JointState]:
    """Read a bag by its index, and decode it by the file's own schema."""
    with (bag / f"{bag.name}.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        states = []
        for _, _, message, decoded in reader.iter_decoded_messages(topics=["/joint_states"]):
            assert message.publish_time == message.log_time
            states.append(from_message(message.log_time, decoded))
        return states


def read_with_sqlite3(bag: Path) -> list[JointState]:
    with sqlite3.connect(f"file:{bag / f'{bag.name}.db3'}?mode=ro", uri=True) as database:
        rows = database.execute(
            "SELECT timestamp, type, data FROM messages JOIN topics ON topic_id = topics.id"
            " WHERE name = '/joint_states' ORDER BY messages.id"
        )
        return [from_message(t, STORE.deserialize_cdr(data, kind)) for t, kind, data in rows]


READERS = [
    ("mcap", read_with_rosbags),
    ("mcap", read_with_mcap),
    ("sqlite3", read_with_rosbags),
    ("sqlite3", read_with_sqlite3),
]
foreign_readers = pytest.mark.parametrize(("storage", "read"), READERS)
both_storages = pytest.mark.parametrize("storage", STORAGES)


def header(stamp: int, frame: str = "") -> Any:
    time = STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp, SECOND))
    return STORE.types["std_msgs/msg/Header"](time, frame)


def joint_message(stamp: int, names: Sequence[str], *numbers: Sequence[float] | np.ndarray, frame: str = "") -> Any:
    """A JointState with the given positions, velocities and efforts."""
    parts = [np.array(part, float) for part in (*numbers, (), (), ())[:3]]
    return STORE.types["sensor_msgs/msg/JointState"](header(stamp, frame), [*names], *parts)


def serialised(message: Any, *, little_endian: bool = True) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__, little_endian=little_endian))


def write_third_party(
    path: Path, messages: Iterable[tuple[str, int, Any]], *, zstd: bool = False, **options: Any
) -> Path:
    """Write a bag of (topic, log time, message) with rosbags alone."""
    writer = Writer(path, **{"version": 9, **options})
    if zstd:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, stamp, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], stamp, serialised(message))
    return path


def metadata(bag: Path) -> dict[str, Any]:
    text = (bag / "metadata.yaml").read_text("utf-8")
    return yaml.load(text, yaml.CSafeLoader)["rosbag2_bagfile_information"]


def assert_consistent(bag: Path, storage: str) -> int:
    """Assert that all readers of its storage open the bag, with as many messages as its metadata states."""
    with Reader(bag) as reader:
        stamps = [stamp for _, stamp, _ in reader.messages()]
        counts = {c.topic: c.msgcount for c in reader.connections}
    if storage == "mcap":
        with (bag / f"{bag.name}.mcap").open("rb") as file:
            summary = make_reader(file).get_summary()
            assert summary is not None and summary.statistics is not None
            assert summary.statistics.message_count == len(stamps)
            indexed = make_reader(file).iter_messages(log_time_order=False)
            assert sum(1 for _ in indexed) == len(stamps)
            file.seek(0)  # and from the beginning to the end, without the index
            streamed = [r for r in StreamReader(file).records if isinstance(r, McapMessage)]
            assert len(streamed) == len(stamps)
    else:
        with sqlite3.connect(f"file:{bag / f'{bag.name}.db3'}?mode=ro", uri=True) as database:
            assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
            assert database.execute("SELECT count(*) FROM messages").fetchone() == (len(stamps),)
    found = metadata(bag)
    assert found["message_count"] == found["files"][0]["message_count"] == len(stamps)
    topics = found["topics_with_message_count"]
    assert {t["topic_metadata"]["name"]: t["message_count"] for t in topics} == counts
    if stamps:
        assert found["starting_time"]["nanoseconds_since_epoch"] == min(stamps)
        assert found["duration"]["nanoseconds"] == max(stamps) - min(stamps)
    assert not (bag / "reserve").exists()
    return len(stamps)


# --- MCAP, record by record ---

MAGIC = b"\x89MCAP0\r\n"


def record(opcode: int, *content: bytes) -> bytes:
    body = b"".join(content)
    return struct.pack("<BQ", opcode, len(body)) + body


def texts(*contents: str | bytes) -> bytes:
    raw = [content.encode() if isinstance(content, str) else content for content in contents]
    return b"".join(struct.pack("<I", len(content)) + content for content in raw)


def channel(number: int, topic: str, qos: str = "") -> bytes:
    metadata = texts("offered_qos_profiles", qos) if qos else b""
    head = struct.pack("<HH", number % 65536, 1)
    return record(4, head, texts(topic, "cdr", metadata))


def message(data: bytes, stamp: int = 1, number: int = 1) -> bytes:
    return record(5, struct.pack("<HIQQ", number, 0, stamp, stamp), data)


def chunk(records: bytes, size: int, compression: str) -> bytes:
    head = struct.pack("<QQQI", 0, 1, size, 0) + texts(compression)
    return record(6, head, struct.pack("<Q", len(records)), records)


HEADER = MAGIC + record(1, texts("ros2", ""))
FOOTER = record(2, bytes(20)) + MAGIC
SCHEMA = record(3, struct.pack("<H", 1), texts("sensor_msgs/msg/JointState", "ros2msg", ""))
CHANNEL = channel(1, "/joint_states")
