"""Read an FMU's file and run an instance of it; all uses of FMPy are here."""

from contextlib import redirect_stdout

with redirect_stdout(None):  # FMPy prints on aarch64-linux that it has no logger for FMI 2.0
    import fmpy  # noqa: F401

from ..export.start_values import Setting, no_variable, resolve, resolve_all
from .description import Fmu, load_any_fmu, opened, resource_reader
from .instance import Instance, Values
from .spans import SPAN, advancing
from .system import System, load_fmu
from .system_instance import SystemInstance, instantiate

__all__ = [
    "SPAN",
    "Fmu",
    "Instance",
    "Setting",
    "System",
    "SystemInstance",
    "Values",
    "advancing",
    "instantiate",
    "load_any_fmu",
    "load_fmu",
    "no_variable",
    "opened",
    "resolve",
    "resolve_all",
    "resource_reader",
]
