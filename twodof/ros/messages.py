"""What is said of a sample, and on which topic: ROS 2 messages and their quality of service."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.typesys import Stores, get_typestore

from ..errors import BagError
from ..experiments import NANOSECONDS, Experiment
from ..fmu import read_resource, urdf_text
from ..master import Sample
from ..plant.urdf import RobotError

if TYPE_CHECKING:
    from .scene import Scene, Transform

Array = NDArray[np.float64]
JOINT_STATES = "/joint_states"
JOINT_STATE = "sensor_msgs/msg/JointState"
TARGET = "/target"
POINT = "geometry_msgs/msg/PointStamped"
FOREVER = QosTime(9223372036, 854775807)

STORE = get_typestore(Stores.ROS2_HUMBLE)
Message = STORE.types
Serialised = bytes | memoryview


class Topic(NamedTuple):
    """Message type and offered quality of service of a topic."""

    type: str
    qos: Qos


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
    "/robot_description": Topic("std_msgs/msg/String", LATCHED),
    "/tf_static": Topic("tf2_msgs/msg/TFMessage", LATCHED),
    "/tf": Topic("tf2_msgs/msg/TFMessage", _qos(100, QosDurability.VOLATILE)),
    TARGET: Topic(POINT, STREAM),
    "/end_effector": Topic(POINT, STREAM),
}


class JointStateLayout:
    """Serialised JointStates that differ in stamp and numbers alone, as all of a run do.

    Writing and reading them so is several times faster than one by one. Where the numbers lie is
    found by serialising some with rosbags.

    Args:
        names: joint names.
        frame: frame_id of the header.
        sizes: how many positions, velocities and efforts there are.
    """

    def __init__(self, names: Sequence[str], frame: str, sizes: Sequence[int]) -> None:
        def serialised(fill: Sequence[int]) -> bytes:
            arrays = [
                np.full(8 * size, value, np.uint8).view(np.float64)
                for size, value in zip(sizes, fill, strict=True)
            ]
            message = Message[JOINT_STATE](_header(0, frame), list(names), *arrays)
            return bytes(STORE.serialize_cdr(message, JOINT_STATE))

        plain = serialised((0, 0, 0))
        self._sizes = sizes
        form, end, self._between = "<4sII", 12, [plain[:4]]
        for i, size in enumerate(sizes):
            marked = serialised([0xFF * (i == j) for j in range(3)])
            differing = [k for k, (a, b) in enumerate(zip(plain, marked, strict=True)) if a != b]
            start = differing[0] if differing else end
            self._between.append(plain[end:start])
            form += f"{start - end}s{size}d"
            end = start + 8 * size
        self._between.append(plain[end:])
        self._struct = struct.Struct(f"{form}{len(plain) - end}s")

    def pack(
        self, stamp: int, q: Sequence[float], v: Sequence[float], effort: Sequence[float]
    ) -> bytes:
        """One message, with its stamp in ns."""
        head, before_q, before_v, before_effort, tail = self._between
        seconds, rest = divmod(stamp, NANOSECONDS)
        return self._struct.pack(
            head, seconds, rest, before_q, *q, before_v, *v, before_effort, *effort, tail
        )

    def unpack(self, messages: Sequence[bytes]) -> list[Array] | None:
        """Positions, velocities, efforts of N messages, N × size; None if one differs in kind."""
        if any(len(message) != self._struct.size for message in messages):
            return None
        head, *fixed = self._between
        fields: list[Any] = [("head", "u1", 4), ("stamp", "u1", 8)]
        for i, size in enumerate(self._sizes):
            fields += [(f"fixed{i}", "u1", len(fixed[i])), (f"numbers{i}", "<f8", size)]
        fields.append(("fixed3", "u1", len(fixed[3])))
        rows = np.frombuffer(b"".join(messages), np.dtype(fields))
        expected = {"head": head, **{f"fixed{i}": text for i, text in enumerate(fixed)}}
        if any((rows[name] != np.frombuffer(text, "u1")).any() for name, text in expected.items()):
            return None
        return [np.array(rows[f"numbers{i}"], dtype=np.float64) for i in range(3)]


class Messages:
    """The messages of a run, serialised.

    Args:
        run: the experiment whose samples come.
        scene: also the robot description, transforms, target and end effector.
        effort: put the control effort into JointState.effort.

    Attributes:
        topics: all topics by name.

    Raises:
        BagError: the FMU has not what is asked for.
    """

    def __init__(self, run: Experiment, *, scene: bool, effort: bool) -> None:
        if effort and not run.fmu.vector("tau"):
            raise BagError(f"'{run.fmu.path}' has no outputs tau[i], which efforts are")
        self._effort = effort
        self._scene = _load_scene(run) if scene else None
        self._axes = run.fmu.axes
        self._root = run.fmu.root
        n = len(run.fmu.joints)
        self._joint_state = JointStateLayout(run.fmu.joints, "", (n, n, n if effort else 0))
        self.topics = {JOINT_STATES: Topic(JOINT_STATE, STREAM), **(SCENE_TOPICS if scene else {})}

    def of(self, sample: Sample) -> list[tuple[str, Serialised]]:
        """Topics and messages of one sample."""
        effort = sample.tau if self._effort else ()
        state = self._joint_state.pack(sample.stamp, sample.q, sample.v, effort)
        found: list[tuple[str, Serialised]] = [(JOINT_STATES, state)]
        if self._scene is not None:
            found += map(_serialise, self._of_scene(self._scene, sample))
        return found

    def latched(self, stamp: int) -> list[tuple[str, Serialised]]:
        """Topics and messages that hold for the whole run: robot description, fixed transforms.

        Their stamp is given in ns since the epoch.
        """
        if self._scene is None:
            return []
        description = Message["std_msgs/msg/String"](data=self._scene.description)
        fixed = _tf_message(stamp, self._scene.fixed)
        return [_serialise(("/robot_description", description)), _serialise(("/tf_static", fixed))]

    def _of_scene(self, scene: Scene, sample: Sample) -> Iterator[tuple[str, Any]]:
        stamp = sample.stamp
        yield "/tf", _tf_message(stamp, scene.moving(sample.q))
        end_effector = scene.end_effector(sample.q)
        target = list(end_effector)  # the target leaves an axis that is not controlled as it is
        for axis, value in zip(self._axes, sample.target or ()):
            target["xyz".index(axis)] = value
        yield TARGET, _point(stamp, self._root, target)
        yield "/end_effector", _point(stamp, self._root, end_effector)


def _load_scene(run: Experiment) -> Scene:
    urdf = urdf_text(run.fmu)
    if urdf is None or not run.fmu.axes:
        raise BagError(f"'{run.fmu.path}' carries no robot.urdf, which a scene shows")
    from .scene import Scene  # SciPy takes half a second to import

    try:
        return Scene(urdf, run.fmu.joints, run.fmu.frame, lambda name: read_resource(run.fmu, name))
    except RobotError as error:
        raise BagError(f"'{run.fmu.path}': resources/robot.urdf: {error}") from error


def _serialise(topic_and_message: tuple[str, Any]) -> tuple[str, Serialised]:
    topic, message = topic_and_message
    return topic, STORE.serialize_cdr(message, SCENE_TOPICS[topic].type)


def _header(stamp: int, frame: str) -> Any:
    seconds, nanoseconds = divmod(stamp, NANOSECONDS)
    time_type = Message["builtin_interfaces/msg/Time"]
    return Message["std_msgs/msg/Header"](
        stamp=time_type(sec=seconds, nanosec=nanoseconds), frame_id=frame
    )


def _point(stamp: int, frame: str, xyz: Sequence[float]) -> Any:
    x, y, z = xyz
    point = Message["geometry_msgs/msg/Point"](x=x, y=y, z=z)
    return Message[POINT](header=_header(stamp, frame), point=point)


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
