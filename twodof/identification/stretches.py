"""Recorded joint states as smooth signals on an even grid: positions, their derivatives, and efforts.

A recording is divided at gaps. Positions are interpolated to an even grid. A Butterworth filter, applied forward and
backward, removes noise without a phase shift and does not change the band of the fit. A quintic spline gives the
derivatives.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..bag.recording import Recording
from ..bounds import MAX_VALUE
from ..errors import InputError, choice
from ..plant.robot import Robot
from ..plant.urdf import UNBOUNDED

Array = NDArray[np.float64]
LOG = logging.getLogger(__name__)

BAND, MOST_BAND, LEAST_BAND = 0.1, 20.0, 2.0
"""Band of the fit: fraction of the sampling rate, and upper and lower bound in Hz."""
MOST_NOISE = 3e-4  # largest share of noise in the power of accelerations; noise in regressors makes inertias too small
CUTOFF, ORDER = 2.5, 5  # cut-off of the filter of positions as a multiple of the band, and its order in one direction
GAP, FINE = 3.5, 0.01
"""Multiple of the usual time between samples that counts as a gap, and the least usual time that counts for it, s."""
SHORTEST = 2.0  # s: shortest stretch between gaps
UNEVEN = 5.0  # largest ratio of the mean time between samples to the usual one
EDGE = 0.15  # s at both ends of a stretch that are not used, because the filter has samples on one side only
HELD_OUT = 0.2  # fraction of each recording, at its end
MOVES = 3.0  # standard deviations of the velocity's noise, above which a joint moves
SPIKES = 0.01  # largest fraction of samples that are spikes
LONE, LEAST_JUMP = 10.0, 0.05
"""Ratio of a jump of the position to the steps before and after it, and the smallest jump, rad or m."""
LEAST_SPEED = 0.03  # fraction of the highest speed, below which the filter's ripple may hide that a joint rests
LEAST_RATE = 20.0  # Hz
MOST_RATE = 100.0 * MOST_BAND  # Hz: means of as many samples as keep this rate replace those of a far higher one
MIXED = 0.03  # second difference of positions between close samples, as part of their range, that shows mixed samples
WRAP = 0.1  # part of a turn by which a step without its whole turn may differ from the step before it
MOST_FITTED, MOST_HELD = 100_000, 6000
"""Samples that are fitted, and that are held out and simulated; of longer recordings, evenly spread parts are used."""
PIECE = 20_000  # samples whose regressors are in memory together
MOST_KURTOSIS, MOST_BEND = 30.0, 5.0
"""Second differences of efforts that show jumps: kurtosis (of noise 0, of a few jumps over 100), and largest one in
standard deviations of the effort. A reversal of friction alone gives at most 2.
"""


class Stretch(NamedTuple):
    """Samples without a gap on an even grid, n joints in the robot's order."""

    bag: int  # index of the recording
    t: Array  # time since the first sample of the bag, s, N
    measured: Array  # recorded positions, N × n
    q: Array  # q, v, a: smooth positions and their derivatives, N × n
    v: Array
    a: Array
    tau: Array  # recorded efforts, N × n
    moving: NDArray[np.bool_]  # whether a joint certainly moves, N × n
    band: Array  # highest frequency of the fit of each joint, Hz, n

    @property
    def step(self) -> float:
        """Time between samples, s."""
        return float(self.t[1] - self.t[0])

    def part(self, rows: slice) -> Stretch:
        """Return a part of the samples."""
        cut = {name: getattr(self, name)[rows] for name in ("t", "measured", "q", "v", "a", "tau", "moving")}
        return self._replace(**cut)


def stretches(recordings: Sequence[Recording], robot: Robot) -> tuple[list[Stretch], list[Stretch]]:
    """Return the stretches of recordings for the fit, and the held-out stretches.

    Raises:
        InputError: a recording does not fit the robot, is too short, has too low a rate, or values that are not
            finite.
    """
    fitted: list[Stretch] = []
    held: list[Stretch] = []
    for bag, recording in enumerate(recordings):
        q, tau = _columns(recording, robot)
        t, h = recording.t, float(np.median(np.diff(recording.t))) if len(recording.t) > 1 else 0.0
        name = recording.path
        if not h > 0.0:
            raise InputError(f"'{name}' has too few joint states, or several at one time")
        if (np.diff(t) == 0.0).any():
            raise InputError(f"'{name}' has several joint states at one time: are there two recordings in it?")
        q = _unwrapped(recording, robot, q)
        close, rough = np.minimum(np.diff(t)[1:], np.diff(t)[:-1]) < 0.9 * h, np.abs(np.diff(q, 2, axis=0)).max(axis=1)
        if close.any() and np.median(rough[close]) > max(MIXED * np.ptp(q, axis=0).max(), 5.0 * np.median(rough)):
            at = t[1:-1][close][rough[close].argmax()]
            raise InputError(
                f"the positions in '{name}' jump at {at:.4g} s: was the clock set back, or are there two bags?"
            )
        _check_spikes(recording, robot, q)
        if 1.0 / h < LEAST_RATE * (1.0 - 1e-6):  # stamps are rounded
            raise InputError(f"'{name}' has {1.0 / h:.3g} joint states a second; a fit needs {LEAST_RATE:g}")
        cuts = [0, *(np.flatnonzero(np.diff(t) > GAP * max(h, FINE)) + 1), len(t)]
        whole = [(a, b) for a, b in pairwise(cuts) if t[b - 1] - t[a] >= SHORTEST]
        if not whole:
            raise InputError(f"'{name}' is too short: a fit needs {SHORTEST:g} s without a gap")
        apart = max((t[b - 1] - t[a]) / (b - a - 1) for a, b in whole)
        if apart > UNEVEN * h:
            raise InputError(
                f"the time stamps in '{name}' are uneven: half of the joint states are at most {h:.3g} s after the"
                f" one before, and the mean is {apart:.3g} s; record joint states at an even rate"
            )
        end, many = t[-1] * (1.0 - HELD_OUT), max(1, int(1.0 / (MOST_RATE * h) + 1e-6))
        for a, b in whole:
            stretch = _smooth(bag, means(t[a:b], many), means(q[a:b], many), means(tau[a:b], many), many * h)
            split = int(np.searchsorted(stretch.t, end))
            for part, into in ((stretch.part(slice(split)), fitted), (stretch.part(slice(split, None)), held)):
                if len(part.t) * many * h >= 0.5 * SHORTEST:
                    into.append(part)
    if not fitted:
        raise InputError("the recordings are too short to hold a fifth out")
    for i, joint in enumerate(robot.joints):
        if not any(stretch.moving[:, i].sum() * stretch.step >= 0.5 for stretch in fitted):
            raise InputError(
                f"joint '{joint}' never moves beyond the noise of its positions: lock it with `lock`, or record it"
                " moving"
            )
    return thinned(fitted, MOST_FITTED, "for the fit"), thinned(held, MOST_HELD, "held out")


def _unwrapped(recording: Recording, robot: Robot, q: Array) -> Array:
    """Return positions in which joints without limits have no jumps of a turn; some encoders wrap at ±π.

    Such positions stay within a turn. A step is a wrap if, without a turn, it is within a tenth of a turn of the step
    before it, at equal speed.

    Raises:
        InputError: a joint with limits jumps by a turn.
    """
    late = np.diff(recording.t)
    turn, steps = 2.0 * np.pi, np.diff(q, axis=0)
    within = (np.ptp(q, axis=0) < (1.0 + WRAP) * turn) & ~np.array(robot.prismatic)
    turns = np.where(within, np.round(steps / turn), 0.0)
    speeds = (steps - turn * turns) / np.maximum(late, 1e-300)[:, None]
    before = np.vstack([speeds[:1], speeds[:-1]]) * late[:, None]
    turns[np.abs(steps - turn * turns - before) > WRAP * turn] = 0.0
    for i, joint in enumerate(robot.joints):
        jumps = np.flatnonzero(turns[:, i] * (late < GAP * np.median(late)))
        if robot.q_min[i] > -UNBOUNDED and len(jumps):
            at = recording.t[1 + jumps[0]]
            raise InputError(
                f"the position of joint '{joint}' in '{recording.path}' jumps by a turn at {at:.4g} s, but the joint"
                " has limits: correct the positions, or make the joint continuous"
            )
    return q - turn * np.vstack([np.zeros_like(q[:1]), np.cumsum(turns, axis=0)])


def _check_spikes(recording: Recording, robot: Robot, q: Array) -> None:
    """Refuse positions of which a few samples are far from the samples before and after them, or that jump once."""
    low, high = np.percentile(q, (1.0, 99.0), axis=0)
    steps = np.diff(q, axis=0)
    usual = np.percentile(np.abs(steps), 100.0 * (1.0 - 2.0 * SPIKES), axis=0)
    there_and_back = np.where(steps[1:] * steps[:-1] < 0.0, np.minimum(np.abs(steps[1:]), np.abs(steps[:-1])), 0.0)
    least = np.maximum(MIXED * (high - low), 3.0 * usual)
    spikes = there_and_back > least
    # a step that is not a gap, much larger than those before and after it, between which speeds would jump
    near = np.pad(np.abs(steps), ((1, 1), (0, 0)))
    alone = np.abs(steps) > np.maximum(np.maximum(least, LEAST_JUMP), LONE * np.maximum(near[2:], near[:-2]))
    alone &= (np.diff(recording.t) < GAP * np.median(np.diff(recording.t)))[:, None]
    for i, joint in enumerate(robot.joints):
        count = int(spikes[:, i].sum())
        if high[i] > low[i] and 0 < count <= SPIKES * len(q):
            k = int(there_and_back[:, i].argmax())
            raise InputError(
                f"the position of joint '{joint}' in '{recording.path}' jumps by {there_and_back[k, i]:.3g} and back"
                f" with the next sample, most at {recording.t[k + 1]:.4g} s, in {count} of {len(q)} samples: leave"
                " these samples out"
            )
        if alone[:, i].any():
            k = int(np.argmax(alone[:, i] * np.abs(steps[:, i])))
            raise InputError(
                f"the position of joint '{joint}' in '{recording.path}' jumps by {steps[k, i]:.3g} at"
                f" {recording.t[k + 1]:.4g} s: was its encoder reset, or are there two recordings?"
            )


def thinned(whole: Sequence[Stretch], most: int, purpose: str = "") -> list[Stretch]:
    """Return the stretches in pieces; of more samples than ``most``, the beginning of each piece.

    With a purpose, a warning states the numbers of samples.
    """
    samples, pieces = sum(len(stretch.t) for stretch in whole), []
    if samples > most and purpose:
        LOG.warning(f"of {samples} samples {purpose}, {most} are used, evenly spread in pieces")
    for stretch in whole:
        cuts = np.linspace(0, len(stretch.t), -(-len(stretch.t) // PIECE) + 1).astype(int).tolist()
        for begin, end in pairwise(cuts):
            used = min(end - begin, max(2, (end - begin) * most // samples))
            pieces.append(stretch.part(slice(begin, begin + used)))
    return pieces


def jumps(recordings: Sequence[Recording], robot: Robot) -> dict[str, float]:
    """Return the time, s, of the largest jump of the effort of each joint whose effort jumps between samples.

    The fit takes the effort between two samples as smooth, which is wrong at a jump.
    """
    from scipy.stats import kurtosis

    found = dict[str, tuple[float, float]]()
    for recording in recordings:
        t = recording.t - recording.t[0]
        used = slice(*np.searchsorted(t, (EDGE, t[-1] - EDGE)))
        tau = _columns(recording, robot)[1][used]
        for joint, effort, bends in zip(robot.joints, tau.T, np.diff(tau, 2, axis=0).T):
            largest = float(np.abs(bends).max(initial=0.0) / max(effort.std(), 1e-300))
            if largest > max(MOST_BEND, found.get(joint, (0.0, 0.0))[0]) and kurtosis(bends) > MOST_KURTOSIS:
                found[joint] = largest, float(t[used][np.abs(bends).argmax() + 1])
    return {joint: t for joint, (_, t) in found.items()}


def _columns(recording: Recording, robot: Robot) -> tuple[Array, Array]:
    """Return positions and efforts in the robot's order of joints."""
    name, own = recording.path, recording.joints
    for joint in robot.joints:
        if joint not in own:
            raise InputError(
                f"'{name}' has no joint '{joint}' of the robot{choice(joint, own)}; lock the joint with `lock`"
                " if it does not move"
            )
    order = [own.index(joint) for joint in robot.joints]
    q, tau = recording.q[:, order], recording.tau[:, order]
    for values, what in ((q, "position"), (tau, "effort")):
        if bad := np.argwhere(~(np.abs(values) <= MAX_VALUE))[:1].tolist():
            k, i = bad[0]
            where = f"joint '{robot.joints[i]}' at {recording.t[k]:g} s"
            fault = f"beyond {MAX_VALUE:g}" if np.isfinite(values[k, i]) else "not a number"
            raise InputError(f"'{name}': the {what} of {where} is {fault}: leave this joint state out")
    return q, tau


def _smooth(bag: int, t: Array, q: Array, tau: Array, h: float) -> Stretch:
    """Return smooth signals of samples without a gap."""
    from scipy.interpolate import make_interp_spline
    from scipy.signal import butter, sosfiltfilt

    grid = t[0] + h * np.arange(int((t[-1] - t[0]) / h + 1e-6) + 1)
    even = np.abs(np.diff(t) / h - 1.0).max() < 1e-3
    measured = q[: len(grid)] if even else make_interp_spline(t, q, 3)(grid)
    cutoff = CUTOFF * min(BAND / h, MOST_BAND)
    # a straight line between the ends is subtracted, so that drift is not filtered
    line = np.linspace(measured[0], measured[-1], len(grid))
    sos = butter(ORDER, cutoff, fs=1.0 / h, output="sos")
    smooth = line + sosfiltfilt(sos, measured - line, axis=0)
    spline = make_interp_spline(grid, smooth, 5)
    v, a = spline(grid, 1), spline(grid, 2)
    # white noise, without the part above the filter's cut-off
    nyquist = 0.5 / h
    noise = np.std(measured - smooth, axis=0) / np.sqrt(1.0 - cutoff / nyquist)
    v_noise = noise * 2.0 * np.pi * np.sqrt(cutoff**3 / 3.0 / nyquist)
    least = MOVES * v_noise
    moving = np.abs(v) > np.maximum(least, LEAST_SPEED * np.abs(v).max(axis=0))
    way = np.where(np.abs(spline(t, 1)) > least, np.sign(spline(t, 1)), 0.0)
    tau = tau[: len(grid)] if even else _resampled(t, tau, way, grid, np.sign(v))
    # acceleration noise below a frequency grows with the fifth power of the frequency
    a_noise = noise * (2.0 * np.pi) ** 2 * np.sqrt(cutoff**5 / 5.0 / nyquist)
    power = np.maximum(np.var(a, axis=0) - a_noise**2, 1e-12)
    band = cutoff * (MOST_NOISE * power / np.maximum(a_noise**2, 1e-300)) ** 0.2
    band = np.clip(band, LEAST_BAND, cutoff / CUTOFF)
    edge = int(np.ceil(EDGE / h))
    reach = int(np.ceil(1.0 / cutoff / h))
    whole = Stretch(bag, grid, measured, smooth, v, a, tau, _eroded(moving, reach), band)
    return whole.part(slice(edge, len(grid) - edge))


def _resampled(t: Array, tau: Array, way: Array, grid: Array, own: Array) -> Array:
    """Return efforts at times of a grid: parabolas through the three nearest samples in the same direction of motion.

    Friction jumps where a joint reverses. Interpolation across the jump gives wrong armatures.

    Args:
        t: times of the samples, N.
        tau: efforts, N × n.
        way: direction of motion at the samples, −1 or 1, or 0 where it is uncertain, N × n.
        grid: times between the first and the last sample, K.
        own: direction of motion at these times, K × n.
    """
    after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    late = t[after] - grid < grid - t[after - 1]
    nearest, other = after - ~late, after - late
    out = np.empty((len(grid), tau.shape[1]))
    for i, effort in enumerate(tau.T):
        home = np.where((way[nearest, i] != own[:, i]) & (way[other, i] == own[:, i]), other, nearest)
        cuts = np.flatnonzero(np.diff(way[:, i])) + 1
        run = np.searchsorted(cuts, home, side="right")
        first, last = np.append(0, cuts)[run], np.append(cuts, len(t))[run] - 3
        k = np.minimum(np.clip(home - 1, first, np.maximum(first, last)), len(t) - 3)
        slope = (effort[k + 1] - effort[k]) / (t[k + 1] - t[k])
        bend = ((effort[k + 2] - effort[k + 1]) / (t[k + 2] - t[k + 1]) - slope) / (t[k + 2] - t[k])
        parabola = effort[k] + (grid - t[k]) * (slope + (grid - t[k + 1]) * bend)
        known = (way[home, i] == own[:, i]) & (first <= last)
        out[:, i] = np.where(known, parabola, np.interp(grid, t, effort))
    return out


def means(values: Array, many: int) -> Array:
    """Return the means of each ``many`` consecutive samples."""
    used = len(values) // many * many
    return np.asarray(values[:used].reshape(-1, many, *values.shape[1:]).mean(axis=1)) if many > 1 else values


def _eroded(moving: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Return True for samples whose neighbours within ``reach`` all move in the same direction."""
    rests = np.pad(np.cumsum(~moving, axis=0), ((1, 0), (0, 0)))  # before each sample
    k = np.arange(len(moving))
    return np.asarray(rests[np.minimum(k + reach + 1, len(k))] == rests[np.maximum(k - reach, 0)])
