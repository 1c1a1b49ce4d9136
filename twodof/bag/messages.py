"""What is said of a sample, and on which topic: ROS 2 messages and their quality of service."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
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
from ..fmu import read_resource
from ..master import Experiment, Sample
from ..scene import Scene, Transform

JOINT_STATES = "/joint_states"
JOINT_STATE = "sensor_msgs/msg/JointState"
NANOSECONDS = 1_000_000_000
FOREVER = QosTime(9223372036, 854775807)

STORE = get_typestore(Stores.ROS2_HUMBLE)
Message = STORE.types


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
    "/target": Topic("geometry_msgs/msg/PointStamped", STREAM),
    "/end_effector": Topic("geometry_msgs/msg/PointStamped", STREAM),
}


class Messages:
    """The messages of a run.

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
            raise BagError(f"'{run.fmu.path}' has no outputs tau[i] for --effort")
        self._effort = effort
        self._scene = _load_scene(run) if scene else None
        self._axes = run.fmu.axes
        self._root = run.fmu.root
        self._joint_state = _joint_state(run.fmu.joints, effort)
        self.topics = {JOINT_STATES: Topic(JOINT_STATE, STREAM), **(SCENE_TOPICS if scene else {})}

    def of(self, sample: Sample, stamp: int) -> Iterator[tuple[str, Any]]:
        """Topics and messages of one sample at a time stamp in ns.

        The JointState is the same object each time: making one costs as much as writing it.
        """
        message = self._joint_state
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, NANOSECONDS)
        message.position[:] = sample.q
        message.velocity[:] = sample.v
        if self._effort:
            message.effort[:] = sample.tau
        yield JOINT_STATES, message
        if self._scene is not None:
            yield from self._of_scene(self._scene, sample, stamp)

    def latched(self, stamp: int) -> Iterator[tuple[str, Any]]:
        """Topics and messages that hold for the whole run: robot description, fixed transforms."""
        if self._scene is not None:
            description = Message["std_msgs/msg/String"](data=self._scene.description)
            yield "/robot_description", description
            yield "/tf_static", _tf_message(stamp, self._scene.fixed)

    def _of_scene(self, scene: Scene, sample: Sample, stamp: int) -> Iterator[tuple[str, Any]]:
        yield "/tf", _tf_message(stamp, scene.moving(sample.q))
        end_effector = scene.end_effector(sample.q)
        target = list(end_effector)  # the target leaves an axis that is not controlled as it is
        for k, axis in enumerate(self._axes):
            target["xyz".index(axis)] = float(sample.inputs[f"x_des[{k + 1}]"])
        yield "/target", _point(stamp, self._root, target)
        yield "/end_effector", _point(stamp, self._root, end_effector)


def _load_scene(run: Experiment) -> Scene:
    urdf = read_resource(run.fmu, "robot.urdf")
    if urdf is None or not run.fmu.axes:
        raise BagError(f"'{run.fmu.path}' carries no robot.urdf, which --scene needs")
    return Scene(
        urdf.decode(), run.fmu.joints, run.fmu.frame, lambda name: read_resource(run.fmu, name)
    )


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
