"""Tests of the model by the residuals of a fit: fast and slow ones, errors of the setup, and rests."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2, norm
from scipy.stats import f as f_distribution

from .parameters import Dynamics, Parameters
from .regression import UNMODELLED, Rows, information_root, jacobian, residual, resting_rows, stretched
from .stretches import Array, Stretch

LEAST_NOISE = 5e-4
"""Noise as a fraction of the efforts, below which errors of filter and spline are not small beside it."""
SEPARATE = 1e-6
"""Part of the power of an error that the coordinates cannot replace, below which the error is not tested."""
SIGNIFICANCE = 1e-4  # probability of residuals below which they are not noise
ALARMS, OF_LOADS = 0.005, 1e-4
"""Probability that the residuals of a right model show an error of the setup, by the nominal distribution; and that for
friction in proportion to the load. Noise in proportion to the effort is largest where that friction is, which makes its
statistic too large: at 0.005, it was reported in 3 of 70 right recordings of a UR5.
"""
LEAST_FILTER = 0.5 * (2.0 * np.pi * 25.0) ** -2
"""Size of the filter of positions at 100 Hz, s²: near rests, its ripple looks like a filter of smaller size."""
SLOW = 2  # number of bins in which a filter is tested: in faster ones, the noise of accelerations looks like a filter

ERRORS = {
    "gravity": "a base that is tilted by about {size:.2g} {unit} (free '{name}')",
    "offset": "positions of joint '{joint}' that need about {size:+.2g} {unit} (free '{name}')",
    "gain": "efforts of joint '{joint}' that need about {percent:+.3g} % (free '{name}')",
    "gains": "efforts of all joints that need about {percent:+.3g} % (free 'gain:*')",
    "bias": "efforts of joint '{joint}' that are about {size:.2g} {effort} too high, or friction that is higher by this"
    " in the positive direction (free '{name}')",
    "drag": "damping of joint '{joint}' by the square of its speed, {size:.2g} {effort} at 1 {unit}/s (record at the"
    " speeds of the task)",
    "load": "friction of joint '{joint}' that grows by about {percent:.2g} % of its load (record with the loads of the"
    " task)",
    "spring": "a spring of about {size:.2g} {effort}/{unit} at joint '{joint}' (it is not part of the model)",
    "payload": "a payload of about {size:+.2g} kg (free '{name}', or correct the masses)",
    "filter": "{filtered} behind a filter with a time constant of about {ms:.2g} ms (record them without it)",
    "delay": "stamps of the efforts of joint '{joint}' that need about {shift:+.2g} ms, beside those of other joints"
    " (correct the stamps)",
    "clock": "speeds that need about {percent:+.2g} %, as of a wrong clock",
}
"""Texts of errors of the setup, by the first part of their names."""


class Misfit(NamedTuple):
    """Comparison of the slow and the fast residuals of one joint."""

    joint: int  # index of the joint
    rms: float  # root mean square of the slow residuals, N·m or N
    ratio: float  # ratio of the variances of slow and fast residuals
    probability: float  # probability of a ratio of this size or more with white noise
    part: float  # ratio of the root mean squares of slow residuals and efforts

    @property
    def bad(self) -> bool:
        """True if the slow residuals are not noise, or exceed the efforts."""
        return (self.probability < SIGNIFICANCE and self.part > LEAST_NOISE) or self.part > 1.0


class Suspect(NamedTuple):
    """An error of the setup that the residuals show."""

    name: str  # name of the parameter, as in patterns, or "clock"
    size: float  # most likely error: rad or m, or a part of efforts or speeds
    probability: float  # probability of such residuals without the error


class Hold(NamedTuple):
    """A stretch in which a joint rests under more than its friction."""

    joint: int  # index of the joint
    t: float  # begin of the stretch, s
    excess: float  # effort beyond friction, N·m or N
    probability: float  # probability of such an excess by noise


def suspects_of(
    parameters: Parameters, rows: Sequence[Rows], sd: Sequence[Array], z: Array, J: Array, N: Array
) -> tuple[tuple[Suspect, ...], Array, Array]:
    """Return the errors that whitened residuals r show, most probable first, and the covariance that they add.

    Third, return the covariance that the coordinates would have in addition if the efforts of each joint had a bias.

    J is the Jacobian of r, and N the covariance of the coordinates. The coordinates replace the part J N Jᵀ e of an
    error's derivatives e, and e⟂ is the rest. Without the error (e⟂ᵀ r)²/|e⟂|² is χ²(1); with it, its size is
    −e⟂ᵀ r/|e⟂|², and the estimate is wrong by N Jᵀ e times this size. Source of this score test: Rao, "Large sample
    tests of statistical hypotheses", Proc. Camb. Phil. Soc. 44, 1948.
    """
    more, x, new = parameters.with_errors(z[:-1])
    dynamics = parameters.dynamics(parameters.values(z[:-1]))
    setup = information_root(more, rows, sd, np.append(x, z[-1]))[:, :-1][:, new]
    names, others = np.array(more.coordinate_names)[new], _others(parameters.robot.joints, rows, sd, dynamics)
    if (gains := np.char.startswith(names, "gain:")).sum() > 1:
        others["gains"] = setup[:, gains].sum(axis=1)
    errors, names = np.column_stack([setup, *others.values()]), np.append(names, [*others])
    r = np.concatenate([residual(each, dynamics, float(z[-1])) / s for each, s in zip(rows, sd)])
    replaced = N @ J.T @ errors
    rest = errors - J @ replaced
    power, score = np.sum(rest**2, axis=0), rest.T @ r
    power[power <= SEPARATE * np.sum(errors**2, axis=0)] = np.inf
    springs, place = np.char.startswith(names, "spring:"), {name: k for k, name in enumerate(names.tolist())}
    for k in np.flatnonzero(springs).tolist():
        bias = place.get(f"bias:{names[k].partition(':')[2]}", k)
        strength, force = np.linalg.lstsq(rest[:, [k, bias]], r, rcond=SEPARATE)[0].tolist()
        if bias != k and strength and np.isfinite(power[[k, bias]]).all():
            for each in (rest, replaced):  # the position at which a spring has no force is not known
                each[:, k] += force / strength * each[:, bias]
            power[k], score[k] = rest[:, k] @ rest[:, k], rest[:, k] @ r
    sizes, statistics = -score / power, score**2 / power
    probabilities = chi2.sf(statistics, 1 + springs)
    alarms = np.where(np.char.startswith(names, "load:"), OF_LOADS, ALARMS) / len(names)
    probabilities[(names == "filter") & (np.abs(sizes) < LEAST_FILTER)] = 1.0
    shown = [k for k in np.argsort(-statistics).tolist() if probabilities[k] < alarms[k]]
    moved = replaced[:, shown] * np.sqrt(sizes**2 + 1.0 / power)[shown]
    bias = np.char.startswith(names, "bias:") & np.isfinite(power)
    by_bias = replaced[:, bias] @ np.linalg.pinv(rest[:, bias].T @ rest[:, bias], SEPARATE, True) @ replaced[:, bias].T
    suspects = tuple(Suspect(str(names[k]), float(sizes[k]), float(probabilities[k])) for k in shown)
    return suspects, moved @ moved.T, by_bias


def holds_of(
    parameters: Parameters,
    stretches: Sequence[Stretch],
    rows: Sequence[Rows],
    sd: Sequence[Array],
    z: Array,
    scales: Array,
    N: Array,
) -> list[Hold]:
    """Return, for each joint that rests under more than its friction, the stretch with the largest excess.

    Friction F holds a joint at rest if |τ − h| ≤ F. N is the covariance of the scaled coordinates.
    """
    values, rates = parameters.dynamics(parameters.values(z[:-1])), parameters.rates(z[:-1])[1]
    slow = [np.mean(s[each.bin == each.bin.min()] ** 2) for each, s in zip(rows, sd)]
    found, count = dict[int, Hold](), 0
    for row, variance, t in resting_rows(parameters, values, stretches, float(z[-1])):
        side = np.sign(residual(row._replace(sign=np.zeros(1)), values, float(z[-1])))
        row = row._replace(sign=side * row.one)  # on the verge of slipping
        direction = jacobian(row, values, rates)[0] * scales
        noise = max(slow[row.joint], variance)
        excess = float((side * residual(row, values, float(z[-1])))[0])
        probability, count = float(norm.sf(excess / np.sqrt(noise + direction @ N @ direction))), count + 1
        if row.joint not in found or probability < found[row.joint].probability:
            found[row.joint] = Hold(row.joint, t, excess / float(row.one[0]), probability)
    return [hold for hold in found.values() if hold.probability * count < SIGNIFICANCE]


def _others(joints: Sequence[str], rows: Sequence[Rows], sd: Sequence[Array], dynamics: Dynamics) -> dict[str, Array]:
    """Return the derivatives of all whitened residuals with respect to each error that is not a parameter."""
    clock = np.concatenate([stretched(each, dynamics) / s for each, s in zip(rows, sd)])
    parts = [-each.unmodelled / s[:, None] for each, s in zip(rows, sd)]
    rates = [-each.tau_rate / s for each, s in zip(rows, sd)]
    slow = [part[:, -1] * (each.bin < SLOW) for each, part in zip(rows, parts)]
    carried = np.concatenate([part[:, -2] for part in parts])
    others, begin = {"clock": clock, "filter": np.concatenate(slow), "payload": carried}, 0
    for each, part, late in zip(rows, parts, rates):
        own = slice(begin, begin := begin + len(part))
        for name, column in zip(UNMODELLED[:-2], part.T):
            others[f"{name}:{joints[each.joint]}"] = np.zeros(len(clock))
            others[f"{name}:{joints[each.joint]}"][own] = column
        others[f"delay:{joints[each.joint]}"] = np.zeros(len(clock))
        others[f"delay:{joints[each.joint]}"][own] = late
    return others


def misfit_of(rows: Rows, errors: Array, used: float) -> Misfit:
    """Compare slow residuals, at the frequencies of the motion, with those in the middle of the band."""
    slow, fast = rows.bin < 2, (rows.bin >= 2) & (rows.bin < 5)
    own, other = max(1.0, slow.sum() - used), max(1.0, float(fast.sum()))
    ratio = float(np.sum(errors[slow] ** 2) / own / max(np.sum(errors[fast] ** 2) / other, 1e-300))
    rms = float(np.sqrt(np.sum(errors[slow] ** 2) / len(errors)))
    effort = float(np.sqrt(np.sum(rows.tau**2) / len(errors)))
    return Misfit(rows.joint, rms, ratio, float(f_distribution.sf(ratio, own, other)), rms / max(effort, 1e-300))
