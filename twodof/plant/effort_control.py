"""No control: joint efforts are inputs, for a controller of the user's own.

τ = tau_cmd
"""

from __future__ import annotations

from typing import Any

from .integrator import Array, Response


def command(plant: Any) -> Response:
    """τ as a function of the state, n values; inputs held."""
    tau = list(plant.tau_cmd)

    def effort(q: Array, v: Array) -> tuple[list[float], int]:
        del q, v
        return tau, 0

    return effort
