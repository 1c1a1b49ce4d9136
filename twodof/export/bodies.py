"""Constants of a robot: its bodies, the transforms of its joints, and their coupling.

Vectors and matrices of a body are in the frame of its joint, whose axis is z. Frames are rotated here once, so that the
other modules need only one kind of axis. Pinocchio has read the URDF.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..plant.robot import Robot

Scalar = Any  # a float or an Expression
Array = NDArray[Any]  # array of numbers, or of numbers and expressions
Frame = tuple[Array, Array]  # R and p of the transform a = R b + p


@dataclass(frozen=True)
class Body:
    """A rigid body, by the parameters that enter the dynamics linearly."""

    mass: Scalar  # kg
    moment: Array  # mass times position of its centre of mass, kg·m, 3 values
    inertia: Array  # about the frame's origin, kg·m², 3 × 3

    def with_point(self, mass: Scalar, offset: Array) -> Body:
        """Return the body with an added point mass."""
        points = offset * mass
        tensor = np.eye(3) * offset.dot(points) - np.outer(offset, points)
        return self + Body(mass, points, tensor)

    def __add__(self, other: Body) -> Body:
        """Return the sum of two bodies in the same frame."""
        return Body(self.mass + other.mass, self.moment + other.moment, self.inertia + other.inertia)

    def moved(self, R: Array, p: Array) -> Body:
        """Return the body in another frame, in which its own frame has the pose (R, p)."""
        d = R.dot(self.moment)
        # I' = R I Rᵀ + (2 d·p + m p·p) 1 − (d pᵀ + p dᵀ + m p pᵀ)
        half = d + p * (0.5 * self.mass)
        rotated = R.dot(self.inertia).dot(R.T)
        inertia = rotated - np.outer(half, p) - np.outer(p, half) + np.eye(3) * (2.0 * half.dot(p))
        return Body(self.mass, d + p * self.mass, symmetric(inertia))


class Inertial(NamedTuple):
    """Mass, kg, centre of mass, m, and inertia about it, kg·m², 3 × 3."""

    mass: Scalar
    com: Array
    inertia: Array


@dataclass(frozen=True)
class FreeLink:
    """A link whose mass, centre of mass or inertia varies."""

    body: int  # index of the joint that moves it
    R: Array  # R, p: pose of its frame in Pinocchio's frame of this joint
    p: Array
    given: Inertial  # its values in the URDF, in its own frame
    free: Inertial  # the same values with variables instead of those that vary

    def change(self, R: Array, p: Array) -> Body:
        """Return what the link adds to its body's given values, in a frame in which the link has the pose (R, p)."""
        (given, com, inertia), (mass, own_com, own_inertia) = self.given, self.free
        added = Body(0.0, np.zeros(3), R.dot(own_inertia - inertia).dot(R.T))
        if own_com is not com:
            return added.with_point(mass, R.dot(own_com) + p).with_point(-given, R.dot(com) + p)
        unit, more = Body(0.0, np.zeros(3), np.zeros((3, 3))).with_point(1.0, R.dot(com) + p), mass - given
        return added + Body(more, unit.moment * more, unit.inertia * more)


def cross(a: Array, b: Array) -> Array:
    """Return a × b, also for expressions, which np.cross refuses in NumPy 2.2."""
    product: Array = a[[1, 2, 0]] * b[[2, 0, 1]] - a[[2, 0, 1]] * b[[1, 2, 0]]
    return product


def symmetric(S: Array) -> Array:
    """Return the symmetric matrix with the upper triangle of S."""
    return np.where(np.tri(3, dtype=bool), S, S.T)


@dataclass(frozen=True)
class JointTree:
    """Constants of a robot whose N joints have axes along z; n of them are independent."""

    parent: tuple[int, ...]  # parent of each joint, −1 for the root
    prismatic: tuple[bool, ...]  # whether each joint is prismatic
    R: Array  # R, p: pose of each joint's frame in its parent's frame at q = 0
    p: Array
    body: tuple[Body, ...]  # body that each joint moves
    path: tuple[int, ...]  # joints from the root to the task frame
    frame_R: Array  # frame_R, frame_p: pose of the task frame in the frame of the last joint of ``path``
    frame_p: Array
    G: Array  # G, c: positions of all joints are G q + c
    c: Array


def joint_tree(robot: Robot, links: Sequence[FreeLink] = ()) -> JointTree:
    """Return the constants of a robot from Pinocchio's model, in frames in which many of them are 0.

    Bodies with links that vary have expressions of the links' variables.
    """
    model = robot.model
    subspaces = [_subspace(joint) for joint in list(model.joints)[1:]]
    slides = tuple(bool(axis[:3].any()) for axis in subspaces)
    parents = tuple(int(parent) - 1 for parent in list(model.parents)[1:])
    placed = [(M.rotation, M.translation) for M in list(model.jointPlacements)[1:]]
    end = model.frames[robot.frame_id]
    path = tuple(int(i) - 1 for i in model.supports[end.parentJoint])[1:]
    frames = _frames([axis[:3] + axis[3:] for axis in subspaces], parents, placed, path)
    rotations, origins, bodies, turns = [], [], [], np.zeros(len(parents))
    for i, ((R, p), inertia) in enumerate(zip(placed, list(model.inertias)[1:])):
        (base, zero), (own, origin) = frames[parents[i]], frames[i]
        rotation = base.T @ R @ own
        if not slides[i]:
            rotation, turns[i] = _without_turn(rotation)
        rotations.append(_without_rounding(rotation))
        origins.append(_without_rounding(base.T @ (p + R @ origin - zero)))
        centred = Body(0.0, np.zeros(3), own.T @ inertia.inertia @ own)
        bodies.append(centred.with_point(inertia.mass, own.T @ (inertia.lever - origin)))
    for link in links:
        own, origin = frames[link.body]
        bodies[link.body] += link.change(own.T @ link.R, own.T @ (link.p - origin))
    base, zero = frames[path[-1]]
    constants = JointTree(
        parent=parents,
        prismatic=slides,
        R=np.array(rotations),
        p=np.array(origins),
        body=tuple(bodies),
        path=path,
        frame_R=base.T @ end.placement.rotation,
        frame_p=base.T @ (end.placement.translation - zero),
        G=np.eye(len(robot.joints)) if robot.coupling is None else robot.coupling,
        c=robot.offset + turns,
    )
    return replace(constants, body=_regrouped(constants))


SKEW = 0.1  # sine of the angle between two axes above which their common normal is well conditioned


def _frames(axes: Sequence[Array], parents: Sequence[int], placed: Sequence[Frame], path: Sequence[int]) -> list[Frame]:
    """Return a frame for each joint, in Pinocchio's frame of the joint, and last a frame for the root.

    z is the joint's axis. x and the origin are on the common normal with the next joint's axis. Therefore the rotation
    to the next frame is about x, and its offset has one component less. Source: Khalil & Kleinfinger, "A new geometric
    notation for open and closed-loop robots", ICRA 1986.
    """
    frames = []
    for i, axis in enumerate(axes):
        following = [k for k, parent in enumerate(parents) if parent == i]
        chosen = [k for k in following if k in path] or following
        x, origin = np.zeros(3), np.zeros(3)
        if chosen:
            R, p = placed[chosen[0]]
            other = R @ axes[chosen[0]]
            normal = cross(axis, other)
            square = normal.dot(normal)
            if square > SKEW**2:
                x, origin = normal, axis * (cross(p, other).dot(normal) / square)
            else:
                x = p - axis * axis.dot(p)
        frames.append((_rotation_to(axis, x), origin))
    return [*frames, (np.eye(3), np.zeros(3))]


def _rotation_to(z: Array, x: Array) -> Array:
    """Return a rotation matrix with the axis z and, unless x is 0, the axis x."""
    length = np.linalg.norm(x)
    if length < 1e-9:
        x = np.roll(np.eye(3)[0], int(np.argmax(np.abs(z))) + 1)  # an axis that is not parallel to z
        x -= z * z.dot(x)
        length = np.linalg.norm(x)
    x = x / length
    return np.column_stack([x, cross(z, x), z])


def _without_turn(R: Array) -> tuple[Array, float]:
    """Return A and φ with R = A R_z(φ), so that an element of A is 0."""
    tilted = np.hypot(R[2, 0], R[2, 1]) > 1e-6
    angle = np.arctan2(R[2, 0], R[2, 1]) if tilted else np.arctan2(R[1, 0], R[0, 0])
    c, s = np.cos(angle), np.sin(angle)
    return R @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]), angle


def _without_rounding(values: Array) -> Array:
    """Round values that are within 1e-15 of an integer."""
    whole = values.round()
    return np.where(np.abs(values - whole) < 1e-15, whole, values)


WITHOUT_YY = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])


def _regrouped(robot: JointTree) -> tuple[Body, ...]:
    """Return the bodies, with mass that a joint cannot distinguish moved to its parent.

    This mass is a rod along the axis of a revolute joint: m, z and I_yy of its body, which become 0. The task frame's
    body keeps its mass, because its payload varies. Source: Gautier & Khalil, "Direct calculation of minimum set of
    inertial parameters of serial robots", IEEE T-RA 6(3), 1990.
    """
    bodies = list(robot.body)
    for i in reversed(range(len(bodies))):
        if robot.prismatic[i] or i == robot.path[-1]:
            continue
        b, parent = bodies[i], robot.parent[i]
        rod = Body(b.mass, b.moment * [0, 0, 1], np.diag([1.0, 1.0, 0.0]) * b.inertia[1, 1])
        bodies[i] = Body(0.0, b.moment * [1, 1, 0], (b.inertia - rod.inertia) * WITHOUT_YY)
        if parent >= 0:
            bodies[parent] = bodies[parent] + rod.moved(robot.R[i], robot.p[i])
    return tuple(bodies)


def _subspace(joint: object) -> Array:
    """Return the unit velocity of a joint in its own frame, linear and angular; one of them is zero."""
    data = joint.createData()  # type: ignore[attr-defined]
    joint.calc(data, np.zeros(1))  # type: ignore[attr-defined]
    return np.asarray(data.S).reshape(6)
