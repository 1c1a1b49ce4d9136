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

With the modes of the damping, the method integrates the difference z from their decay (``damping``), which is exact if
M and the other accelerations stay as they are: ż = f(y(t) + z) − ẏ(t), z(0) = ż(0) = 0. Long steps then pass although
fast modes decay within them. The stages come after such a decay. Therefore the other accelerations are those after it
(``settled``). The stages do not see how M⁻¹D and the other accelerations change during it. One evaluation at the end of
the step, with the velocities δv that have decayed, estimates that effect (``unseen``):
(f(q, v + σ δq) − f(q, v) − T σ δq)/σ, with their displacement δq and σ = |δv|/|δq|.

Source: Rang & Angermann, "New Rosenbrock W-methods of order 3 for partial differential algebraic equations of index
1", BIT 45(4), 2005, in the form without products by T of Hairer & Wanner, "Solving ODEs II", IV.7.
"""

from collections.abc import Callable
from functools import partial
from math import inf, sqrt
from operator import mul

import numpy as np

from .damping import Modes
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
SHARE_UNSEEN = 0.2
"""Later steps do not see the effects of a decay before the stages either, which may have only this share of the
tolerances.
"""
Decay = Callable[[float], tuple[Array, Array]]
"""Function that returns the change of (q, v) after a time, s, and its rate there."""


def rosenbrock(
    rates: Callable[[State], State],
    mobility: Array,
    damping: Array,
    y: State,
    step: float,
    k1: State,
    rtol: float,
    atol: float,
    decay: Decay | None = None,
) -> tuple[State, list[State], float, float]:
    """Take one step from y with the derivative k1.

    Args:
        rates: ẏ at a state.
        mobility: M⁻¹ at y, n × n, with zero rows for joints at rest.
        damping: D, n values, N·m·s/rad or N·s/m.
        y: the state (q, v).
        k1: ẏ at y.
        rtol, atol: tolerances of the state.
        decay: the exact decay of modes, with ẏ = k1 at y; None for none.

    Returns:
        y_new; the derivatives for ``CUBIC``, the last of which is ẏ at y_new; the norm of the error, or that of the
        unexplained changes of velocities if it is larger; and the norm of the error of the dense output, in which stiff
        modes have not decayed.
    """
    n = len(damping)
    solve = np.linalg.inv(np.eye(n) + step * GAMMA * mobility * damping).astype(float)
    base, base_rates, by_T = [0.0] * len(y), [0.0] * len(y), [0.0] * n
    z1 = k1 if decay is None else base
    U, TU, rest, change, k, k_new = list[State](), list[State](), list[Array](), y, z1, k1
    for a, c, node in zip((*A, ()), ((), *C), (*NODES, 1.0)):
        columns = list(zip(*U)) or [()] * len(y)
        r = [GAMMA * (step * rate + sum(map(mul, c, u))) for rate, u in zip(k, columns)]
        u_v = solve.dot(r[n:]).tolist()
        U.append([p + step * GAMMA * s for p, s in zip(r, u_v)] + u_v)
        TU.append([(u - w) / (step * GAMMA) for u, w in zip(u_v, r[n:])])
        if a:
            change = [sum(map(mul, a, u)) for u in zip(*U)]
            by_T = [sum(map(mul, a, u)) for u in zip(*TU)]
        else:
            change, by_T = [x + u for x, u in zip(change, U[-1])], [x + u for x, u in zip(by_T, TU[-1])]
        if decay is not None:
            base, base_rates = (part.tolist() for part in decay(node * step))
        y_new = [x + (u + w) for x, u, w in zip(y, change, base)]
        k_new = rates(y_new)
        k = [rate - own for rate, own in zip(k_new, base_rates)]
        rest.append(step * (np.array(k[n:]) - z1[n:] - by_T))
    mean = [(u + w) / step for u, w in zip(change, base)]  # a difference of states loses digits in short steps
    derivatives = _dense_output(y, y_new, step, k1, k_new, mean, (rtol, atol))
    tolerances = atol + rtol * np.maximum(np.abs(y), np.abs(y_new))
    norm, inside = _errors(U, rest, solve, step, tolerances)
    return y_new, derivatives, norm, inside if decay is None else inf


def _errors(U: list[State], rest: list[Array], solve: Array, step: float, tolerances: Array) -> tuple[float, float]:
    """Return the two norms of ``rosenbrock``."""
    n, errors = len(solve), np.array([sum(map(mul, E, u)) for u in zip(*U)])
    inside = _norm(errors / tolerances)
    errors[n:] = solve.dot(errors[n:])
    errors[:n] += step * GAMMA * errors[n:]
    unexplained = solve.dot(np.max([np.abs(r - node * rest[-1]) for node, r in zip(NODES, rest)], axis=0))
    other = _norm(unexplained / tolerances[n:]) / sqrt(2.0)
    norm = np.maximum(_norm(errors / tolerances), other * sqrt(other))  # one falls with h³, the other with h²
    return float(norm), inside


def settled(acceleration: Callable[[State], State], modes: Modes, y: State, k1: State, step: float) -> Decay:
    """Return the decay of the modes from y, where ẏ is k1.

    All efforts but those of the damping are as after the decay of the fast modes, because that is when the stages see
    them.

    Args:
        acceleration: q̈ at a state.
    """
    n = len(modes.rate)
    share = modes.seen(step)
    falling = (1.0 - share) * (modes.VM @ k1[n:])
    fallen = np.divide(falling, modes.rate, out=np.zeros(n), where=share < 1.0) @ modes.V
    v = np.array(y[n:])
    return partial(modes.decay, v, falling + modes.VM @ acceleration([*y[:n], *(v + fallen).tolist()]))


def unseen(
    acceleration: Callable[[State], State],
    modes: Modes,
    y: State,
    K: list[State],
    y_new: State,
    step: float,
    rtol: float,
    atol: float,
) -> float:
    """Return the norm, for ``rosenbrock``'s, of the velocity changes by modes that have decayed before the stages.

    Args:
        acceleration: q̈ at a state.
        K: the derivatives of the step from y to y_new.
    """
    n = len(modes.rate)
    q, v, v_new = y_new[:n], np.array(y[n:]), np.array(y_new[n:])
    share = modes.seen(step)
    lost = (1.0 - share) * (modes.VM @ (v - v_new))
    fast, moved = lost @ modes.V, np.divide(lost, modes.rate, out=np.zeros(n), where=share < 1.0) @ modes.V
    if not moved.any():
        return 0.0
    rate = float(np.linalg.norm(fast) / np.linalg.norm(moved))
    a = np.array(acceleration([*q, *(v_new + rate * moved).tolist()]))
    change = (a - K[-1][n:]) / rate + fast  # T is −rate in each mode
    return _norm(change / (atol + rtol * np.maximum(np.abs(v), np.abs(v_new)))) / sqrt(2.0) / SHARE_UNSEEN


def _norm(ratios: Array) -> float:
    """Return the root mean square."""
    return float(np.linalg.norm(ratios)) / sqrt(len(ratios))


def _dense_output(
    y: State, y_new: State, step: float, k1: State, k_new: State, mean: State, tolerances: tuple[float, float]
) -> list[State]:
    """Return the derivatives for ``CUBIC``; mean is that of ẏ over the step."""
    n, (rtol, atol) = len(y) // 2, tolerances
    v, v_new, first, last = y[n:], y_new[n:], k1[n:], k_new[n:]
    for i, (s, p, q) in enumerate(zip(mean, v, v_new)):
        a, b = (6.0 * s - 4.0 * p - 2.0 * q) / step, (2.0 * p + 4.0 * q - 6.0 * s) / step
        tolerance = atol + rtol * max(abs(p), abs(q))
        first[i] = first[i] if p == 0.0 or step * abs(first[i] - a) <= tolerance else a
        last[i] = last[i] if step * abs(last[i] - b) <= tolerance else b
    return [k1, v + first, mean, v_new + last, k_new]


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
