"""Metrics of one run, from its samples at the communication points t_0 … t_N.

With e_k = x_des − x_k, the end effector's error at t_k, or under joint control e_k = q_des − q_k,
and d = e_0 / |e_0|, its first direction; |·| is the Euclidean norm over the task axes or joints, h
the communication step, θ_k the angle between the end effector's orientation and its target. Nothing
is interpolated: times are those of samples, and extremes those of samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..simulation.peaks import Limits

Array = NDArray[np.float64]

BAND = 0.02
"""Band of the settling time, as a share of the initial error."""
SMALLEST_MOVE = 1e-9  # m: below, a run that starts at its target has no band to settle in
AT_LIMIT = 1e-9  # rad or m: a joint that the plant has stopped is at its limit to the last bit


class Metric(NamedTuple):
    """One column of a sweep's table.

    Attributes:
        title: for people.
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
        " until the end of the run",
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
    "peak_velocity": Metric("peak |v|", "rad/s", "largest |v_i| of any joint at any sample; m/s for prismatic joints"),
    "time_at_limits": Metric(
        "time at joint limits",
        "s",
        "h times the number of samples after the first at which any joint is at one of its limits",
    ),
    "effort_use": Metric(
        "peak |τ| / limit", "", "largest |τ_i| as a share of the URDF's effort limit; above 1 the robot cannot do it"
    ),
    "velocity_use": Metric("peak |v| / limit", "", "largest |v_i| as a share of the URDF's velocity limit; likewise"),
}
"""By name of the column. A metric is NaN where it is not defined: what a run that was not finished would have done,
the settling of one that did not settle, the settling and overshoot of one that starts within 1e-9 m or rad of its
target, and what needs an output, target or limit that the FMU has not.
For all of them less is better."""


def measure(t: Array, run: Mapping[str, Array], limits: Limits) -> dict[str, float]:
    """Return all metrics of one run of N + 1 samples of n joints and m task axes.

    Args:
        t: N + 1 times, s.
        run: outputs q, v, x, tau and quat, N + 1 rows each, and the vectors x_des, quat_des, q_des,
            q_min and q_max; no columns or NaN where the FMU has none.
        limits: of the URDF.
    """
    metrics, tau = dict.fromkeys(METRICS, nan), run["tau"]
    metrics["peak_velocity"] = float(np.abs(run["v"]).max())
    metrics["velocity_use"] = _use(run["v"], limits.velocity)
    if tau.size:
        metrics["peak_effort"] = float(np.abs(tau).max())
        metrics["effort_use"] = _use(tau, limits.effort)
    q, low, high = run["q"], run["q_min"] + AT_LIMIT, run["q_max"] - AT_LIMIT
    if not np.isnan(low).any() and not np.isnan(high).any():
        at_limit = np.any((q <= low) | (q >= high), axis=1)
        metrics["time_at_limits"] = float(at_limit[1:].sum() * (t[-1] - t[0]) / (len(t) - 1))
    distances = []
    for now in ("x", "q"):
        if run[now].size and not np.isnan(run[f"{now}_des"]).any():
            e = run[f"{now}_des"] - run[now]
            error = np.linalg.norm(e, axis=1)
            distances.append(error)
            if now == "x":
                metrics["final_error"] = float(error[-1])
                metrics["rms_error"] = float(np.sqrt(np.mean(error**2)))
            else:
                metrics["final_joint_error"] = float(np.abs(e[-1]).max())
            if error[0] >= SMALLEST_MOVE:
                metrics["overshoot"] = max(0.0, float((-e @ e[0]).max()) / float(error[0]) ** 2)
    if run["quat"].size and not np.isnan(run["quat_des"]).any():
        distances.append(angles(run["quat"], run["quat_des"]))
        metrics["final_turn_error"] = float(distances[-1][-1])
    ends = [_settled(error) for error in distances if error[0] >= SMALLEST_MOVE]
    if ends and max(ends) < len(t):
        metrics["settling_time"] = float(t[max(ends)] - t[0])
    return metrics


def angles(quat: Array, target: Array) -> Array:
    """Return the angle of each unit quaternion from a target of any length but 0, rad."""
    target = target / np.linalg.norm(target)
    apart = [np.linalg.norm(quat - side, axis=1) for side in (target, -target)]
    return np.asarray(4.0 * np.arcsin(np.minimum(1.0, 0.5 * np.minimum(*apart))))


def _use(values: Array, limits: tuple[float, ...]) -> float:
    """Return the largest magnitude as a share of its limit; NaN where there is no limit."""
    return float((np.abs(values) / limits).max()) if min(limits) < inf else nan


def _settled(error: Array) -> int:
    """Return the sample from which an error stays within the band; the number of samples if none."""
    return int(np.flatnonzero(error > BAND * error[0])[-1]) + 1  # the first sample is outside
