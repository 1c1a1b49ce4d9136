"""Event-driven reference solution of joints with friction and stops, by Pinocchio and SciPy.

It shares no code with the plant. In a mode, each joint slips in a direction, rests by friction, or rests at a stop.
DOP853 integrates the motion up to the first event. The next mode is the only one, among all modes of the joints at
rest, that meets the conditions of friction and stops.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

SLACK = 1e-9
SOON = 1e-11  # s
SLOW = 1e-8  # rad/s: where joints drive each other off their stops without end, that ends here


@dataclass
class Rubbing:
    """A robot of independent joints, and what acts on it.

    Attributes:
        effort: of the controller and the surroundings, at q, v, M and h, without damping and friction.
        friction, damping, low, high: of the joints; stops are rigid.
    """

    model: pin.Model
    effort: Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    friction: np.ndarray
    damping: np.ndarray
    armature: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def __post_init__(self):
        self._data, self.n = self.model.createData(), len(self.friction)
        self._last: tuple = (None, None)

    def mass_matrix(self, q):
        M = np.triu(pin.crba(self.model, self._data, q))
        return M + np.triu(M, 1).T + np.diag(self.armature)

    def motion(self, q, v, mode):
        """q̈ in a mode, which has 1 or −1 for a joint that slips and 0 for a joint at rest; and λ of joints at rest."""
        state = (q.tobytes(), v.tobytes(), mode.tobytes())
        if self._last[0] == state:  # events of one time
            return self._last[1]
        M, h = self.mass_matrix(q), pin.nonLinearEffects(self.model, self._data, q, v)
        known = self.effort(q, v, M, h) - h - self.damping * v - self.friction * mode
        rests = mode == 0
        a, force = np.zeros(self.n), np.zeros(self.n)
        a[~rests] = np.linalg.solve(M[np.ix_(~rests, ~rests)], known[~rests])
        force[rests] = (M @ a - known)[rests]
        self._last = state, (a, force)
        return a, force

    def bounds(self, q):
        """The lowest and the highest λ of each joint at rest."""
        at_low, at_high = q <= self.low, q >= self.high
        return np.where(at_high, -np.inf, -self.friction), np.where(at_low, np.inf, self.friction)

    def mode_at(self, q, v):
        """The mode in which a motion continues from a state after an impact."""
        still = np.flatnonzero(v == 0.0)
        least, most = self.bounds(q)
        best, chosen = -np.inf, None
        for directions in itertools.product((0.0, 1.0, -1.0), repeat=len(still)):
            mode = np.sign(v)
            mode[still] = directions
            if ((mode < 0) & (q <= self.low)).any() or ((mode > 0) & (q >= self.high)).any():
                continue
            a, force = self.motion(q, v, mode)
            rests = mode == 0
            sizes = 1.0 + np.abs(force[rests])
            room = [*((force - least)[rests] / sizes), *((most - force)[rests] / sizes), *(mode * a)[still]]
            worst = min(room, default=np.inf)
            if worst > best:
                best, chosen = worst, mode
        assert best >= -SLACK and chosen is not None, best
        return chosen

    def impact(self, q, v):
        """v after a plastic impact at the limits that it points into."""
        M = self.mass_matrix(q)
        inside = (self.low < q) & (q < self.high)
        at = np.flatnonzero(~inside).tolist()
        side = np.where(q >= self.high, -1.0, 1.0)
        if not any(side[i] * v[i] < 0.0 for i in at):
            return v
        for count in range(1, len(at) + 1):
            for stopped in map(list, itertools.combinations(at, count)):
                impulse, after = np.zeros(self.n), v.copy()
                W = np.linalg.inv(M)
                impulse[stopped] = np.linalg.solve(W[np.ix_(stopped, stopped)], -v[stopped])
                after += W @ impulse
                after[stopped] = 0.0
                if all(side[i] * impulse[i] >= -SLACK and side[i] * after[i] >= -SLACK for i in at):
                    return np.where((side * after < SLOW) & ~inside, 0.0, after)
        raise AssertionError("no impact")

    def run(self, q, v, times, max_step=1e-3):
        """States at times from 0 on, and the modes with the times at which they began."""
        n, t, rows, modes = self.n, 0.0, [], []
        q, v = np.array(q, float), self.impact(np.array(q, float), np.array(v, float))
        mode = self.mode_at(q, v)
        while t < times[-1]:
            modes.append((t, mode))
            rests, slips = mode == 0, np.flatnonzero((mode != 0) & (self.friction > 0))
            least, most = self.bounds(q)
            events: list[Callable] = []
            what: list[tuple] = []

            def watch(function, *name, events=events, what=what):
                function.terminal, function.direction = True, -1
                events.append(function)
                what.append(name)

            for i in slips:  # with room while it accelerates: it may begin at 0, and stop within a first step
                watch(
                    lambda t, y, i=i, mode=mode: (
                        mode[i] * y[n + i] + max(0.0, mode[i] * self.motion(y[:n], y[n:], mode)[0][i])
                    ),
                    *("arrested", i),
                )
            for i in np.flatnonzero(~rests):  # with room while it moves away, or begins to
                for side, limit in ((-1.0, self.high[i]), (1.0, self.low[i])):
                    watch(
                        lambda t, y, i=i, side=side, limit=limit, mode=mode: (
                            side * (y[i] - limit) + max(0.0, side * (y[n + i] or self.motion(y[:n], y[n:], mode)[0][i]))
                        ),
                        *("stopped", i, limit),
                    )
            for i in np.flatnonzero(rests):
                for sign, bound in ((1.0, most[i]), (-1.0, -least[i])):
                    if bound < np.inf:
                        watch(
                            lambda t, y, i=i, sign=sign, bound=bound, mode=mode: (
                                bound - sign * self.motion(y[:n], y[n:], mode)[1][i]
                            ),
                            *("released", i, -sign),
                        )

            def rates(t, y, mode=mode):
                return np.r_[y[n:], self.motion(y[:n], y[n:], mode)[0]]

            wanted = [x for x in times if x > t]
            solution = solve_ivp(
                rates, (t, times[-1]), np.r_[q, v], "DOP853", wanted, False, events, rtol=1e-12, atol=1e-13,
                max_step=max_step,
            )  # fmt: skip
            rows += list(np.reshape(solution.y, (2 * n, -1)).T)
            if solution.status != 1:
                break
            which = next(k for k, found in enumerate(solution.t_events) if len(found))
            t, y = solution.t_events[which][0], solution.y_events[which][0].copy()
            kind, i, *more = what[which]
            q, v = y[:n], np.where(rests, 0.0, y[n:])
            if kind == "released":
                y += SOON * rates(t, y)  # which side of its bound the force is on at t is rounding
                t, q, v = t + SOON, y[:n], np.where(rests, 0.0, y[n:])
                mode = mode.copy()
                mode[i] = more[0]
                continue
            if kind == "arrested":
                v[i] = 0.0
            else:
                q[i] = more[0]
            v = self.impact(q, v)
            mode = self.mode_at(q, v)
        return np.array(rows), modes
