"""Maximum-likelihood estimate of free parameters, its covariance, and tests of the model."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from ..errors import InputError
from .parameters import SEEN, Dynamics, Parameters, Values
from .regression import EDGES, UNMODELLED, Rows, jacobian, residual, rows_of, stretched
from .stretches import Array, Stretch

PRIOR = 3.0
"""Standard deviation, in scales, of the weak prior, which fixes directions that the data do not determine."""
TOLERANCE, STEPS, LAST_STEPS = 1e-8, 15, 40
"""Relative tolerance of a solution, and its most steps, before the last estimate of noise and after it."""
PASSES, FIRST_NOISE = 6, 0.02
"""Number of estimates of the noise variances, and the initial noise, as a fraction of the efforts."""
DELAY_SCALE, LARGEST_SHIFT = 0.02, 5e-4
"""Scale of the delay, and its largest change without new rows, s."""
LARGEST_TURN = 0.01  # rad or m: largest change of an offset after the last linearisation of the rows
FEWEST = 20  # rows for the estimate of a bin's noise
PRIOR_SHARE = 0.1
"""Share of the prior in the variance of a value, above which the data do not determine the value."""
SHARP = 0.05
"""Standard deviation relative to a value, below which the data determine it whatever the prior's share."""
SEPARATE = 1e-6
"""Part of the power of an error that the coordinates cannot replace, below which the error is not tested."""
SIGNIFICANCE = 1e-4
"""Probability of residuals below which they are not noise."""
ALARMS, OF_LOADS = 0.005, 1e-4
"""Probability that the residuals of a right model show an error of the setup, by the nominal distribution; and that for
friction in proportion to the load. Noise in proportion to the effort is largest where that friction is, which makes its
statistic too large: at 0.005, it was reported in 3 of 70 right recordings of a UR5.
"""
SLOW = 2
"""Number of bins in which a filter is tested: in faster ones, the noise of accelerations looks like a filter."""


class Misfit(NamedTuple):
    """Comparison of the slow and the fast residuals of one joint.

    Attributes:
        joint: index of the joint.
        rms: root mean square of the slow residuals, N·m or N.
        ratio: ratio of the variances of slow and fast residuals.
        probability: probability of a ratio of this size or more with white noise.
        part: ratio of the root mean squares of slow residuals and efforts.
    """

    joint: int
    rms: float
    ratio: float
    probability: float
    part: float

    @property
    def bad(self) -> bool:
        """True if the slow residuals are not noise, or exceed the efforts."""
        return self.probability < SIGNIFICANCE or self.part > 1.0


class Suspect(NamedTuple):
    """An error of the setup that the residuals show.

    Attributes:
        name: name of the parameter, as in patterns, or "clock".
        size: most likely error: rad or m, or a part of efforts or speeds.
        probability: probability of such residuals without the error.
    """

    name: str
    size: float
    probability: float


class Estimate(NamedTuple):
    """Result of an estimation of p coordinates and the delay.

    Attributes:
        x: coordinates, p.
        values: physical values.
        covariance: covariance of the reported values, r × r, with the prior.
        known: whether the data determine each reported value, r.
        unseen: directions that the data do not determine, in scales, directions × p.
        delay: delay of recorded efforts, s, and its standard deviation.
        noise: standard deviation of the efforts' noise, N·m or N, n.
        misfits: comparison of residuals for each joint.
        suspects: errors that the residuals show, the most probable one first.
        converged: False if the last solution still moved after its most steps; no value is known then.
        interrupted: True if Ctrl-C ended the estimation.
    """

    x: Array
    values: Values
    covariance: Array
    known: NDArray[np.bool_]
    unseen: Array
    delay: tuple[float, float]
    noise: Array
    misfits: tuple[Misfit, ...]
    suspects: tuple[Suspect, ...]
    converged: bool
    interrupted: bool


class _Solution(NamedTuple):
    """Rows, standard deviations of their noise, coordinates and delay, and the scales of these."""

    rows: Sequence[Rows]
    sd: Sequence[Array]
    z: Array
    scales: Array
    converged: bool


def estimate(
    parameters: Parameters, stretches: Sequence[Stretch], finished: Callable[[], None] = lambda: None
) -> Estimate:
    """Return the most likely coordinates of the free parameters; ``finished`` is called after each of the PASSES.

    Ctrl-C after the first pass ends it with the last solution.
    """
    solutions, interrupted = _solutions(parameters, stretches), False
    solution = next(solutions)
    try:
        finished()
        for better in solutions:
            solution = better
            finished()
    except KeyboardInterrupt:
        interrupted = True
    return _result(parameters, *solution, interrupted)


def _solutions(parameters: Parameters, stretches: Sequence[Stretch]) -> Iterator[_Solution]:
    """Yield a better solution after each of the PASSES."""
    x, low, scales = parameters.coordinates(typical(stretches))
    scales, low = np.append(scales, DELAY_SCALE), np.append(low, -np.inf)
    start = np.append(x, 0.0)
    z = start.copy()
    rows: list[Rows] = []
    sd: list[Array] = []
    relinearise = any(free.group == "offset" for free in parameters.free)
    for k in range(PASSES):
        last = k == PASSES - 1  # for the tests of offsets
        if not rows or relinearise or last or abs(z[-1] - rows[0].about[1]) > LARGEST_SHIFT:
            about = parameters.dynamics(parameters.values(z[:-1]))
            rows = rows_of(parameters, about, stretches, float(z[-1]), relinearise or last)
        sd = sd or [np.full(len(each.tau), FIRST_NOISE * np.sqrt(np.mean(each.tau**2))) for each in rows]
        solved = _solve(parameters, rows, sd, z, start, low, scales, LAST_STEPS if last else STEPS)
        z = solved.x
        dynamics = parameters.dynamics(parameters.values(z[:-1]))
        sd = [_deviations(each, residual(each, dynamics, float(z[-1]))) for each in rows]
        shift, turn = abs(z[-1] - rows[0].about[1]), np.abs(dynamics.offset - rows[0].about[0]).max()
        converged = last and solved.status > 0 and shift <= LARGEST_SHIFT and turn <= LARGEST_TURN
        yield _Solution(rows, sd, z, scales, bool(converged))


def typical(stretches: Sequence[Stretch]) -> dict[str, Array]:
    """Return the friction, damping and armature that would each explain a joint's efforts without other causes."""
    rms = {name: np.sqrt(np.mean(np.concatenate([getattr(s, name) for s in stretches]) ** 2, 0)) for name in "va"}
    effort = np.sqrt(np.mean(np.concatenate([s.tau for s in stretches]) ** 2, axis=0))
    return {"friction": effort, "damping": effort / rms["v"], "armature": effort / rms["a"], "bias": effort}


def _solve(
    parameters: Parameters,
    rows: Sequence[Rows],
    sd: Sequence[Array],
    z: Array,
    start: Array,
    low: Array,
    scales: Array,
    steps: int,
) -> OptimizeResult:
    """Return SciPy's least-squares result for the whitened rows and the weak prior."""

    def errors(z: Array) -> Array:
        dynamics = parameters.dynamics(parameters.values(z[:-1]))
        parts = [residual(each, dynamics, z[-1]) / s for each, s in zip(rows, sd)]
        return np.concatenate([*parts, (z - start) / (PRIOR * scales)])

    def rates(z: Array) -> Array:
        return np.vstack([information_root(parameters, rows, sd, z), np.diag(1.0 / (PRIOR * scales))])

    inside = np.maximum(z, low + 1e-9 * scales)
    options = dict(bounds=(low, np.inf), x_scale=scales, max_nfev=steps)
    try:
        with np.errstate(over="ignore"):
            return least_squares(errors, inside, rates, xtol=TOLERANCE, ftol=TOLERANCE, gtol=TOLERANCE, **options)
    except ValueError as error:  # an overflow
        raise InputError(f"masses, efforts or speeds are too large or too small: {error}") from error


def information_root(parameters: Parameters, rows: Sequence[Rows], sd: Sequence[Array], z: Array) -> Array:
    """Return the Jacobian of the whitened residuals with respect to the coordinates and, last, the delay."""
    dynamics = parameters.dynamics(parameters.values(z[:-1]))
    rates = parameters.rates(z[:-1])[1]
    return np.vstack([jacobian(each, dynamics, rates) / s[:, None] for each, s in zip(rows, sd)])


def _deviations(rows: Rows, errors: Array) -> Array:
    """Return the standard deviation of each row's noise, by bins of frequency.

    Weights 1/s² from n residuals overstate the information n/(n − 2) times, and their own noise adds 2/n to the
    variance of what they weigh. Source: Kenward & Roger, Biometrics 53(3), 1997.
    """
    variance = np.empty(len(EDGES) - 1)
    for k in range(len(variance)):
        near = np.abs(rows.bin - k)
        own = near <= max(0, np.partition(near, min(FEWEST, len(near) - 1))[min(FEWEST, len(near) - 1)])
        n = np.count_nonzero(own)
        variance[k] = np.mean(errors[own] ** 2) * (n + 2.0) / max(n - 2.0, 1.0)
    return np.sqrt(np.maximum(variance, 1e-30))[rows.bin]


def _result(
    parameters: Parameters,
    rows: Sequence[Rows],
    sd: Sequence[Array],
    z: Array,
    scales: Array,
    converged: bool,
    interrupted: bool,
) -> Estimate:
    J = information_root(parameters, rows, sd, z) * scales
    strengths, directions = np.linalg.eigh(J.T @ J)
    variances = 1.0 / (np.maximum(strengths, 0.0) + PRIOR**-2)
    unseen = strengths < SEEN**-2
    reported = np.zeros((len(parameters.names) + 1, len(z)))
    reported[:-1, :-1], reported[-1, -1] = parameters.rates(z[:-1])[0], 1.0
    spread = (reported * scales) @ directions
    total = (spread**2) @ variances
    by_prior = (spread[:, unseen] ** 2) @ variances[unseen]
    values = parameters.values(z[:-1])
    sharp = np.sqrt(total[:-1]) <= SHARP * np.abs(parameters.reported(values))
    known = converged & (sharp | (by_prior <= PRIOR_SHARE * total)[:-1])
    dynamics = parameters.dynamics(values)
    shown, added = _suspects(parameters, rows, sd, z, J, directions * variances @ directions.T)
    covariance = spread @ (np.diag(variances) + directions.T @ added @ directions) @ spread.T
    misfits = [_misfit(each, residual(each, dynamics, float(z[-1])), len(z) / len(rows)) for each in rows]
    noise = np.array([np.sqrt(np.mean(residual(each, dynamics, float(z[-1])) ** 2)) for each in rows])
    return Estimate(
        x=z[:-1],
        values=values,
        covariance=covariance[:-1, :-1],
        known=known,
        unseen=directions[:-1, unseen].T,
        delay=(float(z[-1]), float(np.sqrt(covariance[-1, -1]))),
        noise=noise,
        misfits=tuple(misfits),
        suspects=shown,
        converged=converged,
        interrupted=interrupted,
    )


def _suspects(
    parameters: Parameters, rows: Sequence[Rows], sd: Sequence[Array], z: Array, J: Array, N: Array
) -> tuple[tuple[Suspect, ...], Array]:
    """Return the errors that whitened residuals r show, most probable first, and the covariance that they add.

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
    sizes, statistics = -score / power, score**2 / power
    probabilities = chi2.sf(statistics, 1)
    alarms = np.where(np.char.startswith(names, "load:"), OF_LOADS, ALARMS) / len(names)
    shown = [k for k in np.argsort(-statistics).tolist() if probabilities[k] < alarms[k]]
    moved = replaced[:, shown] * np.sqrt(sizes**2 + 1.0 / power)[shown]
    return tuple(Suspect(str(names[k]), float(sizes[k]), float(probabilities[k])) for k in shown), moved @ moved.T


def _others(joints: Sequence[str], rows: Sequence[Rows], sd: Sequence[Array], dynamics: Dynamics) -> dict[str, Array]:
    """Return the derivatives of all whitened residuals with respect to each error that is not a parameter."""
    clock = np.concatenate([stretched(each, dynamics) / s for each, s in zip(rows, sd)])
    parts = [-each.unmodelled / s[:, None] for each, s in zip(rows, sd)]
    slow = [part[:, -1] * (each.bin < SLOW) for each, part in zip(rows, parts)]
    others, begin = {"clock": clock, "filter": np.concatenate(slow)}, 0
    for each, part in zip(rows, parts):
        own = slice(begin, begin := begin + len(part))
        for name, column in zip(UNMODELLED[:-1], part.T):
            others[f"{name}:{joints[each.joint]}"] = np.zeros(len(clock))
            others[f"{name}:{joints[each.joint]}"][own] = column
    return others


def _misfit(rows: Rows, errors: Array, used: float) -> Misfit:
    """Compare slow residuals, at the frequencies of the motion, with those in the middle of the band."""
    slow, fast = rows.bin < 2, (rows.bin >= 2) & (rows.bin < 5)
    own, other = max(1.0, slow.sum() - used), max(1.0, float(fast.sum()))
    ratio = float(np.sum(errors[slow] ** 2) / own / max(np.sum(errors[fast] ** 2) / other, 1e-300))
    rms = float(np.sqrt(np.sum(errors[slow] ** 2) / len(errors)))
    effort = float(np.sqrt(np.sum(rows.tau**2) / len(errors)))
    return Misfit(rows.joint, rms, ratio, float(f_distribution.sf(ratio, own, other)), rms / max(effort, 1e-300))
