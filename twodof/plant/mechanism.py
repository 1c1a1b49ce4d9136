"""Kinematics and dynamics of a robot in its independent joint coordinates.

Joints that mimic others follow exactly: with the positions G q + c of all joints,

    M(q) = Gᵀ M_all G,    h(q, v) = Gᵀ h_all,    J(q) = J_all G.

Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 3.2; M_all, h_all and J_all are Pinocchio's.
"""

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from .equations import Array
from .robot import Robot

# looked up once, because a module attribute costs as much as the arithmetic of a call
forward_kinematics = pin.forwardKinematics
frame_jacobian = pin.computeFrameJacobian
frame_acceleration = pin.getFrameClassicalAcceleration
WORLD_ALIGNED = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class Mechanism:
    """A robot with gravity, rotors and a point mass (payload) in its task frame; n independent joints.

    Args:
        gravity: in the root's axes, m/s².
        payload: the point mass, kg.
        offset: position of the payload in the task frame, m.
        armature: rotor inertias, added to the diagonal of M, kg·m² or kg, n values.
    """

    def __init__(
        self, robot: Robot, gravity: Sequence[float], payload: float, offset: Sequence[float], armature: Sequence[float]
    ) -> None:
        model = robot.model.copy()
        model.armature[[model.getJointId(name) - 1 for name in robot.joints]] = armature
        model.gravity.linear = np.array(gravity)
        self._frame = robot.frame_id
        if payload:
            frame = model.frames[self._frame]
            mass = pin.Inertia(payload, frame.placement.act(np.array(offset)), np.zeros((3, 3)))
            model.inertias[frame.parentJoint] += mass
        self._model, self._data = model, model.createData()
        self._G, self._c = robot.coupling, robot.offset
        self._still = np.zeros(model.nv)
        self._upper = np.tri(model.nv, dtype=bool).T
        self._inverse_at: tuple[bytes, Array] = b"", self._still
        # both are views that Pinocchio updates
        self._placement: pin.SE3 = self._data.oMf[self._frame]
        self._position: Array = self._placement.translation

    def observe(self, q: Array, v: Array) -> tuple[list[float], list[list[float]], list[float]]:
        """Return position, Jacobian (6 × n: linear, angular) and drift J̇ v (6) of the task frame, in root axes."""
        if self._G is not None:
            q, v = self._G @ q + self._c, self._G @ v
        model, data, frame = self._model, self._data, self._frame
        forward_kinematics(model, data, q, v, self._still)
        J = frame_jacobian(model, data, q, frame, WORLD_ALIGNED)
        if self._G is not None:
            J = J @ self._G
        # with q̈ = 0, the acceleration of the frame is the drift
        drift = frame_acceleration(model, data, frame, WORLD_ALIGNED)
        rows = J.tolist() if J.ndim == 2 else J.reshape(6, 1).tolist()  # one joint: a vector
        return self._position.tolist(), rows, drift.vector.tolist()

    def effort_of_force(self, q: Array, v: Array, force: Sequence[float]) -> Array:
        """Return Jᵀ f of a force at the task frame, in the root's axes, n values."""
        effort: Array = np.array(force) @ np.array(self.observe(q, v)[1][:3])
        return effort

    @property
    def rotation(self) -> Array:
        """Return the rotation matrix of the task frame at the last observed state."""
        rotation: Array = self._placement.rotation
        return rotation

    def inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array:
        """Return τ = M(q) a + h(q, v), N·m or N, n values."""
        G = self._G
        if G is None:
            return np.asarray(pin.rnea(self._model, self._data, q, v, a))
        tau = pin.rnea(self._model, self._data, G @ q + self._c, G @ v, G @ a)
        return np.asarray(G.T @ tau)

    def effort_sizes(self, q: Array, v: Array, a: Array, force: Sequence[float]) -> Array:
        """Return |M a + h| + |h| + |Jᵀ f|, N·m or N, n values; f acts at the task frame, in the root's axes."""
        both = self.inverse_dynamics(q, v, a), self.inverse_dynamics(q, v, np.zeros(len(q)))
        return np.asarray(np.abs([*both, self.effort_of_force(q, v, force)]).sum(axis=0))

    def forward_dynamics(self, q: Array, v: Array, tau: Array) -> Array:
        """Return q̈ = M(q)⁻¹ (τ − h(q, v)), rad/s² or m/s², n values."""
        if self._G is None:
            return np.asarray(pin.aba(self._model, self._data, q, v, tau))
        h = self.inverse_dynamics(q, v, np.zeros(len(q)))
        return np.asarray(np.linalg.solve(self.mass_matrix(q), tau - h))

    def mass_matrix(self, q: Array) -> Array:
        """Return M(q), n × n."""
        G = self._G
        M = self._symmetric(pin.crba(self._model, self._data, q if G is None else G @ q + self._c))
        return M if G is None else np.asarray(G.T @ M @ G)

    def inverse_mass(self, q: Sequence[float] | Array) -> Array:
        """Return M(q)⁻¹, n × n; callers do not change it."""
        q = np.array(q)
        key = q.tobytes()
        if key != self._inverse_at[0]:  # friction and stops ask for it at the same positions
            if self._G is not None:
                inverse: Array = np.asarray(np.linalg.inv(self.mass_matrix(q)))
            else:
                inverse = self._symmetric(pin.computeMinverse(self._model, self._data, q))
            self._inverse_at = key, inverse
        return self._inverse_at[1]

    def _symmetric(self, M: Array) -> Array:
        """Return a matrix of which Pinocchio has computed the upper triangle."""
        return np.where(self._upper, M, M.T)
