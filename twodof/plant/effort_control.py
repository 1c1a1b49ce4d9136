"""No control: joint efforts are inputs, for a controller of the user's own.

τ = tau_cmd
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .integrator import Array

if TYPE_CHECKING:
    from .plant import Command, Plant


def command(plant: Plant) -> Command:
    """τ as a function of the state, n values; inputs held."""
    tau = list(plant.tau_cmd)

    def effort(q: Array, v: Array) -> tuple[list[float], int]:
        del q, v
        return tau, 0

    return effort
