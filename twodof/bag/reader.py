"""Bags, of this or another writer, read back as arrays."""

from __future__ import annotations

import struct
from array import array
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import BagError
from ..files import is_being_written
from ..ros.cdr import JointStateLayout, MixtureError, unpack_point
from ..ros.messages import JOINT_STATE, JOINT_STATES, POINT, POSE, STORE, TARGET
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
                elif (
                    targets is not None
                    and channel.topic == TARGET
                    and channel.type in (POINT, POSE)
                ):
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
    if files != [path] and not (path / "metadata.yaml").is_file():
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
        self._stamps = array("q")
        self._numbers = [array("d") for _ in range(3)]
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
        largest = max(map(len, batch))
        if largest > MAX_JOINT_STATE:
            raise BagError(f"'{self._path}' has a joint state of {largest} bytes")
        try:
            if self._layout is None:
                first: Any = STORE.deserialize_cdr(batch[0], JOINT_STATE)
                sizes = [len(part) for part in (first.position, first.velocity, first.effort)]
                self._layout = JointStateLayout(first.name, first.header.frame_id, sizes)
                self.names = tuple(first.name)
            numbers = self._layout.unpack(batch)
        except MixtureError as error:
            raise BagError(f"'{self._path}' has joint states of different {error}") from error
        except Exception as error:  # rosbags raises anything where a message is no JointState
            packed = batch[0].startswith(ZSTD_MAGIC)
            reason = "its messages are compressed" if packed else "a joint state is damaged"
            raise BagError(f"cannot read the bag '{self._path}': {reason}") from error
        for stored, part in zip(self._numbers, numbers, strict=True):
            stored.frombytes(part.tobytes())


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
        """Take a PointStamped, or a PoseStamped, which begins alike."""
        try:
            frame, point = unpack_point(data)
        except (IndexError, struct.error):
            self._sound = False
            return
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
        return Heard(self._frame.decode("utf-8", "replace"), heard)
