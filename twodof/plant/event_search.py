"""Locate the first event within an integration step, on its dense output.

An event is a time at which a margin becomes negative. Margins are the distance of a joint from a limit, the velocity of
a joint that slips, the distance of a holding effort from its bounds, and the margin of the rank of J⁺. Positions and
velocities are polynomials with known turning points. The other margins are sampled as often as their rates of change
require.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import inf, sqrt

import numpy as np

from .dormand_prince import Array, State
from .rosenbrock import CUBIC
from .stops import Stops

Margin = Callable[[float], float]
"""A function of the time within the step that is negative after the end of the step's regime."""

REACH, PACE = 1.66, 3.72
"""Bounds on the weights of Dormand and Prince's interpolant: the largest sum of their magnitudes, and the largest sum
of the magnitudes of their rates.
"""
DOUBT, LATE = 0.25, 2.0**-8
"""Fractions of the range of an effort's margin over the stages, and of the resolution of a release. Between the stages,
the margin falls below their smallest value by less than this range. If it may therefore be below zero, it is sampled
where a polynomial through the efforts at the stages passes zero, and at each extremum of the polynomial that is below
DOUBT times the range. The former samples are late by LATE times the resolution: there, rounding does not decide the
sign.
"""
HALVINGS = 7
"""Halvings of a step in the search; shorter excursions are ignored."""
TIME_RESOLUTION, RELEASE_RESOLUTION, FINEST_RELEASE, COARSEST_RELEASE = 2.0**-52, 2.0**-10, 2.0**-26, 2.0**-5
"""Resolutions of the time of an event. TIME_RESOLUTION, a fraction of the step, applies to all events but a release.
The resolution of a release is a fraction of the largest step, from FINEST_RELEASE to RELEASE_RESOLUTION. A step shorter
than COARSEST_RELEASE times the largest step has a finer one in proportion. At a release the acceleration is 0, so that
the error of the state grows with the cube of that of the time.
"""
TOGETHER, WINDOW, USUAL_RTOL = 2.0**-25, 2.0**-6, 1e-3
"""TOGETHER and WINDOW are fractions of the largest step. Joints that reach rigid stops within TOGETHER after an event
stop with it. Joints that an impact moves, and that come to rest within WINDOW, stop with the impact. Below USUAL_RTOL,
WINDOW shrinks with rtol, as the first hold at a rigid stop and the resolution of a release do.
"""
THROUGH_THIRDS = np.array([[1, -2.75, 3, -1.125], [0, 4.5, -7.5, 3.375], [0, -2.25, 6, -3.375], [0, 0.5, -1.5, 1.125]])
"""Weights of the efforts at the start, at both thirds and at the end of a stiff step, as those of a dense output."""


@dataclass
class Event:
    """Event at the end of a step.

    Attributes:
        stopped: joints that reached a limit, or are still at one and turn towards it.
        arrested: joints that slipped and have no velocity left.
    """

    stopped: list[int] = field(default_factory=list)
    arrested: list[int] = field(default_factory=list)


def first_zero(distance: float, v: float, a: float) -> float:
    """Return the first positive time at which distance + v t + a t²/2 is 0, or infinity.

    The distance is not negative, and v or a is negative.
    """
    square = v * v - 2.0 * a * distance
    if v >= 0.0:
        return -(v + sqrt(square)) / a
    return 2.0 * distance / (sqrt(square) - v) if square >= 0.0 else inf


def expected_event(
    y: State, rates: State, stops: Stops, grips: Sequence[float], grip_rates: Sequence[float], most: float
) -> float:
    """Return when a joint is expected to stop or to be released, s; infinity if later than ``most``.

    A constant acceleration stops it at a limit or by friction; changes of efforts, at the rates at the end of the last
    regime, release it.
    """
    n, first = len(stops.limits), inf
    first = min((max(0.0, grip) / -rate for grip, rate in zip(grips, grip_rates) if rate < 0.0), default=inf)
    for i, (low, high) in enumerate(stops.limits):
        q, v, a = y[i], rates[i], rates[n + i]
        if i in stops.held:
            continue
        if stops.slip[i] * v > 0.0 > stops.slip[i] * a:
            first = min(first, -v / a)
        reach = (abs(v) + abs(a) * most) * most
        if q - low < reach and (v < 0.0 or a < 0.0):
            first = min(first, first_zero(q - low, v, a))
        if high - q < reach and (v > 0.0 or a > 0.0):
            first = min(first, first_zero(high - q, -v, -a))
    return first if first <= most else inf


def fastest(K: Sequence[State], n: int) -> list[float]:
    """Return bounds on the first n magnitudes of the interpolant's rate, given the derivatives K at the stages.

    The weights of the rate sum to 1, so that it is at most PACE times half the range of K from the middle of the range.
    """
    ranges = [(min(speeds), max(speeds)) for speeds in zip(*(k[:n] for k in K))]
    return [0.5 * (abs(low + high) + PACE * (high - low)) for low, high in ranges]


def search(
    margin: Margin, rate: float, a: float, at_a: float, b: float, at_b: float, step: float, halvings: int = HALVINGS
) -> float:
    """Return the first time in (a, b] at which a margin is negative, or infinity.

    Args:
        rate: its largest rate of change, which excludes intervals in which the margin cannot be negative.
        a, b: times within the step, s.
        at_a, at_b: the margin there.
        step: size of the step, s.
        halvings: how often the interval may be halved.
    """
    if at_b >= 0.0 and (halvings == 0 or at_a + at_b >= rate * (b - a)):
        return inf
    if halvings == 0:
        return locate(margin, a, at_a, b, at_b, TIME_RESOLUTION * step)
    middle = 0.5 * (a + b)
    at_middle = margin(middle)
    first = search(margin, rate, a, at_a, middle, at_middle, step, halvings - 1)
    if first == inf:
        first = search(margin, rate, middle, at_middle, b, at_b, step, halvings - 1)
    return first


def locate(
    margin: Margin, a: float, at_a: float, b: float, at_b: float, resolution: float, growth: float = 0.01
) -> float:
    """Return the first time in (a, b] at which a margin is negative, given that it is at b.

    The interpolation stays near the middle, so that it never needs many more evaluations than bisection. Source:
    Oliveira & Takahashi, "An enhancement of the bisection method", ACM TOMS 47(1), 2020.
    """
    k = growth / (b - a)  # small, because margins are smooth
    slack = b - a  # how much longer the interval may be than after bisection
    while b - a > resolution:
        middle, half = 0.5 * (a + b), 0.5 * (b - a)
        x = (b * at_a - a * at_b) / (at_a - at_b) if at_a > at_b else middle
        shift = min(max(k * (b - a) * (b - a), 0.25 * resolution), abs(middle - x))
        x += shift if middle > x else -shift
        if abs(x - middle) > slack - half:
            x = middle + (slack - half if x > middle else half - slack)
        if not a < x < b:
            x = middle
        if not a < x < b:  # a and b are neighbouring numbers
            break
        at_x = margin(x)
        if at_x < 0.0:
            b, at_b = x, at_x
        else:
            a, at_a = x, at_x
        slack = max(0.5 * slack, resolution)
    return b


def first_crossing(margin: Margin, slope: Sequence[float], step: float, dip: float) -> float:
    """Return the first time at which a position is past a limit or a velocity past 0, or infinity.

    ``slope`` has the coefficients of the margin's rate as a polynomial of time over the step, ascending. A margin that
    is 0 at first may fall below 0 by less than ``dip`` before it is positive. Otherwise an error of the interpolant
    would be a crossing where a joint leaves its limit.
    """
    before, at_before = 0.0, margin(0.0)
    turns = [turn * step for turn in (*sign_changes(slope), 1.0)]
    if dip and len(turns) > 1 and at_before == 0.0 and -dip < margin(turns[0]) < 0.0 <= margin(turns[1]):
        del turns[0]
    for after in turns:
        at_after = margin(after)
        if at_after < 0.0:
            return locate(margin, before, at_before, after, at_after, TIME_RESOLUTION * step)
        before, at_before = after, at_after
    return inf


def sign_changes(coefficients: Sequence[float]) -> list[float]:
    """Return the points in (0, 1) at which a polynomial with ascending coefficients changes sign, in ascending order.

    The polynomial is monotonic between the sign changes of its derivative.
    """
    if len(coefficients) == 1:
        return []

    roots, left = [], 0.0
    slope = [k * coefficient for k, coefficient in enumerate(coefficients)][1:]
    for right in (*sign_changes(slope), 1.0):
        before = _polynomial(coefficients, left)
        if before * _polynomial(coefficients, right) < 0.0:
            low, high = left, right
            while high - low > TIME_RESOLUTION:
                middle = 0.5 * (low + high)
                if _polynomial(coefficients, middle) * before > 0.0:
                    low = middle
                else:
                    high = middle
            roots.append(high)
        left = right
    return roots


def _polynomial(coefficients: Sequence[float], x: float) -> float:
    total = 0.0
    for coefficient in reversed(coefficients):
        total = total * x + coefficient
    return total


def may_vanish(margins: Sequence[float]) -> bool:
    """Return whether the margin of an effort may reach 0 within a step, given its values at the stages."""
    low, high = min(margins), max(margins)
    return low != inf and not low >= high - low


def release_resolution(step: float, max_step: float, coarseness: float) -> float:
    """Return the resolution of the time of a release, s; it shrinks with the factor ``coarseness``."""
    return max(RELEASE_RESOLUTION * coarseness, FINEST_RELEASE) * min(step / COARSEST_RELEASE, max_step)


def first_release(
    grips: Callable[[float], Sequence[float]],
    at_stages: Sequence[Sequence[float]],
    weights: Array,
    doubtful: Sequence[int],
    step: float,
    before: float,
    resolution: float,
) -> float:
    """Return the first time before ``before`` at which a joint is released, or infinity.

    Args:
        grips: the distances of the holding efforts from their bounds, as a function of the time within the step.
        at_stages: the same at the stages of the step, of which the first and the last are at its ends.
        weights: those of the dense output, whose rate is a polynomial through values at the stages.
        doubtful: indices of the distances that may reach 0.
        step: size of the step, s.
        before: a time within the step, s.
        resolution: of the result, s.
    """

    def margin(passed: float) -> float:
        return min(grips(passed))

    instant, end, at_start = TIME_RESOLUTION * step, min(before, step), min(at_stages[0])
    if before <= instant:
        return inf
    if (at_once := margin(instant)) < 0.0 and at_once < -abs(margin(0.0) - at_start):
        return instant  # beyond the difference of two ways to compute the efforts; else the joint would be held again
    if weights is CUBIC:  # its derivatives are not those at the stages
        at_stages = [at_stages[0], grips(step / 3), grips(step * 2 / 3), at_stages[-1]]
        weights = THROUGH_THIRDS
    looks = [look for i in doubtful for look in _looks([m[i] for m in at_stages], weights, step, LATE * resolution)]
    a, at_a = 0.0, at_start
    while a < end:
        b = min((look for look in looks if a < look < end), default=end)
        at_b = margin(b) if b < step else min(at_stages[-1])
        if at_b < 0.0:
            return locate(margin, a, at_a, b, at_b, resolution, 0.0)
        a, at_a = b, at_b
    return inf


def grip_rates(at_stages: Sequence[Sequence[float]], weights: Array, x: float) -> Array:
    """Return the rates of the distances of ``first_release`` at a fraction x of the step, per step."""
    with np.errstate(invalid="ignore"):  # distances without a bound are infinite
        rates: Array = np.array(at_stages).T @ (weights @ (0.0, 2.0, 6.0 * x, 12.0 * x * x))
    return rates


def _looks(margins: Sequence[float], weights: Array, step: float, late: float) -> list[float]:
    """Return times just after a margin, as a polynomial, passes 0, and times of extrema that may be below 0."""
    c = [k * float(row) for k, row in enumerate(np.array(margins) @ weights, 1)]
    slope = [k * coefficient for k, coefficient in enumerate(c)][1:]
    bound = DOUBT * (max(margins) - min(margins))
    extrema = [x * step for x in sign_changes(slope) if _polynomial(c, x) < bound]
    return [x * step + late for x in sign_changes(c)] + extrema
