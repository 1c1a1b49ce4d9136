"""The interface of control laws, which are the modules ``<name>_control``."""

from typing import TYPE_CHECKING, Any, Protocol

from .equations import Law, Ratios
from .mechanism import Mechanism
from .robot import Robot


class ControlledPlant:
    """The parts of a plant that control laws read.

    Each group of variables is an attribute of the same name, in SI units: a list of floats for a vector, and a float,
    int or bool for a scalar. Task vectors are in the root frame.
    """

    robot: Robot  # robot, control: the robot, and the name of its control law (a key of ``CONTROLS``)
    control: str
    known: Mechanism  # the control law's model of the robot

    if TYPE_CHECKING:

        def __getattr__(self, group: str) -> Any: ...
        def __setattr__(self, group: str, value: Any) -> None: ...


class ControlLaw(Protocol):
    """A module with a control law."""

    def command(self, plant: ControlledPlant, /) -> tuple[Law, Ratios]:
        """Return q̈_cmd or τ as a function of the state with inputs held, and the singular values of its Jacobian."""
