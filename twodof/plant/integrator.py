"""Dormand–Prince 5(4) over one communication step, with located joint-limit stops.

The method is that of SciPy's ``RK45``: its coefficients, error norm, step-size control and
dense output (Dormand & Prince, J. Comp. Appl. Math. 6(1), 1980; Shampine, Math. Comp. 46, 1986;
Hairer, Nørsett & Wanner, "Solving ODEs I", II.4). Every communication step begins afresh with
the step min(max_step, h), so that no integrator state outlives it.

A joint limit is a plastic stop: a joint that reaches it is set onto it with v = 0 and held there
while its acceleration points into it. It takes that joint's velocity and exerts no reaction on
the others, whose accelerations stay those of the equations of motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from math import inf, isfinite, sqrt, ulp
from operator import mul

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Acceleration = Callable[[Array, Array], tuple[Sequence[float], int]]
"""At (q, v), joint limits left out: q̈ of the equations of motion, n values, and the rank that J⁺
was given, the number of its singular values that were not dropped."""
Limits = Sequence[tuple[float, float]]
"""Per joint (q_min, q_max)."""

A = np.array(
    [
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
        [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
"""Row s weighs the derivatives of stages 0…s; the last row is the fifth-order solution."""
E = np.array([-71 / 57600, 0, 71 / 16695, -71 / 1920, 17253 / 339200, -22 / 525, 1 / 40])
P = np.array(
    [
        [1, -8048581381 / 2820520608, 8663915743 / 2820520608, -12715105075 / 11282082432],
        [0, 0, 0, 0],
        [0, 131558114200 / 32700410799, -68118460800 / 10900136933, 87487479700 / 32700410799],
        [0, -1754552775 / 470086768, 14199869525 / 1410260304, -10690763975 / 1880347072],
        [0, 127303824393 / 49829197408, -318862633887 / 49829197408, 701980252875 / 199316789632],
        [0, -282668133 / 205662961, 2019193451 / 616988883, -1453857185 / 822651844],
        [0, 40617522 / 29380423, -110615467 / 29380423, 69997945 / 29380423],
    ]
)
SAFETY, MIN_FACTOR, MAX_FACTOR = 0.9, 0.2, 10.0
JUMP_STEP = 2.0**-8
"""As a part of the first step: where J⁺ drops a singular value the right-hand side jumps, and no
step across that passes the error test. One of this size, whose stages had different ranks, is
taken."""
BUDGET = 1_000_000
"""Evaluations of the right-hand side in one communication step; a stiff motion would need more."""
STAGES = 6
"""Evaluations that an integration step costs."""
PATIENCE = 0.25
"""As a part of the largest step: a joint that is back at its limit sooner than this after leaving
it is kept there for as long. Where its acceleration only grazes zero, as it may at a singularity,
it would else leave and return without end."""
TIME_RESOLUTION = 2.0**-52
NUDGE = 1e-6  # rad, m and per s: of the difference quotients that tell how fast a joint is


class StepError(ArithmeticError):
    """A communication step that cannot be done within the tolerances and the budget.

    Attributes:
        too_fine: no integration step was small enough, so that a larger budget would not help.
        joint: index of the joint that changes fastest.
        rate: of its change, 1/s.
    """

    def __init__(self, *, too_fine: bool, joint: int, rate: float) -> None:
        super().__init__(f"joint {joint} changes at a rate of {rate:g} 1/s")
        self.too_fine, self.joint, self.rate = too_fine, joint, rate


@dataclass
class _Equations:
    """The equations of motion, and how often they were evaluated."""

    acceleration: Acceleration
    evaluations: int = 0

    def __call__(self, q: Array, v: Array) -> tuple[Sequence[float], int]:
        self.evaluations += 1
        return self.acceleration(q, v)


@dataclass
class _Stops:
    """Joints at rest at a limit: all of them, and those that may leave it when they are drawn."""

    limits: Limits
    held: list[int]
    watched: list[int]


def advance(
    acceleration: Acceleration,
    q: Sequence[float],
    v: Sequence[float],
    h: float,
    limits: Limits,
    rtol: float,
    atol: float,
    max_step: float,
) -> tuple[list[float], list[float]]:
    """State one communication step later.

    Args:
        acceleration: q̈(q, v); autonomous, as inputs are held over the step.
        q, v: state at the beginning, n each; q within the limits.
        h: communication step, s, > 0.
        limits: per joint (q_min, q_max).
        rtol, atol: tolerances of the error test on the state (q, v).
        max_step: largest integration step, s.

    Returns:
        q, v at the end; q within the limits to the last bit.

    Raises:
        FloatingPointError: the equations gave a value that is not finite.
        StepError: they change too fast.
    """
    equations = _Equations(acceleration)
    y = np.array([*q, *v])
    t = 0.0
    patience = PATIENCE * min(max_step, h)
    left = [-inf] * len(limits)  # when each joint last left its limit
    kept = [0.0] * len(limits)  # until when each joint is kept at its limit
    while t < h:
        end = min((until for until in kept if until > t), default=h)
        stops, y, f, rank = _hold(equations, y, limits, [until > t for until in kept])
        for i, (low, high) in enumerate(limits):
            if i not in stops.held and not low < y[i] < high:
                left[i] = t
        t, y, stopped = _until_event(
            equations, y, f, rank, t, min(end, h), stops, rtol, atol, max_step
        )
        for i in stopped:
            if t - left[i] < patience:
                kept[i] = t + patience
    state = y.tolist()
    return state[: len(q)], state[len(q) :]


def _until_event(
    equations: _Equations,
    y: Array,
    f: list[float],
    rank: int,
    t: float,
    end: float,
    stops: _Stops,
    rtol: float,
    atol: float,
    max_step: float,
) -> tuple[float, Array, list[int]]:
    """Integrate from t until a joint reaches or leaves a limit, or until the end.

    Returns the time, the state there, and the joints that reached a limit. f is q̈ at y, of this
    rank.
    """
    n = len(f)
    first = min(max_step, end - t)
    jump_step = JUMP_STEP * first
    K = np.empty((STAGES + 1, 2 * n))
    K[0, :n] = y[n:]
    K[0, n:] = f
    ranks = [rank] * (STAGES + 1)
    size = np.abs(y)
    step, growth = first, MAX_FACTOR
    while True:
        last = t + step * (1 + 1e-9) >= end
        small = step <= jump_step  # also where it is stretched to the end
        if last:
            step = end - t
        y_new, error = _dormand_prince(equations, y, step, stops.held, K, ranks)
        size_new = np.abs(y_new)
        ratio = error / (atol + rtol * np.maximum(size, size_new))
        norm = sqrt(ratio.dot(ratio) / (2 * n))
        factor = MIN_FACTOR
        if isfinite(norm):
            factor = SAFETY * norm**-0.2 if norm > 0.0 else MAX_FACTOR
        at_jump = small and isfinite(norm) and min(ranks) < max(ranks)
        if norm < 1.0 or at_jump:
            event = _first_event(equations, y, y_new, step, stops, K)
            if event is not None:
                passed, y, stopped = event
                return (end if last and passed == step else t + passed), y, stopped
            if last:
                return end, y_new, []
            t, y, size = t + step, y_new, size_new
            K[0], ranks[0] = K[-1], ranks[-1]
            if norm < 1.0:  # else the error says nothing about the next step
                step = min(max_step, step * max(MIN_FACTOR, min(growth, factor)))
            growth = MAX_FACTOR
        else:
            shorter = step * max(MIN_FACTOR, factor)
            step = shorter if small else max(jump_step, shorter)
            growth = 1.0  # SciPy's rule: no growth right after a rejection
            if step < 10 * ulp(t):
                if not np.isfinite(K).all():
                    raise FloatingPointError(
                        "the equations of motion gave a value that is not finite"
                    )
                raise _too_fast(equations, y, too_fine=True)
        if equations.evaluations > BUDGET:
            raise _too_fast(equations, y, too_fine=False)


def _dormand_prince(
    equations: _Equations, y: Array, step: float, held: list[int], K: Array, ranks: list[int]
) -> tuple[Array, Array]:
    """One step from y, whose derivative is K[0]: (y_new, error); fills K[1:] and ranks[1:]."""
    n = len(y) // 2
    acceleration = equations.acceleration
    equations.evaluations += STAGES
    weights = step * A
    for stage in range(1, STAGES + 1):
        y_new = weights[stage - 1, :stage].dot(K[:stage])
        y_new += y
        v = y_new[n:]
        rates = K[stage]
        rates[:n] = v
        rates[n:], ranks[stage] = acceleration(y_new[:n], v)
        for i in held:
            rates[n + i] = 0.0
    return y_new, step * E.dot(K)


def _too_fast(equations: _Equations, y: Array, *, too_fine: bool) -> StepError:
    """Names the joint whose own acceleration answers most to its position or velocity at y."""
    n = len(y) // 2
    a = equations(y[:n], y[n:])[0]
    rates = []
    for i, order in product(range(n), (2, 1)):  # |∂q̈ᵢ/∂qᵢ|½ and |∂q̈ᵢ/∂vᵢ|
        nudged = y.copy()
        nudged[i + n * (order == 1)] += NUDGE
        change = abs(equations(nudged[:n], nudged[n:])[0][i] - a[i]) / NUDGE
        rates.append((change ** (1 / order) if isfinite(change) else inf, i))
    rate, joint = max(rates)
    return StepError(too_fine=too_fine, joint=joint, rate=rate)


def _hold(
    equations: _Equations, y: Array, limits: Limits, kept: list[bool]
) -> tuple[_Stops, Array, list[float], int]:
    """Joints that rest at a limit; y with the velocity into it taken; what acceleration is left.

    That is of the rank that is the last value.
    """
    n = len(limits)
    y = y.copy()
    for i, (low, high) in enumerate(limits):
        if (y[i] >= high and y[n + i] > 0.0) or (y[i] <= low and y[n + i] < 0.0):
            y[n + i] = 0.0
    f, rank = equations(y[:n], y[n:])
    a = list(f)
    held = []
    for i, (low, high) in enumerate(limits):
        into = (y[i] >= high and a[i] >= 0.0) or (y[i] <= low and a[i] <= 0.0)
        if (into or kept[i]) and y[n + i] == 0.0:
            held.append(i)
            a[i] = 0.0
    return _Stops(limits, held, [i for i in held if not kept[i]]), y, a, rank


def _first_event(
    equations: _Equations, y: Array, y_new: Array, step: float, stops: _Stops, K: Array
) -> tuple[float, Array, list[int]] | None:
    """First time in (0, step] at which a limit is reached or left.

    Returns that time, the state from there on, and the joints that reached a limit.
    """
    n = len(stops.limits)
    at_the_end = _events(equations, y_new, stops)
    if not at_the_end and min(map(mul, y[n:].tolist(), y_new[n:].tolist())) >= 0.0:
        return None  # no joint has turned
    Q = K.T.dot(P)

    def state(passed: float) -> Array:
        return y_new if passed == step else _dense_output(y, Q, passed / step, step)

    latest = step
    if not at_the_end:
        excursion = _excursion(y, y_new, state, step, stops.limits)
        if excursion is None:
            return None
        latest = excursion
    latest = _bisect(lambda passed: bool(_events(equations, state(passed), stops)), latest, step)
    y = state(latest).copy()
    stopped = [i for i in _events(equations, y, stops) if i not in stops.held]
    for i in stopped:
        low, high = stops.limits[i]
        y[i] = min(max(y[i], low), high)
        y[n + i] = 0.0
    return latest, y, stopped


def _events(equations: _Equations, y: Array, stops: _Stops) -> list[int]:
    """Free joints that are past a limit and watched joints that leave theirs, at y."""
    n = len(stops.limits)
    values = y.tolist()
    found = []
    for i, (low, high) in enumerate(stops.limits):
        q, v = values[i], values[n + i]
        if (q >= high and (q > high or v > 0.0)) or (q <= low and (q < low or v < 0.0)):
            found.append(i)
    if stops.watched:
        a, _ = equations(y[:n], y[n:])
        for i in stops.watched:
            low, high = stops.limits[i]
            leaves = a[i] < 0.0 if values[i] >= high else a[i] > 0.0
            if leaves and low < high:
                found.append(i)
    return found


def _excursion(
    y: Array, y_new: Array, state: Callable[[float], Array], step: float, limits: Limits
) -> float | None:
    """When a joint is furthest past a limit, where it is so within one step and back at its end."""
    n = len(limits)
    before, after = y.tolist(), y_new.tolist()
    times = []
    for i, (low, high) in enumerate(limits):
        q, v = before[i], before[n + i]
        limit = high if v > 0.0 else low
        if v * after[n + i] < 0.0 and abs(v) * step > abs(limit - q):
            turn = _turn(state, n + i, v, step)
            if (float(state(turn)[i]) - limit) * v > 0.0:
                times.append(turn)
    return min(times, default=None)


def _turn(state: Callable[[float], Array], component: int, v: float, step: float) -> float:
    return _bisect(lambda passed: float(state(passed)[component]) * v <= 0.0, step, step)


def _dense_output(y: Array, Q: Array, x: float, step: float) -> Array:
    """State at the part x of a step, by the fourth-order interpolant."""
    state: Array = y + step * x * Q.dot((1.0, x, x * x, x * x * x))
    return state


def _bisect(happened: Callable[[float], bool], latest: float, step: float) -> float:
    """First time in (0, latest] at which it has happened, to the last bits of the step."""
    before = 0.0
    while latest - before > TIME_RESOLUTION * step:
        middle = 0.5 * (before + latest)
        if not before < middle < latest:  # of two neighbouring numbers
            break
        if happened(middle):
            latest = middle
        else:
            before = middle
    return latest
