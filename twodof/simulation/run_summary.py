"""Summary of a run: its last sample and its verdict."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

from ..notebook import card, picture
from .judge import Judge
from .removal import Repeat
from .sample import Sample
from .verdict import Verdict, conclude


@dataclass(frozen=True)
class Summary:
    """Summary of a run.

    Attributes:
        last: the last sample.
        wall_time: wall time without loading and initialisation, s.
        stopped: whether a request ended the run before its stop time.
        repeat: function that repeats the run with other settings, if that is possible.
    """

    last: Sample
    wall_time: float
    stopped: bool
    judge: Judge = field(repr=False)
    repeat: Repeat | None = field(default=None, repr=False)

    def _repr_html_(self) -> str:
        facts: dict[str, object] = {"verdict": "; ".join(self.verdict.lines)}
        facts["wall time"] = f"{self.wall_time:.3g} s"
        joints = [*range(1, len(self.last.q) + 1)]
        curves = [(joints, values) for values in (self.last.q, self.judge.wanted("q")) if len(values)]
        positions = picture(curves, "joint", "q at the end, and its target, in rad or m", dots=True)
        end = "stopped" if self.stopped else "ended"
        return card(f"Run, {end} at t = {self.last.t:g} s after {self.last.k} steps", facts, positions)

    @cached_property
    def verdict(self) -> Verdict:
        """Verdict of the run: reached or not, its metrics, and why."""
        return conclude(self.judge, repeat=self.repeat)

    @property
    def error(self) -> float | None:
        """Final distance of the end effector from its target, m; None without a target."""
        return self.judge.metrics().get("final_error")

    @property
    def turn_error(self) -> float | None:
        """Final angle of the end effector from its target orientation, rad; None without a target."""
        return self.judge.metrics().get("final_turn_error")

    @property
    def joint_error(self) -> float | None:
        """Final largest distance of a joint from its target, rad or m; None without a target."""
        return self.judge.metrics().get("final_joint_error")
