"""An FMU's file and an instance of it, whoever made it. All of FMPy is here."""

from .description import Fmu, load_fmu, read_resource
from .instance import Instance, instantiate

__all__ = ["Fmu", "Instance", "instantiate", "load_fmu", "read_resource"]
