"""Bags, of this or another writer, read back as arrays."""

from __future__ import annotations

import struct
from array import array
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import BagError
from ..files import is_being_written
from ..ros.messages import JOINT_STATE, JOINT_STATES, POINT, STORE, TARGET, JointStateLayout
from .provenance import read_provenance
from .recording import Array, Heard, Recording, Stamps, TopicCount
from .records import Allowance, Channel, DamageError, read_messages, storage_files

BATCH = 1024**2  # bytes of messages that are decoded at once
MAX_JOINT_STATE = 1024**2  # bytes; some ten thousand joints
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def read_bag(path: str | Path) -> Recording:
    """Joint states and targets of a bag, of this or another writer.

    Raises:
        BagError: it is no bag, is unfinished or damaged, or has no joint states.
    """
    return _read(Path(path), _JointStates, _Targets())[0]


def read_ends(path: str | Path) -> tuple[Recording, int]:
    """The first and the last joint state of a bag, and how many it has.

    Raises:
        BagError: as ``read_bag``.
    """
    return _read(Path(path), _Ends, None)


def _read(path: Path, kind: type[_JointStates], targets: _Targets | None) -> tuple[Recording, int]:
    """What a kind of reader keeps of a bag's joint states, and how many there are."""
    counts: Counter[Channel] = Counter()
    chosen, states = "", kind(path)
    allowance = Allowance()
    try:
        for file in whole_bag(path):
            for channel, stamp, data in read_messages(file, allowance):
                counts[channel] += 1
                if channel.type == JOINT_STATE:
                    if channel.topic != chosen and (not chosen or channel.topic == JOINT_STATES):
                        chosen, states = channel.topic, kind(path)
                    if channel.topic == chosen:
                        states.add(stamp, data)
                elif targets is not None and (channel.topic, channel.type) == (TARGET, POINT):
                    targets.add(stamp, data)
    except OSError as error:
        raise BagError(f"cannot read the bag '{path}': {error.strerror}") from error
    except DamageError as error:
        raise BagError(
            f"cannot read the bag '{path}': {error};"
            f" 'twodof recover {path}' saves what comes before"
        ) from error
    topics: Counter[tuple[str, str]] = Counter()
    for channel, count in counts.items():
        topics[channel.topic, channel.type] += count
    if not topics[chosen, JOINT_STATE]:
        raise BagError(f"'{path}' has no joint states, no messages of type {JOINT_STATE}")
    stamps, q, v, tau = states.arrays()
    return Recording(
        path=path,
        topics=tuple(TopicCount(*topic, count) for topic, count in sorted(topics.items())),
        stamps=stamps,
        joints=states.names,
        q=q,
        v=v,
        tau=tau,
        heard=targets.heard(stamps) if targets is not None else None,
        provenance=read_provenance(path),
    ), topics[chosen, JOINT_STATE]


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


class _JointStates:
    """The joint states of one topic, decoded in batches."""

    def __init__(self, path: Path) -> None:
        self.names: tuple[str, ...] = ()
        self._path = path
        self._layout: JointStateLayout | None = None
        self._names: dict[str, tuple[NDArray[np.uint8], NDArray[np.uint8]]] = {}
        self._stamps = array("q")
        self._numbers = [array("d") for _ in range(3)]
        self._sizes: list[int] = []
        self._batch: list[bytes] = []
        self._held = 0  # bytes in the batch

    def add(self, stamp: int, data: bytes) -> None:
        self._stamps.append(stamp)
        self._batch.append(data)
        self._held += len(data)
        if self._held > BATCH:
            self._decode()

    def arrays(self) -> tuple[Stamps, Array, Array, Array]:
        """Stamps, positions, velocities, efforts by ascending stamps."""
        if self._batch:
            self._decode()
        stamps = np.asarray(self._stamps)
        q, v, effort = (np.asarray(n).reshape(len(stamps), -1) for n in self._numbers)
        if np.any(np.diff(stamps) < 0):
            order = np.argsort(stamps, kind="stable")
            stamps, q, v, effort = stamps[order], q[order], v[order], effort[order]
        return stamps, q, v, effort

    def _decode(self) -> None:
        batch, self._batch, self._held = self._batch, [], 0
        try:
            numbers = self._decoded(batch)
        except BagError:
            raise
        except Exception as error:  # rosbags raises anything where a message is no JointState
            packed = batch[0].startswith(ZSTD_MAGIC)
            reason = "its messages are compressed" if packed else "a joint state is damaged"
            raise BagError(f"cannot read the bag '{self._path}': {reason}") from error
        sizes = [part.shape[1] for part in numbers]
        if sizes != (self._sizes or sizes):
            raise BagError(f"'{self._path}' has joint states of different sizes")
        self._sizes = sizes
        for stored, part in zip(self._numbers, numbers, strict=True):
            stored.frombytes(part.tobytes())

    def _decoded(self, batch: Sequence[bytes]) -> list[Array]:
        largest = max(map(len, batch))
        if largest > MAX_JOINT_STATE:
            raise BagError(f"'{self._path}' has a joint state of {largest} bytes")
        if self._layout is None:
            first: Any = STORE.deserialize_cdr(batch[0], JOINT_STATE)
            sizes = [len(part) for part in (first.position, first.velocity, first.effort)]
            self._layout = JointStateLayout(first.name, first.header.frame_id, sizes)
            self.names = tuple(first.name)
            self._names = {order: _names(first.name, order) for order in "<>"}
        return self._layout.unpack(batch) or self._decoded_each(batch)

    def _decoded_each(self, batch: Sequence[bytes]) -> list[Array]:
        """Of messages in another frame, or with other bytes in the gaps that CDR leaves."""
        rows = [self._decoded_one(data) for data in batch]
        try:
            return [np.array(part, dtype=np.float64) for part in zip(*rows, strict=True)]
        except ValueError as error:
            raise BagError(f"'{self._path}' has joint states of different sizes") from error

    def _decoded_one(self, data: bytes) -> list[Array]:
        """Positions, velocities, efforts; rosbags would take seconds a megabyte for the names."""
        order = "<" if data[1] else ">"
        number = struct.Struct(f"{order}I")
        expected, told = self._names[order]
        start = 16 + number.unpack_from(data, 12)[0]  # after the header's frame
        start += -start % 4
        end = start + len(expected)
        if ((np.frombuffer(data[start:end], np.uint8) ^ expected) & told).any():
            raise BagError(f"'{self._path}' has joint states of different joints")
        parts = []
        for _ in range(3):
            (size,) = number.unpack_from(data, end)
            end += 4
            end += (4 - end) % 8 if size else 0
            parts.append(np.frombuffer(data, f"{order}f8", size, end))
            end += 8 * size
        if len(data) - end > 3:
            raise ValueError
        return parts


class _Ends(_JointStates):
    """The first and the last joint state of one topic."""

    def add(self, stamp: int, data: bytes) -> None:
        if not self._batch:
            self._stamps, self._batch = array("q", (stamp, stamp)), [data, data]
        elif stamp < self._stamps[0]:
            self._stamps[0], self._batch[0] = stamp, data
        elif stamp >= self._stamps[1]:
            self._stamps[1], self._batch[1] = stamp, data


class _Targets:
    """The points on /target that were told in one frame."""

    def __init__(self) -> None:
        self._frame: bytes | None = None
        self._sound = True
        self._stamps, self._points = array("q"), array("d")

    def add(self, stamp: int, data: bytes) -> None:
        """A PointStamped: stamp, frame, padding to 8 bytes, x, y, z."""
        try:
            order = "<" if data[1] else ">"
            end = 16 + int(struct.unpack_from(f"{order}I", data, 12)[0])
            point = struct.unpack_from(f"{order}3d", data, end + (4 - end) % 8)
        except (IndexError, struct.error):
            self._sound = False
            return
        frame = data[16:end]
        self._sound &= self._frame in (None, frame)
        self._frame = frame
        self._stamps.append(stamp)
        self._points.extend(point)

    def heard(self, stamps: Stamps) -> Heard | None:
        """The latest by each of these stamps; None where there are none, or not of one frame."""
        if self._frame is None or not self._sound:
            return None
        own = np.asarray(self._stamps)
        order = np.argsort(own, kind="stable")
        points = np.asarray(self._points).reshape(-1, 3)[order]
        latest = np.searchsorted(own[order], stamps, side="right") - 1
        heard = np.where((latest >= 0)[:, None], points[latest], np.nan)
        return Heard(self._frame.rstrip(b"\0").decode("utf-8", "replace"), heard)


def _names(names: Sequence[str], order: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A list of names in CDR, and 255 where its bytes say something, 0 in the gaps."""
    expected, told = bytearray(struct.pack(f"{order}I", len(names))), bytearray(b"\xff" * 4)
    for name in names:
        text = name.encode() + b"\0"
        gap = bytes(-len(text) % 4)
        expected += struct.pack(f"{order}I", len(text)) + text + gap
        told += b"\xff" * (4 + len(text)) + gap
    return np.frombuffer(expected, np.uint8), np.frombuffer(told, np.uint8)
