"""A robot as pictures need it: where its links are, what it can reach, where it is singular."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import NamedTuple

import numpy as np

from ..geometry.kinematics import Array, Kinematics, turned
from ..plant.urdf import Joint, RobotError, Urdf, check_axes, read_urdf

DEFAULT_FRAME = "EndEffector"
LOOKS = 2000  # for singularities, along the way


@dataclass(frozen=True)
class Reach:
    """The circle that a planar arm cannot leave: centre (3 values) and radius, m, and its normal.

    ``normal`` is 0, 1 or 2 for the root's x, y or z.
    """

    centre: Array
    radius: float
    normal: int


@dataclass(frozen=True)
class Motion:
    """What the robot's geometry makes of the joints' motion; points in the root frame, m.

    Attributes:
        robot: the robot's name.
        frame, root: the end effector's link, and the link that points are expressed in.
        path: the end effector's, N × 3.
        start, end: the arm at the first and the last sample: root, joints and end effector, × 3.
        reach: None where the arm does not move in a plane of two of the root's axes.
    """

    robot: str
    frame: str
    root: str
    path: Array
    start: Array
    end: Array
    reach: Reach | None


class Robot(NamedTuple):
    """What a picture needs of a robot: geometry, limits and damping.

    Attributes:
        urdf: the robot; its masses need not make sense.
        kinematics: of the joints in ``moving``.
        moving: joints that move on their own; those that mimic one too where a bag has them.
        frame: the end effector's link.
        axes: the task's, of "xyz".
    """

    urdf: Urdf
    kinematics: Kinematics
    moving: tuple[Joint, ...]
    frame: str
    axes: str

    @property
    def chain(self) -> list[Joint]:
        """The joints that move the frame, from the root on."""
        return [joint for joint in self.urdf.chain(self.frame) if joint.moves]


def load_robot(text: str, frame: str, axes: str, names: Sequence[str]) -> Robot:
    """A URDF's robot; without a frame, its "EndEffector", or the link behind most joints.

    Args:
        text: XML text.
        frame: the end effector's link.
        axes: the task's, of "xyz".
        names: joints whose positions are known.

    Raises:
        RobotError: it is not sound, or no joint moves the frame.
    """
    check_axes(axes)
    urdf = read_urdf(text)
    moving = tuple(
        joint
        for joint in urdf.joints.values()
        if joint.moves and (joint.leader == joint.name or joint.name in names)
    )
    if not frame:
        depths = {link: sum(j.moves for j in urdf.chain(link)) for link in urdf.links}
        last = max(enumerate(urdf.links), key=lambda link: (depths[link[1]], link[0]))[1]
        frame = DEFAULT_FRAME if DEFAULT_FRAME in urdf.links else last
    if frame not in urdf.links:
        raise RobotError(f"no frame '{frame}' in the URDF; there are: {', '.join(urdf.links)}")
    kinematics = Kinematics(urdf, [joint.name for joint in moving])
    robot = Robot(urdf, kinematics, moving, frame, axes)
    if not robot.chain:
        raise RobotError(f"no joint moves the frame '{frame}'")
    return robot


def motion_of(robot: Robot, q: Array) -> Motion:
    """What q, N × ``moving``, rad or m, moves."""
    start, end = _skeletons(robot, q[[0, -1]])
    return Motion(
        robot=robot.urdf.name,
        frame=robot.frame,
        root=robot.urdf.root,
        path=robot.kinematics.path(robot.frame, q),
        start=start,
        end=end,
        reach=_reach(robot),
    )


def _skeletons(robot: Robot, q: Array) -> Array:
    """Origins of the root, of the joints that move the frame, and of the frame; N × points × 3."""
    chain = robot.urdf.chain(robot.frame)
    places = robot.kinematics.along(chain, q)
    shown = [0, *(i for i, joint in enumerate(chain, start=1) if joint.moves), -1]
    return np.stack([places[i].translation for i in shown], axis=1)


def _reach(robot: Robot) -> Reach | None:
    """The circle, where all joints turn about one of the root's axes.

    Distances between neighbouring joints do not change, so no point is farther than their sum; in
    a plane the stretched arm is that long. For arms in space the sum would be too large.
    """
    at_zero = np.zeros((1, len(robot.moving)))
    chain = robot.urdf.chain(robot.frame)
    places = robot.kinematics.along(chain, at_zero)[1:]
    turns = np.abs(
        [
            turned(place.rotation, joint.axis)[0] * (not joint.prismatic)
            for joint, place in zip(chain, places)
            if joint.moves
        ]
    )
    normal = int(np.argmax(turns[0]))
    if (turns[:, normal] < 1.0 - 1e-9).any():
        return None
    points = _skeletons(robot, at_zero)[0, 1:]
    links = np.delete(np.diff(points, axis=0), normal, axis=1)
    return Reach(points[0], float(np.linalg.norm(links, axis=1).sum()), normal)


def is_singular(robot: Robot, q: Array, rcond: float, turns: bool) -> bool:
    """Whether the arm has been where it cannot follow any command: σ_min ≤ rcond·σ_max of J.

    That has the rows of the task axes, and where an orientation is followed three of the turning.
    """
    axes = ["xyz".index(axis) for axis in robot.axes] + [3, 4, 5] * turns
    J = robot.kinematics.jacobian(robot.frame, q[:: ceil(len(q) / LOOKS)])[:, axes]
    sigma = np.linalg.svd(J, compute_uv=False)
    return sigma.shape[1] < len(axes) or bool((sigma[:, -1] <= rcond * sigma[:, 0]).any())
