"""Types of the equations of motion and of the control laws in them, as functions of the state."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from math import inf, isfinite

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Answer = tuple[Sequence[float], int, float]
"""A value for each joint, the rank of J⁺, and its margin, negative if the singular values give another rank."""
Law = Callable[[Array, Array, int | None], Answer]
"""A control law: from (q, v) and the rank of J⁺ (None: by its singular values) to n efforts or accelerations."""
Response = Callable[[Array, Array, int | None, Sequence[int]], Answer]
"""The equations of motion: from (q, v), the rank of J⁺ and the directions of slip to q̈. Joints at rest are free."""
Ratios = Callable[[Array], list[float]]
"""σ/σ_max of the task Jacobian at q, in descending order; empty for a law without J⁺."""
NUDGE = 1e-6  # step of the difference quotients that find the fastest joint: rad, m, rad/s or m/s


@dataclass(frozen=True)
class Equations:
    """The equations of motion of a plant with its inputs held.

    Attributes:
        acceleration: q̈.
        ratios: σ/σ_max of J, which decide its rank.
        rcond: J⁺ drops singular values with ratios up to this one.
        swing: for each joint, a bound on the derivative of the ratios with respect to its position, 1/rad or 1/m.
        damping: viscous damping of the joints, N·m·s/rad or N·s/m, n values; empty without damping.
    """

    acceleration: Response
    ratios: Ratios
    rcond: float
    swing: Sequence[float]
    damping: Sequence[float] = ()


def fastest_joint(acceleration: Callable[[list[float]], Sequence[float]], y: list[float]) -> tuple[int, float]:
    """Return the joint whose acceleration is most sensitive to its own state, and its rate of change, 1/s."""
    n, a = len(y) // 2, acceleration(y)
    rates = []
    for i, order in product(range(n), (2, 1)):  # |∂q̈ᵢ/∂qᵢ|½ and |∂q̈ᵢ/∂vᵢ|
        nudged = y.copy()
        nudged[i + n * (order == 1)] += NUDGE
        change = abs(acceleration(nudged)[i] - a[i]) / NUDGE
        rates.append((change ** (1 / order) if isfinite(change) else inf, i))
    rate, joint = max(rates)
    return joint, rate
