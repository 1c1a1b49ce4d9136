"""Closed-form motion of the end effector.

With held inputs, and away from singularities and limits, each task axis obeys

    ẍ = xdd_des + Kd (xd_des − ẋ) + Kp (x_des − x)

With the impulse response ψ, the step response γ = ∫ψ and φ = 1 − Kp γ, the solution is

    x − x_des = φ (x₀ − x_des) + ψ ẋ₀ + γ a          a = xdd_des + Kd xd_des
    ẋ         = −Kp ψ (x₀ − x_des) + ψ' ẋ₀ + ψ a
"""

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SERIES_TERMS = 18


class Held(NamedTuple):
    """Constant inputs of m task axes: position (m), velocity (m/s), acceleration (m/s²), Kp (1/s²) and Kd (1/s)."""

    x_des: tuple[float, ...]
    xd_des: tuple[float, ...]
    xdd_des: tuple[float, ...]
    Kp: tuple[float, ...]
    Kd: tuple[float, ...]


class Responses(NamedTuple):
    """Responses of ẍ + Kd ẋ + Kp x over time, with the names of the equations above."""

    phi: Array
    psi: Array
    gamma: Array
    psi_rate: Array


def responses(t: Array, Kp: float, Kd: float) -> Responses:
    """Return the responses at times t ≥ 0 (s), which are accurate at, near and away from critical damping.

    ψ and γ are divided differences of exp(p t) over the roots p of p² + Kd p + Kp, and over 0 and
    the roots. The formulas avoid cancellation where roots are equal or 0.
    """
    half = 0.5 * Kd
    discriminant = half * half - Kp
    spread = sqrt(abs(discriminant))
    if discriminant < 0.0:
        decay = np.exp(-half * t)
        psi = decay * t * np.sinc(spread * t / np.pi)
        cosine = decay * np.cos(spread * t)
        phi, psi_rate = cosine + half * psi, cosine - half * psi
        gamma = (1.0 - phi) / Kp
        largest = sqrt(Kp)
    else:
        high = -Kp / (half + spread) if half > 0.0 else spread - half
        low = -half - spread
        psi = np.exp(high * t) * (-np.expm1(-2.0 * spread * t) / (2.0 * spread) if spread else t)
        phi, psi_rate = np.exp(high * t) - high * psi, np.exp(low * t) + high * psi
        near, far = sorted((high, low), key=abs)
        gamma = 0.5 * t * t
        if far:
            gamma = (psi - (np.expm1(near * t) / near if near else t)) / far
        largest = abs(far)
    short = largest * t < 0.5
    gamma[short] = _series(t[short], Kp, Kd)
    return Responses(phi, psi, gamma, psi_rate)


def _series(t: Array, Kp: float, Kd: float) -> Array:
    """Return γ for times that are short relative to the roots: Σ hₖ tᵏ⁺² / (k + 2)!."""
    h, before = 1.0, 0.0
    term = 0.5 * t * t
    total = np.zeros_like(t)
    for k in range(SERIES_TERMS):
        total += h * term
        h, before = -Kd * h - Kp * before, h
        term = term * t / (k + 3)
    return total


def task_error(
    x0: Sequence[float],
    xd0: Sequence[float],
    schedule: Sequence[tuple[int, Held]],
    step: float,
    steps: NDArray[np.int64],
) -> Array:
    """Return x − x_des at N communication points, N × m.

    Args:
        x0, xd0: position and velocity at the start, m and m/s, m values each.
        schedule: ascending communication points, from 0 on, and the inputs that apply from each on. At that
            point itself, the error still refers to the previous target.
        step: communication step, s.
        steps: number of communication steps before each, ascending from 0.
    """
    x, xd = np.array(x0, dtype=np.float64), np.array(xd0, dtype=np.float64)
    error = np.empty((len(steps), len(x)))
    error[steps == 0] = x - np.array(schedule[0][1].x_des)
    ends = [k for k, _ in schedule[1:]] + [int(steps[-1])]
    with np.errstate(over="ignore", invalid="ignore"):  # with negative gains, the solution overflows
        for (k, held), end in zip(schedule, ends):
            here = slice(*np.searchsorted(steps, (k, end), side="right"))
            t = (np.append(steps[here], end) - k) * float(step)  # the last time is the start of the next part
            gains = {*zip(held.Kp, held.Kd)}
            solved = {each: responses(t, *each) for each in gains}
            for i, (x_des, xd_des, xdd_des, Kp, Kd) in enumerate(zip(*held)):
                phi, psi, gamma, psi_rate = solved[Kp, Kd]
                a = xdd_des + Kd * xd_des
                e0, v0 = x[i] - x_des, xd[i]
                e = phi * e0 + psi * v0 + gamma * a
                error[here, i] = e[:-1]
                x[i] = x_des + e[-1]
                xd[i] = -Kp * psi[-1] * e0 + psi_rate[-1] * v0 + psi[-1] * a
    return error
