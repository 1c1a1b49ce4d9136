"""Anti-chatter: temporary holds that prevent joints and the rank of J⁺ from switching without end."""

from dataclasses import dataclass
from math import inf

CHATTER_TIME, SHORT_CHATTER_TIME, FIRST_HOLD, HOLD_GROWTH, HOLD_OF_ALL = 0.5, 2.0**-12, 2.0**-24, 8.0, 2.0**-9
"""Times of the anti-chatter rule. CHATTER_TIME is a fraction of the largest step; SHORT_CHATTER_TIME, FIRST_HOLD and
HOLD_OF_ALL are fractions of CHATTER_TIME. A joint that returns to its limit within CHATTER_TIME is held there for
FIRST_HOLD. Each repetition lengthens the hold by the factor HOLD_GROWTH. A hold of HOLD_OF_ALL or longer covers all
joints at limits. Without holds, an acceleration that grazes zero, or joints that push each other off their limits,
would release and stop joints without end. The rank of J⁺ is held in the same way if it drops soon after a rise: the
motion slides along the jump. A higher rank is never held, because its J⁺ is unbounded. SHORT_CHATTER_TIME applies to
the rank and to stops without reaction, because near a singularity ordinary gains move joints back and forth within
microseconds. It also applies to each joint that friction holds again at the instant of its release, or that stops
within FIRST_HOLD of it: there, rounding decides.
"""


@dataclass
class Hold:
    """End and length, s, of a hold: of joints at limits, of a joint in friction, or of the rank of J⁺."""

    until: float = -inf
    length: float = 0.0

    def again(self, t: float, soon: float, longest: float) -> None:
        """Start a hold at t, longer than the last one if that ended less than ``soon`` ago."""
        self.length = min(HOLD_GROWTH * self.length, longest) if t - self.until < soon else FIRST_HOLD * longest
        self.until = t + self.length
