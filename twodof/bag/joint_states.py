"""Joint states and targets of a bag, decoded while it is read."""

import struct
from array import array
from collections import Counter
from pathlib import Path

import numpy as np

from ..bounds import MAX_JOINT_STATE, MAX_NAME, MAX_ODD, MIB, ODD
from ..errors import BagError
from ..ros.cdr import Layout, MixtureError, Rows, joint_state_layout, unpack_points
from ..ros.commands import deserialise
from ..ros.messages import JOINT_STATE
from .downsampling import Indices
from .recording import Array, ReceivedTargets
from .records import Stamps

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class JointStates:
    """Joint states of one topic, decoded incrementally."""

    def __init__(self, path: Path) -> None:
        self.names: tuple[str, ...] = ()
        self._path = path
        self._layout: Layout | None = None
        self._names: tuple[str, ...] = ()
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
                self._layout = joint_state_layout(self._names, frame, self._sizes)
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

    def _checked(self, names: tuple[str, ...], positions: int, *others: int) -> tuple[str, ...]:
        """Return the joints, numbered if the messages do not name them; any array of a JointState may be empty."""
        names = names or tuple(f"joint {i + 1}" for i in range(positions))
        if not names or positions != len(names):
            raise BagError(f"'{self._path}' has {positions} positions for {len(names)} joints")
        if {*others} - {0, positions}:
            sizes = " and ".join(map(str, others))
            raise BagError(f"'{self._path}' has {sizes} velocities and efforts for {positions} joints")
        if len({*names}) < positions:
            twice = next(name for name, count in Counter(names).items() if count > 1)
            raise BagError(f"'{self._path}' has two joints '{twice}'")
        if max(map(len, names)) > MAX_NAME:
            raise BagError(f"'{self._path}' has a joint with a name of more than {MAX_NAME} characters")
        return names

    def _decode_one(self, message: Rows) -> tuple[str, list[Array]]:
        """Return the frame and the numbers of a message, whose joints must be those of the first message."""
        self._odd += ODD + message.nbytes
        if self._odd > MAX_ODD:
            raise BagError(f"'{self._path}' has more than {MAX_ODD // MIB} MiB of joint states of changing form")
        state = deserialise(JOINT_STATE, message.tobytes())
        frame, names = state.header.frame_id, tuple(state.name)
        parts = [state.position, state.velocity, state.effort]
        sizes = tuple(map(len, parts))
        if not self._sizes:
            self._names, self._sizes = names, sizes
            self.names = self._checked(names, *sizes)
        if names != self._names:
            raise MixtureError("joints")
        if sizes != self._sizes:
            raise MixtureError("sizes")
        return frame, parts


class Ends(JointStates):
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


class Targets:
    """Points on /target, all in one frame."""

    def __init__(self) -> None:
        self._frame: bytes | None = None
        self._sound = True
        self._stamps, self._points = array("q"), array("d")

    def add(self, stamps: Stamps, messages: Rows) -> None:
        """Add PointStampeds, or PoseStampeds, which begin with the same fields."""
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
