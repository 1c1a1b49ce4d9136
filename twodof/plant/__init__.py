"""The plant: what runs inside the FMU. Imports numpy and pinocchio, and nothing of the package."""

from .plant import DiscardError, ParameterError, Plant
from .robot import Robot, load_robot
from .urdf import UNBOUNDED, RobotError
from .variables import Variable, variable_table

__all__ = [
    "UNBOUNDED",
    "DiscardError",
    "ParameterError",
    "Plant",
    "Robot",
    "RobotError",
    "Variable",
    "load_robot",
    "variable_table",
]
