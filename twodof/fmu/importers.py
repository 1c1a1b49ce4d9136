"""Run the stimuli of a reference experiment in this master, or in another FMI tool that is chosen by name."""

from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from math import inf
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, SimulationError, choice
from .description import Fmu
from .reference_runs import KINDS, Reference, Values
from .system_instance import instantiate_fmu

Rows = NDArray[np.float64]
T = TypeVar("T")
NANOSECONDS = 1_000_000_000


def in_this_master(fmu: Fmu, reference: Reference, names: Sequence[str]) -> Rows:
    """Run the stimuli by this package's own calls."""
    with instantiate_fmu(fmu) as instance:
        instance.initialise(reference.start, inf, _starts(fmu, reference))
        reals = [name for name in names if fmu.variables[name].type == "Real"]
        read = instance.reader(reals)

        def read_all() -> list[float]:
            values = dict(zip(reals, read()))
            return [values[name] if name in values else instance.value(name) for name in names]

        starts = read_all()
        rows = reference.rows(instance.set, instance.step, read_all)
        rows[0] = starts
        return rows


def _starts(fmu: Fmu, reference: Reference) -> Values:
    """Return the start values of a reference, each with its variable's type."""
    values = {**reference.parameters, **reference.inputs(0)}
    return {name: KINDS[fmu.variables[name].type](value) for name, value in values.items()}


def _by_type(fmu: Fmu, *functions: Callable[..., T]) -> Callable[[str], Callable[..., T]]:
    """Return a function that chooses, by a variable's name, among functions for the types in KINDS."""
    own = dict(zip(KINDS, functions))
    return lambda name: own[fmu.variables[name].type]


def in_fmpy(fmu: Fmu, reference: Reference, names: Sequence[str]) -> Rows:
    """Run the stimuli by FMPy's simulate_fmu."""
    from fmpy import simulate_fmu

    columns, numbers = reference.stimuli
    result = simulate_fmu(
        str(fmu.path),
        start_time=reference.start,
        stop_time=reference.stop,
        step_size=reference.step,
        output_interval=reference.step,
        start_values=_starts(fmu, reference),
        input=np.array([tuple(row) for row in numbers], dtype=[(name, float) for name in ["time", *columns]]),
        output=[*names],
        fmi_type="CoSimulation",
    )
    return np.array([[float(row[name]) for name in names] for row in result])


def in_libcosim(fmu: Fmu, reference: Reference, names: Sequence[str]) -> Rows:
    """Run the stimuli by an execution of libcosim with one slave."""
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimManipulator import CosimManipulator
    from libcosimpy.CosimObserver import CosimObserver
    from libcosimpy.CosimSlave import CosimLocalSlave

    execution = CosimExecution.from_step_size(round(reference.step * NANOSECONDS))
    slave = execution.add_local_slave(CosimLocalSlave(str(fmu.path), "fmu"))
    observer, inputs = CosimObserver.create_last_value(), CosimManipulator.create_override()
    execution.add_observer(observer)
    execution.add_manipulator(inputs)
    start = _by_type(
        fmu, execution.real_initial_value, execution.integer_initial_value, execution.boolean_initial_value
    )
    write = _by_type(fmu, inputs.slave_real_values, inputs.slave_integer_values, inputs.slave_boolean_values)
    read = _by_type(fmu, observer.last_real_values, observer.last_integer_values, observer.last_boolean_values)
    for name, value in _starts(fmu, reference).items():
        start(name)(slave, fmu.variables[name].reference, value)

    def change(values: Values) -> None:
        for name, value in values.items():
            write(name)(slave, [fmu.variables[name].reference], [value])

    def read_all() -> list[float]:
        return [read(name)(slave, [fmu.variables[name].reference])[0] for name in names]

    return reference.rows(change, lambda t, h: execution.step(1), read_all)


def in_ecos(fmu: Fmu, reference: Reference, names: Sequence[str]) -> Rows:
    """Run the stimuli by a simulation of ecos with one model."""
    from ecospy import EcosSimulation, EcosSimulationStructure

    with EcosSimulationStructure() as structure:
        structure.add_model("fmu", str(fmu.path))
        structure.add_parameter_set("start", {f"fmu::{name}": v for name, v in _starts(fmu, reference).items()})
        with EcosSimulation(step_size=reference.step, structure=structure) as simulation:
            simulation.init(start_time=reference.start, parameter_set="start")
            write = _by_type(fmu, simulation.set_real, simulation.set_integer, simulation.set_bool)
            read = _by_type(fmu, simulation.get_real, simulation.get_integer, simulation.get_bool)

            def change(values: Values) -> None:
                for name, value in values.items():
                    write(name)(f"fmu::{name}", value)

            def read_all() -> list[float]:
                return [read(name)(f"fmu::{name}") for name in names]

            return reference.rows(change, lambda t, h: simulation.step(1), read_all)


def in_fmuloader(fmu: Fmu, reference: Reference, names: Sequence[str]) -> Rows:
    """Run the stimuli by calls of fmuloader."""
    from fmuloader.fmi2 import Fmi2Slave, Fmi2Type

    if fmu.description.modelExchange is None:
        raise SimulationError("not run with fmuloader: it runs only FMUs that have Model Exchange too")
    slave = Fmi2Slave(str(fmu.path), model_identifier=fmu.description.coSimulation.modelIdentifier)
    slave.instantiate("fmu", Fmi2Type.CO_SIMULATION, guid=fmu.guid)
    write = _by_type(fmu, slave.set_real, slave.set_integer, slave.set_boolean)
    read = _by_type(fmu, slave.get_real, slave.get_integer, slave.get_boolean)

    def change(values: Values) -> None:
        for name, value in values.items():
            write(name)([fmu.variables[name].reference], [value])

    def read_all() -> list[float]:
        return [read(name)([fmu.variables[name].reference])[0] for name in names]

    change(_starts(fmu, reference))
    slave.setup_experiment(start_time=reference.start)
    slave.enter_initialization_mode()
    slave.exit_initialization_mode()
    rows = reference.rows(change, slave.do_step, read_all)
    slave.free_instance()
    return rows


def in_pathsim(fmu: Fmu, reference: Reference, names: Sequence[str]) -> Rows:
    """Run the stimuli by PathSim's block of an FMU, whose inputs are constants."""
    from pathsim import Connection, Simulation
    from pathsim.blocks import Constant
    from pathsim_fmi import CoSimulationFMU

    inputs = {name: v.start_value for name, v in fmu.variables.items() if v.causality == "input"}
    if reference.start or any(fmu.variables[name].type != "Real" for name in inputs):
        raise SimulationError("not run with pathsim: it runs FMUs with real inputs alone, and from 0 s")
    block = CoSimulationFMU(str(fmu.path), start_values=_starts(fmu, reference), dt=reference.step)
    sources = {name: Constant(reference.inputs(0).get(name, value)) for name, value in inputs.items()}
    wires = [Connection(source, block[name]) for name, source in sources.items()]
    simulation = Simulation([block, *sources.values()], wires, dt=reference.step, log=False)
    read = partial(block.fmu_wrapper.get_real, [fmu.variables[name].reference for name in names])

    def change(values: Values) -> None:
        for name, value in values.items():
            sources[name].value = value

    return reference.rows(change, lambda t, h: simulation.timestep(h), read)


Run = Callable[[Fmu, Reference, Sequence[str]], Rows]
TOOLS: dict[str, tuple[str, Run, str]] = {
    "fmpy": ("fmpy", in_fmpy, "23"),
    "libcosim": ("libcosimpy", in_libcosim, "2"),
    "ecos": ("ecospy", in_ecos, "23"),
    "fmuloader": ("fmuloader", in_fmuloader, "2"),
    "pathsim": ("pathsim_fmi", in_pathsim, "2"),
}
"""Python packages of the tools, functions that run them, and the versions of FMI with which they are tried."""


READ_AT_START = "", "fmpy"  # tools whose runs begin with the outputs before the first step; "": this master


def require(tools: Sequence[str]) -> None:
    """Refuse a tool that is unknown or not installed."""
    for tool in tools:
        if tool not in TOOLS:
            raise InputError(f"`tools`: '{tool}' is unknown{choice(tool, TOOLS)}")
        if find_spec(TOOLS[tool][0]) is None:
            raise InputError(f"{tool} is not installed: pip install {TOOLS[tool][0]}")
