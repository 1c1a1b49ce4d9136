"""One step of ROS34PW2, a Rosenbrock-W method of order 3(2) for stiff joint damping, and its dense output.

The method has its order with any approximation T of the Jacobian, and is L-stable for the terms in T. Here T contains
the joint damping D and q̇ = v:

    T = [ 0      1   ]        (1 − h γ T) uᵢ = h γ f(y + Σ aᵢⱼ uⱼ) + γ Σ cᵢⱼ uⱼ,    j < i
        [ 0   −M⁻¹D  ]        y_new = y + Σ mᵢ uᵢ

with M⁻¹ at y, in which joints at rest are held. The dense output of q is the cubic through the positions and velocities
at both ends. The dense output of v is a cubic with the accelerations at the ends, so that a joint begins to slip in the
right direction. If an acceleration differs by more than the tolerance from that of q's cubic, the joint is stiff. Small
errors of v become large errors of q̈. The acceleration of q's cubic then replaces it.

The error estimate is (1 − h γ T)⁻¹ Σ eᵢ uᵢ. Without the factor, the estimate of a stiff mode would be about half of its
velocity for any long step, although such a step damps the mode. The dense output does not follow the decay, so a step
with an event has to pass the test without the factor.

The stages do not damp stiff modes as y_new does, and M differs between them. The efforts D v of these modes can then
accelerate the other modes, which Σ eᵢ uᵢ does not show. Therefore rᵢ = h (kᵢ − k₁ − T Σ aᵢⱼ uⱼ), the changes of
velocities that T does not explain, must be proportional to time: rᵢ − αᵢ r_new, times the factor, has to be within the
tolerances.

Source: Rang & Angermann, "New Rosenbrock W-methods of order 3 for partial differential algebraic equations of index
1", BIT 45(4), 2005, in the form without products by T of Hairer & Wanner, "Solving ODEs II", IV.7.
"""

from collections.abc import Callable
from math import sqrt
from operator import mul

import numpy as np

from .dormand_prince import Array, State

GAMMA = 0.435866521508459
A = ((2.0,), (1.4192173174557647, -0.2592322116729697), (4.18476048231916, -0.28519201735549593, 2.294280360279042))
"""Row i has the weights of the increments u of the stages before i + 1."""
M = (*A[-1], 1.0)
C = (
    (-4.588560720558084,),
    (-4.18476048231916, 0.28519201735549593),
    (-6.368179200128358, -6.795620944466836, 2.870098604331056),
)
NODES = (0.871733043016918, 0.731579957788852, 1.0)  # times of the stages after the first
E = (0.2777499476479681, -1.403239895175999, 1.7726301276675507, 0.5)
CUBIC = np.array([[0, 0, 0, 0], [1, -2, 1, 0], [0, 3, -2, 0], [0, -1, 1, 0], [0, 0, 0, 0]], float)
"""Weights of the derivatives that ``rosenbrock`` returns, in the dense output: a cubic through both ends."""
STABLE, WORTH = 3.3, 12.0
"""Damping rate times step: up to STABLE, Dormand–Prince is stable; if the product with the largest step exceeds WORTH,
this method is cheaper.
"""


def rosenbrock(
    rates: Callable[[State], State],
    mobility: Array,
    damping: Array,
    y: State,
    step: float,
    k1: State,
    rtol: float,
    atol: float,
) -> tuple[State, list[State], float, float]:
    """Take one step from y with the derivative k1.

    Args:
        rates: ẏ at a state.
        mobility: M⁻¹ at y, n × n, with zero rows for joints at rest.
        damping: D, n values, N·m·s/rad or N·s/m.
        y: the state (q, v).
        k1: ẏ at y.
        rtol, atol: tolerances of the state.

    Returns:
        y_new; the derivatives for ``CUBIC``, the last of which is ẏ at y_new; the norm of the error, or that of the
        unexplained changes of velocities if it is larger; and the norm of the error of the dense output, in which stiff
        modes have not decayed.
    """
    n = len(damping)
    solve = np.linalg.inv(np.eye(n) + step * GAMMA * mobility * damping)
    k, at, by_T, U, TU, rest = k1, y, [0.0] * n, list[State](), list[State](), list[Array]()
    for a, c in zip((*A, ()), ((), *C)):
        columns = list(zip(*U)) or [()] * len(y)
        r = [GAMMA * (step * rate + sum(map(mul, c, u))) for rate, u in zip(k, columns)]
        u_v = solve.dot(r[n:]).tolist()
        U.append([p + step * GAMMA * s for p, s in zip(r, u_v)] + u_v)
        TU.append([(u - w) / (step * GAMMA) for u, w in zip(u_v, r[n:])])
        if a:
            at = [x + sum(map(mul, a, u)) for x, u in zip(y, zip(*U))]
            by_T = [sum(map(mul, a, u)) for u in zip(*TU)]
        else:
            at, by_T = [x + u for x, u in zip(at, U[-1])], [x + u for x, u in zip(by_T, TU[-1])]
        k = rates(at)
        rest.append(step * (np.array(k[n:]) - k1[n:] - by_T))
    y_new, k_new = at, k
    mean = [sum(map(mul, M, u)) / step for u in zip(*U)]  # a difference of states loses digits in short steps
    v, v_new = y[n:], y_new[n:]
    first, last = k1[n:], k_new[n:]
    for i, (s, p, q) in enumerate(zip(mean, v, v_new)):
        a, b = (6.0 * s - 4.0 * p - 2.0 * q) / step, (2.0 * p + 4.0 * q - 6.0 * s) / step
        tolerance = atol + rtol * max(abs(p), abs(q))
        first[i] = first[i] if p == 0.0 or step * abs(first[i] - a) <= tolerance else a
        last[i] = last[i] if step * abs(last[i] - b) <= tolerance else b
    errors = np.array([sum(map(mul, E, u)) for u in zip(*U)])
    tolerances = atol + rtol * np.maximum(np.abs(y), np.abs(y_new))
    inside = np.linalg.norm(errors / tolerances) / sqrt(len(y))
    errors[n:] = solve.dot(errors[n:])
    errors[:n] += step * GAMMA * errors[n:]
    norm = np.linalg.norm(errors / tolerances) / sqrt(len(y))
    unexplained = solve.dot(np.max([np.abs(r - node * rest[-1]) for node, r in zip(NODES, rest)], axis=0))
    other = np.linalg.norm(unexplained / tolerances[n:]) / sqrt(len(y))
    norm = max(norm, other * sqrt(other))  # it falls with h², the error with h³
    return y_new, [k1, v + first, mean, v_new + last, k_new], float(norm), float(inside)


def limiting_rate(mobility: Array, damping: Array, K: list[State], step: float, largest: float) -> float:
    """Return the rate of damping, 1/s, if a step of Dormand–Prince failed because of it, and this method is cheaper.

    Else return 0. The rate is a Rayleigh quotient of M⁻¹D at the difference of the velocities at the last two stages.
    The fastest mode dominates this difference if the step is unstable.

    Args:
        mobility, damping: as in ``rosenbrock``.
        K: derivatives at the stages of the step.
        step, largest: size of the step, and the largest permitted size, s.
    """
    change = np.subtract(K[-1], K[-2])[: len(damping)]
    effort = damping * change
    power = float(effort @ change)
    rate = float(effort @ mobility @ effort) / power if power > 0.0 else 0.0
    return rate if rate * step > STABLE and rate * largest > WORTH else 0.0
