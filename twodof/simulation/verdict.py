"""Verdict of a run: reached or not, its motion and metrics, and the causes, in numbers and in lines."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from math import inf, isfinite
from typing import Any, NamedTuple

import numpy as np

from ..bounds import MAX_VALUE
from ..files import NUMBER
from .cause import FLOOR, Cause
from .causes import causes
from .expressions import expression
from .judge import BLOCK, OUTPUTS, Judge
from .motion import motion_of
from .outcome import missed_outputs, success
from .removal import Repeat, by_removal
from .setup import Array, Setup
from .verdict_text import lines_of


class Metric(NamedTuple):
    """Metric of a run, a column of a sweep's table.

    Attributes:
        title: title in tables and figures.
        unit: FMI unit, "" for a number without one.
        text: definition.
    """

    title: str
    unit: str
    text: str


METRICS: Mapping[str, Metric] = {
    "settling_time": Metric(
        "settling time (2 %)",
        "s",
        "first t_k - t_0 from which on |e| stays within 2 % of |e_0|, and θ within 2 % of θ_0,"
        " until the end of the run; an output that starts at its target stays within 1e-3",
    ),
    "overshoot": Metric(
        "overshoot", "", "largest -e_k·d / |e_0|, the part of the way by which the target is passed; 0: not passed"
    ),
    "final_error": Metric("final error", "m", "|e_N| of the end effector"),
    "final_turn_error": Metric("final orientation error", "rad", "θ_N"),
    "final_joint_error": Metric(
        "final joint error", "rad", "largest |q_des - q_N| of any joint; m for prismatic joints"
    ),
    "rms_error": Metric("RMS error", "m", "root of the mean of |e_k|² of the end effector over all samples"),
    "peak_effort": Metric("peak |τ|", "N.m", "largest |τ_i| of any joint at any sample; N for prismatic joints"),
    "chatter": Metric(
        "RMS change of τ",
        "N.m",
        "root of the mean of (τ_i,k - τ_i,k-1)², of the joint with most; N for prismatic joints",
    ),
    "peak_velocity": Metric("peak |v|", "rad/s", "largest |v_i| of any joint at any sample; m/s for prismatic joints"),
    "time_at_limits": Metric(
        "time at joint limits",
        "s",
        "h times the number of samples after the first at which any joint is at one of its limits",
    ),
    "effort_use": Metric(
        "peak |τ| / limit", "", "largest |τ_i| as a share of the URDF's effort limit; above 1 the robot cannot do it"
    ),
    "velocity_use": Metric(
        "peak |v| / limit", "", "largest |v_i| as a share of the URDF's velocity limit; above 1 the robot cannot do it"
    ),
    "saturated": Metric(
        "saturation", "", "share of the samples at which |τ_i| is at the URDF's effort limit, of the joint with most"
    ),
}
"""Metrics by column name; smaller is better for all of them. A metric is NaN if it is not defined: in a run that was
not finished; settling and overshoot of a run that starts within 1e-9 m or rad of its target; and metrics of an output,
target or limit that the FMU does not have. The settling time of a run that did not settle is infinite in a verdict, and
NaN in a table.
"""
RESULTS = (*METRICS, "frequency", "damping")
"""Names of all numbers of a verdict: the metrics, the frequency of an oscillation, Hz, and its damping ratio."""

SHAPE = {
    "outcome": str,
    "motion": str,
    "samples": int,
    "duration": NUMBER,
    "numbers": {str: NUMBER | None},
    "causes": [
        {
            "kind": str,
            "text": str,
            "joint": str,
            "share": NUMBER,
            "time": NUMBER | None,
            "point": [NUMBER],
            "noted": bool,
            "subject": str,
            "part": NUMBER | None,
            "tried": str | None,
            "removes": NUMBER | None,
        }
    ],
    "lines": [str],
}
"""Shape of a stored verdict."""


@dataclass(frozen=True)
class Verdict:
    """Verdict of a run.

    Attributes:
        outcome: "reached" or "not reached"; for a moving target "followed" or "not followed"; or "no target".
        motion: motion at the end: "steady", "moving", "oscillating" or "diverging".
        samples, duration: number of judged samples, and time from the first to the last one, s.
        numbers: values by name (``METRICS``, "frequency" in Hz, and "damping"). Undefined numbers are missing; the
            settling time is infinite if the run did not settle.
        causes: causes of a failure, the root cause first.
        lines: the verdict in words; the first line has the outcome and the first cause.
    """

    outcome: str
    motion: str
    samples: int
    duration: float
    numbers: Mapping[str, float]
    causes: tuple[Cause, ...]
    lines: tuple[str, ...]

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def failed_by(self, *conditions: str) -> str:
        """Return a line for the first condition, such as "error > 1e-3", that holds; "" if none holds.

        A condition on an undefined number, for example without a target, counts as one that holds.

        Raises:
            InputError: a condition is not a comparison of a verdict's numbers.
        """
        for condition in [expression(text, RESULTS, condition=True) for text in conditions]:
            unknown = [name for name in condition.names if name not in self.numbers]
            values = ", ".join(f"{name} = {self.numbers[name]:.6g}" for name in condition.names if name not in unknown)
            if unknown:
                return f"{condition.text} cannot be decided: {unknown[0]} is not defined for this run"
            if condition.value(self.numbers):
                return f"{condition.text} holds: {values}"
        return ""

    def facts(self) -> dict[str, object]:
        """Return the verdict for JSON, with None for an infinite number."""
        numbers = {name: value if isfinite(value) else None for name, value in self.numbers.items()}
        return {**asdict(self), "numbers": numbers, "causes": [cause._asdict() for cause in self.causes]}


def verdict_in(facts: Mapping[str, Any]) -> Verdict:
    """Return the verdict from stored ``facts`` of the shape SHAPE, which may have more; None is an infinite number."""
    numbers = {name: inf if value is None else float(value) for name, value in facts["numbers"].items()}
    causes = [{name: cause[name] for name in Cause._fields if name in cause} for cause in facts["causes"]]
    found = tuple(Cause(**{**cause, "point": tuple(cause["point"])}) for cause in causes)
    known = {field.name: facts[field.name] for field in fields(Verdict)}
    return Verdict(**{**known, "numbers": numbers, "causes": found, "lines": tuple(facts["lines"])})


@np.errstate(over="ignore", invalid="ignore")  # values below MAX_VALUE may still overflow; then there is no cause
def conclude(judge: Judge, repeat: Repeat | None = None) -> Verdict:
    """Return the verdict of a judge's samples.

    Args:
        repeat: function that repeats the run with other settings, if that is possible.
    """
    judge.flush()
    if not judge.count:
        outcome = "not reached" if judge.targets else "no target"
        lines = tuple(f"{outcome}; {cause.text}" for cause in judge.lost)
        return Verdict(outcome, "diverging", 0, 0.0, {}, judge.lost, lines)
    extreme = [*_extreme(judge)]
    numbers = {name: value for name, value in judge.metrics().items() if not np.isnan(value)}
    t, signals, scale = _signals(judge)
    motion, found, _ = motion_of(t, signals, scale)
    if found is not None:
        numbers |= {"frequency": found.frequency, "damping": found.damping}
    missed = missed_outputs(judge)
    outcome = ("not " if missed else "") + success(judge) if judge.aims else "no target"
    motion = "diverging" if judge.lost else motion
    why = (*judge.lost, *(extreme or causes(judge, missed, motion)))
    together = ""
    if repeat is not None and missed and not extreme:
        why, together = by_removal(judge, missed, why, repeat, _causes_of)
    lines = lines_of(judge, outcome, motion, numbers, why, together)
    return Verdict(outcome, motion, judge.count, judge.duration, numbers, why, lines)


def judged(
    setup: Setup,
    t: Array,
    values: Mapping[str, Array],
    targets: Mapping[str, Array],
    changes: Iterable[tuple[float, Mapping[str, float]]] = (),
) -> Verdict:
    """Return the verdict of N recorded samples.

    Args:
        t: times since the first sample, s, N.
        values: q, v, x, tau and quat, N rows each; unknown ones have no columns.
        targets: targets of x, quat and q in effect up to each sample, N rows each; NaN before the first target.
        changes: times, s, and inputs that changed at them.
    """
    rows = np.hstack([values[name] for name in OUTPUTS])
    known = np.isfinite(np.hstack([*targets.values(), np.zeros((len(t), 1))])).all(axis=1)
    judge = Judge(setup, [values[name].shape[1] for name in OUTPUTS])
    for time, inputs in changes:
        judge.note(time, inputs)
    for k in range(int(known.argmax()), len(t), BLOCK):
        part = slice(k, k + BLOCK)
        judge.judge(t[part], rows[part], {name: target[part] for name, target in targets.items()})
    return conclude(judge)


def _extreme(judge: Judge) -> Iterator[Cause]:
    """Yield a setting that is too large for the equations of the verdict, or not finite, as a cause."""
    for name, value in judge.held.items():
        if not name.rpartition(".")[2].startswith(("q_min[", "q_max[")) and not abs(value) <= MAX_VALUE:
            yield Cause("diverged", f"{name} = {value:g}: with a value beyond {MAX_VALUE:g} no other cause is judged")
            return


def _signals(judge: Judge) -> tuple[Array, Array, float]:
    """Return times, the errors of position or joints (without a target: joint positions), and their scale."""
    t = judge.history()
    way = t >= judge.changed
    aims = {name: aim for name, aim in judge.aims.items() if name != "quat"}
    if aims:
        name = next(iter(aims))
        signals = judge.wanted(name) - judge.history(name)[way]
        return t[way], signals, max(aims[name].first, judge.travel, FLOOR)
    q = judge.history("q")[way]
    return t[way], q, max(float(np.ptp(judge.history("q"), axis=0).max()), FLOOR)


def _causes_of(judge: Judge) -> tuple[Cause, ...]:
    """Return the causes of a repeated run; none if it reaches its target."""
    missed = missed_outputs(judge)
    return causes(judge, missed, motion_of(*_signals(judge))[0]) if missed else ()
