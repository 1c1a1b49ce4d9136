"""Bag of one JointTrajectory, for ROS 2's joint_trajectory_controller."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from time import time_ns
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer

from ..files import temporary_folder
from ..ros.messages import JOINT_TRAJECTORY, store_of
from ..simulation.experiments import NANOSECONDS

if TYPE_CHECKING:
    from rosbags.typesys.store import Msg

TOPIC = "/joint_trajectory_controller/joint_trajectory"
Array = NDArray[np.float64]


def write_trajectory(path: Path, joints: Sequence[str], t: Array, q: Array, v: Array, a: Array) -> None:
    """Write a bag of a motion into a new folder, completely or not at all.

    Args:
        path: the folder, which must not exist.
        joints: names of n joints.
        t: times of the points, s, N.
        q, v, a: positions, rad or m, and their derivatives, N × n.

    Raises:
        OSError: it cannot be written.
    """
    store = store_of(JOINT_TRAJECTORY)
    types = store.types

    def time(kind: str, seconds: float) -> Msg:
        return types[f"builtin_interfaces/msg/{kind}"](*divmod(round(seconds * NANOSECONDS), NANOSECONDS))

    point = types["trajectory_msgs/msg/JointTrajectoryPoint"]
    points = [point(*each, np.empty(0), time("Duration", s)) for *each, s in zip(q, v, a, t.tolist())]
    header = types["std_msgs/msg/Header"](time("Time", 0.0), "")
    message = types[JOINT_TRAJECTORY](header, [*joints], points)
    with temporary_folder(path.absolute().parent) as draft:
        with Writer(draft / path.name, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topic = writer.add_connection(TOPIC, JOINT_TRAJECTORY, typestore=store)
            writer.write(topic, time_ns(), store.serialize_cdr(message, JOINT_TRAJECTORY))
        (draft / path.name).rename(path)
