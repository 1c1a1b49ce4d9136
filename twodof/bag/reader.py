"""Bags, of this or another writer, read back as arrays."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ..errors import BagError
from ..experiment import NANOSECONDS
from ..files import is_being_written
from ..ros.messages import JOINT_STATE, JOINT_STATES, STORE, Array, JointStateLayout
from .provenance import read_provenance
from .records import Channel, DamageError, read_messages, storage_files

BATCH = 8192  # messages that are decoded at once
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class TopicCount:
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
        stamps: time stamps of the joint states, ns since the epoch, N, ascending.
        joints: joint names.
        q, v: positions (rad, m) and velocities, N × n.
        effort: N × n, or N × 0 where the bag has none.
        provenance: what the logger wrote about the run, {} for a bag from elsewhere.
    """

    path: Path
    topics: tuple[TopicCount, ...]
    stamps: Stamps
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
        BagError: it is no bag, is unfinished or damaged, or has no joint states.
    """
    path = Path(path)
    counts: Counter[Channel] = Counter()
    joint_states: dict[str, _JointStates] = {}
    try:
        for file in whole_bag(path):
            for channel, stamp, data in read_messages(file):
                counts[channel] += 1
                if channel.type == JOINT_STATE:
                    states = joint_states.get(channel.topic)
                    if states is None:
                        states = joint_states[channel.topic] = _JointStates(path)
                    states.add(stamp, data)
    except OSError as error:
        raise BagError(f"cannot read the bag '{path}': {error.strerror}") from error
    except DamageError as error:
        raise BagError(
            f"cannot read the bag '{path}': {error};"
            f" 'twodof recover {path}' saves what comes before"
        ) from error
    if not joint_states:
        raise BagError(f"'{path}' has no joint states, no messages of type {JOINT_STATE}")
    states = joint_states.get(JOINT_STATES) or next(iter(joint_states.values()))
    stamps, q, v, effort = states.arrays()
    return Run(
        path=path,
        topics=tuple(
            TopicCount(channel.topic, channel.type, count)
            for channel, count in sorted(counts.items())
        ),
        stamps=stamps,
        joints=states.names,
        q=q,
        v=v,
        effort=effort,
        provenance=read_provenance(path),
    )


def whole_bag(path: Path) -> list[Path]:
    """The files of a bag that was closed.

    Raises:
        BagError: it is no bag, or is unfinished.
        OSError: its folder cannot be read.
    """
    files = storage_files(path)
    if not files:
        packed = [*path.glob("*.zstd")]
        what = "it is compressed as a whole" if packed else "it has no .mcap or .db3 file"
        raise BagError(f"cannot read the bag '{path}': {what}")
    if not (path / "metadata.yaml").is_file():
        if is_being_written(path):
            raise BagError(f"the bag '{path}' is still being written")
        raise BagError(
            f"the bag '{path}' is unfinished: its writer died;"
            f" make it whole with 'twodof recover {path}'"
        )
    return files


class _States(NamedTuple):
    stamps: Stamps
    q: Array
    v: Array
    effort: Array


class _JointStates:
    """The joint states of one topic, decoded in batches."""

    def __init__(self, path: Path) -> None:
        self.names: tuple[str, ...] = ()
        self._path = path
        self._stamps: list[int] = []
        self._data: list[bytes] = []
        self._decoded: list[_States] = []

    def add(self, stamp: int, data: bytes) -> None:
        self._stamps.append(stamp)
        self._data.append(data)
        if len(self._data) == BATCH:
            self._decode()

    def arrays(self) -> _States:
        if self._data:
            self._decode()
        try:
            states = _States(*map(np.concatenate, zip(*self._decoded)))
        except ValueError as error:
            raise BagError(f"'{self._path}' has joint states of different sizes") from error
        if np.any(np.diff(states.stamps) < 0):
            order = np.argsort(states.stamps, kind="stable")
            states = _States(*(part[order] for part in states))  # type: ignore[arg-type]
        return states

    def _decode(self) -> None:
        try:
            first: Any = STORE.deserialize_cdr(self._data[0], JOINT_STATE)
            stamps = np.array(self._stamps, dtype=np.int64)
            sizes = [len(part) for part in (first.position, first.velocity, first.effort)]
            layout = JointStateLayout(first.name, first.header.frame_id, sizes)
            numbers = layout.unpack(self._data)
            if numbers is None or tuple(first.name) != (self.names or tuple(first.name)):
                numbers = self._decode_each()
        except BagError:
            raise
        except Exception as error:  # rosbags raises anything where a message is no JointState
            packed = self._data[0].startswith(ZSTD_MAGIC)
            reason = "its messages are compressed" if packed else "a joint state is damaged"
            raise BagError(f"cannot read the bag '{self._path}': {reason}") from error
        self.names = tuple(first.name)
        self._decoded.append(_States(stamps, *numbers))
        self._stamps, self._data = [], []

    def _decode_each(self) -> list[Array]:
        rows: list[tuple[Any, Any, Any]] = []
        names = self.names
        for data in self._data:
            message: Any = STORE.deserialize_cdr(data, JOINT_STATE)
            names = names or tuple(message.name)
            if tuple(message.name) != names:
                raise BagError(f"'{self._path}' has joint states of different joints")
            rows.append((message.position, message.velocity, message.effort))
        try:
            return [np.array([row[i] for row in rows], dtype=np.float64) for i in range(3)]
        except ValueError as error:
            raise BagError(f"'{self._path}' has joint states of different sizes") from error
