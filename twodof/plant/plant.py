"""The plant: a robot under a control law, with its state, inputs, outputs and parameters.

    τ = M(q) q̈_cmd + h(q, v)                                    inverse dynamics (RNEA)
    q̈ = M(q)⁻¹ (sat(τ) + tau_ext + Jᵀ f_ext − D v − h(q, v) + λ)     forward dynamics (ABA)

Under effort control, τ is an input. λ is the effort of friction and stops (``stops``). M and h include the payload in
forward dynamics, and in inverse dynamics only with ``payload_known``. M includes the armature in both.

Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapters 5 and 7; here Pinocchio's.
"""

import contextlib
from collections.abc import Iterator, Sequence
from math import inf
from operator import itemgetter, mul

import numpy as np

from . import effort_control, joint_control, task_control
from .control_law import ControlLaw, ControlledPlant
from .dormand_prince import STAGES
from .equations import Answer, Array, Equations, Law, Response
from .mechanism import Mechanism
from .orientation import quaternion
from .regime import BUDGET, StepError
from .robot import Robot
from .sampling import Sampling, advance_sampled, sampling_refusal
from .stops import Stops
from .variables import CONTROLS, OF_ORIENTATION, RANGES, Variable

LAWS: dict[str, ControlLaw] = {
    "task": task_control,
    "pose": task_control,
    "joint": joint_control,
    "effort": effort_control,
}


class ParameterError(ValueError):
    """A parameter or input has an invalid value; the message names it."""


class DiscardError(ArithmeticError):
    """A communication step cannot be completed; the message names the culprit and the remedy."""


@contextlib.contextmanager
def refusing(kind: type[Exception]) -> Iterator[None]:
    """Convert a failure of arithmetic into an exception of the given kind."""
    try:
        yield
    except FloatingPointError as error:
        raise kind(str(error)) from error
    except np.linalg.LinAlgError as error:
        raise kind(
            "a matrix of the equations of motion is singular or not finite: inputs, payload or speeds are too large"
        ) from error


class Plant(ControlledPlant):
    """A robot and its control law as a system with inputs, parameters, state and outputs.

    Its variables are attributes (``ControlledPlant``). ``q`` and ``v`` are the state. Reading ``x``, ``xd``, ``tau``,
    ``der_q`` or ``der_v`` computes the value.

    Attributes:
        known: the control law's model of the robot.
        time: time of the state, s.
        sampling: discrete state of the sampled controller and its sensors.
    """

    def __init__(self, robot: Robot, table: Sequence[Variable], control: str = "task") -> None:
        self.robot, self.control, self._table = robot, control, table
        self._law, self._commands = LAWS[control].command, CONTROLS[control].commands
        self.time = 0.0
        for variable in table:
            if variable.causality in ("output", "local"):
                continue
            if variable.index is None:
                setattr(self, variable.group, variable.start)
            elif variable.index == 0:
                setattr(self, variable.group, [variable.start])
            else:
                getattr(self, variable.group).append(variable.start)
        self.q = list(self.q_start)
        self.v = list(self.v_start)
        self.sampling = Sampling.begin(len(self.q), self.time)
        self._axes = ["xyz".index(axis) for axis in robot.axes]
        self._rows = [*self._axes, *((3, 4, 5) if OF_ORIENTATION & {v.group for v in table} else ())]
        self._swing = robot.swing()
        self.prepare()

    def initialise(self) -> list[str]:
        """Check the parameters and set the state to its start; return a line for each clamped value.

        Raises:
            ParameterError: a parameter is invalid; the message names it and its valid values.
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
            self.q.append(inside)
            self.v.append(v)
        y = [*self.q, *self.v]
        with refusing(ParameterError):
            self.stops().impact(y, [False] * len(self.q))
        self.v = y[len(self.q) :]
        self.sampling = Sampling.begin(len(self.q), self.time)
        return warnings

    def prepare(self) -> None:
        """Apply parameters that were set directly, for example by restoring a state."""
        offset, armature = self.payload_com, self.armature
        self._real = self.known = Mechanism(self.robot, self.gravity, self.payload, offset, armature)
        if self.payload and not getattr(self, "payload_known", False):
            self.known = Mechanism(self.robot, self.gravity, 0.0, offset, armature)

    def step(self, h: float, time: float | None = None) -> None:
        """Advance the state by one communication step of h seconds with inputs held.

        Args:
            time: time of the communication point at which the step begins, s; None: the plant's own time.

        Raises:
            DiscardError: the motion is too fast for the integrator, a value would not be finite, or the control law
                cannot follow an input. The state is then unchanged.
        """
        self._check_target()
        limits = {"max_step": self.max_step, "control_period": self.control_period or inf}
        name, shortest = min(limits.items(), key=itemgetter(1))
        if STAGES * h > BUDGET * shortest:
            raise DiscardError(
                f"{name} = {shortest:g} s divides a step of {h:g} s into more than"
                f" {BUDGET // STAGES} integration steps; increase {name} or shorten the step"
            )
        before = self.q, self.v, self.sampling, self.time
        self.time = self.time if time is None else time
        try:
            # an overflow is refused, without a warning of NumPy
            with refusing(DiscardError), np.errstate(over="ignore", invalid="ignore"):
                advance_sampled(self, h)
        except BaseException as error:
            self.q, self.v, self.sampling, self.time = before
            if not isinstance(error, StepError):
                raise
            joint = f"joint '{self.robot.joints[error.joint]}'"
            if not error.finite:
                raise DiscardError(
                    "the equations of motion gave a value that is not finite: inputs, payload or speeds are too large,"
                    f" or {joint}, which changes at a rate of {error.rate:.3g} 1/s, needs armature or a lock"
                ) from error
            need = f"more than {BUDGET} evaluations for the step of {h:g} s"
            if error.too_fine:
                need = "integration steps below the resolution of time"
            raise DiscardError(
                f"rtol = {self.rtol:g} and atol = {self.atol:g} need {need}:"
                f" {joint} changes at a rate of {error.rate:.3g} 1/s;"
                " shorten the step, reduce damping or gains, or increase rtol and atol"
            ) from error
        self.time += h

    @property
    def x(self) -> list[float]:
        """Position of the task frame along the task axes, m, root frame."""
        position = self._observed()[0]
        return [position[axis] for axis in self._axes]

    @property
    def xd(self) -> list[float]:
        """Velocity of the task frame along the task axes, m/s, root frame."""
        jacobian = self._observed()[1]
        return [sum(map(mul, jacobian[axis], self.v)) for axis in self._axes]

    @property
    def quat(self) -> list[float]:
        """Orientation of the task frame in the root's, a unit quaternion x, y, z, w with w ≥ 0."""
        self._observed()
        return quaternion(self._real.rotation)

    @property
    def omega(self) -> list[float]:
        """Angular velocity of the task frame about the root's axes, rad/s."""
        return [sum(map(mul, row, self.v)) for row in self._observed()[1][3:]]

    @property
    def M(self) -> list[float]:
        """Mass matrix of the robot with payload and armature, row by row."""
        return list(self._real.mass_matrix(np.array(self.q)).flat)

    @property
    def h(self) -> list[float]:
        """Effort of gravity, Coriolis and centrifugal forces, n values."""
        return list(self._real.inverse_dynamics(np.array(self.q), np.array(self.v), np.zeros(len(self.q))))

    @property
    def J(self) -> list[float]:
        """Jacobian of the task, row by row: the task axes and, with an orientation, the rotations about x, y and z."""
        jacobian = self._observed()[1]
        return [element for row in self._rows for element in jacobian[row]]

    @property
    def drift(self) -> list[float]:
        """Acceleration of the task at zero joint accelerations, J̇ v."""
        drift = self._observed()[2]
        return [drift[row] for row in self._rows]

    @property
    def tau(self) -> list[float]:
        """Control effort applied at the current state and inputs, N·m or N.

        Raises:
            DiscardError: an input that the control law cannot follow.
        """
        self._check_target()
        return self._settled().effort if self.control_period else self.commanded_effort(self.q, self.v)

    @property
    def q_meas(self) -> list[float]:
        """Positions that the controller measured at its latest sample, n values, rad or m."""
        return self._settled().q_meas

    @property
    def v_meas(self) -> list[float]:
        """Velocities that the controller measured at its latest sample, n values, rad/s or m/s."""
        return self._settled().v_meas

    def commanded_effort(self, q: Sequence[float], v: Sequence[float]) -> list[float]:
        """Return the effort that the control law commands for a measured state, limits included, n values."""
        command, _ = self._law(self)
        tau: list[float] = self._control_effort(command, np.array(q), np.array(v), None)[0].tolist()
        return tau

    def _settled(self) -> Sampling:
        """Return the sampled controller's state after all events that are due at the present time."""
        with refusing(DiscardError):
            return self.sampling.settled(self, self.time)

    @property
    def der_q(self) -> list[float]:
        """Derivative of q: v."""
        return list(self.v)

    @property
    def der_v(self) -> list[float]:
        """Derivative of v at the current state and inputs; 0 for joints at rest.

        Raises:
            DiscardError: an input that the control law cannot follow.
        """
        self._check_target()
        before, self.sampling = self.sampling, self._settled()
        try:
            with refusing(DiscardError):
                equations, stops = self.equations_of_motion(), self.stops()
                slip = stops.slide(self.v)
                rates = list(equations.acceleration(np.array(self.q), np.array(self.v), None, slip)[0])
                stops.hold([*self.q, *self.v], rates, [False] * len(self.q))
        finally:
            self.sampling = before
        return rates

    def equations_of_motion(self) -> Equations:
        """Return the equations of motion with the present inputs held, or the effort of a sampled controller."""
        held = effort_control.given_effort(self.sampling.effort)
        command, ratios = held if self.control_period else self._law(self)
        rcond = self.rcond if "rcond" in CONTROLS[self.control].parameters else 0.0
        damping = self.damping if any(self.damping) else ()
        return Equations(self._acceleration(command), ratios, rcond, self._swing, damping)

    def _acceleration(self, command: Law) -> Response:
        """Return q̈ under a control law."""
        damping, external = np.array(self.damping), np.array(self.tau_ext)
        force, friction = any(self.f_ext), np.array(self.friction)
        # q̈ = q̈_cmd + M⁻¹(…), because rounding of M q̈_cmd + h − h would move joints at rest
        cancels = self._commands == "acceleration" and self.known is self._real
        cancels = cancels and not self.limit_effort and not self.control_period
        if cancels and not (damping.any() or external.any() or force or friction.any()):
            return lambda q, v, rank, slip: command(q, v, rank)

        def acceleration(q: Array, v: Array, rank: int | None, slip: Sequence[int]) -> Answer:
            effort = external - damping * v - friction * slip
            if force:
                effort += self._real.effort_of_force(q, v, self.f_ext)
            if cancels:
                given, rank, margin = command(q, v, rank)
                return np.add(given, self._real.inverse_mass(q) @ effort).tolist(), rank, margin
            if self.control_period:
                given, rank, margin = command(q, v, rank)
                tau = np.array(given)
            else:
                tau, rank, margin = self._control_effort(command, q, v, rank)
            return self._real.forward_dynamics(q, v, tau + effort).tolist(), rank, margin

        return acceleration

    def stops(self) -> Stops:
        """Return friction and joint limits as the integrator's stops, rigid or clamping."""
        limits = list(zip(self.q_min, self.q_max))
        return Stops(limits, self.friction, self._real.inverse_mass, self._acting_efforts, rigid=self.rigid_stops)

    def _acting_efforts(self, y: Sequence[float], a: Sequence[float]) -> Array:
        """Return the sum of the efforts' magnitudes on each joint, n values; the efforts themselves may cancel."""
        q, v = np.array(y).reshape(2, -1)
        given = np.abs(self.tau_ext) + np.abs(np.multiply(self.damping, v))
        return np.asarray(given + self._real.effort_sizes(q, v, np.array(a), self.f_ext))

    def _observed(self) -> tuple[list[float], list[list[float]], list[float]]:
        return self._real.observe(np.array(self.q), np.array(self.v))

    def _control_effort(self, command: Law, q: Array, v: Array, rank: int | None) -> tuple[Array, int, float]:
        given, rank, margin = command(q, v, rank)
        tau: Array = np.array(given)
        if self._commands == "acceleration":
            tau = self.known.inverse_dynamics(q, v, tau)
        if self.limit_effort:
            tau = np.clip(tau, -np.array(self.robot.effort), self.robot.effort)
        return tau, rank, margin

    def _check_target(self) -> None:
        if self.control == "pose" and not any(self.quat_des):
            raise DiscardError("quat_des = 0, 0, 0, 0 is not an orientation; the identity is (0, 0, 0, 1)")

    def _check_parameters(self) -> None:
        try:
            self._check_target()
        except DiscardError as error:
            raise ParameterError(str(error)) from error
        for variable in self._table:
            if variable.group in RANGES:
                value = getattr(self, variable.group)
                value = value if variable.index is None else value[variable.index]
                if refusal := variable.refusal(value):
                    raise ParameterError(refusal)
        if reason := sampling_refusal(self, of_points=self.control == "effort"):
            raise ParameterError(reason)
        for i, (low, high) in enumerate(zip(self.q_min, self.q_max)):
            if low > high:
                raise ParameterError(
                    f"q_min[{i + 1}] = {low:g} > q_max[{i + 1}] = {high:g} (joint '{self.robot.joints[i]}')"
                )
