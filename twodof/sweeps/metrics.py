"""What one run is judged by, from its samples at the communication points t_0 … t_N.

With e_k = x_des − x_k, the end effector's error at t_k, and d = e_0 / |e_0|, its first direction;
|·| is the Euclidean norm over the task axes, h the communication step. Nothing is interpolated:
times are those of samples, and extremes those of samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BAND = 0.02
"""Of the initial error, the usual band of the settling time."""
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
        "settling time (2 %)", "s",
        "first t_k - t_0 from which on |e| stays within 2 % of |e_0| until the end of the run",
    ),
    "overshoot": Metric(
        "overshoot", "",
        "largest -e_k·d / |e_0|, the part of the way by which the target is passed; 0: not passed",
    ),
    "final_error": Metric("final error", "m", "|e_N|"),
    "rms_error": Metric("RMS error", "m", "root of the mean of |e_k|² over all samples"),
    "peak_effort": Metric(
        "peak |τ|", "N.m", "largest |τ_i| of any joint at any sample; N for prismatic joints"
    ),
    "peak_velocity": Metric(
        "peak |v|", "rad/s", "largest |v_i| of any joint at any sample; m/s for prismatic joints"
    ),
    "time_at_limits": Metric(
        "time at joint limits", "s", "h times the number of samples after the first at which any"
        " joint is at one of its limits",
    ),
}  # fmt: skip
"""By name of the column. A metric is NaN where it is not defined: what a run that was not finished
would have done, the settling of one that did not settle, the settling and overshoot of one that
starts within 1e-9 m of its target, and what needs an output, target or limit that the FMU has not.
For all of them less is better."""


def measure(
    t: Array, q: Array, v: Array, x: Array, tau: Array, target: Array, q_min: Array, q_max: Array
) -> dict[str, float]:
    """All metrics of one run of N + 1 samples.

    Args:
        t: N + 1 times, s.
        q, v: joint positions and velocities, (N + 1) × n, rad or m, and per s.
        x: position of the end effector along the task axes, (N + 1) × m, m.
        tau: control effort, (N + 1) × n, N·m or N.
        target: m values, m; NaN where there is none.
        q_min, q_max: n values; NaN where there is none.
    """
    metrics = dict.fromkeys(METRICS, nan)
    metrics["peak_velocity"] = float(np.abs(v).max())
    if tau.size:
        metrics["peak_effort"] = float(np.abs(tau).max())
    if not np.isnan(q_min).any() and not np.isnan(q_max).any():
        at_limit = np.any((q <= q_min + AT_LIMIT) | (q >= q_max - AT_LIMIT), axis=1)
        metrics["time_at_limits"] = float(at_limit[1:].sum() * (t[-1] - t[0]) / (len(t) - 1))
    if not x.size or np.isnan(target).any():
        return metrics
    e = target - x
    error = np.linalg.norm(e, axis=1)
    metrics["final_error"] = float(error[-1])
    metrics["rms_error"] = float(np.sqrt(np.mean(error**2)))
    if error[0] >= SMALLEST_MOVE:
        metrics["overshoot"] = max(0.0, float((-e @ e[0]).max()) / float(error[0]) ** 2)
        outside = np.flatnonzero(error > BAND * error[0])  # the first sample is
        if outside[-1] < len(t) - 1:
            metrics["settling_time"] = float(t[outside[-1] + 1] - t[0])
    return metrics
