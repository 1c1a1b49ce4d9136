"""Summary of a run: its last sample, errors and exceeded limits."""

from __future__ import annotations

from dataclasses import dataclass

from ..notebook import card, picture
from .peaks import Excess
from .sample import Sample


@dataclass(frozen=True)
class Summary:
    """Summary of a run.

    Attributes:
        last: the last sample.
        wall_time: s, without loading and initialisation.
        stopped: whether a request ended it before its stop time.
        beyond_limits: joints whose effort or velocity at a sample exceeds the URDF's limit, the worst first.
    """

    last: Sample
    wall_time: float
    stopped: bool
    beyond_limits: tuple[Excess, ...]

    def _repr_html_(self) -> str:
        errors = {
            "distance from the target": (self.error, "m"),
            "angle from the target orientation": (self.turn_error, "rad"),
            "largest joint error": (self.joint_error, "rad or m"),
        }
        facts: dict[str, object] = {name: f"{e:.3g} {unit}" for name, (e, unit) in errors.items() if e is not None}
        for joint, quantity, peak, limit, unit in self.beyond_limits:
            facts[f"{quantity} of {joint}"] = f"{peak:.4g} {unit} exceeds its limit {limit:.4g}"
        facts["wall time"] = f"{self.wall_time:.3g} s"
        joints = [*range(1, len(self.last.q) + 1)]
        curves = [(joints, values) for values in (self.last.q, self.last.joint_target) if values]
        positions = picture(curves, "joint", "q at the end, and its target, in rad or m", dots=True)
        end = "stopped" if self.stopped else "ended"
        return card(f"Run, {end} at t = {self.last.t:g} s after {self.last.k} steps", facts, positions)

    @property
    def error(self) -> float | None:
        """Final distance of the end effector from its target, m; None without a target."""
        return self.last.error

    @property
    def turn_error(self) -> float | None:
        """Final angle of the end effector from its target orientation, rad; None without a target."""
        return self.last.turn_error

    @property
    def joint_error(self) -> float | None:
        """Final largest distance of a joint from its target, rad or m; None without a target."""
        return self.last.joint_error
