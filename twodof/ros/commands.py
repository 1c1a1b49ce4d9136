"""Map ROS 2 commands to FMU inputs; command time-out.

A control law (``plant.variables.CONTROLS``) accepts messages of one type: points or poses of the frame, or JointStates,
whose joints are matched by name.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import Any, NamedTuple

from ..bounds import MAX_COMMAND
from ..errors import InputError
from ..fmu import Fmu
from ..simulation.experiments import NANOSECONDS
from .messages import JOINT_STATE, POINT, POSE, store_of

LOG = logging.getLogger(__name__)
LONGEST_NAME = 80  # characters of a frame or joint name in a message
TIMEOUT = 0.5  # s without a command until the robot is held
RAMP = 0.5  # s in which efforts decrease to 0
Inputs = dict[str, float]


def warner(log: logging.Logger) -> Callable[[str, str], None]:
    """Return a function that logs one warning for each kind of fault."""
    warned: set[str] = set()

    def warn(kind: str, text: str) -> None:
        if kind not in warned:
            warned.add(kind)
            log.warning("%s; further messages of this kind are not reported", text)

    return warn


class CommandError(Exception):
    """A message is not a valid command; ``kind`` is the fault in one word."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class Command(NamedTuple):
    """The inputs that a message commands."""

    stamp: int  # time stamp, ns since the epoch; 0 without one
    inputs: Inputs
    unknown_joints: tuple[str, ...] = ()  # names of joints that the robot does not have


def deserialise(kind: str, cdr: bytes, most: int = MAX_COMMAND) -> Any:
    """Deserialise a message of a type, of limited size; CommandError: the untrusted bytes are no such message."""
    try:
        if len(cdr) > most:
            raise ValueError(f"it has {len(cdr)} bytes")
        return store_of(kind).deserialize_cdr(cdr, kind)
    except Exception as error:  # rosbags raises exceptions of any type
        raise CommandError("bytes", f"cannot be read ({error})") from error


def known_joints(names: Sequence[str], joints: Mapping[str, int]) -> list[tuple[int, int]]:
    """Match joints by name, (robot index, message index); CommandError: the message has none, or one twice."""
    known = [(joints[name], k) for k, name in enumerate(names) if name in joints]
    listed = f"{', '.join(names)[:LONGEST_NAME]!r}"
    if not known:
        raise CommandError("names", f"names no joint of this robot: {listed}")
    if len(dict(known)) < len(known):
        raise CommandError("names", f"names a joint twice: {listed}")
    return known


def sized(part: Sequence[float], what: str, names: Sequence[str]) -> Sequence[float]:
    """Check that a message has one number for each joint that it names; return the numbers."""
    if len(part) != len(names):
        raise CommandError("sizes", f"has {len(part)} {what} for {len(names)} joints")
    return part


class Commands:
    """The message types that an FMU can follow.

    Attributes:
        type: message type that commands all inputs of the control law; "" if the FMU accepts no commands.
        types: all accepted message types.
    """

    def __init__(self, fmu: Fmu) -> None:
        self._axes, self._root = fmu.axes, fmu.root
        self._groups = {group: fmu.vector(group) for group in ("x_des", "quat_des", "q_des", "v_des", "tau_cmd")}
        self._joints = {name: i for i, name in enumerate(fmu.joints)}
        self.types: tuple[str, ...] = ()
        if self._groups["x_des"] and fmu.axes:
            self.types = (POSE, POINT) if self._groups["quat_des"] else (POINT,)
        elif self._groups["q_des"] or self._groups["tau_cmd"]:
            self.types = (JOINT_STATE,)
        self.type = next(iter(self.types), "")

    def read(self, kind: str, cdr: bytes) -> Command:
        """Return the command in a message of one of ``types``.

        Points and poses must be in the robot's root frame; an empty frame_id means this frame.

        Raises:
            CommandError: the message cannot be decoded, is in another frame, is not finite, has an invalid
                orientation, names no joint of this robot, or lacks the numbers that the control law needs.
        """
        message = deserialise(kind, cdr)
        given = self._of_joints(message) if kind == JOINT_STATE else self._of_frame(kind, message)
        if not all(map(isfinite, given.values())):
            raise CommandError("finite", "is not finite")
        names = message.name if kind == JOINT_STATE else ()
        unknown_joints = tuple(name for name in names if name not in self._joints)
        stamp = message.header.stamp
        return Command(stamp.sec * NANOSECONDS + stamp.nanosec, given, unknown_joints)

    def _of_frame(self, kind: str, message: Any) -> Inputs:
        frame = message.header.frame_id
        if frame not in ("", self._root):
            raise CommandError("frame", f"is in frame {frame[:LONGEST_NAME]!r}, not in '{self._root}'")
        point = message.pose.position if kind == POSE else message.point
        given = {name: getattr(point, axis) for name, axis in zip(self._groups["x_des"], self._axes)}
        if kind == POSE:
            turn = message.pose.orientation
            quat = (turn.x, turn.y, turn.z, turn.w)
            if not any(quat):
                raise CommandError("turn", "has the orientation 0, 0, 0, 0")
            given |= zip(self._groups["quat_des"], quat)
        return given

    def _of_joints(self, message: Any) -> Inputs:
        """Return the inputs for efforts, or for positions and velocities; missing velocities are 0."""
        names = message.name
        known = known_joints(names, self._joints)
        if effort := self._groups["tau_cmd"]:
            tau = sized(message.effort, "efforts", names)
            return {effort[i]: float(tau[k]) for i, k in known}
        q = sized(message.position, "positions", names)
        given = {self._groups["q_des"][i]: float(q[k]) for i, k in known}
        v = message.velocity
        v = sized(v, "velocities", names) if len(v) else [0.0] * len(q)
        return given | {self._groups["v_des"][i]: float(v[k]) for i, k in known}


class Watchdog:
    """Command time-out, which sets safe inputs if no command arrives.

    Targets are held with velocity 0; efforts are ramped to 0.

    Args:
        timeout: time without a command, s.
        ramp: whether to ramp efforts to 0; None: ramp if the FMU has commanded efforts.

    Raises:
        InputError: ``ramp`` is given for an FMU without commanded efforts.
    """

    def __init__(self, fmu: Fmu, timeout: float, ramp: bool | None = None) -> None:
        self.timeout, self._since = timeout, 0.0
        self._efforts, self._speeds = fmu.vector("tau_cmd"), fmu.vector("v_des")
        self._ramp = bool(self._efforts) if ramp is None else ramp
        if self._ramp and not self._efforts:
            raise InputError("`on_timeout` 'ramp' is for control 'effort'; others hold the target")
        self._last: Inputs = {}
        self._warn = warner(LOG)

    def received(self, t: float, inputs: Inputs) -> None:
        """Register a command that arrived at time t, s."""
        self._since = t
        self._last |= inputs

    def asked(self, t: float) -> Inputs:
        """Return the inputs at a time, s, at which no command arrived."""
        late = t - self._since - self.timeout
        if not self._last or late < 0.0:
            return {}
        what = "efforts go to 0" if self._ramp else "the last one is held"
        self._warn("silence", f"no command for {self.timeout:g} s: {what}")
        if self._ramp:
            left = max(0.0, 1.0 - late / RAMP)
            return {name: left * self._last[name] for name in self._efforts if name in self._last}
        return {name: 0.0 for name in self._speeds if name in self._last}
