"""Joints at rest at a limit or by friction: the efforts that hold them, and their release.

A stop is plastic and unilateral: a joint that reaches it loses its velocity and rests while it is pressed against it.
There are two kinds. A clamp has no reaction: the joint rests while its own acceleration points into the limit. The
other joints move as if this joint moved freely beyond the limit, slipping against its friction. A rigid stop
acts on all joints, as friction F does. With the unit vectors E of joints at a limit, which point into the range, and
the efforts λ on joints at rest,

    v⁺ = v + M⁻¹E Λ,          0 ≤ Λ ⟂ Eᵀv⁺ ≥ 0                       at an impact
    q̈ = q̈_free + M⁻¹λ,        −F ≤ λ ≤ F, at a limit into the range without an upper bound;
                              q̈ > 0 only at the lower bound, q̈ < 0 only at the upper one

A moving joint slips: λ = −F sgn(v). Finite friction has no effect in an impact.

Sources: Featherstone, "Rigid Body Dynamics Algorithms", 2008, sections 11.1 to 11.5; Pfeiffer & Glocker, "Multibody
Dynamics with Unilateral Contacts", 1996, chapter 5.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from math import inf

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Limits = Sequence[tuple[float, float]]
"""(q_min, q_max) of each joint, rad or m."""
InverseMass = Callable[[Sequence[float]], Array]
"""M(q)⁻¹, n × n."""
ActingEfforts = Callable[[Sequence[float], Sequence[float]], Array]
"""Magnitudes of the efforts on each joint, without friction, at (q, v) and q̈, n values."""
Bounds = Mapping[int, tuple[float, float]]
"""Bounds of efforts or impulses, by joint."""

MOST_PIVOTS, BLOCK_TRIES = 10_000, 5
ROUNDING = 2.0**-40
"""Rounding error of a sum whose sign decides, relative to its terms."""
FREE, STUCK, STOPPED, CLAMPED = range(4)
"""States of a joint: moving, held by friction, held at a limit by a rigid stop, or held there by a clamp."""


class Stops:
    """Stops and friction of a robot, and the joints that they hold at rest.

    Args:
        limits: position limits of the joints.
        friction: Coulomb friction of the joints, N·m or N, n values.
        inverse_mass: function that returns M⁻¹; called only with friction or rigid stops.
        acting_efforts: function that returns the magnitudes of efforts; called only with friction or rigid stops.
        rigid: whether stops have a reaction.

    Attributes:
        rest: how each joint rests, or FREE.
        slip: direction in which each joint slips, −1 or 1; 0 without friction or at rest.
        held: joints at rest.
        watched: held joints that are released when the holding effort exceeds its bounds.
    """

    def __init__(
        self,
        limits: Limits,
        friction: Sequence[float],
        inverse_mass: InverseMass,
        acting_efforts: ActingEfforts,
        *,
        rigid: bool,
    ) -> None:
        self.limits, self._friction, self.rigid = limits, friction, rigid
        self._inverse_mass, self._acting_efforts, self._acting = inverse_mass, acting_efforts, 0.0
        self.rest, self.slip = [FREE] * len(limits), [0] * len(limits)
        self.held: list[int] = []
        self.watched: list[int] = []

    def impact(self, y: list[float], anti_chatter: Sequence[bool]) -> bool:
        """Remove the velocity that points into a limit from the state (q, v); return whether there was any.

        Args:
            y: the state; changed.
            anti_chatter: joints that stop in both directions. Without them, mutual impacts could repeat without
                end in finite time (Zeno), as those of the feet of a rocking block.
        """
        n = len(self.limits)
        sides = self._sides(y)
        fixed = [i for i in sides if anti_chatter[i] or self._has_no_range(i)]
        into = [i for i, side in sides.items() if side * y[n + i] < 0.0 or (i in fixed and y[n + i])]
        if not into:
            return False
        if self.rigid:
            self._collide(y, self._inverse_mass(y[:n]), sides, fixed)
        else:
            for i in into:
                y[n + i] = 0.0
        return True

    def _collide(self, y: list[float], W: Array, sides: Mapping[int, float], fixed: Collection[int]) -> None:
        """Apply the impulses of rigid stops to the state (q, v); ``fixed`` joints rest whatever their impulse is."""
        n = len(self.limits)
        bounds = {i: (-inf, inf) for i in fixed}
        bounds |= {i: (0.0, inf) if side > 0.0 else (-inf, 0.0) for i, side in sides.items()}
        impulse, at = _complementary(W, y[n:], bounds, fixed, 0.0)
        y[n:] = (np.array(y[n:]) + W @ impulse).tolist()
        for i in at:
            if at[i] == 0:
                y[n + i] = 0.0

    def stop_within(
        self,
        window: float,
        y: list[float],
        a: Sequence[float],
        on_hold: Sequence[bool],
        tolerance: Callable[[float], float],
    ) -> bool:
        """Stop joints whose motion friction or a rigid stop ends within a window; return whether there are any.

        Args:
            window: s, > 0.
            y: the state (q, v) after an impact; changed.
            a: q̈ in the directions of ``slide``.
            on_hold: joints at limits that stop in both directions.
            tolerance: tolerance of a position, which the motion in the window must not exceed.
        """
        n, sides = len(self.limits), self._sides(y)
        v, rates, bounds = np.array(y[n:]), [x + window * rate for x, rate in zip(y[n:], a)], {}
        for i, friction in enumerate(self._friction):
            side, F, slip = sides.get(i, 0.0), window * friction, self.slip[i]
            if (F or side) and 0.5 * window * abs(v[i]) <= tolerance(y[i]):  # bounds beyond the friction in a
                bounds[i] = -inf if side < 0.0 else F * (slip - 1), inf if side > 0.0 else F * (slip + 1)
        if not any(rates[i] * v[i] < 0.0 for i in bounds):
            return False
        W = self._inverse_mass(y[:n])
        fixed = [i for i in bounds if (on_hold[i] or self._has_no_range(i)) and (i in sides or v[i] == 0.0)]
        _, at = _complementary(W, rates, bounds, fixed, window * self._largest_effort(y, a))
        resting = [i for i, state in at.items() if state == 0]
        if not v[resting].any():
            return False
        locked = {i for i in sides if on_hold[i] or self._has_no_range(i)}
        self._collide(y, W, sides, locked | {*resting})
        return True

    def slide(self, v: Sequence[float]) -> list[int]:
        """Set and return the directions of slip at the velocities v."""
        self.slip = [int(x > 0.0) - int(x < 0.0) if F else 0 for x, F in zip(v, self._friction)]
        return self.slip

    def hold(self, y: Sequence[float], a: list[float], on_hold: Sequence[bool]) -> list[float]:
        """Find the joints that rest at (q, v) after an impact, and the directions in which others begin to slip.

        Return the same as ``restrain``.

        Args:
            y: the state.
            a: q̈ with joints at rest free, and slip in the directions of ``slide``; changed to q̈ with joints held.
            on_hold: joints that stay at rest even if the holding effort exceeds its bounds.
        """
        n = len(self.limits)
        sides = self._sides(y)
        locked = [i for i in range(n) if on_hold[i] or self._has_no_range(i)]
        clamps = {i for i in sides if y[n + i] == 0.0 and not self.rigid}
        bounds = {}
        for i in range(n):
            briefly = i in clamps and on_hold[i] and not self._has_no_range(i)
            friction = 0.0 if briefly else self._friction[i]
            if y[n + i] == 0.0 and (friction or (i in sides and self.rigid)):
                side = sides.get(i, 0.0) if self.rigid else 0.0
                bounds[i] = -inf if side < 0.0 else -friction, inf if side > 0.0 else friction
        stopped, at, self._acting = a, dict.fromkeys(bounds, 0), 0.0
        if bounds:
            W, self._acting = self._inverse_mass(y[:n]), self._largest_effort(y, a)
            fixed = [i for i in bounds if i in locked and i not in clamps]
            reaction, at = _complementary(W, a, bounds, fixed, self._acting)
            stopped = (W @ reaction + a).tolist()
        resting = {i for i, state in at.items() if state == 0 or stopped[i] == 0.0}
        for i in range(n):
            self.rest[i] = FREE
            if i in resting:
                self.rest[i] = STOPPED if i in sides and self.rigid else STUCK
            elif i in clamps and (i in locked or sides[i] * stopped[i] <= 0.0):
                self.rest[i] = CLAMPED
        begun = {i: -state for i, state in at.items() if i not in resting and self._friction[i]}
        for i, direction in begun.items():
            self.slip[i], self._acting = direction, max(self._acting, self._friction[i])
        if begun:
            a[:] = (W @ [-self._friction[i] * begun.get(i, 0) for i in range(n)] + a).tolist()
        self.held = [i for i, rest in enumerate(self.rest) if rest]
        self.watched = [i for i in self.held if not on_hold[i] and not (self._has_no_range(i) and self._stays(i))]
        return self.restrain(y, a)

    def restrain(self, y: Sequence[float], a: list[float]) -> list[float]:
        """Add the efforts that hold joints to the acceleration, so that it is 0 for held joints.

        Return two values for each watched joint: the distances of its holding effort from the lower and the upper
        bound, infinite without a bound. The joint is released if one is negative. For a clamp the effort is −q̈.
        """
        if not self.held:
            return []
        efforts = {i: -a[i] for i in self.held}
        reacting = [i for i in self.held if self.rest[i] != CLAMPED]
        if reacting:
            W = self._inverse_mass(y[: len(a)])[:, reacting]
            reaction = np.linalg.solve(W[reacting], [-a[i] for i in reacting])
            a[:] = (np.array(a) + W @ reaction).tolist()
            efforts = {i: -a[i] for i in self.held} | dict(zip(reacting, reaction.tolist()))
        for i in self.held:
            a[i] = 0.0
        slack = 2.0 * ROUNDING * max(self._acting, *map(abs, efforts.values()))  # a released joint moves
        return [grip + slack for i in self.watched for grip in self._grips(i, y[i], efforts[i])]

    def mobility(self, q: Sequence[float]) -> Array:
        """Return M⁻¹ with joints at rest held, n × n: the accelerations that unit efforts cause."""
        W = np.array(self._inverse_mass(q))
        reacting = [i for i in self.held if self.rest[i] != CLAMPED]
        if reacting:
            W -= W[:, reacting] @ np.linalg.solve(W[np.ix_(reacting, reacting)], W[reacting])
        W[self.held] = 0.0
        return W

    def move_freely(self) -> bool:
        """Return whether all joints move, without friction."""
        return not self.held and not any(self.slip)

    def at_limits(self, y: Sequence[float]) -> list[bool]:
        """Return for each joint whether it is at a limit, in the state (q, v)."""
        return [not low < q < high for (low, high), q in zip(self.limits, y)]

    def _largest_effort(self, y: Sequence[float], a: Sequence[float]) -> float:
        """Return the largest effort on a joint, with the friction of moving joints."""
        friction = [F if v else 0.0 for v, F in zip(y[len(a) :], self._friction)]
        return float(np.add(self._acting_efforts(y, a), friction).max())

    def _grips(self, i: int, q: float, effort: float) -> tuple[float, float]:
        friction = 0.0 if self.rest[i] == CLAMPED else self._friction[i]
        above = self.slip[i] > 0 if self._has_no_range(i) else q >= self.limits[i][1]
        low, high = friction + effort, friction - effort
        if self.rest[i] == STUCK:
            return low, high
        return (inf, high) if above else (low, inf)

    def _stays(self, i: int) -> bool:
        """Return whether a held joint without a range acts on the others in the same way whatever its effort is."""
        return self.rigid or (self.rest[i] == CLAMPED and not self.slip[i])

    def _has_no_range(self, i: int) -> bool:
        low, high = self.limits[i]
        return low == high

    def _sides(self, y: Sequence[float]) -> dict[int, float]:
        """Return, for each joint at a limit, the sign of the direction into the range."""
        return {
            i: -1.0 if q >= high else 1.0
            for i, ((low, high), q) in enumerate(zip(self.limits, y))
            if q >= high or q <= low
        }


def _complementary(
    W: Array, b: Sequence[float], bounds: Bounds, fixed: Collection[int], acting: float
) -> tuple[Array, dict[int, int]]:
    """Return the solution z (n values) of a linear complementarity problem, and its active bounds.

    The active bound of a joint with bounds is −1 for the lower, 1 for the upper, and 0 for none. b + W z is above 0
    only if z is at its lower bound, below 0 only if z is at its upper bound, and 0 for ``fixed`` joints, whose z has
    no bounds. z exceeds a bound only if it does so by more than the rounding error of the largest effort or impulse,
    which is in z or is ``acting``. Each iteration changes all violated conditions (block pivoting).
    If their number does not decrease for some iterations, only the last one changes, which terminates for every
    positive definite W. Sources: Júdice & Pires, Computers & Operations Research 21(5), 1994; Murty, Opsearch 11, 1974.
    """
    if not np.isfinite([*b, acting]).all():
        raise np.linalg.LinAlgError("not finite")
    at = {}
    for i, (low, high) in bounds.items():
        upward = low + high > 0.0
        pressed = b[i] < 0.0 if upward else b[i] > 0.0
        at[i] = 0 if i in fixed or low < 0.0 < high or pressed else -1 if upward else 1
    z, given, size = np.zeros(len(b)), np.array(b), np.abs(b)
    fewest, tries = len(b) + 1, BLOCK_TRIES
    for _ in range(MOST_PIVOTS):
        z[:] = 0.0
        for i, state in at.items():
            z[i] = 0.0 if state == 0 else bounds[i][state > 0]
        solved = [i for i, state in at.items() if state == 0]
        if solved:
            z[solved] = np.linalg.solve(W[np.ix_(solved, solved)], -(given + W @ z)[solved])
        largest = max(acting, np.abs(z).max())
        change = W @ z
        wrong = {}
        for i, (low, high) in bounds.items():
            state = at[i]
            if i in fixed:
                continue
            if state:
                new = 0 if state * (b[i] + change[i]) > ROUNDING * (size[i] + abs(change[i])) else state
            else:
                slack = ROUNDING * largest
                new = -1 if z[i] < low - slack else int(z[i] > high + slack)
            if new != state:
                wrong[i] = new
        if not wrong:
            return z, at
        tries = BLOCK_TRIES if len(wrong) < fewest else tries - 1
        fewest = min(fewest, len(wrong))
        at |= wrong if tries > 0 else dict(list(wrong.items())[-1:])
    raise np.linalg.LinAlgError("no efforts hold the joints")
