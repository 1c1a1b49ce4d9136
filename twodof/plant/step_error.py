"""Error for a communication step that the integrator cannot complete; it names the fastest joint."""

from collections.abc import Callable, Sequence
from itertools import product
from math import inf, isfinite

NUDGE = 1e-6  # step of the difference quotients: rad, m, rad/s or m/s


class StepError(ArithmeticError):
    """A communication step that fails the tolerances or exceeds the budget.

    Attributes:
        too_fine: whether even the smallest integration step failed, so that a larger budget would not help.
        joint: index of the joint that changes fastest.
        rate: the joint's rate of change, 1/s.
    """

    def __init__(self, *, too_fine: bool, joint: int, rate: float) -> None:
        super().__init__(f"joint {joint} changes at a rate of {rate:g} 1/s")
        self.too_fine, self.joint, self.rate = too_fine, joint, rate


def fastest_joint(acceleration: Callable[[list[float]], Sequence[float]], y: list[float]) -> tuple[int, float]:
    """Return the joint whose acceleration is most sensitive to its own state, and its rate of change, 1/s.

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
