"""Read an FMU's file and run an instance of it; all uses of FMPy are here."""

from contextlib import redirect_stdout

with redirect_stdout(None):  # FMPy prints on aarch64-linux that it has no logger for FMI 2.0
    import fmpy  # noqa: F401

from ..export.start_values import Setting as Setting
from ..export.start_values import no_variable as no_variable
from ..export.start_values import resolve as resolve
from ..export.start_values import resolve_all as resolve_all
from .description import Fmu as Fmu
from .description import load_any_fmu as load_any_fmu
from .description import opened as opened
from .description import resource_reader as resource_reader
from .instance import Instance as Instance
from .instance import Values as Values
from .spans import SPAN as SPAN
from .spans import advancing as advancing
from .spans import evaluations_in as evaluations_in
from .system import System as System
from .system import load_fmu as load_fmu
from .system_instance import SystemInstance as SystemInstance
from .system_instance import instantiate as instantiate
