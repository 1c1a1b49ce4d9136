"""The Python flavour's slave: adapts the plant to FMI 2.0 co-simulation through pythonfmu.

The FMU contains it as ``slave_<digest>.py``, next to the package ``twodof_<digest>``. The names are unique, because the
wrapper imports modules by name into ``sys.modules``, which several FMUs may share.

The wrapper converts an exception to fmi2Fatal, after which no call is allowed. Therefore no method raises after
instantiation: a refused call is logged, changes nothing, and makes the next doStep return fmi2Discard. The FMI state
machine is the table ``ALLOWED``.
"""

import importlib
import json
import re
import site
import sys
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from functools import partialmethod
from math import isfinite
from pathlib import Path

PACKAGE = __name__.replace("slave_", "twodof_")
fmi = importlib.import_module(f"{PACKAGE}.pythonfmu.fmi2slave")
Status = importlib.import_module(f"{PACKAGE}.pythonfmu.enums").Fmi2Status

PHASES = ("instantiated", "initialization mode", "step mode", "terminated", "error")
INSTANTIATED, INITIALIZATION, STEP, TERMINATED, ERROR = PHASES
ALLOWED = {
    "fmi2SetupExperiment": {INSTANTIATED},
    "fmi2EnterInitializationMode": {INSTANTIATED},
    "fmi2ExitInitializationMode": {INITIALIZATION},
    "fmi2DoStep": {STEP},
    "fmi2Terminate": {STEP, ERROR},
    "fmi2Get": {INITIALIZATION, STEP, TERMINATED, ERROR},
    "fmi2Set of a parameter": {INSTANTIATED, INITIALIZATION},
    "fmi2Set of an input": {INSTANTIATED, INITIALIZATION, STEP},
}
COMPUTED = ("output", "local")  # causalities
TIME_TOLERANCE = 1e-9
MAX_STATE = 64 * 1024  # bytes, of a serialised state; that of 128 joints has half of them
UNSOUND = "invalid FMU state"


def import_plant(resources: Path, site_packages: list[str]):
    """Import this FMU's plant module; if a package is missing, name the remedy."""
    for package in sys.modules.keys() & {PACKAGE, f"{PACKAGE}.plant"}:  # an earlier instance's
        sys.modules[package].__path__ = [str(resources.joinpath(*package.split(".")))]
    with suppress(ModuleNotFoundError):
        return importlib.import_module(f"{PACKAGE}.plant.plant")
    for folder in site_packages:
        site.addsitedir(folder)  # reads .pth files, which pin needs
    try:
        return importlib.import_module(f"{PACKAGE}.plant.plant")
    except ModuleNotFoundError as missing:
        version = ".".join(map(str, sys.version_info[:3]))
        linked = f" and neither have {', '.join(site_packages)}" if site_packages else ""
        message = (
            f"the Python of this process ({version}, {sys.prefix}) has no package"
            f" '{missing.name}'{linked}: install resources/requirements.txt of this FMU into it,"
            " or see documentation/externalDependencies.txt, or build the FMU with the option"
            " link_environment, or use the native FMU, which needs no Python"
        )
        print(message, file=sys.stderr)  # some importers show no log
        raise ImportError(message) from None


class TwoDofSlave(fmi.Fmi2Slave):
    """An instance of the FMU, with its files in ``self.resources``."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        resources = Path(self.resources)
        config = json.loads((resources / "plant.json").read_text("utf-8"))
        self._plant_module = import_plant(resources, config["site_packages"])
        urdf = (resources / "robot.urdf").read_text("utf-8")
        robot = importlib.import_module(f"{PACKAGE}.plant.robot").load_robot(urdf, config["frame"], config["axes"])
        starts = {k: tuple(v) if isinstance(v, list) else v for k, v in config["starts"].items()}
        variables = importlib.import_module(f"{PACKAGE}.plant.variables")
        self._table = variables.variable_table(robot, starts, config["control"], config["outputs"])
        self._plant = self._plant_module.Plant(robot, self._table, config["control"])
        self._identity = config["identity"]
        self._phase = INSTANTIATED
        self._refused = ""
        self._outputs: dict[str, list[float]] = {}

    # --- life cycle ---

    def setup_experiment(self, start_time, stop_time=None, tolerance=None):
        if not self._allowed("fmi2SetupExperiment"):
            return
        if not isfinite(start_time):
            self._refuse(f"fmi2SetupExperiment: start time {start_time} is not finite")
            return
        if tolerance is not None:
            self.log("the tolerance of the experiment is ignored: rtol and atol are parameters")
        self._plant.time = start_time

    def enter_initialization_mode(self):
        if self._allowed("fmi2EnterInitializationMode"):
            self._phase = INITIALIZATION

    def exit_initialization_mode(self):
        if self._allowed("fmi2ExitInitializationMode"):
            warnings = self._initialise()
            self._phase = ERROR if warnings is None else STEP
            for line in warnings or ():
                self._log(line, Status.warning)

    def do_step(self, current_time, step_size):
        if self._refused:
            self._log(f"step discarded: {self._refused}", Status.discard)
            self._refused = ""
            return False
        if not self._allowed("fmi2DoStep"):
            self._refused = ""  # the discarded step reports it
            return False
        time = self._plant.time
        if not abs(current_time - time) <= TIME_TOLERANCE * max(1.0, abs(time)):
            return self._discard(
                f"fmi2DoStep: the communication point {current_time!r} s is not the time of the FMU, {time!r} s"
            )
        if not (step_size > 0.0 and isfinite(step_size)):
            return self._discard(f"fmi2DoStep: the step {step_size!r} s must be finite and > 0")
        try:
            self._plant.step(step_size, current_time)
        except self._plant_module.DiscardError as error:
            return self._discard(f"fmi2DoStep at {current_time!r} s: {error}")
        except KeyboardInterrupt:  # SIGINT of the process; if re-raised, it would be fatal
            return self._discard(f"fmi2DoStep at {current_time!r} s: interrupted")
        self._outputs.clear()
        return True

    def terminate(self):
        if self._allowed("fmi2Terminate"):
            self._phase = TERMINATED

    # --- variables ---

    def _get(self, vrs, kind, nothing):
        if self._phase not in ALLOWED["fmi2Get"]:
            # some importers read start values too early, which is only logged
            self._log(f"fmi2Get{kind} is not allowed in the state '{self._phase}'", Status.error)
            return [nothing] * len(vrs)
        if self._phase == INITIALIZATION and not self._outputs and self._initialise() is None:
            return [nothing] * len(vrs)
        values = []
        for vr in vrs:
            variable = self._variable(vr, kind, f"fmi2Get{kind}")
            if variable is None:
                values.append(nothing)
            elif variable.causality in COMPUTED:
                values.append(self._output(variable.group)[variable.index])
            else:
                value = getattr(self._plant, variable.group)
                values.append(value if variable.index is None else value[variable.index])
        return values

    def _output(self, group):
        if group not in self._outputs:
            try:
                self._outputs[group] = getattr(self._plant, group)
            except self._plant_module.DiscardError as error:
                self._refuse(str(error))
                return [float("nan")] * len(self._plant.q)
        return self._outputs[group]

    def _set(self, vrs, values, kind):
        """Set all values, or none if one of them is refused."""
        variables = [self._settable(vr, value, kind) for vr, value in zip(vrs, values)]
        if None in variables:
            return
        for variable, value in zip(variables, values):
            if variable.index is None:
                setattr(self._plant, variable.group, value)
            else:
                getattr(self._plant, variable.group)[variable.index] = value
        if self._phase == INITIALIZATION:
            self._outputs.clear()
        else:
            for group in ("tau", "der_v", "q_meas", "v_meas"):
                self._outputs.pop(group, None)

    get_real = partialmethod(_get, kind="Real", nothing=float("nan"))
    get_boolean = partialmethod(_get, kind="Boolean", nothing=False)
    get_integer = partialmethod(_get, kind="Integer", nothing=0)
    get_string = partialmethod(_get, kind="String", nothing="")
    set_real = partialmethod(_set, kind="Real")
    set_boolean = partialmethod(_set, kind="Boolean")
    set_integer = partialmethod(_set, kind="Integer")
    set_string = partialmethod(_set, kind="String")

    def _settable(self, vr, value, kind):
        variable = self._variable(vr, kind, f"fmi2Set{kind}")
        if variable is None:
            return None
        if variable.group in ("q", "v") and self._phase in (INSTANTIATED, INITIALIZATION):
            state = variable.name
            variable = replace(variable, group=f"{variable.group}_start", causality="parameter")
            if self._phase == INITIALIZATION:
                self._refuse(f"fmi2Set{kind}: {state} follows from {variable.name} in initialization mode: set that")
                return None
        if variable.causality in COMPUTED:
            self._refuse(f"fmi2Set{kind}: {variable.name} is computed and cannot be set")
            return None
        article = "a" if variable.causality == "parameter" else "an"
        if not self._allowed(f"fmi2Set of {article} {variable.causality}", variable.name):
            return None
        if kind == "Real" and not isfinite(value):
            self._refuse(f"{variable.name} = {value} is not finite")
            return None
        if variable.causality == "input" and variable.refusal(value):
            self._refuse(variable.refusal(value))  # parameters are checked when the run begins
            return None
        return variable

    def _variable(self, vr, kind, call):
        if not 1 <= vr <= len(self._table):
            self._refuse(f"{call}: there is no variable with value reference {vr}")
            return None
        variable = self._table[vr - 1]
        if variable.type != kind:
            self._refuse(f"{call}: {variable.name} is of type {variable.type}")
            return None
        return variable

    # --- state ---

    def _get_fmu_state(self):
        groups = {variable.group for variable in self._table if variable.causality not in COMPUTED}
        values = {group: getattr(self._plant, group) for group in sorted(groups | {"q", "v"})}
        return {
            "identity": self._identity,
            "phase": self._phase,
            "time": self._plant.time,
            "refused": self._refused,
            "plant": deepcopy(values),
            "sampling": deepcopy(vars(self._plant.sampling)),
        }

    def _set_fmu_state(self, state):
        """Restore an untrusted state entirely, or leave the instance as it was."""
        try:
            plant = self._plant_in(state)
        except ValueError as reason:
            self._refuse(f"fmi2SetFMUstate: {reason}")
            return
        self._plant = plant
        self._phase, self._refused = state["phase"], state["refused"]
        self._outputs.clear()

    def _plant_in(self, state):
        """Return the plant of a state; raise ValueError for an invalid FMU state."""
        if not isinstance(state, dict) or state.get("identity") != self._identity:
            raise ValueError("the state is not one of this FMU")
        if not (alike(state, self._get_fmu_state()) and state["phase"] in PHASES):
            raise ValueError(UNSOUND)
        plant = self._plant_module.Plant(self._plant.robot, self._table, self._plant.control)
        vars(plant).update(deepcopy(state["plant"]), time=state["time"])
        plant.prepare()
        sampling = type(plant.sampling)(**deepcopy(state["sampling"]))
        if state["phase"] in (STEP, TERMINATED):  # in earlier phases, the begin of the run checks it
            plant.initialise()
            plant.q, plant.v = list(state["plant"]["q"]), list(state["plant"]["v"])
            limits = zip(plant.q, plant.q_min, plant.q_max)
            if not (all(low <= q <= high for q, low, high in limits) and sampling.is_sound(plant)):
                raise ValueError(UNSOUND)
            plant.sampling = sampling
        return plant

    @staticmethod
    def _fmu_state_from_bytes(state):
        """Deserialise a state, or return None if it is damaged; it is checked when it is set."""
        try:
            return json.loads(state) if len(state) <= MAX_STATE else None
        except (ValueError, RecursionError):
            return None

    # --- refusals ---

    def _initialise(self):
        """Return the warnings of the plant's initialisation; None if its parameters are refused."""
        try:
            warnings = self._plant.initialise()
        except self._plant_module.ParameterError as error:
            self._refuse(str(error))
            return None
        self._outputs.clear()
        return warnings

    def _allowed(self, call, culprit=""):
        if self._phase in ALLOWED[call]:
            return True
        what = f" ({culprit})" if culprit else ""
        self._refuse(f"{call}{what} is not allowed in the state '{self._phase}'")
        return False

    def _refuse(self, message):
        self._log(message, Status.error)
        self._refused = message

    def _discard(self, message):
        self._log(message, Status.discard)
        return False

    def _log(self, message, status):
        # FMI messages are printf formats
        self.log(message.replace("%", "%%"), status)


def alike(value, own):
    """Return whether a value has the types and sizes of a reference, with finite numbers and valid text."""
    if type(value) is not type(own):
        return False
    if isinstance(own, dict):
        return value.keys() == own.keys() and all(alike(value[key], own[key]) for key in own)
    if isinstance(own, list):
        return len(value) == len(own) and all(map(alike, value, own))
    if isinstance(own, str):
        return not re.search("[\ud800-\udfff]", value)  # lone surrogates, which cannot be encoded
    return abs(value) < float("inf")
