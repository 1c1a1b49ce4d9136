"""Integrate one communication step by Dormand–Prince 5(4) or ROS34PW2, with located events.

Every communication step restarts with the step min(max_step, h), so that the integrator has no state between them. It
is integrated from event to event, each stretch in one regime (``regime``).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

from .anti_chatter import (
    CHATTER_TIME,
    FIRST_HOLD,
    FIRST_RIGID_HOLD,
    HOLD_OF_ALL,
    SHORT_CHATTER_TIME,
    Hold,
    Slide,
    stop_time,
)
from .dormand_prince import State
from .equations import Equations
from .regime import AUTOMATIC, Motion
from .stops import Stops


@dataclass
class Budget:
    """Count of the evaluations of the right-hand side in all parts of a communication step."""

    spent: int = 0


def advance(
    equations: Equations,
    q: Sequence[float],
    v: Sequence[float],
    h: float,
    stops: Stops,
    rtol: float,
    atol: float,
    max_step: float,
    integrator: int = AUTOMATIC,
    budget: Budget | None = None,
) -> tuple[list[float], list[float]]:
    """Integrate the state over one communication step or a part of it.

    Args:
        equations: the equations of motion, autonomous because inputs are held over the step.
        q, v: state at the beginning, n each; q within the limits.
        h: communication step, s, > 0.
        rtol, atol: tolerances of the error test on the state (q, v).
        max_step: largest integration step, s.
        integrator: DORMAND_PRINCE, STIFF, or AUTOMATIC, which changes to STIFF if a step fails because of stiff
            damping.
        budget: evaluations in earlier parts of the communication step; None if this is the first part.

    Returns:
        q and v at the end; q is within the limits to the last bit.

    Raises:
        StepError: the state changes too fast, or the equations gave a value that is not finite.
    """
    n, budget, motion = len(q), budget or Budget(), Motion(equations, stops, rtol, atol, max_step, integrator)
    motion.evaluations = budget.spent
    y = _regimes(motion, [*q, *v], h)
    budget.spent = motion.evaluations
    return y[:n], y[n:]


def _regimes(motion: Motion, y: State, h: float) -> State:
    """Return the state after h, integrated from event to event."""
    n, stops, t = motion.n, motion.stops, 0.0
    chatter_time = CHATTER_TIME * motion.max_step
    short_time = SHORT_CHATTER_TIME * chatter_time
    first = max(FIRST_RIGID_HOLD * motion.coarseness, FIRST_HOLD) if stops.rigid else FIRST_HOLD
    joint_hold, slide, stuck = Hold(), Slide(), [Hold() for _ in range(n)]
    left, slipped = [-inf] * n, [-inf] * n  # last release and start of slip
    soon, bounds = chatter_time, [inf] * n  # times of the holds at limits
    chattering, anti_chatter = [False] * n, [False] * n
    while t < h:
        motion.check_budget(y)
        if any(chattering):
            if t - joint_hold.until >= soon:  # the first of a sequence of holds
                bounds = [bound if chatters else inf for bound, chatters in zip(bounds, chattering)]
            longest = min(chatter_time, *(bound for bound, at in zip(bounds, stops.at_limits(y)) if at))
            joint_hold.again(t, soon, longest, first)
            anti_chatter = chattering
            if joint_hold.length >= HOLD_OF_ALL * chatter_time and joint_hold.length > first * longest:
                anti_chatter = stops.at_limits(y)
        elif joint_hold.until <= t:
            anti_chatter = [False] * n
        rank, rank_held = motion.rank, slide.until > t
        end = min((hold.until for hold in (joint_hold, slide, *stuck) if hold.until > t), default=h)
        on_hold = [chatters or hold.until > t for chatters, hold in zip(anti_chatter, stuck)]
        rates = motion.set_out(y, anti_chatter, on_hold, rank_held)
        for i, at_limit in enumerate(stops.at_limits(y)):
            if at_limit and i not in stops.held:
                left[i] = t
            if stops.slip[i] and y[n + i] == 0.0 and i not in stops.held:
                slipped[i] = t
        chattering = [False] * n
        soon = chatter_time if stops.rigid else joint_hold.at_once
        motion.crossed |= t > 0.0 and motion.rank != rank
        if motion.rank > rank:
            slide.rise(t, y[n:])
        elif motion.rank < rank and slide.drop(t, y, rates, motion.tolerance, chatter_time):
            continue
        t, y, event = motion.until_event(y, rates, t, min(end, h), hold_ends=end < h and not rank_held)
        for i in event.stopped:
            passed = t - left[i]
            usual = motion.coarseness if stops.rigid else 1.0
            hold = stop_time(passed, y[n + i], motion.tolerance(y[i]) / usual, chatter_time)
            if passed < (chatter_time if stops.rigid else hold):
                chattering[i], bounds[i] = True, hold
                soon = soon if passed < FIRST_HOLD * chatter_time else max(soon, hold)
        for i in event.arrested:
            if t - slipped[i] < FIRST_HOLD * chatter_time:
                stuck[i].again(t, short_time, chatter_time)
    if joint_hold.until <= h:
        anti_chatter = [False] * n
    stops.impact(y, anti_chatter)
    return y
