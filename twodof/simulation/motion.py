"""Motion at the end of a run: steady, moving, oscillating or diverging, with frequency and damping.

A response y'' + 2 ζ ω y' + ω² (y − y∞) = 0, sampled every h, obeys y_k = a y_{k−1} + b y_{k−2} + c exactly. Least
squares give a and b, and the roots z of z² = a z + b the poles s = ln(z) / h = −ζ ω ± i ω √(1 − ζ²). Source: Prony's
method; Hildebrand, "Introduction to Numerical Analysis", 1974, section 9.4.
"""

from math import hypot, log, pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LINEAR = 0.05  # residual, relative to the second differences, above which the motion is not linear
VISIBLE = 1e-3  # fraction of a signal's range below which swings are not counted
LASTING = 0.01  # fraction of the scale: a smaller amplitude at the end counts as rest
LASTS = 0.5  # fraction of the time that the crossings of an oscillation span at least
UNEVEN = 1e-6  # fraction of the duration by which uneven times differ from evenly spaced ones
GROWTH = 1.5  # ratio of the amplitudes in the last and the third quarter


class Ringing(NamedTuple):
    """Frequency of a damped oscillation, Hz, and its damping ratio, which is negative if the oscillation grows."""

    frequency: float
    damping: float


def ringing(t: Array, y: Array) -> Ringing | None:
    """Return the oscillation of a signal at evenly spaced times, s; None without an oscillation.

    If the motion is not linear, use crossings of the mean and the decrement of the swings.
    """
    if len(y) < 8 or not np.ptp(y) > 0.0:
        return None
    h = (t[-1] - t[0]) / (len(t) - 1)
    y = (y - y[-1]) / np.ptp(y)
    fitted = np.column_stack([y[1:-1], y[:-2], np.ones(len(y) - 2)])
    (a, b, c), *_ = np.linalg.lstsq(fitted, y[2:], rcond=None)
    bend = y[2:] - 2.0 * y[1:-1] + y[:-2]
    residual = y[2:] - fitted @ (a, b, c)
    if np.linalg.norm(residual) <= LINEAR * np.linalg.norm(bend):
        root = complex(np.roots([1.0, -a, -b])[0])
        if not root:
            return None  # the motion ends within one sample
        s = np.log(root) / h
        seen = swings(y - c / (1.0 - a - b)) if a + b != 1.0 else 0
        return Ringing(abs(s.imag) / (2 * pi), -s.real / abs(s)) if seen >= 2 and abs(s.imag) * h > 1e-9 else None
    return _by_crossings(t, y)


def swings(y: Array) -> int:
    """Count the sign changes of a signal, without swings smaller than VISIBLE."""
    size = VISIBLE * float(np.abs(y).max(initial=0.0))
    signs = np.sign(y[np.abs(y) > size])
    return int(np.count_nonzero(np.diff(signs)))


def _by_crossings(t: Array, y: Array) -> Ringing | None:
    """Return frequency and damping by the crossings of the mean in the last half, and by its swings.

    The crossings of an oscillation span half of that time at least, unlike those of a jolt at a stop.
    """
    half = len(y) // 2
    t, y = t[half:], y[half:] - np.mean(y[half:])
    k = np.flatnonzero(np.sign(y[1:]) * np.sign(y[:-1]) < 0)
    if len(k) < 3 or swings(y) < 3:
        return None
    crossed = t[k] + (t[k + 1] - t[k]) * y[k] / (y[k] - y[k + 1])
    if crossed[-1] - crossed[0] < LASTS * (t[-1] - t[0]):
        return None
    frequency = (len(k) - 1) / (2.0 * (crossed[-1] - crossed[0]))
    peaks = np.maximum.reduceat(np.abs(y), k + 1)[:-1]
    decrement = log(max(peaks[0], 1e-300) / max(peaks[-1], 1e-300)) / max(1, len(peaks) - 1)
    return Ringing(float(frequency), decrement / hypot(pi, decrement))


def motion_of(t: Array, signals: Array, scale: float) -> tuple[str, Ringing | None, int]:
    """Return the kind of motion at the end, the oscillation, and the index of the signal with the largest swing.

    Args:
        t: N times, s.
        signals: N × s errors or positions.
        scale: length of the motion, in the signals' unit.
    """
    if len(t) < 8 or not t[-1] > t[0]:
        return "steady", None, 0
    even = np.linspace(t[0], t[-1], len(t))
    if np.abs(t - even).max() > UNEVEN * (t[-1] - t[0]):  # a bag with gaps, or a downsampled one
        signals = np.column_stack([np.interp(even, t, signal) for signal in signals.T])
        t = even
    quarter = len(t) // 4
    third, last = signals[-2 * quarter : -quarter], signals[-quarter:]
    before, after = (0.5 * np.ptp(part, axis=0) for part in (third, last))
    j = int(np.argmax(after if after.max() > LASTING * scale else np.ptp(signals, axis=0)))
    found, y = ringing(t, signals[:, j]), signals[:, j]
    if after[j] <= LASTING * scale:
        return "steady", found, j
    turns = swings(last[:, j] - last[:, j].mean())
    grows = after[j] > GROWTH * before[j] and abs(y[-1]) > abs(y[-2 * quarter])
    away = abs(y[-1] - y[0]) > abs(scale) and np.abs(last[:, j]).min() >= np.abs(third[:, j]).max()
    if grows and (turns >= 3 or away):
        return "diverging", found, j
    return ("oscillating", found, j) if turns >= 3 or (found and found.damping < 0.2) else ("moving", found, j)
