"""Terms of the derivatives of inverse dynamics as recursions over a robot's joints.

Spatial vectors are in the root's axes about the task frame's origin, where rounding errors are small for distal joints.
Motion vectors are (angular, linear), force vectors (moment, force). For each joint, s is its velocity at the unit
velocity of the independent joint that it follows, v and a are the velocity and the acceleration of the body before it,
and I, B and f are the inertia, the Coriolis matrix and the wrench of all bodies that it moves:

    ψ = v × s,   χ = a × s + v × ψ,                    I = Σ I_k,   B = Σ B_k,   f = Σ (I_k a_k + v_k ×* I_k v_k)
    ∂τ_i/∂q_j = sᵢᵀ (2 B_i ψ_j + I_i χ_j)              ∂τ_j/∂q_i = sⱼᵀ (2 B_i ψ_i + I_i χ_i + sᵢ ×* f_i)
    ∂τ_i/∂v_j = 2 sᵢᵀ (B_i s_j + I_i ψ_j)              ∂τ_j/∂v_i = 2 sⱼᵀ (B_i s_i + I_i ψ_i)

for a joint j before i or i itself. Source: Singh, Russell & Wensing, "Efficient analytical derivatives of rigid-body
dynamics using spatial vector algebra", IEEE RA-L 7(2), 2022, for joints of one degree of freedom.
"""

from collections.abc import Sequence

import numpy as np

from .bodies import Array, Body, JointTree, cross
from .recursions import placements


def joint_motions(robot: JointTree, joint: Array, v: Array, a: Array, gravity: Array) -> list[Array]:
    """Return s, ψ, χ, and velocity and acceleration after each joint (N × 6), rotations and origins of its frame.

    Gravity is an upward acceleration of the root.
    """
    local, offsets = placements(robot, joint)
    follows = (robot.G != 0.0).astype(float)
    rates, accelerations, ratios = follows.dot(v), follows.dot(a), robot.G.sum(axis=1)
    rotations: list[Array] = []
    origins: list[Array] = []
    for R, p, parent in zip(local, offsets, robot.parent):
        before = rotations[parent] if parent >= 0 else np.eye(3)
        rotations.append(before.dot(R))
        origins.append((origins[parent] if parent >= 0 else np.zeros(3)) + before.dot(p))
    end = robot.path[-1]
    x = origins[end] + rotations[end].dot(robot.frame_p)
    motions: list[tuple[Array, ...]] = []
    root = np.array([0.0, 0.0, 0.0, *-gravity])
    for i, parent in enumerate(robot.parent):
        origins[i] = origins[i] - x
        z, zero = rotations[i][:, 2] * ratios[i], np.zeros(3)
        s = np.array([*zero, *z] if robot.prismatic[i] else [*z, *cross(origins[i], z)])
        velocity, acceleration = motions[parent][3:] if parent >= 0 else (np.zeros(6), root)
        psi = _motion_cross(velocity, s)
        chi = _motion_cross(acceleration, s) + _motion_cross(velocity, psi)
        motions.append((s, psi, chi, velocity + s * rates[i], acceleration + psi * rates[i] + s * accelerations[i]))
    return [*map(np.array, zip(*motions)), np.array(rotations), np.array(origins)]


Load = tuple[Body, Array, Array, Array]
"""A body or several rigidly joined ones: inertia in the root's axes, momentum p, angular block of B, and wrench f."""


def joint_force(body: Body, motions: Sequence[Array], beyond: Load) -> tuple[Load, list[Array]]:
    """Return the load of a joint, and its terms: Bᵀs (its linear part is 0), I s, and the two wrenches above.

    For a body with the momentum p, the first moment d and the inertia J about the origin, B maps an angular velocity w
    to the moment and the force

        ω × (J − tr J/2) w − d × (v × w),   w × p
    """
    s, psi, chi, velocity, acceleration, R, origin = motions
    own, omega, linear = body.moved(R, origin), velocity[:3], velocity[3:]
    J, d, momentum = own.inertia, own.moment, _inertial(own, velocity)[3:]
    half = J - np.eye(3) * (0.5 * (J[0, 0] + J[1, 1] + J[2, 2]))
    own_B = np.array([cross(omega, column) for column in half]).T - np.outer(linear, d) + np.eye(3) * d.dot(linear)
    wrench = _inertial(own, acceleration) + _coriolis(own_B, momentum, omega)
    b, p, B, f = load = own + beyond[0], momentum + beyond[1], own_B + beyond[2], wrench + beyond[3]
    z, linear = s[:3], s[3:]
    crossed = np.array([*(cross(z, f[:3]) + cross(linear, f[3:])), *cross(z, f[3:])])
    by_q = _coriolis(B, p, psi) * 2.0 + _inertial(b, chi) + crossed
    by_v = (_coriolis(B, p, s) + _inertial(b, psi)) * 2.0
    return load, [B.T.dot(z) + cross(p, linear), _inertial(b, s), by_q, by_v]


def _motion_cross(m: Array, s: Array) -> Array:
    return np.array([*cross(m[:3], s[:3]), *(cross(m[:3], s[3:]) + cross(m[3:], s[:3]))])


def _inertial(b: Body, m: Array) -> Array:
    return np.array([*(b.inertia.dot(m[:3]) + cross(b.moment, m[3:])), *(m[3:] * b.mass + cross(m[:3], b.moment))])


def _coriolis(B: Array, p: Array, m: Array) -> Array:
    return np.array([*B.dot(m[:3]), *cross(m[:3], p)])
