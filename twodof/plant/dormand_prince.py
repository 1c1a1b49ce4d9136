"""One step of Dormand–Prince 5(4), or of Heun's method, and its interpolant.

Coefficients, error norm and dense output of Dormand–Prince are those of SciPy's ``RK45``.
Sources: Dormand & Prince, J. Comp. Appl. Math. 6(1), 1980; Shampine, Math. Comp. 46, 1986.
"""

from collections.abc import Callable
from functools import lru_cache
from math import sqrt

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
State = list[float]
"""State (q, v), 2n plain floats: at this size, a call of NumPy costs more than the arithmetic."""

A = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
"""Row s weighs the derivatives of stages 0…s; the last row is the fifth-order solution."""
E = (-71 / 57600, 0.0, 71 / 16695, -71 / 1920, 17253 / 339200, -22 / 525, 1 / 40)
P = np.array(
    [
        [1, -8048581381 / 2820520608, 8663915743 / 2820520608, -12715105075 / 11282082432],
        [0, 0, 0, 0],
        [0, 131558114200 / 32700410799, -68118460800 / 10900136933, 87487479700 / 32700410799],
        [0, -1754552775 / 470086768, 14199869525 / 1410260304, -10690763975 / 1880347072],
        [0, 127303824393 / 49829197408, -318862633887 / 49829197408, 701980252875 / 199316789632],
        [0, -282668133 / 205662961, 2019193451 / 616988883, -1453857185 / 822651844],
        [0, 40617522 / 29380423, -110615467 / 29380423, 69997945 / 29380423],
    ]
)
HEUN = np.array([[1.0, -0.5, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0]])
STAGES = 6
"""Evaluations of the right-hand side in one step."""
FINEST_TOLERANCE = 2.0**-36
"""Smallest relative tolerance that shared tolerances give. At smaller ones, rounding would fail the error test."""


@lru_cache(maxsize=8)  # most steps have the same size
def _weights(step: float) -> list[list[float]]:
    """Return the rows of A and the vector E, multiplied by the step."""
    return [[step * weight for weight in row] for row in (*A, E)]


def dormand_prince(rates: Callable[[State], State], y: State, step: float, k1: State) -> tuple[State, list[State]]:
    """Take one step from y with the derivative k1; return y_new and the derivatives at the stages."""
    s2, s3, s4, s5, s6, s7, _ = _weights(step)
    (a,) = s2
    k2 = rates([u + a * p for u, p in zip(y, k1)])
    a, b = s3
    k3 = rates([u + (a * p + b * q) for u, p, q in zip(y, k1, k2)])
    a, b, c = s4
    k4 = rates([u + (a * p + b * q + c * r) for u, p, q, r in zip(y, k1, k2, k3)])
    a, b, c, d = s5
    k5 = rates([u + (a * p + b * q + c * r + d * s) for u, p, q, r, s in zip(y, k1, k2, k3, k4)])
    a, b, c, d, e = s6
    k6 = rates([u + (a * p + b * q + c * r + d * s + e * t) for u, p, q, r, s, t in zip(y, k1, k2, k3, k4, k5)])
    a, _, b, c, d, e = s7
    y_new = [u + (a * p + b * q + c * r + d * s + e * t) for u, p, q, r, s, t in zip(y, k1, k3, k4, k5, k6)]
    return y_new, [k1, k2, k3, k4, k5, k6, rates(y_new)]


def heun(
    rates: Callable[[State], State], y: State, step: float, k1: State, rtol: float, atol: float
) -> tuple[State, list[State], float]:
    """Take one step of Heun's method, of second order, with one evaluation.

    Returns:
        y_new; the derivatives for ``HEUN``, the second at the state of Euler's method; and the norm of the error of
        Euler's method.
    """
    k2 = rates([u + step * p for u, p in zip(y, k1)])
    errors = [0.5 * step * (q - p) for p, q in zip(k1, k2)]
    y_new = [u + step * p + e for u, p, e in zip(y, k1, errors)]
    ratios = [e / (atol + rtol * max(abs(u), abs(w))) for e, u, w in zip(errors, y, y_new)]
    return y_new, [k1, k2], sqrt(sum(ratio * ratio for ratio in ratios) / len(y))


def error_norm(K: list[State], y: State, y_new: State, step: float, rtol: float, atol: float) -> float:
    """Return the root mean square of error/tolerance; a step passes if it is below 1."""
    a, _, b, c, d, e, f = _weights(step)[-1]
    k1, _, k3, k4, k5, k6, k7 = K
    total = 0.0
    for old, new, p, q, r, s, t, u in zip(y, y_new, k1, k3, k4, k5, k6, k7):
        size = max(abs(old), abs(new))
        error = a * p + b * q + c * r + d * s + e * t + f * u
        ratio = error / (atol + rtol * size)
        total += ratio * ratio
    return sqrt(total / len(y))


def shared_tolerance(part: float, rtol: float) -> float:
    """Return the fraction of the tolerances that a step may use.

    Args:
        part: the step as a fraction of the time over which steps share the tolerances.
        rtol: relative tolerance.
    """
    return min(1.0, max(part, FINEST_TOLERANCE / rtol))


def interpolant(y: State, y_new: State, K: list[State], P: Array, step: float) -> Callable[[float], State]:
    """Return the dense output of a step as a function of the time within the step; P has the weights of K."""
    start, Q = np.array(y), np.array(K).T.dot(P)

    def state(passed: float) -> State:
        if passed == step:
            return y_new
        x = passed / step
        reached: State = (start + step * x * Q.dot((1.0, x, x * x, x * x * x))).tolist()
        return reached

    return state
