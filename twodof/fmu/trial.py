"""FMU under test: its default experiment, its runs, and comparisons of their outputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from math import inf, isfinite
from typing import Any

from fmpy.model_description import ModelVariable, Unknown

from ..errors import SimulationError
from ..export.typed_values import DISCRETE
from .description import Fmu
from .instance import Instance
from .reference_runs import TIME_TOLERANCE
from .scalar import scalars
from .system_instance import instantiate_fmu

STEPS = 20
DELTA = 1e-4  # change of a variable, relative to its magnitude or to 1
MOST_TRIES = 100  # runs that find out which values an FMU accepts
UNUSUAL = "a run with parameters changed from 0"
Outputs = tuple[Any, ...]
Values = dict[str, float | bool]


class UnpassedError(Exception):
    """A trial ends with the outcome "remark" or "does not apply"."""

    def __init__(self, outcome: str, text: str) -> None:
        super().__init__(text)
        self.outcome = outcome


class Trial:
    """An FMU with its default experiment.

    Args:
        note: called with the name of the next call, which the report of a crash contains.

    Attributes:
        during: what the next calls belong to, with a comma; "" for the trial itself.
        start, step: start time and step of its default experiment, s.
        steps: number of steps of a run, which ends at the stop time of the default experiment at the latest.
        variables: FMPy's descriptions of real variables, by the names of their elements.
        outputs, inputs: names of real outputs and continuous inputs.
        held: names of discrete real inputs without clocks.
        starts: start values of real inputs and parameters that have one.
        discrete_starts: those of types in DISCRETE, without clocks.
        exact: start values of other variables that are constant or have initial="exact".
        changing: names of inputs and parameters that may change between steps.
        others: names of outputs of types in DISCRETE.
        names: names of all these outputs, in the order of rows.
        clocks: names of the independent variable, at most one.
    """

    def __init__(self, fmu: Fmu, note: Callable[[str], object]) -> None:
        self.fmu, self._note, self.about = fmu, note, fmu.description
        self.during = ""
        start, stop, step = (
            getattr(self.about.defaultExperiment, name, None) for name in ("startTime", "stopTime", "stepSize")
        )
        self.start = float(start or 0.0)
        self.step = float(step or (float(stop) - self.start if stop else 5.0) / 500)
        length = inf if stop is None else (float(stop) - self.start) / self.step
        self.steps = int(max(2.0, min(STEPS, length + 1e-6)))
        self.variables: dict[str, ModelVariable] = {
            scalar.name: v for v in self.about.modelVariables for scalar in scalars(v, {}) if scalar.type == "Real"
        }
        self.outputs = [name for name, v in self.variables.items() if v.causality == "output"]
        self.others = [n for n, v in fmu.variables.items() if v.causality == "output" and v.type in DISCRETE]
        self.names = [*self.outputs, *self.others]
        self.clocks = [name for name, v in self.variables.items() if v.causality == "independent"]
        inputs = [name for name, v in self.variables.items() if v.causality == "input"]
        self.inputs = [name for name in inputs if self.variables[name].variability in (None, "continuous")]
        clocked = {v.valueReference for v in self.about.modelVariables if v.clocks}  # of FMI 3.0
        self.held = [n for n in inputs if n not in self.inputs and fmu.variables[n].reference not in clocked]

        stated = [v for v in fmu.variables.values() if v.start is not None and v.type in {"Real", *DISCRETE}]
        starts = [v for v in stated if v.causality in ("input", "parameter")]
        self.starts = {v.name: float(v.initial_value) for v in starts if v.type == "Real"}
        discrete = (v for v in starts if v.type != "Real" and v.reference not in clocked)
        self.discrete_starts = {v.name: v.initial_value for v in discrete}
        self.exact = {v.name: v.initial_value for v in stated if v.exact and v not in starts}
        self.changing = {v.name for v in starts if v.causality == "input" or v.variability == "tunable"}

    def changed_inputs(self) -> dict[str, float]:
        """Return values of the inputs that differ from their start values, so that an FMU at rest moves."""
        return {name: self.inside(name, DELTA) for name in [*self.inputs, *self.held]}

    def changed_parameters(self, *, zero: bool = False) -> dict[str, float]:
        """Return values of parameters that differ from their start values, which are 0 or not."""
        numbers = {n: start for n, start in self.starts.items() if isfinite(start) and (start == 0.0) == zero}
        return {
            name: self.inside(name, DELTA * (abs(start) or 1.0))
            for name, start in numbers.items()
            if self.variables[name].causality == "parameter" and self.variables[name].variability != "constant"
        }

    def changed_discrete(self) -> dict[str, float | bool]:
        """Return values in their ranges of integers, enumerations and Booleans that differ from their start values."""
        values: dict[str, float | bool] = {}
        for name, start in self.discrete_starts.items():
            if isinstance(start, str):
                continue
            kind = self.fmu.variables[name].value_type
            numbers = [start - 1, start + 1] if start > 1 else [start + 1, start - 1]
            items = [item for item in kind.items.values() if item != start]
            others = [not start] if isinstance(start, bool) else items if kind.name == "Enumeration" else numbers
            allowed = [other for other in others if kind.low <= other <= kind.high]
            if allowed:
                values[name] = allowed[0]
        return values

    @cached_property
    def other_values(self) -> Values:
        """Other values of inputs, discrete variables, and parameters not 0 at the start, that the FMU accepts."""
        with self.instance() as instance:
            self.rows(instance)
        return self._accepted({}, [self.changed_inputs(), self.changed_parameters(), self.changed_discrete()])

    @cached_property
    def _all_values(self) -> Values:
        self.during = f"{UNUSUAL}, "
        try:
            return self._accepted(self.other_values, [self.changed_parameters(zero=True)])
        finally:
            self.during = ""

    def rounds(self) -> Iterator[Values]:
        """Yield other values, first without parameters that start at 0; many of these are switches."""
        yield self.other_values
        if self._all_values != self.other_values:
            yield self._all_values

    def _accepted(self, values: Values, groups: Sequence[Mapping[str, float | bool]]) -> Values:
        """Return values and those of groups with which the FMU runs; halves of a group that it refuses are tried."""
        values, waiting = {**values}, [group for group in reversed(groups) if group]
        for _ in range(MOST_TRIES):
            if not waiting:
                break
            group = waiting.pop()
            with suppress(SimulationError), self.instance({**values, **group}) as instance:
                self.rows(instance)
                values |= group
                continue
            names = [*group]
            if len(names) > 1:
                half = len(names) // 2
                waiting += [{n: group[n] for n in part} for part in (names[half:], names[:half])]
        return values

    def note(self, what: str) -> None:
        """Report the name of the next call."""
        self._note(f"{self.during}{what}")

    def require(self, *claims: str) -> None:
        """End a trial of a feature that the description does not claim."""
        for claim in claims:
            if not getattr(self.about.coSimulation, claim):
                raise UnpassedError("does not apply", f"it does not state {claim}")

    @contextmanager
    def instance(self, values: Mapping[str, float | bool] | None = None) -> Iterator[Instance]:
        """Instantiate and initialise the FMU."""
        self.note("instantiation and initialisation")
        with instantiate_fmu(self.fmu) as instance:
            instance.initialise(self.start, inf, values or {})
            yield instance

    def begin_again(self, instance: Instance, values: Mapping[str, float | bool] | None = None) -> None:
        """Reset and initialise an instance."""
        self.note("reset")
        instance.reset()
        instance.initialise(self.start, inf, values or {})

    def rows(self, instance: Instance, count: int = 0, first: int = 0) -> list[Outputs]:
        """Return the outputs after each of ``count`` steps (0: all steps of a run) from step ``first`` on.

        The first row of a run has the outputs at its start.
        """
        read, last = self.reader(instance), first + (count or self.steps)
        rows = [] if first else [self.checked(read(), 0)]
        for k in range(first, last):
            self.note(f"step {k + 1}")
            instance.step(self.start + k * self.step, self.step)
            rows.append(self.checked(read(), k + 1))
            self._compare_time(instance, k + 1)
        return rows

    def checked(self, row: Outputs, steps: int) -> Outputs:
        """Return outputs after some steps; raise for a number that is not finite, and a Boolean not 0 or 1."""
        for name, value in zip(self.names, row):
            kind = self.fmu.variables[name].type
            if (kind == "Real" and not isfinite(value)) or (kind == "Boolean" and value not in (0, 1)):
                raise SimulationError(f"{name} is {value} after {steps} steps")
        return row

    def _compare_time(self, instance: Instance, steps: int) -> None:
        """Raise for an independent variable that is not the time after some steps, within TIME_TOLERANCE of a step."""
        time = self.start + steps * self.step
        for name, value in zip(self.clocks, instance.reader(self.clocks)()):
            if not abs(value - time) <= TIME_TOLERANCE * self.step:
                raise SimulationError(f"{name}, the independent variable, is {value:.12g} at {time:.12g} s")

    def reader(self, instance: Instance) -> Callable[[], Outputs]:
        """Return a function that reads all outputs, real ones first."""
        read = instance.reader(self.outputs)
        return lambda: (*read(), *(instance.value(name, raw=True) for name in self.others))

    def require_outputs(self) -> None:
        """End a trial that would compare nothing."""
        if not self.outputs and not self.others:
            raise UnpassedError("does not apply", "it has no outputs to compare")

    def compare(self, expected: Sequence[Outputs], rows: Sequence[Outputs], when: str) -> None:
        """Raise for rows that are not equal, with the name of the first output that differs."""
        for k, pair in enumerate(zip(expected, rows)):
            for name, x, y in zip(self.names, *pair):
                if x != y:
                    raise SimulationError(f"{when}: {name} is {y!r} instead of {x!r}, in row {k + 1} of the outputs")

    def inside(self, name: str, change: float) -> float:
        """Return a variable's start value plus a change, with this distance from its bounds if the range allows it."""
        variable, start = self.variables[name], self.fmu.variables[name].start_value or 0.0
        low, high = (end if text is None else float(text) for text, end in ((variable.min, -inf), (variable.max, inf)))
        margin = change if high - low > 2.0 * change else 0.0
        return min(max(start + change, low + margin), high - margin)


def dependencies(unknowns: Sequence[Unknown]) -> dict[int, set[int]]:
    """Return the value references on which unknowns depend, by that of the unknown, if they state them."""
    found: dict[int, set[int]] = {}
    for unknown in unknowns:
        if unknown.dependencies is not None:
            references = (variable.valueReference for variable in unknown.dependencies)
            found.setdefault(unknown.variable.valueReference, set()).update(references)
    return found


def undeclared(unknown: str, known: str, kind: str) -> SimulationError:
    """Return the error of a dependency that an element of a ``kind`` of the model structure does not declare."""
    return SimulationError(f"{unknown} depends on {known}, and its {kind} does not declare it")
