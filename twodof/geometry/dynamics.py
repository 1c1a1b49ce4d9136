"""Inverse dynamics of a URDF without Pinocchio, for verdicts on machines that cannot build.

In the root's axes, with the joint's axis z, the arm r from the parent's origin, and a body's centre c:

    ω = ω_p + z q̇,  ω̇ = ω̇_p + z q̈ + ω_p × z q̇    revolute;    ω = ω_p,  ω̇ = ω̇_p    prismatic
    a = a_p + ω̇_p × r + ω_p × (ω_p × r)  (+ z q̈ + 2 ω_p × z q̇ for a prismatic joint)
    f = m (a + ω̇ × c + ω × (ω × c) − g),  n = I ω̇ + ω × I ω + c × f

The effort of a joint is the sum of n + r × f of all bodies beyond it along z, or of f for a prismatic joint.
Source: Luh, Walker & Paul, "On-line computational scheme for mechanical manipulators", ASME J. DSMC 102(2), 1980.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..plant.urdf import Urdf
from .kinematics import Array, Kinematics, Placement, rotated


class Observation(NamedTuple):
    """Position of a frame, m, rotation matrix, Jacobian (6 × n: linear, angular) and drift J̇ v (6), in root axes."""

    position: Array
    rotation: Array
    jacobian: Array
    drift: Array


class Dynamics:
    """A robot with gravity, rotors and a point mass (payload) in a frame; n independent joints.

    Args:
        joints: names of the n joints.
        frame: the link that carries the payload.
        gravity: in the root's axes, m/s².
        payload: the point mass, kg.
        offset: position of the payload in the frame, m.
        armature: rotor inertias, kg·m² or kg, n values.
    """

    def __init__(
        self,
        urdf: Urdf,
        joints: Sequence[str],
        frame: str,
        gravity: Sequence[float] | Array,
        payload: float,
        offset: Sequence[float] | Array,
        armature: Sequence[float] | Array,
    ) -> None:
        self._kinematics, self._frame, self._n = Kinematics(urdf, joints), frame, len(joints)
        self._tree = sorted(urdf.joints.values(), key=lambda joint: len(urdf.chain(joint.child)))
        self._gravity, self._armature = np.asarray(gravity), np.asarray(armature)
        self._bodies: dict[str, list[tuple[float, Array, Array]]] = {}
        for joint in self._tree:
            mass, com, inertia = self._kinematics.body(joint.child)
            self._bodies[joint.child] = [(mass, np.array(com), np.array(inertia).reshape(3, 3))]
        if payload and frame in self._bodies:
            self._bodies[frame].append((payload, np.asarray(offset), np.zeros((3, 3))))

    def _motion(self, q: Array, v: Array, a: Array) -> tuple[dict[str, tuple[Placement, Array, Array, Array]], Array]:
        """Return transform, angular velocity and accelerations of each link, and the axes of the joints."""
        count = len(q)
        rest = np.zeros((count, 3))
        links = {self._kinematics.urdf.root: (Placement(rest, np.tile(np.eye(3), (count, 1, 1))), rest, rest, rest)}
        axes = np.zeros((len(self._tree), count, 3))
        for k, joint in enumerate(self._tree):
            at, w, dw, acceleration = links[joint.parent]
            here = at * self._kinematics.in_parent(joint, q)
            column, ratio, _ = self._kinematics.column(joint)
            z, arm = rotated(here.rotation, joint.axis), here.translation - at.translation
            rate, change = (np.zeros((count, 1)) if column is None else ratio * x[:, column, None] for x in (v, a))
            carried, sideways = acceleration + _swung(dw, w, arm), np.cross(w, z) * rate
            if joint.prismatic:
                links[joint.child] = here, w, dw, carried + z * change + 2.0 * sideways
            else:
                links[joint.child] = here, w + z * rate, dw + z * change + sideways, carried
            axes[k] = z
        return links, axes

    def inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Return τ = M(q) a + h(q, v), N·m or N; all arrays have n columns, or one state has n values."""
        if a.ndim == 1:
            return np.asarray(self.inverse_dynamics(q[None], v[None], a[None])[0])
        links, axes = self._motion(q, v, a)
        tau = self._armature * a
        forces, moments = ({name: np.zeros((len(q), 3)) for name in links} for _ in range(2))
        for joint, z in zip(self._tree[::-1], axes[::-1]):
            at, w, dw, acceleration = links[joint.child]
            force, moment = forces[joint.child], moments[joint.child]
            for mass, com, inertia in self._bodies[joint.child]:
                c, I_world = rotated(at.rotation, com), at.rotation @ inertia @ at.rotation.transpose(0, 2, 1)
                push = mass * (acceleration + _swung(dw, w, c) - self._gravity)
                force = force + push
                moment = moment + rotated(I_world, dw) + np.cross(w, rotated(I_world, w)) + np.cross(c, push)
            column, ratio, _ = self._kinematics.column(joint)
            if column is not None:
                tau[:, column] += ratio * (z * (force if joint.prismatic else moment)).sum(axis=1)
            arm = at.translation - links[joint.parent][0].translation
            forces[joint.parent] += force
            moments[joint.parent] += moment + np.cross(arm, force)
        return tau

    def mass_matrix(self, q: Array) -> Array:
        """Return M(q), n × n."""
        n = self._n
        still, states = np.zeros((n + 1, n)), np.tile(q, (n + 1, 1))
        tau = self.inverse_dynamics(states, still, np.vstack([still[:1], np.eye(n)]))
        return np.asarray((tau[1:] - tau[0]).T)

    def observe(self, q: Array, v: Array) -> Observation:
        """Return position, rotation, Jacobian and drift of the frame."""
        links, _ = self._motion(q[None], v[None], np.zeros((1, self._n)))
        at, _, dw, acceleration = links[self._frame]
        jacobian = self._kinematics.jacobian(self._frame, q[None])[0]
        return Observation(at.translation[0], at.rotation[0], jacobian, np.hstack([acceleration[0], dw[0]]))


def _swung(dw: Array, w: Array, arm: Array) -> Array:
    """Return the acceleration of a point of a body relative to its origin."""
    return np.asarray(np.cross(dw, arm) + np.cross(w, np.cross(w, arm)))


def rotation_error(quat: Array, rotation: Array) -> Array:
    """Return the rotation from a matrix to a quaternion x, y, z, w of any length but 0, rad about the root's axes."""
    return np.asarray((Rotation.from_quat(quat) * Rotation.from_matrix(rotation).inv()).as_rotvec())
