"""Anti-chatter: holds of joints, and of the rank of J⁺, that would otherwise switch without end."""

from dataclasses import dataclass
from math import inf

CHATTER_TIME, SHORT_CHATTER_TIME, FIRST_HOLD, HOLD_GROWTH, HOLD_OF_ALL = 0.5, 2.0**-12, 2.0**-24, 8.0, 2.0**-9
"""Anti-chatter. A joint that returns to its limit sooner than CHATTER_TIME (part of the largest step) is held there for
FIRST_HOLD; each repetition lengthens the hold by HOLD_GROWTH, and one of HOLD_OF_ALL or more covers all joints at
limits (parts of CHATTER_TIME). Otherwise an acceleration that grazes zero, or impacts that drive joints off each
other's limits, would release and stop joints without end. The rank of J⁺ is held likewise where it drops soon after a
rise: the motion slides along the jump. A higher rank is never held, because its J⁺ is unbounded. Rank, and stops
without reaction, use a SHORT_CHATTER_TIME: near a singularity ordinary gains whip joints within microseconds. So do
joints, each for itself, that their friction holds again at the instant of their release, or that stop within FIRST_HOLD
of it: there rounding decides."""


@dataclass
class Hold:
    """A hold of joints at their limits, of one by its friction, or of the rank of J⁺: its end and its length, s."""

    until: float = -inf
    length: float = 0.0

    def again(self, t: float, soon: float, longest: float) -> None:
        """Start a hold at t, longer than the last one if that ended less than ``soon`` ago."""
        self.length = min(HOLD_GROWTH * self.length, longest) if t - self.until < soon else FIRST_HOLD * longest
        self.until = t + self.length
