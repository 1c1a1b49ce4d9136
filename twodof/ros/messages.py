"""What is said of a sample, and on which topic: ROS 2 messages and their quality of service."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

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
from ..fmu import read_resource
from ..master import Sample
from ..plant.urdf import RobotError
from .cdr import JointStateLayout

if TYPE_CHECKING:
    from .scene import Scene, Transform

JOINT_STATES = "/joint_states"
JOINT_STATE = "sensor_msgs/msg/JointState"
TARGET = "/target"
END_EFFECTOR = "/end_effector"
CLOCK = "/clock"
POINT = "geometry_msgs/msg/PointStamped"
POSE = "geometry_msgs/msg/PoseStamped"
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
    END_EFFECTOR: Topic(POINT, STREAM),
}


class Messages:
    """The messages of a run, serialised.

    Args:
        run: the experiment whose samples come.
        scene: also the robot description, transforms, target and end effector.
        effort: put the control effort into JointState.effort.
        clock: also the samples' stamps as the time.

    Attributes:
        topics: all topics by name.

    Raises:
        BagError: the FMU has not what is asked for.
    """

    def __init__(self, run: Experiment, *, scene: bool, effort: bool, clock: bool = False) -> None:
        if effort and not run.fmu.vector("tau"):
            raise BagError(f"'{run.fmu.path}' has no outputs tau[i], which efforts are")
        self._effort = effort
        self._scene = _load_scene(run) if scene else None
        self._clock = clock
        self._axes = run.fmu.axes
        self._root = run.fmu.root
        n = len(run.fmu.joints)
        self._joint_state = JointStateLayout(run.fmu.joints, "", (n, n, n if effort else 0))
        self.topics = {JOINT_STATES: Topic(JOINT_STATE, STREAM)}
        if scene:
            self.topics |= SCENE_TOPICS
            if run.fmu.vector("quat_des"):
                self.topics |= dict.fromkeys((TARGET, END_EFFECTOR), Topic(POSE, STREAM))
            if not run.fmu.vector("x_des"):
                del self.topics[TARGET]
        if clock:
            self.topics[CLOCK] = Topic("rosgraph_msgs/msg/Clock", STREAM)

    def of(self, sample: Sample) -> list[tuple[str, Serialised]]:
        """Topics and messages of one sample."""
        effort = sample.tau if self._effort else ()
        state = self._joint_state.pack(sample.stamp, sample.q, sample.v, effort)
        messages: list[tuple[str, Serialised]] = [(JOINT_STATES, state)]
        if self._clock:
            now = Message["rosgraph_msgs/msg/Clock"](clock=_time(sample.stamp))
            messages.insert(0, self._serialise((CLOCK, now)))
        if self._scene is not None:
            messages += map(self._serialise, self._of_scene(self._scene, sample))
        return messages

    def latched(self, stamp: int) -> list[tuple[str, Serialised]]:
        """Topics and messages that hold for the whole run: robot description, fixed transforms.

        Their stamp is given in ns since the epoch.
        """
        if self._scene is None:
            return []
        description = Message["std_msgs/msg/String"](data=self._scene.description)
        fixed = _tf_message(stamp, self._scene.fixed)
        told = (("/robot_description", description), ("/tf_static", fixed))
        return [*map(self._serialise, told)]

    def _serialise(self, topic_and_message: tuple[str, Any]) -> tuple[str, Serialised]:
        topic, message = topic_and_message
        return topic, STORE.serialize_cdr(message, self.topics[topic].type)

    def _of_scene(self, scene: Scene, sample: Sample) -> Iterator[tuple[str, Any]]:
        stamp = sample.stamp
        yield "/tf", _tf_message(stamp, scene.moving(sample.q))
        end_effector = scene.end_effector(sample.q)
        if TARGET in self.topics:
            target = list(end_effector)  # the target leaves an axis that is not controlled as it is
            for axis, value in zip(self._axes, sample.target or ()):
                target["xyz".index(axis)] = value
            yield TARGET, _place(stamp, self._root, target, sample.target_quat)
        yield END_EFFECTOR, _place(stamp, self._root, end_effector, sample.quat)


def _load_scene(run: Experiment) -> Scene:
    urdf = run.fmu.urdf
    if urdf is None or not run.fmu.axes:
        raise BagError(f"'{run.fmu.path}' carries no robot.urdf, which a scene shows")
    from .scene import Scene  # SciPy takes half a second to import

    try:
        return Scene(urdf, run.fmu.joints, run.fmu.frame, lambda name: read_resource(run.fmu, name))
    except RobotError as error:
        raise BagError(f"'{run.fmu.path}': resources/robot.urdf: {error}") from error


def _time(stamp: int) -> Any:
    seconds, nanoseconds = divmod(stamp, NANOSECONDS)
    return Message["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)


def _header(stamp: int, frame: str) -> Any:
    return Message["std_msgs/msg/Header"](stamp=_time(stamp), frame_id=frame)


def _place(stamp: int, frame: str, xyz: Sequence[float], quat: Sequence[float] | None) -> Any:
    """A PointStamped, or with an orientation a PoseStamped."""
    x, y, z = xyz
    point = Message["geometry_msgs/msg/Point"](x=x, y=y, z=z)
    if not quat:
        return Message[POINT](header=_header(stamp, frame), point=point)
    qx, qy, qz, qw = quat
    turn = Message["geometry_msgs/msg/Quaternion"](x=qx, y=qy, z=qz, w=qw)
    pose = Message["geometry_msgs/msg/Pose"](position=point, orientation=turn)
    return Message[POSE](header=_header(stamp, frame), pose=pose)


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
