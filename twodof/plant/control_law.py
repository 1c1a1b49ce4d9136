"""The interface of control laws, which are the modules ``<name>_control``."""

from typing import Protocol

from .equations import Law, Ratios
from .mechanism import Mechanism
from .robot import Robot


class ControlledPlant:
    """The parts of a plant that control laws read.

    Attributes:
        robot, control: the robot and the name of its law, a key of ``CONTROLS``.
        known: the robot as its control law knows it.
        x_des, …, rcond: the inputs and parameters of the laws, of which a plant has those of its own law.
    """

    robot: Robot
    control: str
    known: Mechanism
    x_des: list[float]
    xd_des: list[float]
    xdd_des: list[float]
    quat_des: list[float]
    omega_des: list[float]
    alpha_des: list[float]
    Kp_rot: list[float]
    Kd_rot: list[float]
    q_des: list[float]
    v_des: list[float]
    a_des: list[float]
    Kp: list[float]
    Kd: list[float]
    tau_cmd: list[float]
    Kn: float
    rcond: float


class ControlLaw(Protocol):
    """A module with a control law."""

    def command(self, plant: ControlledPlant, /) -> tuple[Law, Ratios]:
        """Return q̈_cmd or τ as a function of the state, inputs held, and the singular values of its Jacobian."""
