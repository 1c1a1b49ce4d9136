"""Nearest reachable position or pose of a link, within the limits of its joints.

    min |p(q) − p_des|² + |log(R_des R(q)ᵀ)|²   over low ≤ q ≤ high

A metre counts as a radian. SciPy's bounded least squares (trust region reflective) solves the problem from many starts.
Source: Branch, Coleman & Li, "A subspace, interior, and conjugate gradient method for large-scale bound-constrained
minimization problems", SIAM J. Sci. Comput. 21(1), 1999.
"""

from collections.abc import Sequence
from math import pi
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from .kinematics import Array, Kinematics

SCATTERED, IMPROVED = 2000, 6  # starts, and those of them that are improved
MOST_STEPS = 100  # of each start; robots of many joints converge slowly to poses out of reach
MOST_TURNS = 5000  # evaluated joints of all starts: fewer steps and starts of a robot of more than 7 joints
LONGEST = 10.0  # m: range of starts for a prismatic joint without limits
LOCKED = 1e-9  # rad or m: least range of a joint that the solver accepts
PRECISE = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-13)
EXACT = 1e-9  # m, rad: a solution within this distance of the target ends the search


class Nearest(NamedTuple):
    """Nearest reachable pose: joint positions, position in the root frame (m), and errors (m, rad)."""

    q: Array
    point: Array
    distance: float
    angle: float


def nearest(
    kinematics: Kinematics,
    link: str,
    *,
    axes: Sequence[int],
    target: Array,
    quat: Array,
    low: Array,
    high: Array,
    q: Array,
) -> Nearest:
    """Return the reachable pose of a link that is nearest to a target.

    Args:
        link: the link whose origin is compared.
        axes: root axes, 0 to 2, along which the target is given.
        target: position along the axes, m.
        quat: target orientation x, y, z, w; empty for any orientation.
        low, high: limits of the columns of q, rad or m, infinite without a limit.
        q: first initial guess of the joint positions, rad or m.
    """
    wanted = Rotation.from_quat(quat) if quat.size else None
    rows, joints = [*axes, *((3, 4, 5) if wanted else ())], [joint for _, joint in kinematics.parts(link)[0]]
    sliding = np.zeros(len(q), bool)
    for joint in joints:
        sliding[kinematics.column(joint)[0]] = joint.prismatic

    def residual(at: Array) -> Array:
        end = kinematics.end(link, at[None])
        off = end.translation[0][list(axes)] - target
        if wanted is None:
            return np.asarray(off)
        return np.concatenate([off, (Rotation.from_matrix(end.rotation[0]) * wanted.inv()).as_rotvec()])

    def slope(at: Array) -> Array:
        return np.asarray(kinematics.jacobian(link, at[None])[0][rows])

    high = np.maximum(high, low + LOCKED)
    half = np.where(sliding, LONGEST, pi)
    ends = np.where(np.isfinite(low), low, q - half), np.where(np.isfinite(high), high, q + half)
    starts = np.random.default_rng(0).uniform(*ends, (SCATTERED, len(q)))
    scattered = kinematics.end(link, starts)
    far = np.linalg.norm(scattered.translation[:, list(axes)] - target, axis=1)
    if wanted:
        far = np.hypot(far, (Rotation.from_matrix(scattered.rotation) * wanted.inv()).magnitude())
    found, left = [], MOST_TURNS // max(1, len(joints))
    width = high - low
    margin = 1e-12 * (1 + np.where(np.isfinite(width), width, 0))  # the solver must start inside the limits
    for start in [q, *starts[np.argsort(far)[:IMPROVED]]]:
        inside = np.clip(start, low + margin, high - margin)
        found.append(least_squares(residual, inside, slope, (low, high), max_nfev=min(MOST_STEPS, left), **PRECISE))
        left -= found[-1].nfev
        if found[-1].cost < 0.5 * EXACT**2 or left < 1:
            break
    best = min(found, key=lambda each: each.cost)
    end, off = kinematics.end(link, best.x[None]), residual(best.x)
    distance, angle = (float(np.linalg.norm(part)) for part in np.split(off, [len(axes)]))
    return Nearest(best.x, end.translation[0], distance, angle)
