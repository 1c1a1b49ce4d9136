"""Joint-limit stops: which joints rest at a limit, the reaction of a stop, and when it releases.

A stop is plastic and unilateral: a joint that reaches it loses its velocity there, and rests there
while it is pressed into it. Without a reaction, as a clamp, that is all: it is pressed while its
own acceleration points into the limit, and the other joints move as if it were not there. Rigid
stops act on all joints. With E the unit vectors of joints at a limit, into the range,

    v⁺ = v + M⁻¹E Λ,          0 ≤ Λ ⟂ Eᵀv⁺ ≥ 0          at an impact
    q̈ = q̈_free + M⁻¹E λ,      0 ≤ λ ⟂ Eᵀq̈ ≥ 0           while at rest

Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, sections 11.1 to 11.5.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Limits = Sequence[tuple[float, float]]
"""Per joint (q_min, q_max)."""
InverseMass = Callable[[Sequence[float]], Array]
"""M(q)⁻¹, n × n."""

MOST_PIVOTS, BLOCK_TRIES = 10_000, 5
ROUNDING = 2.0**-40
"""Rounding error of a sum that decides a sign, as a part of its terms."""


class Stops:
    """Stops of a robot, and the joints that rest at them.

    Args:
        limits: of the joints.
        inverse_mass: of rigid stops; None: of stops without a reaction.

    Attributes:
        rigid: stops have a reaction.
        held: joints at rest at a limit.
        watched: those of them that leave it when they are no longer pressed.
    """

    def __init__(self, limits: Limits, inverse_mass: InverseMass | None) -> None:
        self.limits, self._inverse_mass = limits, inverse_mass
        self.rigid = inverse_mass is not None
        self.held: list[int] = []
        self.watched: list[int] = []

    def impact(self, y: list[float], anti_chatter: Sequence[bool]) -> None:
        """Remove the velocity that points into a limit from the state (q, v).

        Args:
            y: the state; changed.
            anti_chatter: joints that stop in both directions. Otherwise mutual impacts, as of the feet
                of a rocking block, would repeat for ever in finite time (Zeno).
        """
        n = len(self.limits)
        contacts = self._contacts(y)
        into = [
            i
            for i, side in contacts
            if side * y[n + i] < 0.0 or ((anti_chatter[i] or self._has_no_range(i)) and y[n + i])
        ]
        if not into:
            return
        if self._inverse_mass is None:
            stopped = into
        else:
            W = self._inverse_mass(y[:n])
            forced = [i for i, _ in contacts if anti_chatter[i]]
            impulse = self._complementary(W, contacts, y[n:], forced)
            y[n:] = (np.array(y[n:]) + W @ impulse).tolist()
            stopped = [i for i, _ in contacts if impulse[i]]
        for i in stopped:
            y[n + i] = 0.0

    def hold(self, y: Sequence[float], a: list[float], anti_chatter: Sequence[bool]) -> list[float]:
        """Find the joints that rest at (q, v) after an impact, and make their acceleration 0.

        Returns the contact forces of ``restrain``.

        Args:
            y: the state.
            a: q̈ without stops; changed to that with them.
            anti_chatter: joints that stay at their limits whatever the contact force.
        """
        n = len(self.limits)
        contacts = [(i, side) for i, side in self._contacts(y) if y[n + i] == 0.0]
        forced = [i for i, _ in contacts if anti_chatter[i]]
        if self._inverse_mass is None:
            self.held = [i for i, side in contacts if anti_chatter[i] or self._has_no_range(i) or side * a[i] <= 0.0]
        elif contacts:
            W = self._inverse_mass(y[:n])
            reaction = self._complementary(W, contacts, a, forced)
            stopped = (W @ reaction + a).tolist()
            self.held = [
                i for i, _ in contacts if reaction[i] or anti_chatter[i] or self._has_no_range(i) or stopped[i] == 0.0
            ]
        else:
            self.held = []
        self.watched = [i for i in self.held if not anti_chatter[i] and not self._has_no_range(i)]
        return self.restrain(y, a)

    def restrain(self, y: Sequence[float], a: list[float]) -> list[float]:
        """Make the acceleration of held joints 0; return the contact force of each."""
        pressed = [0.0] * len(a)
        if not self.held:
            return pressed
        if self._inverse_mass is None:
            for i in self.held:
                pressed[i], a[i] = a[i] * self._outwards(y, i), 0.0
            return pressed
        W = self._inverse_mass(y[: len(a)])[:, self.held]
        reaction = np.linalg.solve(W[self.held], [-a[i] for i in self.held])
        a[:] = (np.array(a) + W @ reaction).tolist()
        for i, force in zip(self.held, reaction.tolist()):
            pressed[i], a[i] = -force * self._outwards(y, i), 0.0
        return pressed

    def at_limits(self, y: Sequence[float]) -> list[bool]:
        """Return for each joint whether it is at a limit, in the state (q, v)."""
        return [not low < q < high for (low, high), q in zip(self.limits, y)]

    def _has_no_range(self, i: int) -> bool:
        low, high = self.limits[i]
        return low == high

    def _outwards(self, y: Sequence[float], i: int) -> float:
        return 1.0 if y[i] >= self.limits[i][1] else -1.0

    def _contacts(self, y: Sequence[float]) -> list[tuple[int, float]]:
        """Return the joints at a limit, with the sign of the direction back into the range."""
        return [
            (i, -1.0 if q >= high else 1.0)
            for i, ((low, high), q) in enumerate(zip(self.limits, y))
            if q >= high or q <= low
        ]

    def _complementary(
        self, W: Array, contacts: Sequence[tuple[int, float]], b: Sequence[float], both: list[int]
    ) -> Array:
        """Return z, n values: 0 ≤ E z ⟂ E (b + W z) ≥ 0 at the contacts, 0 elsewhere.

        All contacts that are wrong change sides at a time; where that does not lessen their number
        for a while only the last one does, which ends for every positive definite W. A joint in
        ``both`` or without a range keeps b + W z = 0, whichever way z points. Sources: Júdice &
        Pires, Computers & Operations Research 21(5), 1994; Murty, Opsearch 11, 1974.
        """
        fixed = {i for i, _ in contacts if i in both or self._has_no_range(i)}
        active = {i for i, side in contacts if i in fixed or side * b[i] < 0.0}
        z, size = np.zeros(len(b)), np.abs(b)
        fewest, tries = len(b) + 1, BLOCK_TRIES
        for _ in range(MOST_PIVOTS):
            z[:] = 0.0
            chosen = sorted(active)
            if chosen:
                z[chosen] = np.linalg.solve(W[np.ix_(chosen, chosen)], [-b[i] for i in chosen])
            change = W @ z
            largest = np.abs(z).max(initial=0.0)
            wrong = [
                i
                for i, side in contacts
                if i not in fixed
                and (
                    side * z[i] < -ROUNDING * largest
                    if i in active
                    else side * (b[i] + change[i]) < -ROUNDING * (size[i] + abs(change[i]))
                )
            ]
            if not wrong:
                return z
            tries = BLOCK_TRIES if len(wrong) < fewest else tries - 1
            fewest = min(fewest, len(wrong))
            active ^= set(wrong if tries > 0 else wrong[-1:])
        return np.full(len(b), np.nan)  # which no step accepts
