"""Compare an FMU's directional derivatives with central differences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import SimulationError
from .instance import Instance
from .trial import DELTA, Trial, UnpassedError, dependencies, undeclared

PART = 0.37  # fraction of a step, after which a sampled controller takes no sample
MOST_KNOWNS = 200  # inputs and states with respect to which derivatives are compared
SMOOTH, EXACT = 1e-3, 1e-7
"""A derivative is compared if the quotients of two widths differ by at most SMOOTH, relative to the derivative's
magnitude or to 1. The tolerance is this difference, plus EXACT relative to the derivative's magnitude, plus the effect
of rounding.
"""
NEAR, SCATTER = (0.9, 0.9137, 0.9291, 0.9473, 0.9649, 0.9831), 4.0
"""If a derivative differs from the quotients, quotients of these fractions of the width are taken too. They differ by
the rounding of terms within the FMU, which no output shows, and SCATTER times their spread is added to the tolerance.
"""
STEADY, CHANGED = ("constant", "fixed", "tunable"), 1e-4
"""Kinds of dependencies whose derivatives do not change in a run, and the smallest relative change that is judged."""
OWN, OTHER = 0.2, 0.03
"""Relative difference of a state's change from the integral of its derivative, above which that may be another state's
derivative, and the difference from the integral of the other one, below which it is.
"""
ULPS = 32.0  # spacings of numbers by which an output may be rounded, at the magnitude of its terms or its nominal value
Array = NDArray[np.float64]


class Slopes(NamedTuple):
    """Difference quotients of the unknowns over one variable.

    Attributes:
        best: quotients extrapolated from two widths.
        doubt: difference between the quotients of the two widths, plus the effect of rounding.
    """

    best: Array
    doubt: Array

    @property
    def smooth(self) -> NDArray[np.bool_]:
        """True where the two quotients agree; elsewhere there is a jump."""
        return self.doubt <= SMOOTH * np.maximum(1.0, np.abs(self.best))

    def differ(self, given: Array) -> NDArray[np.bool_]:
        """Return where derivatives differ from the quotients."""
        return self.smooth & ~(np.abs(given - self.best) <= self.doubt + EXACT * np.abs(self.best))


class Point:
    """The values of inputs and states at which derivatives are compared.

    Attributes:
        values: the point, by the names of the knowns.
        rates: names of derivatives of states.
        unknowns: names of real outputs and of derivatives of states.
        sizes: magnitudes of the unknowns, at least their nominal values, which are 1 if not stated.
    """

    def __init__(self, trial: Trial) -> None:
        self._trial = trial
        rates = [unknown.variable for unknown in trial.about.derivatives]
        states = [v.derivative for v in rates if v.derivative is not None]
        self.rates = [name for name, v in trial.variables.items() if v in rates]
        settable = [state for state in states if state.initial in ("exact", "approx")]
        names = [*trial.inputs, *(name for name, v in trial.variables.items() if v in settable)]
        starts = {name: trial.fmu.variables[name].start_value for name in names}
        widths = {name: DELTA * max(1.0, abs(start)) for name, start in starts.items() if start is not None}
        self._widths = dict([*widths.items()][:MOST_KNOWNS])
        self.values = {name: trial.inside(name, 2.0 * width) for name, width in self._widths.items()}
        self.unknowns = [*trial.outputs, *self.rates]
        nominals = (float(trial.variables[name].nominal or 1.0) for name in self.unknowns)
        self.sizes = np.array([abs(size) if size and isfinite(size) else 1.0 for size in nominals])

    def measure(self, stated: Array) -> None:
        """Set the magnitudes of the unknowns at least to those of the terms of which they consist."""
        terms = np.abs(stated) @ [max(1.0, abs(value)) for value in self.values.values()]
        self.sizes = np.fmax(self.sizes, np.where(np.isfinite(terms), terms, 0.0))

    def least(self, name: str) -> Array:
        """Return the smallest derivatives over a variable that rounding does not explain."""
        return EXACT * self.sizes / max(1.0, abs(self.values[name]))

    def keep_inside(self, instance: Instance) -> None:
        """Move states that a parameter bounds below their start values, and leave out those that cannot change."""
        for name in self._clamped(instance, 1.0):
            self.values[name] -= 4.0 * self._widths[name]
        for name in self._clamped(instance, -1.0):
            del self.values[name]

    def _clamped(self, instance: Instance, sign: float) -> list[str]:
        """Return the states that the FMU clamps if they change in the direction of a sign."""
        states = [name for name in self.values if name not in self._trial.inputs]
        far = {name: self.values[name] + sign * self._widths[name] for name in states}
        self._trial.begin_again(instance, {**self.values, **far})
        found = zip(states, instance.reader(states)())
        return [name for name, value in found if abs(value - far[name]) > 0.5 * self._widths[name]]

    def slopes(
        self, instance: Instance, name: str, change: Callable[[Mapping[str, float]], object], given: Array
    ) -> Slopes:
        """Return the slopes over a variable, which is changed by a function, to be compared with given derivatives."""
        read, width = instance.reader(self.unknowns), self._widths[name]

        def around(part: float) -> Array:
            rows = np.empty((2, len(self.unknowns)))
            for row, sign in zip(rows, (-1.0, 1.0)):
                change({name: self.values[name] + sign * part * width})
                row[:] = read()
            return rows

        def quotient(rows: Array, part: float) -> Array:
            return np.asarray((rows[1] - rows[0]) / (2.0 * part * width))

        near, far = around(0.5), around(1.0)
        narrow, wide = quotient(near, 0.5), quotient(far, 1.0)
        largest = np.maximum(self.sizes, np.abs([*near, *far]).max(axis=0))
        doubt = np.abs(narrow - wide) + ULPS * np.spacing(largest) / width
        found = Slopes((4.0 * narrow - wide) / 3.0, doubt)
        if not found.differ(given).any():
            return found
        spread = np.ptp([quotient(around(part), part) for part in NEAR], axis=0)
        return Slopes(found.best, doubt + SCATTER * spread)

    def go_on(self, instance: Instance, steps: int = 0) -> None:
        """Do some steps and a part of a step, or a whole one if the step may not vary."""
        trial = self._trial
        if steps:
            trial.rows(instance, steps)
        varies = trial.about.coSimulation.canHandleVariableCommunicationStepSize
        instance.step(trial.start + steps * trial.step, trial.step * (PART if varies else 1.0))

    def between_samples(self, instance: Instance, name: str) -> NDArray[np.bool_]:
        """Return where derivatives over an input are not those of the differences after a part of a step."""
        self._trial.begin_again(instance, self.values)
        self.go_on(instance)
        given = instance.derivatives(self.unknowns, [name])[:, 0]
        slopes = self.slopes(instance, name, instance.set, given)
        return ~slopes.smooth | slopes.differ(given)

    def holds(self, instance: Instance, state: str) -> NDArray[np.bool_]:
        """Return which unknowns keep their values exactly over a part of a step in which the state changes."""
        trial = self._trial
        read, reads_state = instance.reader(self.unknowns), instance.reader([state])
        trial.begin_again(instance, self.values)
        before, at = np.array(read()), reads_state()[0]  # a later read has the same buffer
        self.go_on(instance)
        return np.asarray((np.array(read()) == before) & (reads_state()[0] != at))


def _given(trial: Trial, instance: Instance, point: Point, knowns: Sequence[str]) -> Array:
    """Return the FMU's derivatives; raise if an output changes because they are read."""
    read = trial.reader(instance)
    before = read()
    trial.note("directional derivatives")
    found = instance.derivatives(point.unknowns, knowns)
    trial.compare([before], [read()], "after directional derivatives")
    return found


def _check_sum(instance: Instance, point: Point, stated: Array) -> None:
    """Compare the derivative along all knowns with the sum of those along each."""
    seed = {name: 1.0 + k % 7 for k, name in enumerate(point.values)}
    parts = stated * [*seed.values()]
    total, found = parts.sum(axis=1), instance.directional(point.unknowns, seed)
    tolerance = EXACT * np.abs(parts).sum(axis=1) + ULPS * np.spacing(point.sizes) / DELTA
    wrong = np.isfinite(total) & ~(np.abs(found - total) <= tolerance)
    if wrong.any():
        k = int(wrong.argmax())
        what = f"the derivative of {point.unknowns[k]} with a seed of several variables"
        raise SimulationError(f"{what} is {found[k]:.9g}, and the sum of those with one seed each is {total[k]:.9g}")


def _check_declared(trial: Trial, point: Point, name: str, clear: NDArray[np.bool_]) -> None:
    """Raise for an unknown that clearly depends on a variable and does not declare it.

    The trial of inputs judges outputs that depend on inputs.
    """
    own, about = trial.fmu.variables[name].reference, trial.about
    kinds = {"Output": about.outputs, "Derivative": about.derivatives}
    if name in trial.inputs or trial.variables[name].initial == "exact":
        kinds["InitialUnknown"] = about.initialUnknowns
    for kind, unknowns in kinds.items():
        declared = dependencies(unknowns)
        for unknown in (u for u, depends in zip(point.unknowns, clear) if depends):
            judged = name in trial.inputs and unknown in trial.outputs
            if not judged and own not in declared.get(trial.fmu.variables[unknown].reference, {own}):
                raise undeclared(unknown, name, kind)


def _check_kinds(trial: Trial, instance: Instance, point: Point, stated: Array) -> None:
    """Compare derivatives after the steps with those at the start, where the kind of a dependency keeps them."""
    steady = {
        (unknown.variable.valueReference, known.valueReference): kind
        for unknown in [*trial.about.outputs, *trial.about.derivatives]
        for known, kind in zip(unknown.dependencies or (), unknown.dependenciesKind or ())
        if kind in STEADY
    }
    variables = trial.fmu.variables
    for start, name in zip(stated.T, point.values):
        kinds = [steady.get((variables[u].reference, variables[name].reference)) for u in point.unknowns]
        if not any(kinds):
            continue
        later = instance.derivatives(point.unknowns, [name])[:, 0]
        changed = np.abs(later - start) > CHANGED * np.maximum(np.abs(later), np.abs(start)) + point.least(name)
        for unknown, kind, old, new, differs in zip(point.unknowns, kinds, start, later, changed):
            if kind and differs:
                what = f"∂{unknown}/∂{name} is {old:.9g} at the start and {new:.9g} after the steps"
                raise SimulationError(f"{what}, and its dependency is declared as {kind}")


def _check_rates(trial: Trial, instance: Instance, point: Point) -> None:
    """Raise if derivatives are those of other states, by the changes of states in the steps."""
    variables = trial.fmu.variables
    found = {(v.reference, v.element): name for name, v in variables.items() if v.type == "Real"}
    rates = [name for name in point.rates if trial.variables[name].derivative is not None][:MOST_KNOWNS]
    of = [(trial.variables[name].derivative.valueReference, variables[name].element) for name in rates]
    if len(rates) < 2 or not {*of} <= {*found}:
        return
    states = [found[place] for place in of]
    read = instance.reader([*rates, *states])
    trial.begin_again(instance, point.values)
    rows = [np.array(read())]
    for k in range(trial.steps):
        trial.note(f"step {k + 1}")
        instance.step(trial.start + k * trial.step, trial.step)
        rows.append(np.array(read()))
    slopes, values = np.split(np.array(rows), 2, axis=1)
    changes, integrals = np.diff(values, axis=0), trial.step * 0.5 * (slopes[1:] + slopes[:-1])
    sizes = np.linalg.norm(changes, axis=0)
    moved = sizes > EXACT * np.maximum(1.0, np.abs(values).max(axis=0))
    away = np.linalg.norm(changes[:, :, None] - integrals[:, None, :], axis=0) / np.where(moved, sizes, np.inf)[:, None]
    strange = moved & (np.diag(away) > OWN)
    for k in map(int, np.flatnonzero(strange)):
        j = int(away[k].argmin())
        if strange[j] and away[k, j] < OTHER:
            what = f"{states[k]} changes by {rates[j]}"
            raise SimulationError(f"{what}, which is stated as the derivative of {states[j]}")


def _check_later(trial: Trial, instance: Instance, point: Point, stated: Array) -> None:
    """Compare derivatives over inputs after the steps; outputs that change only in a step are not compared."""
    names = [name for name in point.values if name in trial.inputs]
    steps = trial.steps - 1
    trial.begin_again(instance, point.values)
    point.go_on(instance, steps)
    _check_kinds(trial, instance, point, stated)
    for given, name in zip(_given(trial, instance, point, names).T, names):
        slopes = point.slopes(instance, name, instance.set, given)
        instance.set({name: point.values[name]})
        wrong = slopes.differ(given) & (slopes.best != 0.0)
        if wrong.any():
            k = int(wrong.argmax())
            what = f"∂{point.unknowns[k]}/∂{name} is {slopes.best[k]:.9g} after {steps} steps"
            raise SimulationError(f"{what}, and it gives {given[k]:.9g}")


def derivatives(trial: Trial) -> str:
    """Compare directional derivatives with central differences, at the start and, over inputs, after the steps.

    Inputs and states are changed before initialisation. If the initialisation takes a sample, as in a sampled
    controller, differences across it are no derivatives. Inputs are then changed between two samples, after a part of a
    step, and differences over states prove nothing. An output that keeps its value while the state changes was sampled.
    """
    trial.require("providesDirectionalDerivative")
    point = Point(trial)
    jumps, samples, doubtful = 0, False, ""
    with trial.instance(point.values) as instance:
        point.keep_inside(instance)
        trial.begin_again(instance, point.values)
        stated = _given(trial, instance, point, [*point.values])
        point.measure(stated)
        _check_sum(instance, point, stated)

        def at_start(values: Mapping[str, float]) -> None:
            trial.begin_again(instance, {**point.values, **values})

        for given, name in zip(stated.T, point.values):
            slopes = point.slopes(instance, name, at_start, given)
            jumps += int((~slopes.smooth).sum())
            wrong = slopes.differ(given)
            if wrong.any() and name in trial.inputs:
                still = point.between_samples(instance, name)
                samples |= bool((wrong & ~still).any())
                wrong &= still
            elif wrong.any() and (held := wrong & point.holds(instance, name) & (given == 0.0)).any():
                samples, wrong = True, wrong & ~held
                doubtful = (
                    doubtful or f"∂{point.unknowns[int(held.argmax())]}/∂{name} is not 0 at the start, and it gives 0"
                )
            if wrong.any():
                k = int(wrong.argmax())
                text = f"∂{point.unknowns[k]}/∂{name} is {slopes.best[k]:.9g}, and it gives {given[k]:.9g}"
                if name in trial.inputs or not samples:
                    raise SimulationError(text)
                doubtful = doubtful or text
            clear = slopes.smooth & ~slopes.differ(given) & (np.abs(given) > slopes.doubt + point.least(name))
            _check_declared(trial, point, name, clear)
        _check_later(trial, instance, point, stated)
        _check_rates(trial, instance, point)
    if doubtful:
        raise UnpassedError("remark", f"{doubtful}; the first may contain a sample that the initialisation takes")
    if stated.size == jumps:
        raise UnpassedError("does not apply", "there is no output that is smooth in an input or state at the start")
    left = f"; {jumps} more at a jump were not compared" if jumps else ""
    return f"{stated.size - jumps} agree with central differences{left}"
