"""ROS 2 bags: a sink that writes each sample as sensor_msgs/JointState, and a reader."""

from __future__ import annotations

import errno
import importlib.metadata
import json
import os
import shutil
import sqlite3
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Literal, cast

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import Reader, StoragePlugin, Writer, WriterError
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer
from rosbags.typesys import Stores, get_typestore

from . import __version__
from .errors import BagError
from .fmu import read_resource
from .master import Experiment, Sample
from .scene import Scene, Transform

METADATA_VERSION: Final[Literal[8]] = 8  # what Humble reads; it refuses version 9
JOINT_STATES = "/joint_states"
JOINT_STATE = "sensor_msgs/msg/JointState"
PROVENANCE = "run.json"
PROVENANCE_KEY = "twodof"
FORMAT = 1
STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
RESERVE = "reserve"
RESERVE_SIZE = 2 * 1024**2
FLUSH_PERIOD = 0.5  # s of wall time
CHUNK_SIZE = 512 * 1024  # below rosbags' own 1 MiB, so that every chunk is cut here
FOREVER = QosTime(9223372036, 854775807)
NANOSECONDS = 1_000_000_000
LATEST_STAMP = (2**31 - 1) * NANOSECONDS  # builtin_interfaces/Time has int32 seconds

STORE = get_typestore(Stores.ROS2_HUMBLE)
Message = STORE.types
Array = NDArray[np.float64]


def _qos(depth: int, durability: QosDurability) -> Qos:
    return Qos(
        QosHistory.KEEP_LAST,
        depth,
        QosReliability.RELIABLE,
        durability,
        FOREVER,
        FOREVER,
        QosLiveliness.AUTOMATIC,
        FOREVER,
        False,
    )


STREAM = _qos(10, QosDurability.VOLATILE)
LATCHED = _qos(1, QosDurability.TRANSIENT_LOCAL)
SCENE_TOPICS = {
    "/robot_description": ("std_msgs/msg/String", LATCHED),
    "/tf_static": ("tf2_msgs/msg/TFMessage", LATCHED),
    "/tf": ("tf2_msgs/msg/TFMessage", _qos(100, QosDurability.VOLATILE)),
    "/target": ("geometry_msgs/msg/PointStamped", STREAM),
    "/end_effector": ("geometry_msgs/msg/PointStamped", STREAM),
}


class Bag:
    """A sink that writes a rosbag2 folder.

    Left in whatever way, the bag is closed and readable with every sample written so far.

    Args:
        path: folder of the bag; must not exist, unless ``overwrite`` and it is a bag.
        run: the experiment whose samples come; goes into the provenance.
        storage: "mcap" or "sqlite3".
        scene: add the robot description, transforms, target and end effector.
        effort: put the control effort into JointState.effort.
        stamp_start: time of the first stamp, s since the epoch; None: the wall clock.
        overwrite: replace an existing bag.
        command_line: for the provenance.

    Raises:
        BagError: the folder exists or cannot be written; in ``write`` where the disk is full.
    """

    def __init__(
        self,
        path: str | Path,
        run: Experiment,
        *,
        storage: str = "mcap",
        scene: bool = False,
        effort: bool = False,
        stamp_start: float | None = None,
        overwrite: bool = False,
        command_line: str = "",
    ) -> None:
        self.path = Path(path)
        self._run = run
        if storage not in STORAGES:
            raise BagError(f"storage '{storage}' is not one of {', '.join(STORAGES)}")
        self._plugin = STORAGES[storage]
        self._overwrite = overwrite
        self._command_line = command_line
        if stamp_start is not None and not 0 <= stamp_start * NANOSECONDS <= LATEST_STAMP:
            raise BagError(f"the first stamp, {stamp_start:g} s, is out of range")
        # a fraction: a double of today's nanoseconds is good to 256 only
        exact = None if stamp_start is None else Fraction(stamp_start) * NANOSECONDS
        self._start = time.time_ns() if exact is None else round(exact)
        self._effort = effort
        if effort and not run.fmu.vector("tau"):
            raise BagError(f"'{run.fmu.path}' has no outputs tau[i] for --effort")
        self._scene = _load_scene(run) if scene else None
        if self._start + run.steps * run.step * NANOSECONDS > LATEST_STAMP:
            raise BagError(f"the last stamp, {run.steps * run.step:g} s later, is out of range")
        _check_free(self.path, overwrite)

    def __enter__(self) -> Bag:
        _check_free(self.path, self._overwrite)
        provenance = _json(_provenance(self._run, self._start, self._command_line))
        created = False
        try:
            if self.path.exists():
                shutil.rmtree(self.path)
            self._writer = Writer(self.path, version=METADATA_VERSION, storage_plugin=self._plugin)
            self._writer.set_custom_data(PROVENANCE_KEY, provenance)
            created = True
            self._writer.open()
            (self.path / PROVENANCE).write_text(provenance + "\n", "utf-8")
            _write_reserve(self.path / RESERVE)
            if isinstance(self._writer.storage, Sqlite3Writer):
                # commits are for a killed process, and need not wait for the disk
                self._writer.storage.conn.execute("PRAGMA synchronous = OFF")
            self._connections = {JOINT_STATES: self._add(JOINT_STATES, JOINT_STATE, STREAM)}
            if self._scene is not None:
                for topic, (kind, qos) in SCENE_TOPICS.items():
                    self._connections[topic] = self._add(topic, kind, qos)
            self._joint_states = self._connections[JOINT_STATES]
            self._message = _joint_state(self._run.fmu.joints, self._effort)
            self._flush()
        except (OSError, WriterError, sqlite3.Error) as error:
            if created and not isinstance(error, WriterError):  # else the folder is not ours
                with suppress(OSError, sqlite3.Error):
                    self._writer.abort()
                shutil.rmtree(self.path, ignore_errors=True)
            raise BagError(f"cannot write the bag '{self.path}': {_reason(error)}") from error
        return self

    def write(self, sample: Sample) -> None:
        """Write one sample: one JointState, and the scene's messages."""
        stamp = self._start + round(sample.k * self._run.step * NANOSECONDS)
        message = self._message  # one for all samples: making it costs as much as writing it
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, NANOSECONDS)
        message.position[:] = sample.q
        message.velocity[:] = sample.v
        if self._effort:
            message.effort[:] = sample.tau
        try:
            self._put(self._joint_states, stamp, message)
            if self._scene is not None:
                self._write_scene(self._scene, stamp, sample)
            late = time.monotonic() - self._flushed > FLUSH_PERIOD
            if late or self._pending > CHUNK_SIZE:
                self._flush()
        except (OSError, sqlite3.Error) as error:
            self._salvage()
            kept = self._writer.counts[self._joint_states.id]
            raise BagError(
                f"cannot go on writing the bag '{self.path}': {_reason(error)};"
                f" it is closed with its first {kept} samples"
            ) from error

    def __exit__(self, *exception: object) -> None:
        try:
            (self.path / RESERVE).unlink(missing_ok=True)
            self._writer.close()
        except (OSError, sqlite3.Error) as error:
            raise BagError(f"cannot close the bag '{self.path}': {_reason(error)}") from error

    def _add(self, topic: str, kind: str, qos: Qos) -> Connection:
        return self._writer.add_connection(topic, kind, typestore=STORE, offered_qos_profiles=[qos])

    def _put(self, connection: Connection, stamp: int, message: object) -> None:
        data = STORE.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, stamp, data)
        self._pending += len(data)

    def _write_scene(self, scene: Scene, stamp: int, sample: Sample) -> None:
        def put(topic: str, message: object) -> None:
            self._put(self._connections[topic], stamp, message)

        if sample.k == 0:
            put("/robot_description", Message["std_msgs/msg/String"](data=scene.description))
            put("/tf_static", _tf_message(stamp, scene.fixed))
        put("/tf", _tf_message(stamp, scene.moving(sample.q)))
        end_effector = scene.end_effector(sample.q)
        target = list(end_effector)  # the target leaves an axis that is not controlled as it is
        for k, axis in enumerate(self._run.fmu.axes):
            target["xyz".index(axis)] = float(sample.inputs[f"x_des[{k + 1}]"])
        put("/target", _point(stamp, self._run.fmu.root, target))
        put("/end_effector", _point(stamp, self._run.fmu.root, end_effector))

    def _flush(self) -> None:
        """Hand what is written to the operating system: rosbags does so only at the end."""
        storage = self._writer.storage
        if isinstance(storage, McapWriter):
            if storage.chunk.msgs:
                storage.close_chunk()
            storage.bio.flush()
            self._safe = storage.bio.tell()
        elif isinstance(storage, Sqlite3Writer):
            storage.conn.commit()
        self._flushed = time.monotonic()
        self._pending = 0

    def _salvage(self) -> None:
        """Give up the reserve and bring the storage into a state in which it can be closed."""
        (self.path / RESERVE).unlink(missing_ok=True)
        storage = self._writer.storage
        if isinstance(storage, McapWriter):
            storage.bio.flush()
            if storage.chunk.msgs:  # the chunk did not get through: cut off what did of it
                storage.bio.seek(self._safe)
                storage.bio.truncate()
        elif isinstance(storage, Sqlite3Writer):
            _recount(self._writer, storage)


def _recount(writer: Writer, storage: Sqlite3Writer) -> None:
    """Commit, or accept that SQLite rolled back, and count what is there."""
    if storage.conn.in_transaction:
        storage.conn.commit()
    counts = storage.conn.execute(
        "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id"
    ).fetchall()
    found = {topic: count for topic, count, _, _ in counts}
    writer.counts.update({topic: found.get(topic, 0) for topic in writer.counts})
    writer.min_timestamp = min((row[2] for row in counts), default=writer.min_timestamp)
    writer.max_timestamp = max((row[3] for row in counts), default=0)


def _reason(error: Exception) -> str:
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    if full or "full" in str(error):
        return "the disk is full"
    return (isinstance(error, OSError) and error.strerror) or str(error)


def _check_free(path: Path, overwrite: bool) -> None:
    try:
        if not path.exists():
            return
    except OSError as error:
        raise BagError(f"cannot write the bag '{path}': {error.strerror}") from error
    if not overwrite:
        raise BagError(f"'{path}' exists already; choose another name with -o or use --overwrite")
    if path.is_symlink() or not _is_bag(path):
        raise BagError(f"'{path}' is not a bag and is not overwritten")


def _is_bag(path: Path) -> bool:
    """A folder with rosbag2's metadata, or with our provenance where the writer died."""
    try:
        metadata = (path / "metadata.yaml").read_text("utf-8", "replace")
        return metadata.startswith("rosbag2_bagfile_information:")
    except OSError:
        return bool(_read_provenance(path))


def _write_reserve(path: Path) -> None:
    """Space that is given up to close the bag where the disk is full."""
    with path.open("wb") as file:
        file.write(b"\0" * RESERVE_SIZE)
        file.flush()
        os.fsync(file.fileno())


def _load_scene(run: Experiment) -> Scene:
    urdf = read_resource(run.fmu, "robot.urdf")
    if urdf is None or not run.fmu.axes:
        raise BagError(f"'{run.fmu.path}' carries no robot.urdf, which --scene needs")
    return Scene(
        urdf.decode(), run.fmu.joints, run.fmu.frame, lambda name: read_resource(run.fmu, name)
    )


def _json(value: object) -> str:
    """JSON without a single space: writers of YAML fold at spaces, and not all do it right."""
    return json.dumps(value, separators=(",", ":")).replace(" ", "\\u0020")


def _provenance(run: Experiment, stamp_start: int, command_line: str) -> dict[str, Any]:
    """What plots, replay and recovery need to know; readable by anything that reads JSON."""
    fmu = run.fmu
    urdf = read_resource(fmu, "robot.urdf")
    packages = ("numpy", "fmpy", "rosbags", "pin")
    return {
        "format": FORMAT,
        "fmu": {"name": fmu.name, "guid": fmu.guid, "file": fmu.path.name},
        "robot": fmu.robot,
        "frame": fmu.frame,
        "root": fmu.root,
        "axes": fmu.axes,
        "joints": list(fmu.joints),
        "start_time": run.start_time,
        "step": run.step,
        "steps": run.steps,
        "stamp_start_ns": stamp_start,
        "start_values": dict(run.start_values),
        "input_changes": [[t, values] for t, values in run.changes],
        "versions": {
            "twodof": __version__,
            **{name: importlib.metadata.version(name) for name in packages},
        },
        "command_line": command_line,
        "urdf": None if urdf is None else urdf.decode(),
    }


def _joint_state(joints: Sequence[str], effort: bool) -> Any:
    """A JointState to be filled in."""
    n = len(joints)
    return Message[JOINT_STATE](
        header=_header(0, ""),
        name=list(joints),
        position=np.zeros(n),
        velocity=np.zeros(n),
        effort=np.zeros(n if effort else 0),
    )


def _header(stamp: int, frame: str) -> Any:
    seconds, nanoseconds = divmod(stamp, NANOSECONDS)
    time_type = Message["builtin_interfaces/msg/Time"]
    return Message["std_msgs/msg/Header"](
        stamp=time_type(sec=seconds, nanosec=nanoseconds), frame_id=frame
    )


def _point(stamp: int, frame: str, xyz: Sequence[float]) -> Any:
    x, y, z = xyz
    point = Message["geometry_msgs/msg/Point"](x=x, y=y, z=z)
    return Message["geometry_msgs/msg/PointStamped"](header=_header(stamp, frame), point=point)


def _tf_message(stamp: int, transforms: Sequence[Transform]) -> Any:
    messages = []
    for parent, child, (x, y, z), (qx, qy, qz, qw) in transforms:
        transform = Message["geometry_msgs/msg/Transform"](
            translation=Message["geometry_msgs/msg/Vector3"](x=x, y=y, z=z),
            rotation=Message["geometry_msgs/msg/Quaternion"](x=qx, y=qy, z=qz, w=qw),
        )
        messages.append(
            Message["geometry_msgs/msg/TransformStamped"](
                header=_header(stamp, parent), child_frame_id=child, transform=transform
            )
        )
    return Message["tf2_msgs/msg/TFMessage"](transforms=messages)


@dataclass(frozen=True)
class Topic:
    """One topic of a bag: its name, message type and number of messages."""

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class Run:
    """A bag read back; N samples of n joints.

    Attributes:
        path: the bag's folder.
        topics: all topics of the bag.
        stamps: time stamps of the joint states, ns since the epoch, N.
        joints: joint names.
        q, v: positions (rad, m) and velocities, N × n.
        effort: N × n, or N × 0 where the bag has none.
        provenance: what the logger wrote about the run, {} for a bag from elsewhere.
    """

    path: Path
    topics: tuple[Topic, ...]
    stamps: NDArray[np.int64]
    joints: tuple[str, ...]
    q: Array
    v: Array
    effort: Array
    provenance: dict[str, Any]

    @property
    def t(self) -> Array:
        """Time since the first sample, s, N."""
        return cast(Array, (self.stamps - self.stamps[0]) / NANOSECONDS)


def read_bag(path: str | Path) -> Run:
    """Joint states of a bag, of this or another writer.

    Raises:
        BagError: it is no bag, cannot be read, or has no joint states.
    """
    path = Path(path)
    stamps: list[int] = []
    rows: list[tuple[Any, Any, Any]] = []
    names: tuple[str, ...] = ()
    try:
        with Reader(path) as reader:
            topics = tuple(
                Topic(c.topic, c.msgtype, c.msgcount)
                for c in sorted(reader.connections, key=lambda c: c.topic)
            )
            chosen = [c for c in reader.connections if c.msgtype == JOINT_STATE]
            if not chosen:
                raise BagError(f"'{path}' has no topic of type {JOINT_STATE}")
            chosen = [c for c in chosen if c.topic == JOINT_STATES] or chosen[:1]
            for connection, stamp, data in reader.messages(chosen):
                message: Any = STORE.deserialize_cdr(data, connection.msgtype)
                names = names or tuple(message.name)
                if tuple(message.name) != names:
                    raise BagError(f"'{path}' has joint states of different joints")
                stamps.append(stamp)
                rows.append((message.position, message.velocity, message.effort))
        q, v, effort = (np.array([row[i] for row in rows], dtype=np.float64) for i in range(3))
    except BagError:
        raise
    except Exception as error:  # a damaged bag raises anything inside the reader
        raise BagError(f"cannot read the bag '{path}': {error}") from error
    if not rows:
        raise BagError(f"'{path}' has no joint states")
    return Run(
        path=path,
        topics=topics,
        stamps=np.array(stamps, dtype=np.int64),
        joints=names,
        q=q,
        v=v,
        effort=effort,
        provenance=_read_provenance(path),
    )


def _read_provenance(path: Path) -> dict[str, Any]:
    file = path / PROVENANCE
    if not file.is_file():
        return {}
    try:
        found = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise BagError(f"cannot read '{file}': {error}") from error
    ours = isinstance(found, dict) and found.get("format") == FORMAT and "fmu" in found
    return found if ours else {}
