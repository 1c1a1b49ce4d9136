"""Forward kinematics of a URDF for many samples at a time, for transforms, plots and pages.

    p_child = p_parent + R_parent (xyz + R(rpy) a q),  R_child = R_parent R(rpy)            prismatic
    p_child = p_parent + R_parent xyz,                 R_child = R_parent R(rpy) exp[a q]×  revolute

a is the joint's axis. A column of the Jacobian of a point p is

    a                  prismatic,      a × (p − p_child)        revolute

with a in the root's axes. Source: Siciliano, Sciavicco, Villani & Oriolo, "Robotics", 2009, sections 2.8 and 3.1.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ..plant.urdf import INERTIA, Joint, RobotError, Urdf, attribute, read_urdf, vector

Array = NDArray[np.float64]
BLOCK = 10_000  # samples whose arrays fit into the cache


class Placement(NamedTuple):
    """Transforms of a frame in another one at N samples: N × 3, m, and N × 3 × 3; or one for all samples.

    Rotations are matrices, because SciPy takes ten times as long for the product of two Rotations.
    """

    translation: Array
    rotation: Array

    def __mul__(self, inner: Placement) -> Placement:  # type: ignore[override]
        """Compose two transforms."""
        translation = self.translation + rotated(self.rotation, inner.translation)
        return Placement(translation, self.rotation @ inner.rotation)


class Body(NamedTuple):
    """A link's mass, kg, its centre, m, and the inertia about it, kg·m², 9 values by rows, in the link's axes."""

    mass: float
    com: list[float]
    inertia: list[float]


def quaternions(rotation: Array) -> Array:
    """Return the quaternions x, y, z, w of N rotation matrices, N × 4."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat())


def rotated(rotation: Array, vectors: ArrayLike) -> Array:
    """Return R v at N samples."""
    return np.asarray(np.einsum("...ij,...j->...i", rotation, np.asarray(vectors)))


class Kinematics:
    """Forward kinematics of a robot.

    Args:
        joints: names of the joints whose positions are the columns of q. Joints without a column follow the joint
            that they mimic, or rest at 0.

    Attributes:
        origins: rotation matrix of each joint's frame in its parent's frame at position 0, by name.
    """

    def __init__(self, urdf: Urdf, joints: Sequence[str]) -> None:
        self.urdf = urdf
        self._columns = {name: i for i, name in enumerate(joints)}
        self.origins = {joint.name: Rotation.from_euler("xyz", joint.rpy).as_matrix() for joint in urdf.joints.values()}
        self._parts: dict[str, tuple[list[tuple[Placement, Joint]], Placement]] = {}

    def body(self, link: str) -> Body:
        """Return the inertia of a link; zeros if the URDF has none."""
        element = next(each for each in self.urdf.tree.findall("link") if each.get("name") == link)
        inertial = element.find("inertial")
        if inertial is None:
            return Body(0.0, [0.0] * 3, [0.0] * 9)
        origin = inertial.find("origin")
        xx, xy, xz, yy, yz, zz = (attribute(inertial, "inertia", key, 0.0) for key in INERTIA)
        turn = Rotation.from_euler("xyz", vector(origin, "rpy", (0.0, 0.0, 0.0))).as_matrix()
        inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        com = vector(origin, "xyz", (0.0, 0.0, 0.0))
        return Body(attribute(inertial, "mass", "value", 0.0), [*com], inertia.ravel().tolist())

    def moves(self, joint: Joint) -> bool:
        """Return whether a joint's position depends on q."""
        return self.column(joint)[0] is not None

    def column(self, joint: Joint) -> tuple[int | None, float, float]:
        """Return the column of q that moves a joint, with ratio and offset; None for a joint at rest."""
        if joint.name in self._columns:
            return self._columns[joint.name], 1.0, 0.0
        return self._columns.get(joint.leader), joint.ratio, joint.offset

    def in_parent(self, joint: Joint, q: ArrayLike) -> Placement:
        """Return the transforms of a joint's child in its parent."""
        origin, along = self.origins[joint.name], self._moved(joint, q) * joint.axis
        if joint.prismatic:
            return Placement(joint.xyz + rotated(origin, along), origin[None])
        turn = Rotation.from_rotvec(along).as_matrix()
        return Placement(np.asarray(joint.xyz, dtype=np.float64)[None], origin @ turn)

    def pose(self, joint: Joint, q: ArrayLike) -> Array:
        """Return the pose of a joint's child in its parent; q is N × joints, rad or m.

        The pose is N × 7, or 1 × 7 for a joint at rest: position in m, and a unit quaternion x, y, z, w.
        """
        moved, still = self._moved(joint, q), Rotation.from_matrix(self.origins[joint.name])
        if joint.prismatic:
            position = joint.xyz + moved * still.apply(joint.axis)
            return np.hstack([position, np.broadcast_to(still.as_quat(), (len(moved), 4))])
        half = still * Rotation.from_quat([*joint.axis, 0.0])  # a rotation by π
        quat = np.cos(moved / 2) * still.as_quat() + np.sin(moved / 2) * half.as_quat()
        return np.hstack([np.broadcast_to(joint.xyz, (len(moved), 3)), quat])

    def _moved(self, joint: Joint, q: ArrayLike) -> Array:
        """Return a joint's position, N × 1, rad or m; 1 × 1 for a joint at rest, NaN instead of infinity."""
        column, ratio, offset = self.column(joint)
        if column is None:
            return np.full((1, 1), offset)
        moved = offset + ratio * np.asarray(q, dtype=np.float64)[:, column, None]
        return np.where(np.isinf(moved), np.nan, moved)

    def along(self, chain: Iterable[Joint], q: ArrayLike) -> Iterator[Placement]:
        """Yield the transforms of the root and of the child of each joint of a chain from the root."""
        n = len(np.asarray(q))
        here = Placement(np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)))
        yield here
        for joint in chain:
            here = here * self.in_parent(joint, q)
            yield here

    def end(self, link: str, q: ArrayLike) -> Placement:
        """Return the transforms of a link from the root at N samples."""
        q = np.asarray(q, dtype=np.float64)
        here = Placement(np.zeros((len(q), 3)), np.tile(np.eye(3), (len(q), 1, 1)))
        parts, last = self.parts(link)
        for before, joint in parts:
            here = here * (before * self.in_parent(joint, q))
        return here * last

    def parts(self, link: str) -> tuple[list[tuple[Placement, Joint]], Placement]:
        """Return the moving joints above a link, each with the transform before it, and the transform after the last.

        Joints at rest are composed once for each link.
        """
        if link not in self._parts:
            parts, still = list[tuple[Placement, Joint]](), Placement(np.zeros((1, 3)), np.eye(3)[None])
            rest = still
            for joint in self.urdf.chain(link):
                if self.moves(joint):
                    parts.append((rest, joint))
                    rest = still
                else:
                    rest = rest * self.in_parent(joint, ())
            self._parts[link] = parts, rest
        return self._parts[link]

    def path(self, link: str, q: ArrayLike) -> Array:
        """Return positions of a link's origin in the root frame, N × 3, m."""
        q = np.asarray(q, dtype=np.float64)
        path = np.empty((len(q), 3))
        for k in range(0, len(q), BLOCK):
            point: Array = np.zeros((1, 3))
            for joint in reversed(self.urdf.chain(link)):
                point = self._seen_from_parent(joint, q[k : k + BLOCK], point)
            path[k : k + BLOCK] = point
        return path

    def _seen_from_parent(self, joint: Joint, q: Array, point: Array) -> Array:
        """Transform a point of the child to the parent; N × 3, or 1 × 3 if nothing moves.

        Rodrigues' formula is p = a (a·p) + cos q (p − a (a·p)) + sin q a × p.
        """
        moved, axis = self._moved(joint, q), np.array(joint.axis)
        origin = self.origins[joint.name].T
        if joint.prismatic:
            return np.asarray(joint.xyz + (point + moved * axis) @ origin)
        along, across = np.outer(axis, axis), np.cross(np.eye(3), axis)
        beside = np.cos(moved) * (point @ ((np.eye(3) - along) @ origin))
        beside += np.sin(moved) * (point @ (-across @ origin))
        return np.asarray(joint.xyz + point @ (along @ origin) + beside)

    def jacobian(self, link: str, q: ArrayLike) -> Array:
        """Return the Jacobian of the link in the root's axes, N × 6 × joints: linear, then angular rows."""
        q = np.asarray(q, dtype=np.float64)
        parts, last = self.parts(link)
        transforms = [Placement(np.zeros((len(q), 3)), np.tile(np.eye(3), (len(q), 1, 1)))]
        for before, joint in parts:
            transforms.append(transforms[-1] * (before * self.in_parent(joint, q)))
        end = (transforms[-1] * last).translation
        jacobian = np.zeros((len(q), 6, len(self._columns)))
        for (_, joint), transform in zip(parts, transforms[1:]):
            column, ratio, _ = self.column(joint)
            axis = ratio * rotated(transform.rotation, joint.axis)
            arm = end - transform.translation
            if joint.prismatic:
                jacobian[:, :3, column] += axis
            else:
                jacobian[:, :3, column] += np.cross(axis, arm)
                jacobian[:, 3:, column] += axis
        return jacobian


def chains_at(text: str, joints: Sequence[str], q: Sequence[float]) -> list[list[Array]]:
    """Return the points, m, of each chain of a URDF's links at positions q, rad or m; none if it is not a URDF."""
    try:
        urdf = read_urdf(text)
    except RobotError:
        return []
    kinematics, parents = Kinematics(urdf, joints), {joint.parent for joint in urdf.joints.values()}
    chains = [urdf.chain(link) for link in urdf.links if link not in parents]
    return [[at.translation[0] for at in kinematics.along(chain, [q])] for chain in chains]
