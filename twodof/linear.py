"""Linear model of an FMU at an operating point.

    ẏ = A y + B u,    z = C y + D u,    y = (q, v)

A, B, C and D are the FMU's directional derivatives, exact to rounding. y, u and z are the deviations of states, inputs
and outputs from the operating point. An eigenvalue λ ≠ 0 of A has the frequency |λ| and the damping ratio −Re λ/|λ|. In
the model of a sampled controller, the effort is held at the law's value at the operating point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import InputError, SimulationError, choice
from .fmu import Fmu, Instance, System, instantiate, load_fmu
from .notebook import card, picture
from .simulation.input_values import Setting, Value, resolve
from .simulation.setup import limits_of, robot_of

Array = NDArray[np.float64]

MOST_ITERATIONS = 50
SETTLED, AT_REST = 1e-11, 1e-6
"""Rates at which the search for an equilibrium ends, and below which a point is called an equilibrium. They are
relative to the largest derivative of a rate with respect to a state, if that is above 1.
"""
NEAR_JUMP = 1e-6
PERFECT = {"control_delay": 0.0, "q_resolution": 0.0, "q_noise": 0.0, "v_noise": 0.0, "v_from_q": False}
"""Settings with which a sampled controller applies the effort of its law immediately."""


class Mode(NamedTuple):
    """An eigenvalue, 1/s, with its damping ratio (NaN for the eigenvalue 0) and its frequency, rad/s."""

    eigenvalue: complex
    damping: float
    frequency: float


class LinearModel(NamedTuple):
    """Linear model; ``control.ss(*model[:4])`` converts it for python-control.

    Attributes:
        A, B, C, D: the matrices, SI units.
        states, inputs, outputs: the FMU's names of rows and columns.
        units: units of states, inputs and outputs, by name.
        point: values of states and inputs at the operating point, by name.
        rates: derivatives of the states there; 0 at an equilibrium.
        remarks: notes on the operating point, one line each.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: dict[str, str]
    point: dict[str, float]
    rates: tuple[float, ...]
    remarks: tuple[str, ...]

    def __repr__(self) -> str:
        n, m, p = len(self.states), len(self.inputs), len(self.outputs)
        return f"<LinearModel: {n} states, {m} inputs, {p} outputs>"

    def _repr_html_(self) -> str:
        facts = {"states": ", ".join(self.states), "inputs": ", ".join(self.inputs), "outputs": ", ".join(self.outputs)}
        modes = {
            f"mode {i + 1}": f"{m.eigenvalue:.4g} 1/s, damping ratio {m.damping:.3g}" for i, m in enumerate(self.modes)
        }
        plane = [([m.eigenvalue.real for m in self.modes], [m.eigenvalue.imag for m in self.modes])]
        plot = picture(plane, "Re λ in 1/s", "Im λ in 1/s", dots=True)
        return card("Linear model", facts | modes | dict.fromkeys(self.remarks, ""), plot)

    @property
    def modes(self) -> list[Mode]:
        """Return the eigenvalues of A, the slowest first; parts below rounding are 0."""
        values = sorted(_eigenvalues(self.A), key=lambda z: (abs(z), -z.imag))
        return [Mode(z, -z.real / abs(z) if z else np.nan, abs(z)) for z in values]


def _eigenvalues(A: Array) -> list[complex]:
    """Return eigenvalues, with parts below n ε ‖A‖ κ set to 0 (κ: condition number of the eigenvalue)."""
    values, vectors = np.linalg.eig(A)
    condition = np.linalg.norm(np.linalg.pinv(vectors), axis=1)
    error = len(A) * np.finfo(float).eps * np.linalg.norm(A) * condition
    parts = [np.where(np.abs(part) > error, part, 0.0) for part in (values.real, values.imag)]
    return [complex(*pair) for pair in np.transpose(parts).tolist()]


def linearise(
    fmu: Fmu | str | Path,
    at: Mapping[str, Setting] | None = None,
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
) -> LinearModel:
    """Return the linear model of an FMU at an operating point.

    Args:
        fmu: an FMU with directional derivatives, such as a native one.
        at: values of inputs and parameters, and of the states ``q`` and ``v``. Without ``q`` and
            ``v`` the point is the equilibrium near ``q_start``.
        inputs, outputs: groups of variables, e.g. ``["tau_cmd"]``; None: all.

    Raises:
        InputError: a name or value is wrong, or the FMU has no derivatives.
        SimulationError: there is no equilibrium near ``q_start``, or the plant has no linear model at the point.
    """
    fmu = fmu if isinstance(fmu, Fmu) else load_fmu(fmu)
    if isinstance(fmu, System):
        raise InputError(f"'{fmu.path}' is a system, which has no derivatives; linearise the FMU of its plant")
    if not fmu.description.coSimulation.providesDirectionalDerivative or "der(q[1])" not in (fmu.variables):
        raise InputError(f"'{fmu.path}' has no directional derivatives; build a native FMU with `native=True`")
    groups = ("der(q[{}])", "der(v[{}])", "q_start[{}]", "v_start[{}]", "q_min[{}]", "q_max[{}]")
    for name in (g.format(i + 1) for i in range(len(fmu.vector("q"))) for g in groups):
        if name not in fmu.variables:
            raise InputError(f"'{fmu.path}' has no variable '{name}', which its linear model needs")
    given = dict(at or {})
    fixed = bool({name.partition("[")[0] for name in given} & {"q", "v"})
    starts = {"v_start": 0.0} if fixed else {}
    values = resolve(fmu, starts) | _values(fmu, given)
    values |= resolve(fmu, {name: value for name, value in PERFECT.items() if fmu.vector(name)})
    period = {**fmu.start_values, **values}.get("control_period", 0.0)
    with instantiate(fmu) as instance:
        assert isinstance(instance, Instance)
        point = _Point(fmu, instance, {**values, "control_period": 0.0} if period else values)
        if not fixed:
            point.settle()
        if period:
            point.hold_effort(period)
        return point.model(_chosen(fmu, "input", inputs, "inputs"), _chosen(fmu, "output", outputs, "outputs"))


def _values(fmu: Fmu, given: Mapping[str, Setting]) -> dict[str, Value]:
    """Return the values of inputs and parameters; states are replaced by the parameters that set them."""
    values: dict[str, Value] = {}
    for name, value in given.items():
        group, bracket, index = name.partition("[")
        if group not in ("q", "v"):
            values |= resolve(fmu, {name: value})
            continue
        try:
            values |= resolve(fmu, {f"{group}_start{bracket}{index}": value})
        except InputError as error:
            raise InputError(str(error).replace(f"{group}_start", group)) from None
    return values


def _chosen(fmu: Fmu, causality: str, wanted: Sequence[str] | None, argument: str) -> list[str]:
    groups = fmu.groups(causality)
    for group in wanted or ():
        if group not in groups:
            raise InputError(f"`{argument}`: there is no '{group}'{choice(group, groups)}")
    return [name for group in (groups if wanted is None else wanted) for name in groups[group]]


class _Point:
    """An FMU instance that is moved from state to state."""

    def __init__(self, fmu: Fmu, instance: Instance, values: Mapping[str, Value]) -> None:
        self._fmu, self._instance, self._values = fmu, instance, dict(values)
        self._q, self._v = fmu.vector("q"), fmu.vector("v")
        self._starts = fmu.vector("q_start"), fmu.vector("v_start")
        self._accelerations = [f"der({name})" for name in self._v]
        self._begin()

    def _begin(self, **others: Value) -> None:
        """Reset the instance to the point's values, of which some may be replaced for once."""
        self._instance.reset()
        self._instance.initialise(0.0, np.inf, {**self._values, **others})

    def _read(self, names: Sequence[str]) -> Array:
        return np.array(self._instance.reader(names)())

    def _move(self, q: Array) -> None:
        q = np.clip(q, *(self._read(self._fmu.vector(name)) for name in ("q_min", "q_max")))
        still = dict.fromkeys(self._starts[1], 0.0)
        self._values.update({**dict(zip(self._starts[0], q.tolist())), **still})
        self._begin()

    def settle(self) -> None:
        """Move to an equilibrium, by Newton's method with halved steps."""
        first = q = self._read(self._q)
        self._move(q)
        for _ in range(MOST_ITERATIONS):
            a = self._read(self._accelerations)
            slope = self._instance.derivatives(self._accelerations, self._q)
            if np.abs(a).max() <= SETTLED * max(1.0, np.abs(slope).max()):
                return
            step = np.linalg.lstsq(slope, -a, rcond=1e-10)[0]
            for halving in range(30):
                self._move(q + 0.5**halving * step)
                if np.linalg.norm(self._read(self._accelerations)) < np.linalg.norm(a):
                    break
            q = self._read(self._q)
        raise SimulationError(
            f"there is no equilibrium near q_start = ({', '.join(f'{x:g}' for x in first)}): it"
            f" still accelerates by {np.abs(a).max():.3g}; give another q_start, other inputs,"
            " or the state, q"
        )

    def hold_effort(self, period: float) -> None:
        """Sample the controller at the present state, so that its effort is held."""
        self._values["control_period"] = period
        self._begin()

    def model(self, inputs: list[str], outputs: list[str]) -> LinearModel:
        """Return the linear model at the point."""
        states = [*self._q, *self._v]
        rates = [f"der({name})" for name in states]
        known = [*states, *inputs]
        remarks = self._remarks()
        whole = self._instance.derivatives([*rates, *outputs], known)
        n = len(states)
        moving = self._read(rates)
        if np.abs(moving).max() > AT_REST * max(1.0, np.abs(whole[:n, :n]).max()):
            remarks.append(f"no equilibrium: the rates are up to {np.abs(moving).max():.3g}")
        else:
            growing = [z.real for z in _eigenvalues(whole[:n, :n]) if z.real > 0.0]
            if growing:
                remarks.append(
                    f"an unstable equilibrium: {len(growing)} of {n} eigenvalues grow, the fastest"
                    f" by {max(growing):.6g} 1/s"
                )
        variables = self._fmu.variables
        return LinearModel(
            *(whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:]),
            *(tuple(states), tuple(inputs), tuple(outputs)),
            units={name: variables[name].unit or "" for name in [*known, *outputs]},
            point=dict(zip(known, self._read(known).tolist())),
            rates=tuple(moving.tolist()),
            remarks=tuple(remarks),
        )

    def _remarks(self) -> list[str]:
        """Return notes on a singular pose and on joints that stick or saturate; raise if there is no linear model."""
        limits = [self._read(self._fmu.vector(name)) for name in ("q", "q_min", "q_max")]
        for joint, q, low, high in zip(self._fmu.joints, *limits):
            if q in (low, high):
                raise SimulationError(
                    f"joint '{joint}' is at its limit {q:g}, where the model is not linear: move"
                    " it off, or widen q_min and q_max"
                )
        remarks = self._stuck() + self._saturated()
        if self._values.get("control_period"):
            remarks.append("the controller is sampled: the model is that of the plant with its effort held")
        if "quat_des[1]" in self._fmu.variables:
            actual, target = (self._read(self._fmu.vector(name)) for name in ("quat", "quat_des"))
            if abs(actual @ (target / np.linalg.norm(target))) < NEAR_JUMP:
                raise SimulationError(
                    "the frame is half a turn from quat_des, where the orientation error jumps:"
                    " choose another q or quat_des"
                )
        rows = [*self._fmu.vector("xd"), *self._fmu.vector("omega")]  # the rows of the task Jacobian
        if "rcond" not in self._fmu.variables or not rows:
            return remarks
        jacobian = self._instance.derivatives(rows, self._v)
        sigma, (rcond,) = np.linalg.svd(jacobian)[1], self._read(["rcond"])
        ratio = sigma / sigma[0] if sigma[0] else 0.0 * sigma
        if np.abs(ratio[1:] - rcond).min(initial=1.0) < NEAR_JUMP:
            raise SimulationError(f"J⁺ jumps here: σ_min/σ_max = {ratio[-1]:.6g} is rcond; choose another q or rcond")
        if ratio[-1] <= rcond:
            remarks.append(
                f"a singular pose: σ_min/σ_max = {ratio[-1]:.3g} is below rcond = {rcond:g}, so"
                " that a direction of the frame is not controlled"
            )
        return remarks

    def _stuck(self) -> list[str]:
        """Return notes on joints that stick; raise if one begins to slip."""
        if "friction[1]" not in self._fmu.variables:
            return []
        remarks = []
        values = [self._read(names) for names in (self._v, self._accelerations, self._fmu.vector("friction"))]
        for joint, v, a, friction in zip(self._fmu.joints, *values):
            if friction and not v and a:
                raise SimulationError(
                    f"joint '{joint}' begins to slip against its friction {friction:g}, where the model is not"
                    " linear: give it a velocity, or friction=0"
                )
            if friction and not v:
                remarks.append(f"joint '{joint}' sticks by its friction {friction:g}: in the model it stays at rest")
        return remarks

    def _saturated(self) -> list[str]:
        """Return notes on saturated joints; raise if an effort is exactly at its limit."""
        if not {**self._fmu.start_values, **self._values}.get("limit_effort"):
            return []
        self._begin(limit_effort=False)
        efforts = self._read(self._fmu.vector("tau"))
        self._begin()
        remarks = []
        for joint, tau, limit in zip(
            self._fmu.joints, efforts, limits_of(robot_of(self._fmu.urdf), self._fmu.joints).effort
        ):
            if abs(abs(tau) - limit) <= NEAR_JUMP * limit < np.inf:
                raise SimulationError(
                    f"joint '{joint}' is at its effort limit {limit:g}, where the model is not"
                    " linear: choose another point, or limit_effort=false"
                )
            if abs(tau) > limit:
                remarks.append(
                    f"joint '{joint}' is saturated: its effort stays at {limit:g}, the controller asks for {tau:.4g}"
                )
        return remarks
