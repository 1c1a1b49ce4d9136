"""The interface of control laws, which are the modules ``<name>_control``."""

from typing import TYPE_CHECKING, Any, Protocol

from .equations import Law, Ratios
from .mechanism import Mechanism
from .robot import Robot


class ControlledPlant:
    """The parts of a plant that control laws read.

    Attributes:
        robot, control: the robot and the name of its law, a key of ``CONTROLS``.
        known: the robot as its control law knows it.

    Each variable of the table is an attribute of its group's name: a list of floats of a vector, in SI units, task
    vectors in the root frame; a float, int or bool of a scalar.
    """

    robot: Robot
    control: str
    known: Mechanism

    if TYPE_CHECKING:

        def __getattr__(self, group: str) -> Any: ...
        def __setattr__(self, group: str, value: Any) -> None: ...


class ControlLaw(Protocol):
    """A module with a control law."""

    def command(self, plant: ControlledPlant, /) -> tuple[Law, Ratios]:
        """Return q̈_cmd or τ as a function of the state, inputs held, and the singular values of its Jacobian."""
