"""Motion of a plant by solvers of SciPy, from one event of friction and stops to the next.

The plant's rules decide which joints rest and slip after an event. SciPy integrates the motion and locates the event.
"""

from functools import partial
from math import inf

import numpy as np

from ..errors import BuildError
from ..plant.plant import Plant
from ..plant.regime import DORMAND_PRINCE, Motion
from .closed_form import Array

SOON, MOST_EVENTS, PASSED = 1e-11, 1000, 1e-11
"""Time after an event, s, at which rounding no longer hides the sides of bounds; the most events in one call; and the
distance beyond a stop, rad or m, that shows an event which was not found.
"""


def advanced(plant: Plant, h: float, method: str, tolerance: float) -> Array:
    """Return the state (q, v) after h seconds with inputs held, by SciPy between events, of limited number."""
    from scipy.integrate import solve_ivp  # which takes 0.4 s to import, and most builds have no references

    n, t, y, idle = len(plant.q), 0.0, np.array([*plant.q, *plant.v]), [False] * len(plant.q)
    stops = plant.stops()
    motion = Motion(plant.equations_of_motion(), stops, plant.rtol, plant.atol, plant.max_step, DORMAND_PRINCE)

    def rates(t: float, y: Array) -> Array:
        return np.array([*y[n:], *motion.acceleration(y.tolist())[0]])

    for _ in range(MOST_EVENTS):
        state = y.tolist()
        motion.set_out(state, idle, idle, rank_held=False)
        free = [i for i in range(n) if i not in stops.held]
        ends = [(n + i, 0.0, stops.slip[i]) for i in free if stops.slip[i]]
        ends += [(i, end, side) for i in free for end, side in zip(stops.limits[i], (1, -1))]
        events = [partial(_distance, *end) for end in ends]
        events += [partial(_grip, motion, i) for i, grip in enumerate(motion.grips[0]) if np.isfinite(grip)]
        for event in events:
            event.terminal, event.direction = True, -1  # type: ignore[attr-defined]
        y = np.array(state)
        y, t = y + SOON * rates(t, y), t + SOON
        hit = {i: end for i, end, side in ends if i < n and side * (y[i] - end) < 0.0}
        if hit:  # within this time; the solver would find no event
            y[[*hit]] = [*hit.values()]
            continue
        until, before = h, inf
        while t < until < before:  # again up to the event, if a stop was passed and left in the same step
            found = solve_ivp(
                rates, (t, until), y, method, events=events, rtol=tolerance, atol=1e-14, max_step=plant.max_step
            )
            last, before = found.y[:, -1], until
            if any(i < n and side * (last[i] - end) < -PASSED for i, end, side in ends):
                until = found.t[-1]
        if t < h:
            t, y = found.t[-1], last
        if t >= h:
            return y
        y, t = y + SOON * rates(t, y), t + SOON
        for (i, end, _side), times in zip(ends, found.t_events):
            if len(times):
                y[i] = end
    raise BuildError("no references: a motion with friction has too many events; choose another `q_start`")


def _distance(i: int, end: float, side: int, t: float, y: Array) -> float:
    """Return the distance of a component of the state from an end, enlarged while a position moves away from it."""
    away = side * y[i + len(y) // 2] if i < len(y) // 2 else 0.0
    return float(side * (y[i] - end) + max(0.0, away))


def _grip(motion: Motion, i: int, t: float, y: Array) -> float:
    return motion.acceleration(y.tolist())[1][i]
