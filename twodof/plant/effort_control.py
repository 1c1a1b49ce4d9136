"""Effort control: joint efforts are inputs, for an external controller.

τ = tau_cmd
"""

from collections.abc import Sequence
from math import inf

from .control_law import ControlledPlant
from .equations import Array, Law, Ratios


def command(plant: ControlledPlant) -> tuple[Law, Ratios]:
    """Return τ (n values) as a function of the state, with inputs held; this law has no J⁺."""
    return given_effort(plant.tau_cmd)


def given_effort(tau: Sequence[float]) -> tuple[Law, Ratios]:
    """Return a control law whose effort (n values) is constant."""
    tau = list(tau)

    def effort(q: Array, v: Array, rank: int | None) -> tuple[list[float], int, float]:
        del q, v
        return tau, rank or 0, inf

    return effort, lambda q: []
