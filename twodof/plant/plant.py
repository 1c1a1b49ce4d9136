"""The plant: a robot under operational-space control, with its state, inputs and parameters.

    τ = M(q) q̈_cmd + h(q, v)                          inverse dynamics (RNEA)
    q̈ = M(q)⁻¹ (sat(τ) + tau_ext − D v − h(q, v))      forward dynamics (ABA)

Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapters 5 and 7; here Pinocchio's.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import mul

import numpy as np
import pinocchio as pin

from .controller import apply_pseudo_inverse
from .integrator import BUDGET, STAGES, Acceleration, Array, StepError, advance
from .robot import Robot
from .variables import Variable

# looked up once: an attribute of the module costs as much as a call's arithmetic
forward_kinematics = pin.forwardKinematics
frame_jacobian = pin.computeFrameJacobian
frame_acceleration = pin.getFrameClassicalAcceleration
WORLD_ALIGNED = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class ParameterError(ValueError):
    """A parameter or input with a value that makes no sense; the message names it."""


class DiscardError(ArithmeticError):
    """A communication step that cannot be done; the message names the culprit and the remedy."""


class Plant:
    """A robot and its controller as a system with inputs, parameters, state and outputs.

    Every variable of the table is an attribute of its group's name: lists of floats for vectors
    (SI units; task vectors in the root frame), floats and a bool for scalars. ``q`` and ``v`` are
    the state; ``x`` and ``tau`` are computed when read.
    """

    x_des: list[float]
    xd_des: list[float]
    xdd_des: list[float]
    Kp: list[float]
    Kd: list[float]
    tau_ext: list[float]
    Kn: float
    q_start: list[float]
    v_start: list[float]
    q_min: list[float]
    q_max: list[float]
    gravity: list[float]
    rcond: float
    rtol: float
    atol: float
    max_step: float
    limit_effort: bool

    def __init__(self, robot: Robot, table: Sequence[Variable]) -> None:
        self.robot = robot
        for variable in table:
            if variable.causality == "output":
                continue
            if variable.index is None:
                setattr(self, variable.group, variable.start)
            elif variable.index == 0:
                setattr(self, variable.group, [variable.start])
            else:
                getattr(self, variable.group).append(variable.start)
        self.q = list(self.q_start)
        self.v = list(self.v_start)
        self._model = robot.model.copy()
        self._data = self._model.createData()
        self._still = np.zeros(len(robot.joints))
        self._axes = ["xyz".index(axis) for axis in robot.axes]
        # a view: it follows what Pinocchio computes
        self._position = self._data.oMf[robot.frame_id].translation

    def initialise(self) -> list[str]:
        """Check the parameters and set the state to its start; what was clamped, a line each.

        Raises:
            ParameterError: naming the parameter and what it must be.
        """
        self._check_parameters()
        self.prepare()
        warnings = []
        self.q = []
        self.v = []
        for i, joint in enumerate(self.robot.joints):
            q, v, low, high = self.q_start[i], self.v_start[i], self.q_min[i], self.q_max[i]
            inside = min(max(q, low), high)
            if inside != q:
                warnings.append(
                    f"q_start[{i + 1}] = {q:g} of joint '{joint}' is outside its limits"
                    f" [{low:g}, {high:g}] and was clamped to {inside:g}"
                )
            into = (inside >= high and v > 0.0) or (inside <= low and v < 0.0)
            self.q.append(inside)
            self.v.append(0.0 if into else v)
        return warnings

    def prepare(self) -> None:
        """Take over parameters that were set directly, as after restoring a state."""
        self._model.gravity.linear = np.array(self.gravity)

    def step(self, h: float) -> None:
        """Advance the state by one communication step of h seconds, inputs held.

        Raises:
            DiscardError: the motion is too fast for the integrator, or its values would no longer
                be finite; the state is left as it was.
        """
        if STAGES * h > BUDGET * self.max_step:
            raise DiscardError(
                f"max_step = {self.max_step:g} s divides a step of {h:g} s into more than"
                f" {BUDGET // STAGES} integration steps; enlarge max_step or shorten the step"
            )
        self._hold_inputs()
        limits = list(zip(self.q_min, self.q_max))
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # an exception tells it
                self.q, self.v = advance(
                    self._equations_of_motion(), self.q, self.v, h, limits,
                    self.rtol, self.atol, self.max_step,
                )  # fmt: skip
        except FloatingPointError as error:
            raise DiscardError(str(error)) from error
        except StepError as error:
            need = f"more than {BUDGET} evaluations for the step of {h:g} s"
            if error.too_fine:
                need = "integration steps below the resolution of time"
            raise DiscardError(
                f"rtol = {self.rtol:g} and atol = {self.atol:g} need {need}: joint"
                f" '{self.robot.joints[error.joint]}' changes at a rate of {error.rate:.3g} 1/s;"
                " shorten the step, lessen damping or gains, or enlarge rtol and atol"
            ) from error

    @property
    def x(self) -> list[float]:
        """Position of the task frame along the task axes, m, root frame."""
        q = np.array(self.q)
        pin.framesForwardKinematics(self._model, self._data, q)
        position: list[float] = self._position.tolist()
        return [position[axis] for axis in self._axes]

    @property
    def tau(self) -> list[float]:
        """Control effort applied at the current state and inputs, N·m or N."""
        self._hold_inputs()
        tau: list[float] = self._control_effort(np.array(self.q), np.array(self.v))[0].tolist()
        return tau

    def _hold_inputs(self) -> None:
        self._task = list(zip(self._axes, self.x_des, self.xd_des, self.xdd_des, self.Kp, self.Kd))

    def _commanded_acceleration(self, q: Array, v: Array) -> tuple[list[float], int]:
        """q̈_cmd of the controller at a state, n values, and the rank of its J⁺."""
        model, data, frame = self._model, self._data, self.robot.frame_id
        forward_kinematics(model, data, q, v, self._still)
        jacobian = frame_jacobian(model, data, q, frame, WORLD_ALIGNED).tolist()
        # with q̈ = 0 the frame's acceleration is the drift J̇v
        drift = frame_acceleration(model, data, frame, WORLD_ALIGNED).linear.tolist()
        x = self._position.tolist()
        velocity = v.tolist()
        Kn, several = self.Kn, len(velocity) > 1
        rows, command = [], []
        for axis, x_des, xd_des, xdd_des, Kp, Kd in self._task:
            row = jacobian[axis] if several else [jacobian[axis]]
            xd = sum(map(mul, row, velocity))
            rows.append(row)
            command.append(
                xdd_des + Kd * (xd_des - xd) + Kp * (x_des - x[axis]) - drift[axis] + Kn * xd
            )
        qdd, rank = apply_pseudo_inverse(rows, command, self.rcond)
        return [a - Kn * vi for a, vi in zip(qdd, velocity)] if Kn else qdd, rank

    def _control_effort(self, q: Array, v: Array) -> tuple[Array, int]:
        command, rank = self._commanded_acceleration(q, v)
        tau: Array = pin.rnea(self._model, self._data, q, v, np.array(command))
        if self.limit_effort:
            tau = np.clip(tau, -np.array(self.robot.effort), self.robot.effort)
        return tau, rank

    def _equations_of_motion(self) -> Acceleration:
        damping = np.array(self.robot.damping)
        external = np.array(self.tau_ext)
        if not (self.limit_effort or damping.any() or external.any()):
            return self._commanded_acceleration  # M⁻¹(M q̈_cmd + h − h)

        def acceleration(q: Array, v: Array) -> tuple[list[float], int]:
            tau, rank = self._control_effort(q, v)
            effort = tau + external - damping * v
            return pin.aba(self._model, self._data, q, v, effort).tolist(), rank

        return acceleration

    def _check_parameters(self) -> None:
        for name in ("rtol", "atol", "max_step"):
            if not getattr(self, name) > 0.0:
                raise ParameterError(f"{name} = {getattr(self, name):g} must be > 0")
        if not 0.0 <= self.rcond < 1.0:
            raise ParameterError(f"rcond = {self.rcond:g} must be in [0, 1)")
        for i, (low, high) in enumerate(zip(self.q_min, self.q_max)):
            if low > high:
                raise ParameterError(
                    f"q_min[{i + 1}] = {low:g} > q_max[{i + 1}] = {high:g}"
                    f" (joint '{self.robot.joints[i]}')"
                )
