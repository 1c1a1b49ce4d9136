"""Dormand–Prince 5(4) over one communication step, with located joint-limit stops.

The step-size control is that of SciPy's ``RK45`` (Hairer, Nørsett & Wanner, "Solving ODEs I",
II.4). Every communication step begins afresh with the step min(max_step, h), so that no integrator
state outlives it.

A joint that reaches a limit is set onto it and stays there until it is released (``stops``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain, product
from math import inf, isfinite, ulp
from struct import Struct

import numpy as np
from numpy.typing import NDArray

from .dormand_prince import State, dormand_prince, error_norm, interpolant
from .stops import Stops

Array = NDArray[np.float64]
Response = Callable[[Array, Array], tuple[Sequence[float], int]]
"""At (q, v), joint limits left out: q̈ of the equations of motion, or what a control law gives, n
values, and the rank of the law's J⁺, the number of its singular values that were not dropped."""

SAFETY, MIN_FACTOR, MAX_FACTOR = 0.9, 0.2, 10.0
JUMP_STEP = 2.0**-8
"""As a part of the first step: where J⁺ drops a singular value the right-hand side jumps, and no
step across that passes the error test. One of this size, whose stages had different ranks, is
taken."""
BUDGET = 1_000_000
"""Evaluations of the right-hand side in one communication step; a stiff motion would need more."""
PATIENCE, FIRST_WAIT = 0.25, 2.0**-30
"""As parts of the largest step, and of that: a joint that is back at its limit sooner than the one
after leaving it is kept there for the other, and each time that this is so again twice as long.
Where its acceleration only grazes zero, as it may at a singularity, or where joints drive each
other off, it would else leave and return without end; where it returns but once, nothing is
changed."""
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


class _Motion:
    """The equations of motion as a system of first order, with stops, and how often they were
    evaluated."""

    def __init__(
        self, acceleration: Response, stops: Stops, rtol: float, atol: float, max_step: float
    ) -> None:
        n = len(stops.limits)
        self._acceleration = acceleration
        state = np.empty(2 * n)
        self._write = Struct(f"{2 * n}d").pack_into  # quicker than numpy at this size
        self._buffer, self._q, self._v = state.data, state[:n], state[n:]
        self.n, self.evaluations = n, 0
        self.stops, self.rtol, self.atol, self.max_step = stops, rtol, atol, max_step

    def acceleration(self, y: State) -> tuple[list[float], int]:
        """q̈ at y, and its rank."""
        self.evaluations += 1
        self._write(self._buffer, 0, *y)
        a, rank = self._acceleration(self._q, self._v)
        return list(a), rank

    def rates(self, ranks: list[int], y: State) -> State:
        """ẏ at y with the joints held that are; the rank is added to ranks."""
        a, rank = self.acceleration(y)
        if self.stops.held:
            self.stops.restrain(y, a)
        ranks.append(rank)
        return y[self.n :] + a

    def until_event(
        self, y: State, f: list[float], rank: int, t: float, end: float
    ) -> tuple[float, State, list[int], list[int]]:
        """Integrate from t until a joint reaches or leaves a limit, or until the end.

        Returns the time, the state there, the joints that reached a limit, and those that leave
        theirs. f is q̈ at y, of this rank.
        """
        step = min(self.max_step, end - t)
        jump_step = JUMP_STEP * step
        rates = [*y[self.n :], *f]
        growth = MAX_FACTOR
        while True:
            last = t + step * (1 + 1e-9) >= end
            small = step <= jump_step  # also where it is stretched to the end
            if last:
                step = end - t
            ranks = [rank]
            y_new, K = dormand_prince(partial(self.rates, ranks), y, step, rates)
            norm = error_norm(K, y, y_new, step, self.rtol, self.atol)
            factor = MIN_FACTOR
            if isfinite(norm):
                factor = SAFETY * norm**-0.2 if norm > 0.0 else MAX_FACTOR
            at_jump = small and isfinite(norm) and min(ranks) < max(ranks)
            if norm < 1.0 or at_jump:
                event = self._first_event(y, y_new, step, K)
                if event is not None:
                    passed, y, stopped, let_go = event
                    return end if last and passed == step else t + passed, y, stopped, let_go
                if last:
                    return end, y_new, [], []
                t, y, rates, rank = t + step, y_new, K[-1], ranks[-1]
                if norm < 1.0:  # else the error says nothing about the next step
                    step = min(self.max_step, step * max(MIN_FACTOR, min(growth, factor)))
                growth = MAX_FACTOR
            else:
                shorter = step * max(MIN_FACTOR, factor)
                step = shorter if small else max(jump_step, shorter)
                growth = 1.0  # SciPy's rule: no growth right after a rejection
                if step < 10 * ulp(t):
                    if not all(map(isfinite, chain(*K))):
                        text = "the equations of motion gave a value that is not finite"
                        raise FloatingPointError(text)
                    raise self._too_fast(y, too_fine=True)
            if self.evaluations > BUDGET:
                raise self._too_fast(y, too_fine=False)

    def _too_fast(self, y: State, *, too_fine: bool) -> StepError:
        """Names the joint whose own acceleration answers most to its position or velocity at y."""
        a, _ = self.acceleration(y)
        rates = []
        for i, order in product(range(self.n), (2, 1)):  # |∂q̈ᵢ/∂qᵢ|½ and |∂q̈ᵢ/∂vᵢ|
            nudged = y.copy()
            nudged[i + self.n * (order == 1)] += NUDGE
            change = abs(self.acceleration(nudged)[0][i] - a[i]) / NUDGE
            rates.append((change ** (1 / order) if isfinite(change) else inf, i))
        rate, joint = max(rates)
        return StepError(too_fine=too_fine, joint=joint, rate=rate)

    def _first_event(
        self, y: State, y_new: State, step: float, K: list[State]
    ) -> tuple[float, State, list[int], list[int]] | None:
        """First time in (0, step] at which a limit is reached or left.

        Returns that time, the state from there on, the joints that reached a limit, and those that
        leave theirs.
        """
        n, stops = self.n, self.stops
        if not stops.watched:
            for (low, high), q, v, before in zip(stops.limits, y_new, y_new[n:], y[n:]):
                if not low < q < high or v * before < 0.0:
                    break
            else:  # all are inside, and none has turned
                return None
        state = interpolant(y, y_new, K, step)
        latest = step if self._events(y_new) else self._excursion(y, y_new, state, step)
        if latest is None:
            return None
        latest = _bisect(lambda passed: bool(self._events(state(passed))), latest, step)
        y = state(latest).copy()
        events = self._events(y)
        stopped = [i for i in events if i not in stops.held]
        for i in stopped:
            low, high = stops.limits[i]
            y[i] = min(max(y[i], low), high)
        return latest, y, stopped, [i for i in events if i in stops.held]

    def _events(self, y: State) -> list[int]:
        """Free joints that are past a limit and watched joints that are let go, at y."""
        events = []
        for i, ((low, high), q, v) in enumerate(zip(self.stops.limits, y, y[self.n :])):
            if (q >= high and (q > high or v > 0.0)) or (q <= low and (q < low or v < 0.0)):
                events.append(i)
        if self.stops.watched:
            a, _ = self.acceleration(y)
            events += self.stops.released(y, a)
        return events

    def _excursion(
        self, y: State, y_new: State, state: Callable[[float], State], step: float
    ) -> float | None:
        """When a joint is furthest past a limit, where it is so in one step and back at its end."""
        times = []
        for i, (low, high) in enumerate(self.stops.limits):
            q, v, component = y[i], y[self.n + i], self.n + i
            limit = high if v > 0.0 else low
            if v * y_new[component] < 0.0 and abs(v) * step > abs(limit - q):
                turn = _turn(state, component, v, step)
                if (state(turn)[i] - limit) * v > 0.0:
                    times.append(turn)
        return min(times, default=None)


def _turn(state: Callable[[float], State], component: int, v: float, step: float) -> float:
    return _bisect(lambda passed: state(passed)[component] * v <= 0.0, step, step)


def advance(
    acceleration: Response,
    q: Sequence[float],
    v: Sequence[float],
    h: float,
    stops: Stops,
    rtol: float,
    atol: float,
    max_step: float,
) -> tuple[list[float], list[float]]:
    """State one communication step later.

    Args:
        acceleration: q̈(q, v); autonomous, as inputs are held over the step.
        q, v: state at the beginning, n each; q within the limits.
        h: communication step, s, > 0.
        stops: at the joints' limits.
        rtol, atol: tolerances of the error test on the state (q, v).
        max_step: largest integration step, s.

    Returns:
        q, v at the end; q within the limits to the last bit.

    Raises:
        FloatingPointError: the equations gave a value that is not finite.
        StepError: they change too fast.
    """
    limits = stops.limits
    motion = _Motion(acceleration, stops, rtol, atol, max_step)
    y, t = [*q, *v], 0.0
    patience = PATIENCE * min(max_step, h)
    left = [-inf] * len(limits)  # when each joint last left its limit
    kept = [-inf] * len(limits)  # until when each joint is kept at its limit,
    wait = [0.0] * len(limits)  # and for how long
    let_go: list[int] = []
    while t < h:
        end = min((until for until in kept if until > t), default=h)
        keep = [until > t for until in kept]
        stops.impact(y, keep)
        f, rank = motion.acceleration(y)
        stops.hold(y, f, keep)
        for i, (low, high) in enumerate(limits):
            if i not in stops.held and not low < y[i] < high:
                left[i] = t
        again = [i for i in let_go if i in stops.watched]  # it is pressed again, by rounding
        for i in again:
            wait[i] = _wait(wait[i], t - kept[i], patience)
            kept[i] = t + wait[i]
        let_go = []
        if again:
            continue
        t, y, stopped, let_go = motion.until_event(y, f, rank, t, min(end, h))
        for i in stopped:
            if t - left[i] < patience:
                wait[i] = _wait(wait[i], t - kept[i], patience)
                kept[i] = t + wait[i]
    stops.impact(y, [until > h for until in kept])
    return y[: len(q)], y[len(q) :]


def _wait(last: float, since: float, patience: float) -> float:
    """How long a joint is kept at its limit, s; last time it was so long, and ended so long ago."""
    return min(2.0 * last, patience) if since < patience else FIRST_WAIT * patience


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
