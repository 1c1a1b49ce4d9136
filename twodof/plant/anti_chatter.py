"""Anti-chatter: temporary holds that prevent joints and the rank of J⁺ from switching without end."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, sqrt

Tolerance = Callable[[float], float]
"""Tolerance of the error test on a position, by its value."""
CHATTER_TIME, SHORT_CHATTER_TIME, FIRST_HOLD, HOLD_GROWTH = 0.5, 2.0**-12, 2.0**-24, 8.0
FIRST_RIGID_HOLD, HOLD_OF_ALL = 2.0**-16, 2.0**-9
"""Times of the anti-chatter rule. CHATTER_TIME is a fraction of the largest step, SHORT_CHATTER_TIME, FIRST_RIGID_HOLD
and HOLD_OF_ALL are fractions of CHATTER_TIME, and FIRST_HOLD is a fraction of the longest hold. A joint that returns to
its limit too soon is held there for FIRST_HOLD, at a rigid stop for FIRST_RIGID_HOLD. Each repetition lengthens the
hold by the factor HOLD_GROWTH. With rigid stops, a return within CHATTER_TIME is too soon, and a repeated hold of
HOLD_OF_ALL or longer covers all joints at limits. Without holds, an acceleration that grazes zero, or joints that push
each other off their limits, would release and stop joints without end. The rank of J⁺ is held in the same way if it
drops soon after a rise: the motion slides along the jump. A higher rank is never held, because its J⁺ is unbounded.

The error that a hold causes limits its length, for the rank (``Slide``) and for stops (``stop_time``). In a hold of
length τ, joint i errs by Δa_i τ²/2, where Δa is the difference of the accelerations with and without the hold. This
must not exceed the tolerance of the error test. At rigid stops, the tolerance at an rtol of 1e-3 applies if rtol is
smaller, because mutual impacts would otherwise repeat too often. The last excursion, of length θ, shows Δa:

    rank:     Δa = |a_low − Δv/θ|      Δv is the change of velocity under the higher rank
    stop:     Δa = 2|v|/θ              return at v after a start from rest, if the acceleration falls linearly

Except at rigid stops, an excursion is chatter if θ is below the longest hold: its effect is then within the tolerances
too. Therefore the rule does not depend on the communication step, and fast motion is never held. An excursion from a
stop that is shorter than FIRST_HOLD ends by rounding, and shows no Δa. The hold after it grows only if the excursion
follows the last hold at once.

SHORT_CHATTER_TIME applies to each joint that friction holds again at the instant of its release, or that stops within
FIRST_HOLD of it: there, rounding decides.
"""


@dataclass
class Hold:
    """End and length, s, of a hold: of joints at limits, of a joint in friction, or of the rank of J⁺."""

    until: float = -inf
    length: float = 0.0

    def again(self, t: float, soon: float, longest: float, first: float = FIRST_HOLD) -> None:
        """Start a hold at t, longer than the last one if that ended less than ``soon`` ago."""
        self.length = min(HOLD_GROWTH * self.length, longest) if t - self.until < soon else first * longest
        self.until = t + self.length

    @property
    def at_once(self) -> float:
        """Time after the hold within which an excursion by rounding prolongs it, s."""
        return HOLD_GROWTH * self.length


@dataclass
class Slide(Hold):
    """A hold of the rank of J⁺, with the time of its last rise, s, and the velocities then."""

    risen: float = -inf
    risen_v: Sequence[float] = ()

    def rise(self, t: float, v: Sequence[float]) -> None:
        """Note the time t of a rise of the rank, and the velocities v then."""
        self.risen, self.risen_v = t, v

    def drop(self, t: float, y: Sequence[float], rates: Sequence[float], tolerance: Tolerance, longest: float) -> bool:
        """Start a hold if a drop of the rank at t is chatter; return whether it is.

        Args:
            y, rates: the state (q, v) and its derivative under the lower rank.
            tolerance: tolerance of the error test on a position.
            longest: upper bound of the hold, s.
        """
        n, passed = len(self.risen_v), t - self.risen
        if not passed < longest:
            return False
        for i, before in enumerate(self.risen_v):
            error = 0.5 * passed * abs(rates[n + i] * passed - (y[n + i] - before))
            longest = _bounded(longest, passed, error, tolerance(y[i]))
        if passed < longest:
            self.again(t, longest, longest)
        return passed < longest


def stop_time(passed: float, v: float, tolerance: float, longest: float) -> float:
    """Return the longest hold of a joint that returns to a stop, s.

    Args:
        passed: time since the joint left its limit, s.
        v: its velocity at the return, rad/s or m/s.
        tolerance: tolerance of the error test on its position.
        longest: upper bound of the hold, s.
    """
    return _bounded(longest, passed, abs(v) * passed, tolerance) if passed < longest else longest


def _bounded(longest: float, passed: float, error: float, tolerance: float) -> float:
    """Return the longest hold within a tolerance, if a hold of the length ``passed`` has the given error."""
    return min(longest, passed * sqrt(tolerance / error)) if error > 0.0 else longest
