"""The constants of a robot: its bodies, where their joints are, and which of these follow others.

Vectors and matrices of a body are in the frame of its joint, whose axis is z: frames are turned
here, once, so that all else knows one kind of axis. Pinocchio has read the URDF.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..plant.robot import Robot

Array = NDArray[Any]
"""Of numbers, or of numbers and expressions."""


@dataclass(frozen=True)
class Body:
    """A rigid body: what is linear in the masses that it consists of.

    Attributes:
        mass: kg.
        moment: mass times the place of its centre, kg·m, 3 values.
        inertia: about the frame's origin, kg·m², 3 × 3.
    """

    mass: Any
    moment: Array
    inertia: Array

    def with_point(self, mass: Any, place: Array) -> Body:
        """Together with a point mass."""
        points = place * mass
        tensor = np.eye(3) * place.dot(points) - np.outer(place, points)
        return Body(self.mass + mass, self.moment + points, self.inertia + tensor)


@dataclass(frozen=True)
class Mechanism:
    """The constants of a robot whose N joints have axes along z; n of them move on their own.

    Attributes:
        parent: of each joint, −1 for the root.
        prismatic: whether it slides.
        R, p: placement of its frame in its parent's at q = 0.
        body: what it moves.
        path: joints from the root to the task frame.
        frame_R, frame_p: placement of the task frame in that of the last of these.
        G, c: positions of all joints are G q + c.
    """

    parent: tuple[int, ...]
    prismatic: tuple[bool, ...]
    R: Array
    p: Array
    body: tuple[Body, ...]
    path: tuple[int, ...]
    frame_R: Array
    frame_p: Array
    G: Array
    c: Array


def mechanism(robot: Robot) -> Mechanism:
    """The constants of a robot, read by Pinocchio, with frames turned so that axes are z."""
    model = robot.model
    subspaces = [_subspace(joint) for joint in list(model.joints)[1:]]
    to_z = [_rotation_to_z(axis[:3] + axis[3:]) for axis in subspaces]
    turned = [np.eye(3), *to_z]  # by Pinocchio's joint index, 0 the root
    parents = [int(parent) for parent in list(model.parents)[1:]]
    placements = list(model.jointPlacements)[1:]
    frame = model.frames[robot.frame_id]
    to_frame = turned[frame.parentJoint].T
    bodies = []
    for R, inertia in zip(to_z, list(model.inertias)[1:]):
        centred = Body(0.0, np.zeros(3), R.T @ inertia.inertia @ R)
        bodies.append(centred.with_point(inertia.mass, R.T @ inertia.lever))
    return Mechanism(
        parent=tuple(parent - 1 for parent in parents),
        prismatic=tuple(bool(axis[:3].any()) for axis in subspaces),
        R=np.array([turned[p].T @ M.rotation @ R for p, M, R in zip(parents, placements, to_z)]),
        p=np.array([turned[p].T @ M.translation for p, M in zip(parents, placements)]),
        body=tuple(bodies),
        path=tuple(int(i) - 1 for i in model.supports[frame.parentJoint])[1:],
        frame_R=to_frame @ frame.placement.rotation,
        frame_p=to_frame @ frame.placement.translation,
        G=np.eye(len(robot.joints)) if robot.coupling is None else robot.coupling,
        c=robot.offset,
    )


def _subspace(joint: object) -> Array:
    """Velocity of a joint with one coordinate, in its own frame: linear, angular; one is zero."""
    data = joint.createData()  # type: ignore[attr-defined]
    joint.calc(data, np.zeros(1))  # type: ignore[attr-defined]
    return np.asarray(data.S).reshape(6)


def _rotation_to_z(axis: Array) -> Array:
    """A rotation R with R e_z = axis; a permutation, so exact, where the axis is x, y or z."""
    k = int(np.argmax(np.abs(axis)))
    x = np.roll(np.eye(3)[0], k + 1)  # the coordinate axis after the largest component
    x -= axis * axis.dot(x)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])
