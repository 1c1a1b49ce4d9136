"""Motion in one regime, integrated until an event.

A regime is the set of joints at rest, the directions in which the others slip (``stops``), and the rank of J⁺. An event
ends it. The event is located within an integration step (``event_search``); the step ends there, and the next one
begins in another regime. A step is accepted only if its error test passes. The step-size control is that of SciPy's
``RK45`` (Hairer, Nørsett & Wanner, "Solving ODEs I", II.4).

Where a joint is expected to stop soon, a short step of one evaluation tries to reach that event. Without an event in
it, it is discarded, unless it ends with a hold of joints. Impacts on many joints with friction are followed by such
events within microseconds.

After a change of the rank, steps share the tolerances. Motion back and forth across a singularity takes so many steps
that their errors would add energy.
"""

from collections.abc import Callable, Sequence
from itertools import chain
from math import inf, isfinite, isnan, nan, ulp
from struct import Struct

import numpy as np

from . import event_search as events
from .damping import Modes, find_modes
from .dormand_prince import HEUN, Array, P, State, dormand_prince, error_norm, heun, interpolant, shared_tolerance
from .equations import Equations, fastest_joint
from .pseudo_inverse import rank_margin
from .rosenbrock import CUBIC, STABLE, limiting_rate, rosenbrock, settled, unseen
from .stops import Stops

SAFETY, MIN_FACTOR, MAX_FACTOR = 0.9, 0.2, 10.0
SHORT, LONGER = 0.25, 1024.0
"""Longest short step: SHORT is a fraction of the largest step. LONGER, for joints that stop together, is a multiple of
the time until the first one stops.
"""
AUTOMATIC, DORMAND_PRINCE, STIFF = range(3)
"""Values of the parameter ``integrator``."""
BUDGET = 10_000_000
"""Most evaluations of the right-hand side in one communication step; only a stiff motion would need more."""
MOST_ROWS = 6
"""Largest number of rows of a task Jacobian: three axes, and three for an orientation."""


class StepError(ArithmeticError):
    """A communication step that fails the tolerances or exceeds the budget.

    Attributes:
        too_fine: whether even the smallest integration step failed, so that a larger budget would not help.
        joint: index of the joint that changes fastest.
        rate: the joint's rate of change, 1/s.
        finite: whether the equations of motion gave only finite values.
    """

    def __init__(self, *, too_fine: bool, joint: int, rate: float, finite: bool) -> None:
        super().__init__(f"joint {joint} changes at a rate of {rate:g} 1/s")
        self.too_fine, self.joint, self.rate, self.finite = too_fine, joint, rate, finite


class Motion:
    """The equations of motion in one regime, as a system of first order.

    Attributes:
        rank: rank of J⁺ in this regime.
        rank_held: whether the rank must not rise in this regime.
        crossed: whether the rank has changed in the communication step.
        evaluations: evaluations of the right-hand side so far.
        grips, margins: the result of ``Stops.restrain``, and the margin of the rank, at each stage of the present step.
    """

    def __init__(
        self, equations: Equations, stops: Stops, rtol: float, atol: float, max_step: float, integrator: int
    ) -> None:
        n = len(stops.limits)
        self._equations = equations
        state = np.empty(2 * n)
        self._write = Struct(f"{2 * n}d").pack_into  # quicker than numpy at this size
        self._buffer, self._q, self._v = state.data, state[:n], state[n:]
        self.n, self.evaluations = n, 0
        self.stops, self.rtol, self.atol, self.max_step = stops, rtol, atol, max_step
        self.coarseness = min(1.0, rtol / events.USUAL_RTOL)
        self._damping = np.array(equations.damping) if len(equations.damping) else np.zeros(n)
        self._automatic = integrator == AUTOMATIC and bool(len(equations.damping))
        self._rate = inf if integrator == STIFF else 0.0  # of damping; longer steps than STABLE / rate are stiff
        self.rank = MOST_ROWS
        self.rank_held = self.crossed = False
        self.grips: list[list[float]] = []
        self._grip_rates: dict[int, list[float]] = {}  # at the end of the last regime, per s
        self.margins: list[float] = []
        self._modes: Modes | None = None  # of the damping, as in the state _modes_at
        self._modes_at: State = []

    def set_out(self, y: State, anti_chatter: Sequence[bool], on_hold: Sequence[bool], rank_held: bool) -> State:
        """Apply an impact and determine the regime after it; return ẏ in it.

        Args:
            y: the state (q, v); changed.
            anti_chatter: joints that stop in both directions.
            on_hold: joints that stay at rest even if the holding effort exceeds its bounds.
            rank_held: whether the rank stays as it is.
        """
        self.rank_held, rank = rank_held, self.rank if rank_held else None
        hits = self.stops.impact(y, anti_chatter) and self.stops.rigid
        self.stops.slide(y[self.n :])
        a, self.rank, margin = self._acceleration(y, rank)
        window = events.WINDOW * self.max_step * self.coarseness
        if hits and self.stops.stop_within(window, y, a, on_hold, self.tolerance):
            self.stops.slide(y[self.n :])
            a, self.rank, margin = self._acceleration(y, rank)
        self.grips, self.margins = [self.stops.hold(y, a, on_hold)], [margin]
        return y[self.n :] + a

    def acceleration(self, y: State) -> tuple[list[float], list[float], float]:
        """Return q̈ at y in the regime, the result of ``Stops.restrain``, and the margin of the rank."""
        a, _, margin = self._acceleration(y, self.rank)
        return a, self.stops.restrain(y, a), margin

    def _acceleration(self, y: State, rank: int | None) -> tuple[list[float], int, float]:
        self.evaluations += 1
        self._write(self._buffer, 0, *y)
        a, rank, margin = self._equations.acceleration(self._q, self._v, rank, self.stops.slip)
        return list(a), rank, margin

    def rates(self, y: State) -> State:
        """Return ẏ at a stage of a step; NaN if the equations have no solution there."""
        a, grips, margin = self._at_stage(y)
        self.grips.append(grips)
        self.margins.append(margin)
        return y[self.n :] + a

    def _at_stage(self, y: State) -> tuple[list[float], list[float], float]:
        try:
            return self.acceleration(y)
        except np.linalg.LinAlgError:
            return [nan] * self.n, [nan] * len(self.grips[0]), nan

    def tolerance(self, q: float) -> float:
        """Return the tolerance of the error test on a position."""
        return self.atol + self.rtol * abs(q)

    def until_event(
        self, y: State, rates: State, t: float, end: float, *, hold_ends: bool
    ) -> tuple[float, State, events.Event]:
        """Integrate from t, with ẏ at y, until an event, the end, or the end of the budget.

        Return the time, the state and the event. ``hold_ends`` means that a hold of joints ends at the end.
        """
        if len(self.stops.held) == self.n and not any(map(isnan, self.grips[0])):
            return end, y, events.Event()  # inputs and all joints are held: nothing changes
        soon = None if self._rate else self._short_step(y, rates, end - t, hold_ends)
        if soon is not None:
            passed, y, event = soon
            return end if passed == end - t else t + passed, y, event
        step, growth = min(self.max_step, end - t), MAX_FACTOR
        self._modes, exact = None, False  # whether their decay is exact in the step
        while self.evaluations <= BUDGET:
            last = t + step * (1 + 1e-9) >= end
            if last:
                step = end - t
            del self.grips[1:], self.margins[1:]
            stiff = self._rate * step > STABLE
            if stiff:
                y_new, K, norm, inside = self._stiff_step(y, rates, step, self._modes if exact else None)
            else:
                y_new, K = dormand_prince(self.rates, y, step, rates)
                norm, inside = error_norm(K, y, y_new, step, self.rtol, self.atol), 0.0
            share = self._share(step)
            found = self._first_event(y, y_new, step, K, CUBIC if stiff else P) if norm < share else None
            norm = (norm if found is None else max(norm, inside)) / share
            factor = MIN_FACTOR
            if isfinite(norm):
                order = (3 if stiff else 5) - self.crossed
                factor = SAFETY * norm ** (-1 / order) if norm > 0.0 else MAX_FACTOR
            if norm < 1.0:
                if found is not None:
                    passed, y, event = found
                    return end if last and passed == step else t + passed, y, event
                if last:
                    return end, y_new, events.Event()
                t, y, rates = t + step, y_new, K[-1]
                self.grips[0], self.margins[0] = self.grips[-1], self.margins[-1]
                step = min(self.max_step, step * max(MIN_FACTOR, min(growth, factor)))
                growth, exact = MAX_FACTOR, False
            elif self._automatic and not stiff and (rate := self._limiting_rate(y, K, step, end - t)):
                self._rate = rate  # until the end of the communication step
            elif stiff and not exact and found is None and self._decays_clear(y, rates, step):
                exact = True
            else:
                exact = exact and (self._modes_at is y or self._decays_clear(y, rates, step, anew=True))
                again = stiff and growth == 1.0  # errors of stiff modes hardly depend on the step
                step *= MIN_FACTOR if again else max(MIN_FACTOR, factor)
                growth = 1.0  # SciPy's rule: no growth right after a rejection
                if step < 10 * ulp(end):
                    raise self._too_fast(y, too_fine=True, finite=all(map(isfinite, chain(*K))))
        return t, y, events.Event()

    def _stiff_step(
        self, y: State, rates: State, step: float, modes: Modes | None
    ) -> tuple[State, list[State], float, float]:
        """Return the result of ``rosenbrock``; with modes, their decay is exact."""
        mobility, tolerances = self.stops.mobility(y[: self.n]), (self.rtol, self.atol)

        def acceleration(at: State) -> list[float]:
            return self._at_stage(at)[0]

        decay = None if modes is None else settled(acceleration, modes, y, rates, step)
        y_new, K, norm, inside = rosenbrock(self.rates, mobility, self._damping, y, step, rates, *tolerances, decay)
        if modes is not None:
            lost = unseen(acceleration, modes, y, K, y_new, step, *tolerances)
            norm = float(np.maximum(norm, lost))  # NaN if one is NaN
        return y_new, K, norm, inside

    def _decays_clear(self, y: State, rates: State, step: float, *, anew: bool = False) -> bool:
        """Return whether all joints move freely, and meet no event during the decay of the modes within a step.

        The modes are found if there are none, or anew.
        """
        if not self.stops.move_freely():
            return False
        if self._modes is None or anew:
            self._modes, self._modes_at = find_modes(self.stops.mobility(y[: self.n]), self._damping), y
        v, a = np.array(y[self.n :]), np.array(rates[self.n :])
        reach = (events.REACH * self._modes.excursions(v, a, step)).tolist()
        free = all(low < q - r and q + r < high for q, r, (low, high) in zip(y, reach, self.stops.limits))
        return free and self.margins[0] > sum(map(float.__mul__, self._equations.swing, reach))

    def _limiting_rate(self, y: State, K: list[State], step: float, left: float) -> float:
        mobility = self.stops.mobility(y[: self.n])
        return limiting_rate(mobility, self._damping, K, step, min(self.max_step, left))

    def check_budget(self, y: State) -> None:
        """Raise StepError at y if no evaluations are left."""
        if self.evaluations > BUDGET:
            raise self._too_fast(y, too_fine=False)

    def _share(self, step: float) -> float:
        """Return the fraction of the tolerances that a step may use."""
        return shared_tolerance(step / self.max_step, self.rtol) if self.crossed else 1.0

    def _short_step(
        self, y: State, rates: State, left: float, hold_ends: bool
    ) -> tuple[float, State, events.Event] | None:
        """Return the result of a short step to an event that is expected soon, or to the end of a hold of joints."""
        most = SHORT * self.max_step
        grip_rates = [rate for i in self.stops.watched for rate in self._grip_rates.get(i, (0.0, 0.0))]
        expected = events.expected_event(y, rates, self.stops, self.grips[0], grip_rates, 0.5 * most)
        together = min(events.TOGETHER * self.max_step, LONGER * expected)
        step = min(max(2.0 * expected, together), left)
        if not (0.0 < step <= most and (hold_ends or expected < inf)):
            return None
        del self.grips[1:], self.margins[1:]
        y_new, K, norm = heun(self.rates, y, step, rates, self.rtol, self.atol)
        if not norm / self._share(step) < 1.0:
            return None
        found = self._first_event(y, y_new, step, K, HEUN)
        return (left, y_new, events.Event()) if found is None and hold_ends and step == left else found

    def _too_fast(self, y: State, *, too_fine: bool, finite: bool = True) -> StepError:
        joint, rate = fastest_joint(lambda at: self.acceleration(at)[0], y)
        return StepError(too_fine=too_fine, joint=joint, rate=rate, finite=finite)

    def _first_event(
        self, y: State, y_new: State, step: float, K: list[State], weights: Array
    ) -> tuple[float, State, events.Event] | None:
        """Return the time in (0, step] at which the regime ends, the state there, and the event; None without one."""
        n, stops = self.n, self.stops
        reach = [events.REACH * step * max(map(abs, speeds)) for speeds in zip(*(k[:n] for k in K))]
        near = [
            i
            for i, (q, change, (low, high)) in enumerate(zip(y, reach, stops.limits))
            if not (q - change > low and q + change < high) and i not in stops.held
        ]
        sweep = sum(map(float.__mul__, self._equations.swing, reach))
        near_rank = not max(self.margins[0], self.margins[-1]) > sweep
        near += [n + i for i in range(n) if self._may_be_arrested(i, y, step, K)]
        doubtful = [i for i, grips in enumerate(zip(*self.grips)) if events.may_vanish(grips)]
        if not near and not near_rank and not doubtful:
            return None
        state = interpolant(y, y_new, K, weights, step)
        crossings = {}
        for i in near:
            slope = [(k + 1) * c for k, c in enumerate(np.array([k[i] for k in K]).dot(weights).tolist())]
            dip = self.atol if i < n and y[n + i] == 0.0 else 0.0
            crossings[i] = events.first_crossing(self._margin_of(i, state), slope, step, dip)
        first = min(crossings.values(), default=inf)

        def grips(passed: float) -> list[float]:
            return self.acceleration(state(passed))[1]

        def singular_margin(passed: float) -> float:
            return self._singular_margin(state(passed))

        if doubtful:
            resolution = events.release_resolution(step, self.max_step, self.coarseness)
            first = min(first, events.first_release(grips, self.grips, weights, doubtful, step, first, resolution))
        if near_rank:
            a, b = singular_margin(0.0), singular_margin(step)
            pace = sum(map(float.__mul__, self._equations.swing, events.fastest(K, n)))
            first = min(first, events.search(singular_margin, pace, 0.0, a, step, b, step))
        if first == inf:
            return None
        slopes = events.grip_rates(self.grips, weights, first / step) / step
        self._grip_rates = dict(zip(stops.watched, slopes.reshape(-1, 2).tolist())) if weights is not CUBIC else {}
        last = first + events.TOGETHER * self.max_step if stops.rigid else -inf
        return first, *self._event(state(first), [i for i in crossings if i < n and crossings[i] <= last])

    def _may_be_arrested(self, i: int, y: State, step: float, K: list[State]) -> bool:
        """Return whether the velocity of a slipping joint may cross 0 within a step."""
        slip, n = self.stops.slip[i], self.n
        if not slip or i in self.stops.held:
            return False
        return not slip * y[n + i] > events.REACH * step * max(abs(k[n + i]) for k in K)

    def _margin_of(self, component: int, state: Callable[[float], State]) -> events.Margin:
        """Return the distance of a position from its limits, or the velocity in the direction of slip."""
        if component >= self.n:
            slip = self.stops.slip[component - self.n]
            return lambda passed: slip * state(passed)[component]
        low, high = self.stops.limits[component]

        def distance(passed: float) -> float:
            q = state(passed)[component]
            return min(high - q, q - low)

        return distance

    def _event(self, y: State, together: Sequence[int]) -> tuple[State, events.Event]:
        """Return a state with positions clipped to limits and reversed velocities set to 0, and its event."""
        y, n, stops, event = list(y), self.n, self.stops, events.Event()
        for i, (low, high) in enumerate(stops.limits):
            if i in stops.held:
                continue
            side = (y[i] >= high) - (y[i] <= low)
            if not low <= y[i] <= high or side * y[n + i] > 0.0 or i in together:
                event.stopped.append(i)
                y[i] = high if high - y[i] <= y[i] - low else low
            if stops.slip[i] * y[n + i] < 0.0:
                event.arrested.append(i)
                y[n + i] = 0.0
        return y, event

    def _singular_margin(self, y: State) -> float:
        """Return the margin of the rank; for a held rank, the margin to a lower rank only."""
        self.evaluations += 1
        ratios, rank = self._equations.ratios(np.array(y[: self.n])), self.rank
        if self.rank_held:
            return ratios[rank - 1] - self._equations.rcond if rank else 1.0
        return rank_margin(ratios, self._equations.rcond, rank)
