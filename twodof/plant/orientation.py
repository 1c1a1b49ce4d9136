"""Orientations as unit quaternions x, y, z, w, the order of ROS."""

from collections.abc import Sequence
from math import atan2, sqrt

import pinocchio as pin

from .equations import Array


def quaternion(rotation: Array) -> list[float]:
    """Return the unit quaternion of a rotation matrix, w ≥ 0."""
    x, y, z, w = pin.Quaternion(rotation).coeffs().tolist()
    return [-x, -y, -z, -w] if w < 0.0 else [x, y, z, w]


def rotation_error(target: Sequence[float], rotation: Array) -> list[float]:
    """Return log(R_des Rᵀ), the shortest rotation from R to R_des, rad about the root's axes, ≤ π.

    With the quaternion (a, w) of R_des Rᵀ it is 2 atan2(|a|, w) a/|a|. Source: Siciliano,
    Sciavicco, Villani & Oriolo, "Robotics", 2009, sections 2.6 and 3.7.3.

    Args:
        target: quaternion of R_des, of any length but 0.
        rotation: R.
    """
    largest = max(map(abs, target))  # scaling prevents overflow and underflow of the length
    ax, ay, az, aw = (component / largest for component in target)
    bx, by, bz, bw = quaternion(rotation)
    x = aw * -bx + ax * bw - ay * bz + az * by
    y = aw * -by + ay * bw - az * bx + ax * bz
    z = aw * -bz + az * bw - ax * by + ay * bx
    w = aw * bw + ax * bx + ay * by + az * bz
    sine = sqrt(x * x + y * y + z * z)
    if not sine:
        return [0.0, 0.0, 0.0]
    angle = 2.0 * atan2(sine, abs(w))
    factor = angle / sine if w >= 0.0 else -angle / sine
    return [factor * x, factor * y, factor * z]
