"""Read bags of any writer as arrays."""

from __future__ import annotations

import logging
import struct
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..bounds import MAX_DRAWN, MAX_JOINT_STATE, MAX_ODD, MAX_SAMPLES, MAX_SAMPLES_RATIO, MIB
from ..errors import BagError, no_such, path_of
from ..files import is_being_written, shown
from ..ros.cdr import Layout, MixtureError, Rows, joint_state_layout, unpack_points
from ..ros.messages import JOINT_STATE, JOINT_STATES, POINT, POSE, TARGET, store_of
from .contents import read_messages, stated_count, storage_files
from .downsampling import Downsampler, Indices
from .provenance import file_of, read_provenance, robot_in, robots_of
from .recording import Array, ReceivedTargets, Recording, TopicCount
from .records import DamageError, ReadBudget, Stamps
from .summary import read_summary

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"

LOG = logging.getLogger(__name__)


def read_bag(path: str | Path) -> Recording:
    """Read the joint states and targets of a bag of any writer.

    Args:
        path: the bag's folder; for one of several robots, followed by a colon and its namespace.

    Raises:
        BagError: the path is not a bag, or the bag is unfinished, damaged or without joint states.
    """
    return _read(path_of(path, "bag"), _JointStates, _Targets())


def read_downsampled(path: str | Path, most: int, lines: Callable[[Recording], Sequence[Array]]) -> Recording:
    """Read a bag as ``read_bag`` does, downsampled to at most ``most`` samples for drawing.

    Memory holds at most ``most`` samples and a chunk of the bag. ``lines`` returns the curves of a part of the bag that
    are drawn in addition to positions and velocities; its exceptions are passed on.
    """
    return _read(Path(path), _JointStates, _Targets(), Downsampler(most, lines))


def read_ends(path: str | Path) -> Recording:
    """Return the first and the last joint state of a bag.

    Use the summaries of the files if all have a valid one; otherwise read the whole bag.

    Raises:
        BagError: as ``read_bag``.
    """
    path = Path(path)
    folder, prefix, others = _place(path)
    with _refusing(folder):
        summaries = [read_summary(file) for file in whole_bag(folder)]
        if None in summaries:
            return _read(path, _Ends, None)
        counts: Counter[tuple[str, str]] = Counter()
        total = 0
        for summary in filter(None, summaries):
            for number, count in summary.counts.items():
                channel = summary.channels[number]
                if _is_within(channel.topic, prefix, others):
                    counts[channel.topic, channel.type] += count
                total += count
        stating = [topic for topic, kind in counts if kind == JOINT_STATE]
        usual = prefix + JOINT_STATES
        if len(stating) > 1 and usual not in stating:  # the topic that comes first in the file decides
            return _read(path, _Ends, None)
        chosen = usual if usual in stating else "".join(stating)
        ends, budget = _Ends(path), ReadBudget()
        for summary in filter(None, summaries):
            for batch in summary.ends(chosen, budget):
                ends.add(batch.stamps, batch.messages)
        _check_count(folder, total)
        return _recording(path, counts, chosen, ends, None)


def _place(path: Path) -> tuple[Path, str, tuple[str, ...]]:
    """Return a bag's folder, the chosen robot's topic prefix, and the prefixes of robots nested in its namespace."""
    folder, namespace = robot_in(path)
    inside = (name for name in robots_of(folder) if name.startswith(f"{namespace}/"))
    return folder, f"/{namespace}" if namespace else "", tuple(f"/{name}/" for name in inside)


def _is_within(topic: str, prefix: str, others: tuple[str, ...]) -> bool:
    return not prefix or (topic.startswith(f"{prefix}/") and not topic.startswith(others))


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Name the bag in errors of its files."""
    try:
        yield
    except (FileNotFoundError, NotADirectoryError) as error:
        raise BagError(no_such("bag", path)) from error
    except OSError as error:
        raise BagError(f"cannot read the bag '{path}': {error.strerror}") from error
    except DamageError as error:
        raise BagError(
            f"cannot read the bag '{path}': {error}; 'twodof recover {path}' saves what comes before"
        ) from error


def _read(
    path: Path, kind: type[_JointStates], targets: _Targets | None, downsampler: Downsampler | None = None
) -> Recording:
    """Read a bag's joint states with the given accumulator, and downsample them."""
    counts: Counter[tuple[str, str]] = Counter()
    chosen, states, total = "", kind(path), 0
    budget, thinned, most = ReadBudget(), False, MAX_SAMPLES

    def thin(downsampler: Downsampler) -> None:
        states.keep(downsampler.choose(_recording(path, counts, chosen, states, targets)))

    folder, prefix, others = _place(path)
    with _refusing(folder):
        files = whole_bag(folder)
        if downsampler is None:  # a bag of a few MB may unpack to gigabytes
            most = min(most, MAX_DRAWN + MAX_SAMPLES_RATIO * sum(file.stat().st_size for file in files))
        for file in files:
            for channel, stamps, messages in read_messages(file, budget):
                total += len(stamps)
                if not _is_within(channel.topic, prefix, others):
                    continue
                counts[channel.topic, channel.type] += len(stamps)
                if channel.type == JOINT_STATE:
                    usual = channel.topic == prefix + JOINT_STATES
                    if channel.topic != chosen and (not chosen or usual):
                        chosen, states = channel.topic, kind(path)
                    if channel.topic == chosen:
                        states.add(stamps, messages)
                        if states.size > most:
                            much = f"{most // MIB} MiB of joint states"
                            raise BagError(f"'{path}' unpacks to more than {much}; cut it into several bags")
                        if downsampler is not None:
                            downsampler.most = min(downsampler.most, MAX_DRAWN * len(states) // states.size)
                            if len(states) > downsampler.most:
                                thin(downsampler)
                                thinned = True
                elif targets and channel.topic == prefix + TARGET and channel.type in (POINT, POSE):
                    targets.add(stamps, messages)
        _check_count(folder, total)
    stating = [topic for topic, kind in counts if kind == JOINT_STATE]
    if len(stating) > 1 and chosen != prefix + JOINT_STATES:
        LOG.warning(
            f"'{path}' has several topics of joint states, {', '.join(map(shown, stating))}; {shown(chosen)} is read"
        )
    if downsampler is not None and thinned:
        thin(downsampler)  # downsample the end like the rest
    return _recording(path, counts, chosen, states, targets)


def _check_count(path: Path, count: int) -> None:
    """Warn if the files and metadata.yaml disagree on the number of messages."""
    stated = stated_count(path) if path.is_dir() else count
    if stated not in (None, count):
        LOG.warning(
            f"'{path}' has {stated} messages according to its metadata.yaml, and {count} in its"
            f" files; 'twodof recover {path}' corrects this"
        )


def _recording(
    path: Path, counts: Counter[tuple[str, str]], chosen: str, states: _JointStates, targets: _Targets | None
) -> Recording:
    if not counts[chosen, JOINT_STATE]:
        _, robot = robot_in(path)
        where = f" of the robot that its {file_of(robot)} is of" if robot else ""
        raise BagError(f"'{path}' has no joint states{where}, no messages of type {JOINT_STATE}")
    stamps, q, v, tau = states.arrays()
    return Recording(
        path=path,
        count=counts[chosen, JOINT_STATE],
        topics=tuple(TopicCount(*topic, count) for topic, count in sorted(counts.items())),
        stamps=stamps,
        joints=states.names,
        q=q,
        v=v,
        tau=tau,
        received=targets.received(stamps) if targets is not None else None,
        provenance=read_provenance(*robot_in(path)),
    )


def whole_bag(path: Path) -> list[Path]:
    """Return the files of a closed bag; raise BagError for an unfinished bag, or for a path that is not a bag."""
    files = storage_files(path)
    if not files:
        packed = f"cannot read the bag '{path}': it is compressed as a whole"
        raise BagError(packed if [*path.glob("*.zstd")] else no_such("bag", path))
    if files != [path] and not (path / "metadata.yaml").is_file():
        if is_being_written(path):
            raise BagError(f"the bag '{path}' is still being written")
        raise BagError(f"the bag '{path}' is unfinished: its writer died; repair it with 'twodof recover {path}'")
    return files


class _JointStates:
    """Joint states of one topic, decoded incrementally."""

    def __init__(self, path: Path) -> None:
        self.names: tuple[str, ...] = ()
        self._path = path
        self._layout: Layout | None = None
        self._sizes: tuple[int, ...] = ()
        self._odd = 0  # bytes that were decoded one by one
        self._stamps = array("q")
        self._numbers = [array("d") for _ in range(3)]

    def add(self, stamps: Stamps, messages: Rows) -> None:
        """Add N joint states."""
        numbers = self._decoded(messages)
        self._stamps.frombytes(stamps.tobytes())
        for stored, part in zip(self._numbers, numbers, strict=True):
            stored.frombytes(part.tobytes())

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def size(self) -> int:
        """Bytes of all states."""
        return 8 * (len(self._stamps) + sum(map(len, self._numbers)))

    def keep(self, chosen: Indices) -> None:
        """Keep only the states at these indices of the arrays that ``arrays`` returns."""
        stamps, *numbers = self.arrays()
        self._stamps = array("q", stamps[chosen].tobytes())
        self._numbers = [array("d", part[chosen].tobytes()) for part in numbers]

    def arrays(self) -> tuple[Stamps, Array, Array, Array]:
        """Return stamps, positions, velocities and efforts by ascending stamps."""
        stamps = np.asarray(self._stamps)
        q, v, effort = (np.asarray(n).reshape(len(stamps), -1) for n in self._numbers)
        if np.any(np.diff(stamps) < 0):
            order = np.argsort(stamps, kind="stable")
            stamps, q, v, effort = stamps[order], q[order], v[order], effort[order]
        return stamps, q, v, effort

    def _decoded(self, messages: Rows) -> list[Array]:
        if messages.shape[1] > MAX_JOINT_STATE:
            raise BagError(f"'{self._path}' has a joint state of {messages.shape[1]} bytes")
        message = messages[0].tobytes()
        try:
            numbers = None if self._layout is None else self._layout.unpack(messages)
            if numbers is None:
                frame, _ = self._decode_one(messages[0])
                self._layout = joint_state_layout(self.names, frame, self._sizes)
                numbers = self._layout.unpack(messages)
            if numbers is None:
                parts = zip(*(self._decode_one(each)[1] for each in messages), strict=True)
                numbers = [np.array(part, np.float64) for part in parts]
            return numbers
        except BagError:
            raise
        except MixtureError as error:
            raise BagError(f"'{self._path}' has joint states of different {error}") from error
        except Exception as error:  # rosbags raises any exception for bytes that are not a JointState
            packed = message.startswith(ZSTD_MAGIC)
            reason = "its messages are compressed" if packed else "a joint state is damaged"
            raise BagError(f"cannot read the bag '{self._path}': {reason}") from error

    def _decode_one(self, message: Rows) -> tuple[str, list[Array]]:
        """Return the frame and the numbers of a message, whose joints must be the first one's."""
        self._odd += message.nbytes
        if self._odd > MAX_ODD:
            raise BagError(f"'{self._path}' has more than {MAX_ODD // MIB} MiB of joint states of changing form")
        frame, names, *parts = _deserialised(message.tobytes())
        sizes = tuple(map(len, parts))
        if not self._sizes:
            self.names, self._sizes = names, sizes
        if names != self.names:
            raise MixtureError("joints")
        if sizes != self._sizes:
            raise MixtureError("sizes")
        return frame, parts


def _deserialised(message: bytes) -> tuple[Any, ...]:
    """Return frame, names, positions, velocities and efforts of a JointState."""
    state: Any = store_of(JOINT_STATE).deserialize_cdr(message, JOINT_STATE)
    return state.header.frame_id, tuple(state.name), state.position, state.velocity, state.effort


class _Ends(_JointStates):
    """First and last joint state of one topic."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._ends: list[tuple[int, Rows]] = []

    def add(self, stamps: Stamps, messages: Rows) -> None:
        """Add N joint states."""
        first, last = int(np.argmin(stamps)), len(stamps) - 1 - int(np.argmax(stamps[::-1]))
        some = [*self._ends, *((int(stamps[k]), messages[k : k + 1]) for k in (first, last))]
        earliest = min(some, key=lambda end: end[0])
        self._ends = [earliest, max(reversed(some), key=lambda end: end[0])]

    def arrays(self) -> tuple[Stamps, Array, Array, Array]:
        """Return stamps, positions, velocities and efforts of both states."""
        for stamp, message in self._ends:
            super().add(np.array([stamp]), message)
        return super().arrays()


class _Targets:
    """Points on /target, all in one frame."""

    def __init__(self) -> None:
        self._frame: bytes | None = None
        self._sound = True
        self._stamps, self._points = array("q"), array("d")

    def add(self, stamps: Stamps, messages: Rows) -> None:
        """Add PointStampeds, or PoseStampeds, which begin alike."""
        try:
            frame, points = unpack_points(messages)
        except (MixtureError, IndexError, struct.error):
            self._sound = False
            return
        self._sound &= self._frame in (None, frame)
        self._frame = frame
        new = np.ones(len(stamps), bool)  # repeated points are dropped
        new[1:-1] = (np.diff(points[:-1], axis=0) != 0).any(axis=1) | (np.diff(stamps)[1:] < 0)
        self._stamps.frombytes(stamps[new].tobytes())
        self._points.frombytes(points[new].tobytes())

    def received(self, stamps: Stamps) -> ReceivedTargets | None:
        """Return the latest target at each stamp; None without targets, or if they are in several frames."""
        if self._frame is None or not self._sound:
            return None
        own = np.asarray(self._stamps)
        order = np.argsort(own, kind="stable")
        points = np.asarray(self._points).reshape(-1, 3)[order]
        latest = np.searchsorted(own[order], stamps, side="right") - 1
        received = np.where((latest >= 0)[:, None], points[latest], np.nan)
        return ReceivedTargets(self._frame.decode("utf-8", "replace"), received)
