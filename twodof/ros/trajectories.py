"""Joint trajectories as inputs of an FMU.

Between two points, the position of a joint is a polynomial. The fields that both points have determine its degree:

    positions                               q(s) = Σ cᵢ sⁱ, linear
    positions, velocities                   cubic
    positions, velocities, accelerations    quintic

After the last point, the joint rests there. Inputs are held over a communication step; their value is the mean over the
step, so that the robot does not lag by half a step.

Source: ros2_controllers, joint_trajectory_controller, "Trajectory Representation".
"""

from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from math import comb, factorial
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.polynomial.polynomial import polyder, polyval

from ..bounds import MAX_TRAJECTORY
from ..simulation.experiments import NANOSECONDS
from .cdr import Array
from .commands import CommandError, deserialise, known_joints, sized
from .messages import JOINT_TRAJECTORY

PARTS = ("positions", "velocities", "accelerations")
DEGREE = 5
ORDERS = np.arange(DEGREE + 1)
BINOMIALS = np.array([[comb(j, i) for j in ORDERS] for i in ORDERS])
FACTORIALS = np.array([factorial(i) for i in ORDERS])
HIGHER = {
    1: np.array([[1.0]]),
    2: np.array([[3.0, -1.0], [-2.0, 1.0]]),
    3: np.array([[10.0, -4.0, 0.5], [-15.0, 7.0, -1.0], [6.0, -3.0, 0.5]]),
}
"""Matrices for cᵢ Tⁱ, higher half of i, from the errors of the lower half in q, T q̇ and T² q̈ at the end T."""
NODES, WEIGHTS = leggauss(3)  # exact up to degree 5


class Trajectory(NamedTuple):
    """A trajectory of joints."""

    start: float  # start time, s
    joints: list[int]  # indices of the n joints
    times: list[float]  # times of the points, s, ascending; some may be before the start
    points: list[Array]  # position, and if given velocity and acceleration, k × n each
    unknown_joints: tuple[str, ...] = ()  # names of joints that the robot does not have


def read_trajectory(cdr: bytes, joints: Mapping[str, int], came: int, begin: int) -> Trajectory:
    """Read a JointTrajectory.

    It starts at its recording time. ``time_from_start`` of its points counts from its stamp, or from its start if the
    stamp is 0.

    Args:
        joints: indices of the robot's joints by name.
        came: recording time, ns since the epoch.
        begin: time 0 of the run, ns since the epoch.

    Raises:
        CommandError: the message cannot be decoded, is not finite, names no joint of this robot, has no points,
            has points whose times do not ascend or whose fields are incomplete, or ends before it starts.
    """
    message = deserialise(JOINT_TRAJECTORY, cdr, MAX_TRAJECTORY)
    known = known_joints(message.joint_names, joints)
    begun = message.header.stamp
    stamp = begun.sec * NANOSECONDS + begun.nanosec or came
    spans = (point.time_from_start for point in message.points)
    times = [stamp + span.sec * NANOSECONDS + span.nanosec for span in spans]
    if not times or any(late <= early for early, late in pairwise(times)):
        raise CommandError("times", "has no points, or their times do not increase")
    if (late := (came - times[-1]) / NANOSECONDS) > 0.0:
        raise CommandError("stamp", f"ends {late:.3g} s before it starts; its stamp must be 0 or of the bag's clock")
    points = []
    for point in message.points:
        count = 3 if len(point.accelerations) else 2 if len(point.velocities) else 1
        parts = [sized(getattr(point, what), what, message.joint_names) for what in PARTS[:count]]
        points.append(np.array(parts)[:, [k for _, k in known]])
    if not all(np.isfinite(point).all() for point in points):
        raise CommandError("finite", "is not finite")
    begins, *seconds = ((t - begin) / NANOSECONDS for t in (came, *times))
    unknown_joints = tuple(name for name in message.joint_names if name not in joints)
    return Trajectory(begins, [i for i, _ in known], seconds, points, unknown_joints)


class _Path:
    """Desired motion of a joint over time: polynomials, each until the next begins.

    Before them it rests at ``q``, rad or m; ``begin`` is in s.
    """

    def __init__(self, begin: float, q: float) -> None:
        self._begins, self._pieces = [begin], [np.array([q, *[0.0] * DEGREE])]

    def before(self, t: float) -> Array:
        """Return position, velocity and acceleration just before a time t > ``begin``."""
        i = bisect_left(self._begins, t) - 1
        values: Array = _moved(self._pieces[i], t - self._begins[i])[:3] * FACTORIALS[:3]
        return values

    def replace(self, begins: Sequence[float], pieces: Sequence[Array]) -> None:
        """Replace the polynomials from the first new start time on."""
        keep = bisect_left(self._begins, begins[0])
        self._begins[keep:], self._pieces[keep:] = begins, pieces

    def means(self, grid: Array) -> Array:
        """Return the means of position, velocity and acceleration between N successive times, N − 1 × 3.

        All polynomials begin within these times.
        """
        edges = np.union1d(grid, self._begins)
        spans, steps = np.diff(edges), np.searchsorted(grid, edges[:-1], "right") - 1
        times = edges[:-1, None] + spans[:, None] * (NODES + 1.0) / 2.0
        means = []
        for order in range(3):
            start = self._values(order, grid[:-1])  # the reference value, so that a joint at rest stays exactly at rest
            off = (self._values(order, times) - start[steps, None]) @ (WEIGHTS / 2.0) * spans
            total = np.add.reduceat(off, np.searchsorted(edges, grid[:-1]))
            means.append(start + total / np.diff(grid))
        return np.stack(means, axis=1)

    def _values(self, order: int, times: Array) -> Array:
        at = np.searchsorted(self._begins, times, "right") - 1
        pieces = polyder(np.stack(self._pieces, axis=1), order)[:, at]
        values: Array = polyval(times - np.asarray(self._begins)[at], pieces, tensor=False)
        return values


def follow(trajectories: Iterable[Trajectory], rest: Sequence[float], grid: Array) -> dict[int, Array]:
    """Return the motion of joints along trajectories; each joint follows the latest trajectory that names it.

    If all points of a trajectory are after its start, it begins at the desired state just before its start.

    Args:
        trajectories: trajectories in the order of their recording times.
        rest: position of each joint before the first trajectory, rad or m.
        grid: N communication points, s; the first before and the last after all trajectories.

    Returns:
        Means of position, velocity and acceleration between successive times, N − 1 × 3, by joint index.
    """
    paths: dict[int, _Path] = {}
    with np.errstate(all="ignore"):  # the inputs are checked later
        for start, joints, times, points, _ in trajectories:
            own = [paths.setdefault(i, _Path(grid[0], rest[i])) for i in joints]
            if times[0] > start:
                wanted = np.stack([path.before(start) for path in own], axis=1)
                times, points = [start, *times], [wanted, *points]
            first = max(k for k, t in enumerate(times) if t <= start)
            pieces = [
                _piece(t[1] - t[0], *ends) for t, ends in zip(pairwise(times[first:]), pairwise(points[first:]))
            ] + [np.vstack([points[-1][:1], np.zeros((DEGREE, len(joints)))])]
            pieces[0] = _moved(pieces[0], start - times[first])
            for path, own_pieces in zip(own, np.stack(pieces).transpose(2, 0, 1)):
                path.replace([start, *times[first + 1 :]], [*own_pieces])
        return {i: path.means(grid) for i, path in paths.items()}


def _piece(T: float, start: Array, end: Array) -> Array:
    """Return the polynomials of n joints between two points T apart, 6 × n."""
    k, piece = min(len(start), len(end)), np.zeros((DEGREE + 1, start.shape[1]))
    piece[:k] = start[:k] / FACTORIALS[:k, None]
    missed = end[:k] - _moved(piece, T)[:k] * FACTORIALS[:k, None]
    powers = T ** np.arange(2 * k)[:, None]
    piece[k : 2 * k] = HIGHER[k] @ (missed * powers[:k]) / powers[k:]
    return piece


def _moved(piece: Array, by: float) -> Array:
    """Return a polynomial shifted in time: q(by + s) in powers of s."""
    moved: Array = BINOMIALS * by ** np.maximum(ORDERS - ORDERS[:, None], 0) @ piece
    return moved
