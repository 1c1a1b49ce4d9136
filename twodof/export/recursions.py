"""Kinematics and dynamics of a robot as recursions over its joints.

They work with arrays of numbers or of expressions (``straight_line``). Numbers give a value, expressions give the C
code that computes it. Vectors and matrices of a body are in the frame of its joint, whose axis is z.
"""

from collections.abc import Sequence

import numpy as np

from .bodies import Array, Body, JointTree, Scalar, cross, symmetric


def placements(robot: JointTree, joint: Array) -> tuple[list[Array], list[Array]]:
    """Return R(q), p(q) of each joint's frame in its parent's: a = R b + p.

    ``joint`` is N × 2: cosine and sine of a revolute joint's angle, or the displacement of a prismatic joint.
    """
    rotations, origins = [], []
    for R, p, slides, (c, s) in zip(robot.R, robot.p, robot.prismatic, joint):
        if slides:
            rotations.append(R)
            origins.append(p + R[:, 2] * c)
        else:
            x, y, z = R.T
            rotations.append(np.array([x * c + y * s, y * c - x * s, z]).T)
            origins.append(p)
    return rotations, origins


def task_frame(robot: JointTree, joint: Array, v: Array) -> tuple[Array, Array, Array, Array]:
    """Return x (3), R (3 × 3), J (6 × n: linear, angular) and J̇ v (6) of the task frame in the root's axes.

        J_i = z_i × (x − o_i), or z_i for a prismatic joint;   ω_i = ω_p + z_i v_i for a revolute joint
        J̇ v = Σ (ω_p + ω_i) × J_i v_i,   and of the angular rows Σ ω_p × z_i v_i

    Source: Siciliano, Sciavicco, Villani & Oriolo, "Robotics", 2009, sections 3.1 and 7.3; the
    sum over the joints is the acceleration there for q̈ = 0.
    """
    rotations, origins = placements(robot, joint)
    rates = robot.G.dot(v)
    R: Array = np.eye(3)
    x = omega = alpha = a = np.zeros(3)
    axes, positions = [], []
    for i in robot.path:
        x = x + R.dot(origins[i])
        R = R.dot(rotations[i])
        axes.append(R[:, 2])
        positions.append(x)
    x = x + R.dot(robot.frame_p)
    columns = np.zeros((len(robot.parent), 6), dtype=object)
    for i, z, o in zip(robot.path, axes, positions):
        before, turning = omega, z * rates[i]
        if robot.prismatic[i]:
            columns[i, :3] = z
        else:
            columns[i] = [*cross(z, x - o), *z]
            alpha, omega = alpha + cross(omega, turning), omega + turning
        a = a + cross(before + omega, columns[i, :3] * rates[i])
    return x, R.dot(robot.frame_R), columns.T.dot(robot.G), np.array([*a, *alpha])


def inverse_dynamics(
    robot: JointTree, body: Sequence[Body], joint: Array, armature: Array, v: Array, a: Array, gravity: Array
) -> Array:
    """Return τ = M(q) a + h(q, v): motion outwards, forces inwards.

        f = m a + α × d + ω × (ω × d),   n = I α + ω × I ω + d × a     with d = m c

    Gravity enters as an upward acceleration of the root. Source: Luh, Walker & Paul, "On-line
    computational scheme for mechanical manipulators", ASME J. Dyn. Sys. 102(2), 1980.
    """
    rotations, origins = placements(robot, joint)
    rates, accelerations = robot.G.dot(v), robot.G.dot(a)
    zero = np.zeros(3)
    motions: list[tuple[Array, Array, Array]] = []
    force, moment = [], []
    for i, parent in enumerate(robot.parent):
        omega, alpha, linear = motions[parent] if parent >= 0 else (zero, zero, -gravity)
        R, p = rotations[i], origins[i]
        linear = linear + cross(alpha, p) + cross(omega, cross(omega, p))
        omega, alpha, linear = (R.T.dot(each) for each in (omega, alpha, linear))
        coriolis = np.array([omega[1] * rates[i], -omega[0] * rates[i], 0.0])
        along = np.array([0.0, 0.0, 1.0])
        if robot.prismatic[i]:
            linear = linear + 2.0 * coriolis + along * accelerations[i]
        else:
            alpha = alpha + coriolis + along * accelerations[i]
            omega = omega + along * rates[i]
        motions.append((omega, alpha, linear))
        b = body[i]
        f = linear * b.mass + cross(alpha, b.moment) + cross(omega, cross(omega, b.moment))
        n = b.inertia.dot(alpha) + cross(omega, b.inertia.dot(omega)) + cross(b.moment, linear)
        force.append(f)
        moment.append(n)
    tau = np.zeros(len(robot.parent), dtype=object)
    for i in reversed(range(len(robot.parent))):
        parent = robot.parent[i]
        tau[i] = (force if robot.prismatic[i] else moment)[i][2]
        if parent >= 0:
            f = rotations[i].dot(force[i])
            force[parent] = force[parent] + f
            moment[parent] = moment[parent] + rotations[i].dot(moment[i]) + cross(origins[i], f)
    effort: Array = robot.G.T.dot(tau) + armature * a
    return effort


def effort_bounds(
    robot: JointTree, body: Sequence[Body], joint: Array, armature: Array, v: Array, a: Array, gravity: Array
) -> Array:
    """Return upper bounds of |τ| by the recursion of ``inverse_dynamics``, with norms instead of vectors.

    |x × y| ≤ |x| |y|, |I x| ≤ ‖I‖ |x| with Frobenius' norm, |x + y| ≤ |x| + |y|.
    """
    rates, accelerations = np.abs(robot.G.dot(v)), np.abs(robot.G.dot(a))
    reach = [_length(p) + (abs(c) if slides else 0.0) for p, slides, (c, _) in zip(robot.p, robot.prismatic, joint)]
    motions: list[tuple[Scalar, Scalar, Scalar]] = []
    force, moment = [], []
    for i, parent in enumerate(robot.parent):
        omega, alpha, linear = motions[parent] if parent >= 0 else (0.0, 0.0, _length(gravity))
        linear = linear + (alpha + omega * omega) * reach[i]
        if robot.prismatic[i]:
            linear = linear + 2.0 * omega * rates[i] + accelerations[i]
        else:
            alpha = alpha + omega * rates[i] + accelerations[i]
            omega = omega + rates[i]
        motions.append((omega, alpha, linear))
        turning, lever = alpha + omega * omega, _length(body[i].moment)
        force.append(linear * abs(body[i].mass) + turning * lever)
        moment.append(turning * _length(body[i].inertia.ravel()) + linear * lever)
    for i in reversed(range(len(robot.parent))):
        parent = robot.parent[i]
        if parent >= 0:
            force[parent] = force[parent] + force[i]
            moment[parent] = moment[parent] + moment[i] + force[i] * reach[i]
    tau = np.where(robot.prismatic, force, moment)
    bound: Array = np.abs(robot.G).T.dot(tau) + armature * np.abs(a)
    return bound


def _length(a: Array) -> Scalar:
    return np.sqrt(a.dot(a))


def mass_matrix(robot: JointTree, body: Sequence[Body], joint: Array, armature: Array) -> Array:
    """Return M(q), n × n, with the armature on its diagonal, by the composite-rigid-body algorithm.

    Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 6.2.
    """
    rotations, origins = placements(robot, joint)
    composite, n = list(body), len(robot.parent)
    M = np.zeros((n, n), dtype=object)
    for i in reversed(range(n)):
        b, slides = composite[i], robot.prismatic[i]
        f = np.array([0.0, 0.0, b.mass]) if slides else np.array([-b.moment[1], b.moment[0], 0.0])
        t = np.array([b.moment[1], -b.moment[0], 0.0]) if slides else b.inertia[:, 2]
        k = i
        while True:
            M[i, k] = M[k, i] = f[2] if robot.prismatic[k] else t[2]
            if robot.parent[k] < 0:
                break
            f, t = rotations[k].dot(f), rotations[k].dot(t)
            t = t + cross(origins[k], f)
            k = robot.parent[k]
        if robot.parent[i] >= 0:
            composite[robot.parent[i]] += b.moved(rotations[i], origins[i])
    if not np.array_equal(robot.G, np.eye(n)):  # products with G are n³
        M = robot.G.T.dot(M).dot(robot.G)
    M[np.diag_indices_from(M)] += armature
    return M


def operations_of_factors(parent: Sequence[int]) -> int:
    """Count the operations that factorise the sparse M of a tree; n³/3 for a chain."""
    ancestors: list[int] = []
    for above in parent:
        ancestors.append(ancestors[above] + 1 if above >= 0 else 0)
    return sum(count * (count + 1) for count in ancestors)


def hybrid_by_factors(M: Array, tau: Array, free: Array, held: Array) -> tuple[Array, Array]:
    """Return a and λ of M a = τ + λ: free joints have λ = 0, the others have a prescribed a.

    It factorises M = Lᵀ D L of the free joints from the last joint inwards, so that elements between branches of a tree
    stay 0. Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, sections 6.5 and 9.2.

    ``tau`` is τ at free joints, ``held`` is a at the others, and ``free`` is 1 at free joints; elsewhere they are 0.
    """
    n = len(tau)
    L, u = M.copy(), np.array(tau, dtype=object)  # rows of D L replace those of M
    a, reaction, inverse = np.zeros(n, dtype=object), np.zeros(n, dtype=object), [0.0] * n
    for k in reversed(range(n)):
        inverse[k] = free[k] / L[k, k]
        push = u[k] * inverse[k] + held[k]
        for i in reversed(range(k)):
            share = L[k, i] * inverse[k]
            for j in range(i + 1):
                L[i, j] = L[i, j] - share * L[k, j]
            u[i] = u[i] - L[k, i] * push
    for k in range(n):
        rest = u[k] - L[k, :k].dot(a[:k])
        a[k] = rest * inverse[k] + held[k]
        reaction[k] = L[k, k] * a[k] - rest
    return a, reaction


def hybrid_by_recursion(
    robot: JointTree, body: Sequence[Body], joint: Array, armature: Array, tau: Array, free: Array, held: Array
) -> tuple[Array, Array]:
    """Return a and λ as ``hybrid_by_factors`` does, by articulated bodies without mimic joints.

        n = A α + B a,  f = Bᵀ α + C a                    wrench at a joint, inwards
        U = I s,  D = sᵀ U + armature,  u = τ − sᵀ b,  I − U Uᵀ/D,  b + U u/D      to the parent
        q̈ = (u − Uᵀ a)/D                                                 outwards

    There are no velocities and no gravity. A joint that is not free transmits all of I, and U q̈.
    Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, sections 7.3 and 9.2.
    """
    rotations, origins = placements(robot, joint)
    n = len(robot.parent)
    A = [b.inertia for b in body]
    B = [_skew(b.moment) for b in body]
    C = [np.eye(3) * b.mass for b in body]
    bias = [(np.zeros(3), np.zeros(3))] * n
    U: list[tuple[Array, Array]] = [bias[0]] * n
    u, D, inverse = [0.0] * n, [0.0] * n, [0.0] * n
    for i in reversed(range(n)):
        slides, parent = robot.prismatic[i], robot.parent[i]
        angular, linear = (B[i][:, 2], C[i][:, 2]) if slides else (A[i][:, 2], B[i][2])
        U[i] = angular, linear
        D[i] = U[i][slides][2] + armature[i]
        inverse[i] = free[i] / D[i]
        u[i] = tau[i] - bias[i][slides][2]
        push = u[i] * inverse[i] + held[i]
        if parent < 0:
            continue
        left = _passed_on((A[i], B[i], C[i]), slides, inverse[i], 1.0 - free[i] + armature[i] * inverse[i])
        b_angular, b_linear = bias[i]
        f = rotations[i].dot(b_linear + linear * push)
        t = rotations[i].dot(b_angular + angular * push) + cross(origins[i], f)
        bias[parent] = bias[parent][0] + t, bias[parent][1] + f
        moved = _moved_articulated(left, rotations[i], origins[i])
        A[parent], B[parent], C[parent] = (
            whole + part for whole, part in zip((A[parent], B[parent], C[parent]), moved)
        )
    a, reaction = np.zeros(n, dtype=object), np.zeros(n, dtype=object)
    motion: list[tuple[Array, Array]] = []
    for i, parent in enumerate(robot.parent):
        alpha, linear = motion[parent] if parent >= 0 else (np.zeros(3), np.zeros(3))
        linear = rotations[i].T.dot(linear + cross(alpha, origins[i]))
        alpha = rotations[i].T.dot(alpha)
        rest = u[i] - U[i][0].dot(alpha) - U[i][1].dot(linear)
        a[i] = rest * inverse[i] + held[i]
        reaction[i] = D[i] * a[i] - rest
        along = np.array([0.0, 0.0, 1.0]) * a[i]
        motion.append((alpha, linear + along) if robot.prismatic[i] else (alpha + along, linear))
    return a, reaction


def _passed_on(
    blocks: tuple[Array, Array, Array], slides: bool, inverse: Scalar, passed: Scalar
) -> tuple[Array, Array, Array]:
    """Return I − U Uᵀ/D of a body; along its axis, a free joint transmits the armature's part, a held joint all."""
    A, B, C = blocks
    angular, linear = (B[:, 2], C[:, 2]) if slides else (A[:, 2], B[2])
    left = (
        A - np.outer(angular * inverse, angular),
        B - np.outer(angular * inverse, linear),
        C - np.outer(linear * inverse, linear),
    )
    if slides:
        left[1][:, 2] = B[:, 2] * passed
        left[2][:, 2] = left[2][2] = C[:, 2] * passed
    else:
        left[0][:, 2] = left[0][2] = A[:, 2] * passed
        left[1][2] = B[2] * passed
    return left


def _moved_articulated(blocks: tuple[Array, Array, Array], R: Array, p: Array) -> list[Array]:
    """Return A, B and C in another frame, in which their own frame has the pose (R, p)."""
    A, B, C = blocks
    A, B, C = (R.dot(block).dot(R.T) for block in (A, B, C))
    A, C, P = symmetric(A), symmetric(C), _skew(p)
    G = B + P.dot(C)
    return [symmetric(A + P.dot(B.T) - G.dot(P)), G, C]


def _skew(a: Array) -> Array:
    """Return [a]×, so that [a]× b = a × b."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
