"""Terms of the derivatives of inverse dynamics as recursions over a robot's joints.

Spatial vectors are in the root's axes about the task frame's origin, where rounding errors are small for distal joints.
Motion vectors are (angular, linear), force vectors (moment, force). For each joint, s is its velocity at the unit
velocity of the independent joint that it follows. v and a are the velocity and the acceleration of the body before it.
I, B and f are the inertia, the Coriolis matrix and the wrench of all bodies that it moves:

    ψ = v × s,   χ = a × s + v × ψ,                    I = Σ I_k,   B = Σ B_k,   f = Σ (I_k a_k + v_k ×* I_k v_k)
    ∂τ_i/∂q_j = sᵢᵀ (2 B_i ψ_j + I_i χ_j)              ∂τ_j/∂q_i = sⱼᵀ (2 B_i ψ_i + I_i χ_i + sᵢ ×* f_i)
    ∂τ_i/∂v_j = 2 sᵢᵀ (B_i s_j + I_i ψ_j)              ∂τ_j/∂v_i = 2 sⱼᵀ (B_i s_i + I_i ψ_i)

for a joint j before i or i itself. Source: Singh, Russell & Wensing, "Efficient analytical derivatives of rigid-body
dynamics using spatial vector algebra", IEEE RA-L 7(2), 2022, for joints of one degree of freedom.
"""

from collections.abc import Sequence

import numpy as np

from .bodies import Array, Body, Frame, JointTree, Scalar, cross


def joint_motions(robot: JointTree, joint: Array, v: Array, a: Array, gravity: Array) -> list[Array]:
    """Return s, ψ, χ, and velocity and acceleration after each joint (N × 6), rotations and origins of its frame.

    Gravity is an upward acceleration of the root.
    """
    follows = (robot.G != 0.0).astype(float)
    rates = zip(follows.dot(v), follows.dot(a))
    frames: list[Frame] = []
    for own, position, parent in zip(zip(robot.R, robot.p), joint_positions(robot, joint), robot.parent):
        frames.append(joint_frame(own, position, frames[parent] if parent >= 0 else ROOT))
    R, origin = frames[robot.path[-1]]
    x = origin + R.dot(robot.frame_p)
    frames = [(R, origin - x) for R, origin in frames]
    motions: list[list[Array]] = []
    root = [np.zeros(6), np.array([0.0, 0.0, 0.0, *-gravity])]
    for frame, ratio, rate, parent in zip(frames, joint_ratios(robot), rates, robot.parent):
        motions.append(joint_motion(frame, ratio, rate, motions[parent][3:] if parent >= 0 else root))
    return [*map(np.array, zip(*motions)), *map(np.array, zip(*frames))]


ROOT: Frame = np.eye(3), np.zeros(3)


def joint_positions(robot: JointTree, joint: Array) -> Array:
    """Return cosine, sine and displacement of each joint, N × 3."""
    return np.array([(1.0, 0.0, c) if slides else (c, s, 0.0) for (c, s), slides in zip(joint, robot.prismatic)])


def joint_ratios(robot: JointTree) -> Array:
    """Return the ratios of rotation and translation of each joint to the independent joint that it follows, N × 2."""
    slides = np.array(robot.prismatic)
    ratios: Array = np.array([~slides, slides]).T * robot.G.sum(axis=1)[:, np.newaxis]
    return ratios


def joint_frame(constant: Frame, position: Array, before: Frame) -> Frame:
    """Return a joint's frame in the root's axes; ``constant`` is its frame at 0 in the frame before it."""
    (x, y, z), p, (c, s, displacement) = constant[0].T, constant[1], position
    R, origin = before
    return R.dot(np.array([x * c + y * s, y * c - x * s, z]).T), origin + R.dot(p + z * displacement)


def joint_motion(frame: Frame, ratio: Array, rate: Sequence[Scalar], before: Sequence[Array]) -> list[Array]:
    """Return s, ψ, χ, velocity and acceleration of a joint from its rates and the motion of its parent."""
    (R, origin), (velocity, acceleration) = frame, before
    z = R[:, 2]
    angular = z * ratio[0]
    s = np.array([*angular, *(cross(origin, angular) + z * ratio[1])])
    psi = _motion_cross(velocity, s)
    chi = _motion_cross(acceleration, s) + _motion_cross(velocity, psi)
    return [s, psi, chi, velocity + s * rate[0], acceleration + psi * rate[0] + s * rate[1]]


Load = tuple[Body, Array, Array, Array]
"""A body or several rigidly joined ones: inertia in the root's axes, momentum p, angular block of B, and wrench f."""


def joint_force(body: Body, motions: Sequence[Array], beyond: Load) -> tuple[Load, list[Array]]:
    """Return the load of a joint, and its terms: Bᵀs, whose linear part is 0, I s, and the two wrenches above.

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
