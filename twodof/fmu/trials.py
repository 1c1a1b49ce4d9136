"""Trials of a co-simulation FMU against requirements of the FMI standard.

Each function takes a ``Trial`` and returns a line with the result. Equal means bit-identical.

Sources: FMI 2.0.5, sections 2.1 and 4.2; FMI 3.0.2, sections 2.2 and 4.2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from ctypes import byref, c_void_p
from functools import partial
from itertools import accumulate
from math import inf, isfinite

from ..errors import SimulationError
from .derivative_trial import derivatives
from .importers import READ_AT_START, TOOLS, Run, in_this_master
from .instance import Instance
from .reference_runs import Reference
from .system_instance import instantiate_fmu
from .trial import Outputs, Trial, UnpassedError, Values, dependencies, undeclared

SIZES = (1.0, 0.5, 0.25, 0.25, 2.0, 3.0, 0.5, 1.5, 1.0)
"""Sizes of variable steps, as multiples of the default step."""
FORBIDDEN = "a forbidden call"
UNKNOWN = 2**31 - 9  # a value reference that no variable has
Calls = dict[str, tuple[str, Callable[[Instance], object]]]


def simulation(trial: Trial) -> str:
    """Do the steps of the default experiment, read the outputs twice at the end, and repeat it without reads."""
    with trial.instance() as instance:
        first = trial.checked(trial.reader(instance)(), 0)
        trial.compare([first], [trial.reader(instance)()], "in a second read at one time")
        last = trial.rows(instance)[-1:]
        trial.compare(last, [trial.reader(instance)()], "in a second read at one time")
    with trial.instance() as instance:
        for k in range(trial.steps):
            trial.note(f"step {k + 1}, without reads")
            instance.step(trial.start + k * trial.step, trial.step)
        trial.compare(last, [trial.reader(instance)()], "in a run without reads between its steps")
    return f"{trial.steps} steps of {trial.step:g} s, {len(trial.outputs)} real outputs, all finite"


def start_values(trial: Trial) -> str:
    """Compare inputs, parameters, constants and exact variables in initialisation mode with their start values."""
    starts = {**trial.starts, **trial.discrete_starts, **trial.exact}
    if not starts:
        raise UnpassedError("does not apply", "it states no start values of inputs, parameters or exact variables")
    trial.note("initialisation mode")
    with instantiate_fmu(trial.fmu) as instance:
        instance.begin(trial.start, inf, {})
        _compare_starts(trial, instance, starts, "before it is set")
    return f"{len(starts)} inputs, parameters and exact variables have their start values"


def _compare_starts(trial: Trial, instance: Instance, starts: Mapping[str, float | bool | str], when: str) -> None:
    """Raise for a variable that has another value than its start value."""
    reals = [name for name in starts if name in trial.variables]
    found = {**dict(zip(reals, instance.reader(reals)())), **{n: instance.value(n) for n in starts if n not in reals}}
    for name, start in starts.items():
        if (value := found[name]) != start and not (value != value and start != start):
            raise SimulationError(f"{name} is {value!r} {when}, and its start value is {start!r}")


def reset(trial: Trial) -> str:
    """Run, run with other inputs and parameters, reset and run again."""
    trial.require_outputs()
    for values in trial.rounds():
        _reset_after(trial, values)
    return "the run after a reset, and after a run with other values, is equal"


def _reset_after(trial: Trial, values: Values) -> None:
    with trial.instance() as instance:
        before = dict(zip(trial.starts, instance.reader([*trial.starts])()))
        once = trial.rows(instance)
        with suppress(SimulationError):
            trial.begin_again(instance, values)
            trial.rows(instance)
        for name, start in trial.discrete_starts.items():
            if isinstance(start, str):  # a run might open a file of this name
                instance.reset()
                with suppress(SimulationError):
                    instance.set({name: f"{start}_"})
        trial.begin_again(instance)
        _compare_starts(trial, instance, {**before, **trial.discrete_starts}, "after a reset")
        trial.compare(once, trial.rows(instance), "after a reset")


def two_instances(trial: Trial) -> str:
    """Step two instances of one library in turn, one with other inputs and parameters."""
    if trial.about.coSimulation.canBeInstantiatedOnlyOncePerProcess:
        raise UnpassedError("does not apply", "it states canBeInstantiatedOnlyOncePerProcess")
    trial.require_outputs()
    for values in trial.rounds():
        _step_in_turn(trial, {}, values)
    return "two instances, stepped in turn, are equal to one alone"


def _step_in_turn(trial: Trial, *given: Values) -> None:
    """Compare instances with given values, stepped in turn, with runs of one alone."""
    with trial.instance() as first:

        def begun(values: Values) -> Instance:
            instance = first.another()
            instance.initialise(trial.start, inf, values)
            return instance

        alone = []
        for values in given:
            instance = begun(values)
            alone.append(trial.rows(instance))
            instance.free()
        trial.note("a second instance")
        pair = [begun(values) for values in given]
        for k in range(trial.steps):
            for instance, rows in zip(pair, alone):
                trial.compare(rows[k + min(k, 1) : k + 2], trial.rows(instance, 1, k), "beside a second instance")
        for instance in pair:
            instance.free()


def state(trial: Trial) -> str:
    """Save the state, step, restore it and step again."""
    trial.require("canGetAndSetFMUstate")
    starts = {**trial.starts, **trial.discrete_starts}
    for values in trial.rounds():
        with trial.instance(values) as instance:
            saved, rows = _saved(trial, instance)
            instance.set({name: starts[name] for name in values if name in trial.changing})
            text = _restored(trial, instance, saved, rows)
    return text


def serialised_state(trial: Trial) -> str:
    """Restore a serialised state in a new instance, after the old one and its state were freed."""
    trial.require("canGetAndSetFMUstate", "canSerializeFMUstate")
    for values in trial.rounds():
        with trial.instance(values) as instance:
            saved, rows = _saved(trial, instance)
            content = bytes(instance.slave.serializeFMUState(saved))
            instance.slave.freeFMUState(saved)
        with trial.instance() as instance:
            text = _restored(trial, instance, instance.slave.deserializeFMUState(content), rows)
    return f"{text} in a new instance"


def _saved(trial: Trial, instance: Instance) -> tuple[c_void_p, list[Outputs]]:
    """Return the state after half of the steps, and the outputs then and after each further step."""
    trial.require_outputs()
    half = trial.steps // 2
    trial.rows(instance, half)
    trial.note("saving the state")
    saved, before = instance.slave.getFMUState(), trial.reader(instance)()
    instance.final.value = False
    return saved, [before, *trial.rows(instance, half, half)]


def _restored(trial: Trial, instance: Instance, saved: c_void_p, rows: Sequence[Outputs]) -> str:
    """Restore a state twice, and compare the outputs with those after it was saved; overwrite and free it."""
    half, read = trial.steps // 2, trial.reader(instance)
    trial.note("saving a second state")
    later, at_later = instance.slave.getFMUState(), read()
    instance.final.value = False

    def restore(expected: Outputs, what: str, again: str = "", kept: c_void_p = saved) -> None:
        trial.note("restoring the state")
        instance.slave.setFMUState(kept)
        trial.compare([expected], [read()], f"at the {what}{again}")

    for again in ("", ", restored again"):
        restore(rows[0], "restored state", again)
        trial.compare(rows[1:], trial.rows(instance, half, half), f"after the state was restored{again and ' again'}")
    restore(at_later, "second of two saved states", kept=later)
    restore(rows[0], "restored state", ", restored after another")
    trial.rows(instance, half, half)
    trial.note("saving into an existing state")
    save = instance.slave.fmi2GetFMUstate if trial.fmu.version == 2 else instance.slave.fmi3GetFMUState
    save(instance.slave.component, byref(saved))
    restore(rows[-1], "state that was saved into an existing one")
    instance.slave.freeFMUState(later)
    trial.note("freeing the state")
    instance.slave.freeFMUState(saved)
    if saved:  # so pythonfmu does, in Python FMUs of this project too: importers do not use a freed state
        raise UnpassedError("remark", "the pointer to a state is not null after the state was freed; FMI demands null")
    return f"save, {half} steps, restore, {half} steps: equal"


def variable_steps(trial: Trial) -> str:
    """Take steps of different sizes, and compare the end with that of equal steps."""
    trial.require("canHandleVariableCommunicationStepSize")
    grain = float(getattr(trial.about.coSimulation, "fixedInternalStepSize", None) or 0.0)
    h = max(1, round(trial.step / 4.0 / grain)) * grain * 4.0 if grain else trial.step
    lengths = [*accumulate(SIZES)]
    sizes = SIZES[: 1 + max(k for k, length in enumerate(lengths) if length <= trial.steps and length.is_integer())]
    with trial.instance() as instance:
        ends = []
        for run in ([1.0] * round(sum(sizes)), sizes):
            trial.begin_again(instance)
            done = 0.0
            for size in run:
                trial.note(f"a step of {size * h:g} s")
                try:
                    instance.step(trial.start + done * h, size * h)
                except SimulationError as error:
                    if error.outcome != "discarded":
                        raise
                    raise UnpassedError("remark", f"it discards a step of {size * h:g} s at {done * h:g} s") from error
                done += size
            ends.append(tuple(instance.reader(trial.outputs)()))
    away = max((abs(a - b) for a, b in zip(*ends)), default=0.0)
    if not isfinite(away):
        raise SimulationError("with variable steps an output is not finite")
    steps = f"steps of {min(sizes):g} to {max(sizes):g} times {h:g} s"
    return f"{steps}; final outputs are within {away:.2g} of those of equal steps"


def inputs(trial: Trial) -> str:
    """Change each input at the start and between steps; compare changed outputs with stated dependencies."""
    others = {n: value for n, value in trial.other_values.items() if trial.fmu.variables[n].causality == "input"}
    changes: Values = {**trial.changed_inputs(), **others}
    if not changes:
        raise UnpassedError("does not apply", "it has no inputs that can be changed")
    initial, later = dependencies(trial.about.initialUnknowns), dependencies(trial.about.outputs)
    with trial.instance() as instance:
        read = trial.reader(instance)
        start = read()
        for name, value in changes.items():
            trial.begin_again(instance, {name: value})
            _compare_dependencies(trial, name, start, read(), initial, "InitialUnknown")
            trial.begin_again(instance)
            trial.rows(instance, 1)
            trial.note(f"a change of {name}")
            before = read()
            instance.set({name: value})
            _compare_dependencies(trial, name, before, read(), later, "Output")
            trial.rows(instance, 1, 1)
    return f"{len(changes)} inputs; outputs depend only on those that they declare"


def _compare_dependencies(
    trial: Trial, name: str, before: Outputs, after: Outputs, stated: Mapping[int, set[int]], kind: str
) -> None:
    """Raise for an output that changed with an input that its unknown of a ``kind`` does not declare."""
    own = trial.fmu.variables[name].reference
    for output, old, new in zip(trial.names, before, after):
        if old != new and own not in stated.get(trial.fmu.variables[output].reference, {own}):
            raise undeclared(output, name, kind)


def call_order(trial: Trial) -> str:
    """Make calls that the standard forbids; an FMU need not detect them."""
    calls = _forbidden(trial)
    accepted = []
    for what, (phase, call) in calls.items():
        trial.note("instantiation and initialisation")
        with instantiate_fmu(trial.fmu) as instance:
            if phase != "new":
                instance.initialise(trial.start, inf, {})
            if phase == "ended":
                instance.slave.terminate()
            trial.note(f"{FORBIDDEN}, {what}")
            if not instance.refuses(partial(call, instance)):
                accepted.append(what)
    if accepted:
        raise UnpassedError("remark", f"it accepts {', '.join(accepted)}")
    return f"{len(calls)} calls that the standard forbids are refused"


def _forbidden(trial: Trial) -> Calls:
    """Return forbidden calls by description, with the state in which they are made: "new", "stepping" or "ended"."""
    t, h = trial.start, trial.step
    read = "getReal" if trial.fmu.version == 2 else "getFloat64"
    fixed = [n for n, v in trial.variables.items() if v.causality == "parameter" and v.variability == "fixed"][:1]
    again = {name: trial.fmu.variables[name].start_value or 0.0 for name in fixed}
    calls: Calls = {
        "a step before initialisation": ("new", lambda i: i.slave.doStep(t, h)),
        "the end of an initialisation that was not begun": ("new", lambda i: i.slave.exitInitializationMode()),
        "a second initialisation": ("stepping", lambda i: i.slave.enterInitializationMode()),
        "a step of a negative size": ("stepping", lambda i: i.slave.doStep(t, -h)),
        "a step from another time": ("stepping", lambda i: i.slave.doStep(t + 100.0 * h, h)),
        "a read of a variable that does not exist": ("stepping", lambda i: getattr(i.slave, read)([UNKNOWN])),
        "a fixed parameter set after initialisation": ("stepping", lambda i: i.set(again)),
        "a step after the end": ("ended", lambda i: i.slave.doStep(t, h)),
    }
    return {what: call for what, call in calls.items() if again or "parameter" not in what}


def reference_run(trial: Trial, reference: Reference, tool: str = "") -> str:
    """Compare the results of a run, in another tool or in this master, with those that the FMU carries."""
    names, fmi = reference.results[0], str(trial.fmu.version)
    run: Run = in_this_master
    missing = [n for n in [*names, *reference.stimuli[0], *reference.parameters] if n not in trial.fmu.variables]
    if missing:
        raise SimulationError(f"there is no variable '{missing[0]}'")
    if tool:
        _, run, versions = TOOLS[tool]
        if fmi not in versions or any(variable.dimensions for variable in trial.about.modelVariables):
            raise SimulationError(f"not run with {tool}: it runs FMI {' and '.join(versions)} without arrays")
    trial.note("the run of a reference")
    rows = run(trial.fmu, reference, names)
    if reference.tolerance != reference.tolerance:
        raise UnpassedError("does not apply", "the experiment states no tolerance")
    return reference.judge(rows, first=0 if tool in READ_AT_START else 1)


TRIALS: dict[str, Callable[[Trial], str]] = {
    trial.__name__.replace("_", " "): trial
    for trial in (
        simulation,
        start_values,
        reset,
        two_instances,
        state,
        serialised_state,
        variable_steps,
        inputs,
        derivatives,
        call_order,
    )
}
"""Trials by the name of their row, in order."""
