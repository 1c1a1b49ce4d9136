"""A communication step that the integrator cannot do, and the joint that is too fast for it."""

from collections.abc import Callable, Sequence
from itertools import product
from math import inf, isfinite

NUDGE = 1e-6  # rad, m and per s: of the difference quotients


class StepError(ArithmeticError):
    """A communication step that fails the tolerances or exceeds the budget.

    Attributes:
        too_fine: no integration step was small enough, so that a larger budget would not help.
        joint: index of the joint that changes fastest.
        rate: of its change, 1/s.
    """

    def __init__(self, *, too_fine: bool, joint: int, rate: float) -> None:
        super().__init__(f"joint {joint} changes at a rate of {rate:g} 1/s")
        self.too_fine, self.joint, self.rate = too_fine, joint, rate


def fastest_joint(acceleration: Callable[[list[float]], Sequence[float]], y: list[float]) -> tuple[int, float]:
    """Return the joint whose acceleration is most sensitive to its own state, and the rate of its change, 1/s.

    Args:
        acceleration: q̈ at a state (q, v).
        y: the state.
    """
    n, a = len(y) // 2, acceleration(y)
    rates = []
    for i, order in product(range(n), (2, 1)):  # |∂q̈ᵢ/∂qᵢ|½ and |∂q̈ᵢ/∂vᵢ|
        nudged = y.copy()
        nudged[i + n * (order == 1)] += NUDGE
        change = abs(acceleration(nudged)[i] - a[i]) / NUDGE
        rates.append((change ** (1 / order) if isfinite(change) else inf, i))
    rate, joint = max(rates)
    return joint, rate
