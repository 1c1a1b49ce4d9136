"""Maximum-likelihood estimate of free parameters, and its covariance."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from ..errors import InputError
from .model_tests import LEAST_NOISE, Hold, Misfit, Suspect, holds_of, misfit_of, suspects_of
from .parameters import SEEN, Parameters, Values
from .regression import EDGES, Rows, information_root, residual, rows_of
from .stretches import Array, Stretch

PRIOR = 3.0  # standard deviation, in scales, of the weak prior, which fixes directions that the data do not determine
TOLERANCE, STEPS, LAST_STEPS = 1e-8, 15, 40
"""Relative tolerance of a solution, and its most steps, before the last estimate of noise and after it."""
PASSES, FIRST_NOISE = 6, 0.02
"""Number of estimates of the noise variances, and the initial noise, as a fraction of the efforts."""
DELAY_SCALE, LARGEST_SHIFT = 0.02, 5e-4  # scale of the delay, and its largest change without new rows, s
LARGEST_TURN = 0.01  # rad or m: largest change of an offset after the last linearisation of the rows
FEWEST = 20  # rows for the estimate of a bin's noise
PROPORTIONAL = np.linspace(0.0, 0.95, 20)  # parts of the noise's variance that grow with the square of the effort
PRIOR_SHARE = 0.1  # share of the prior in the variance of a value, above which the data do not determine the value
SHARP = 0.05  # standard deviation relative to a value, below which the data determine it whatever the prior's share
NORMAL_95 = 1.959964


class Estimate(NamedTuple):
    """Result of an estimation of p coordinates and the delay."""

    x: Array  # coordinates, p
    values: Values  # physical values
    covariance: Array  # covariance of the reported values, r × r, with the prior
    known: NDArray[np.bool_]  # whether the data determine each reported value, r
    unseen: Array  # directions that the data do not determine, in scales, directions × p
    delay: tuple[float, float]  # delay of recorded efforts, s, and its standard deviation
    noise: Array  # standard deviation of the efforts' noise, N·m or N, n
    misfits: tuple[Misfit, ...]  # comparison of residuals for each joint
    suspects: tuple[Suspect, ...]  # errors that the residuals show, the most probable one first
    # for each joint that rests under more than its friction, the stretch with the largest excess
    holds: tuple[Hold, ...]
    # change of each reported value, in its standard deviations, by constant errors of the efforts that these data
    # cannot show, r
    fragile: Array
    converged: bool  # False if the last solution still moved after its most steps; no value is known then
    interrupted: bool  # True if Ctrl-C ended the estimation


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
    for i, joint in enumerate(parameters.robot.joints):
        if i not in [each.joint for each in solution.rows]:
            raise InputError(f"joint '{joint}' reverses too often for a fit: record slower motions of it")
    try:
        finished()
        for better in solutions:
            solution = better
            finished()
    except KeyboardInterrupt:
        interrupted = True
    return _result(parameters, stretches, *solution, interrupted)


def unexplained(parameters: Parameters, stretches: Sequence[Stretch]) -> Array:
    """Return the residual power of each joint as a part of that of its efforts, or 1 if a joint has no rows, n."""
    *_, (rows, _, z, _, _) = _solutions(parameters, stretches)
    dynamics, parts = parameters.dynamics(parameters.values(z[:-1])), np.ones(len(parameters.robot.joints))
    for each in rows:
        left = np.sum(residual(each, dynamics, float(z[-1])) ** 2)
        parts[each.joint] = left / max(float(np.sum(each.tau**2)), 1e-300)
    return parts


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


def _deviations(rows: Rows, errors: Array) -> Array:
    """Return the standard deviation of each row's noise: by bins of frequency, and partly in proportion to the effort.

    The part is the most likely one.
    """
    best, most = errors, np.inf
    for part in PROPORTIONAL:
        shape = 1.0 - part + part * rows.power / np.mean(rows.power)
        least = (LEAST_NOISE * np.sqrt(np.mean(rows.tau**2))) ** 2
        variance = np.maximum(shape * _variances(rows.bin, errors**2 / shape)[rows.bin], max(least, 1e-30))
        if (loss := float(np.sum(np.log(variance)))) < most:
            best, most = np.sqrt(variance), loss
    return best


def _variances(bins: NDArray[np.int64], squares: Array) -> Array:
    """Return the variance in each bin of frequency.

    Weights 1/s² from n residuals overstate the information n/(n − 2) times, and their own noise adds 2/n to the
    variance of what they weigh. Source: Kenward & Roger, Biometrics 53(3), 1997.
    """
    variance = np.empty(len(EDGES) - 1)
    for k in range(len(variance)):
        near = np.abs(bins - k)
        own = near <= max(0, np.partition(near, min(FEWEST, len(near) - 1))[min(FEWEST, len(near) - 1)])
        n = np.count_nonzero(own)
        variance[k] = np.mean(squares[own]) * (n + 2.0) / max(n - 2.0, 1.0)
    return variance


def _result(
    parameters: Parameters,
    stretches: Sequence[Stretch],
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
    N, root = directions * variances @ directions.T, reported[:-1] * scales
    shown, added, by_bias = suspects_of(parameters, rows, sd, z, J, N)
    covariance = spread @ (np.diag(variances) + directions.T @ added @ directions) @ spread.T
    misfits = [misfit_of(each, residual(each, dynamics, float(z[-1])), len(z) / len(rows)) for each in rows]
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
        holds=tuple(holds_of(parameters, stretches, rows, sd, z, scales, N)) if converged else (),
        fragile=NORMAL_95 * np.sqrt(np.einsum("ij,jk,ik->i", root, by_bias, root) / total[:-1]),
        converged=converged,
        interrupted=interrupted,
    )
