"""Effort control: joint efforts are inputs, for an external controller.

τ = tau_cmd
"""

from collections.abc import Sequence
from math import inf

from .control_law import ControlledPlant
from .equations import Array, Law, Ratios


def command(plant: ControlledPlant) -> tuple[Law, Ratios]:
    """Return τ as a function of the state, n values, inputs held; this law has no J⁺."""
    return given_effort(plant.tau_cmd)


def given_effort(tau: Sequence[float]) -> tuple[Law, Ratios]:
    """Return a law that gives an effort, n values, at any state."""
    tau = list(tau)

    def effort(q: Array, v: Array, rank: int | None) -> tuple[list[float], int, float]:
        del q, v
        return tau, rank or 0, inf

    return effort, lambda q: []
