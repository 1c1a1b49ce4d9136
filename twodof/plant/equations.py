"""The equations of motion of a plant as functions of its state, and control laws, which are parts of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Answer = tuple[Sequence[float], int, float]
"""Values of the joints, the rank of J⁺, and its margin, negative where the singular values give another."""
Law = Callable[[Array, Array, int | None], Answer]
"""At (q, v), with a J⁺ of a rank (None: that of its singular values): what a control law gives, n values."""
Response = Callable[[Array, Array, int | None, Sequence[int]], Answer]
"""The same of the equations of motion, whose joints slip in directions: q̈, all joints at rest being free."""
Ratios = Callable[[Array], list[float]]
"""σ/σ_max of the task Jacobian at q, in descending order; none of a law without J⁺."""


@dataclass(frozen=True)
class Equations:
    """The equations of motion of a plant, inputs held.

    Attributes:
        acceleration: q̈.
        ratios: singular values of J that decide its rank.
        rcond: up to which J⁺ drops them.
        swing: per joint, a bound on how fast it changes them, 1/rad or 1/m.
        damping: of the joints, N·m·s/rad or N·s/m, n values; empty without.
    """

    acceleration: Response
    ratios: Ratios
    rcond: float
    swing: Sequence[float]
    damping: Sequence[float] = ()
