"""The tutorial's program as written, without its ROS 2 node. Do not use it: it is wrong.

The benchmark measures it. Its two mistakes are kept and marked: the Jacobian is in the frame of the end effector
although the error is in the world frame, and the Jacobian's time variation is read although nothing computes it. Its
solver call, its ``pinv``, its order of calls and its clock that accumulates steps are the tutorial's too. The equations
that it intends are those of ``twodof.plant``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp


class PendulumSimulator:
    """The tutorial's node: ``step`` is its timer's callback; it publishes ``q`` and ``v``."""

    def __init__(self, urdf_path: str | Path) -> None:
        self.model = pin.buildModelFromUrdf(str(urdf_path))
        self.model.gravity.linear = np.array([0.0, -9.81, 0.0])
        self.data = self.model.createData()
        self.ee_frame_id = self.model.getFrameId("EndEffector")

        self.q = np.array([0.5, 0.35])
        self.v = np.zeros(2)
        self.q_min = np.array([-np.pi, -np.pi])
        self.q_max = np.array([np.pi, np.pi])
        self.x_des = np.array([0.2, 0.05])
        self.Kp = np.diag([50.0, 50.0])
        self.Kd = np.diag([40.0, 40.0])
        self.t = 0.0
        self.dt = 0.01

    def control(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        pin.forwardKinematics(self.model, self.data, q, v)
        pin.updateFramePlacements(self.model, self.data)
        pin.computeJointJacobians(self.model, self.data, q)
        x = self.data.oMf[self.ee_frame_id].translation[:2]
        # first mistake: LOCAL, where x_des - x is in the world's axes
        J = pin.getFrameJacobian(self.model, self.data, self.ee_frame_id, pin.ReferenceFrame.LOCAL)[:2, :]
        # second mistake: nothing has called computeJointJacobiansTimeVariation, so this is 0
        dJ = pin.getFrameJacobianTimeVariation(self.model, self.data, self.ee_frame_id, pin.ReferenceFrame.LOCAL)[:2, :]
        x_ddot = self.Kp @ (self.x_des - x) - self.Kd @ (J @ v)
        q_ddot = np.linalg.pinv(J) @ (x_ddot - dJ @ v)
        M = pin.crba(self.model, self.data, q)
        h = pin.nonLinearEffects(self.model, self.data, q, v)
        return M @ q_ddot + h

    def dynamics(self, t: float, y: np.ndarray) -> np.ndarray:
        q, v = y[:2], y[2:]
        tau = self.control(q, v)
        q_ddot = pin.aba(self.model, self.data, q, v, tau)
        return np.concatenate((v, q_ddot))

    def enforce_limits(self) -> None:
        for i in range(2):
            if self.q[i] <= self.q_min[i]:
                self.q[i] = self.q_min[i]
                self.v[i] = max(0.0, self.v[i])
            elif self.q[i] >= self.q_max[i]:
                self.q[i] = self.q_max[i]
                self.v[i] = min(0.0, self.v[i])

    def step(self) -> None:
        self.enforce_limits()
        y = np.concatenate((self.q, self.v))
        span = [self.t, self.t + self.dt]
        solution = solve_ivp(self.dynamics, span, y, method="RK45", max_step=0.001)
        self.q, self.v = solution.y[:2, -1], solution.y[2:, -1]
        self.enforce_limits()
        self.t += self.dt
