"""A robot's constants in Denavit-Hartenberg frames, compared with Pinocchio."""

import numpy as np
import pinocchio as pin
import pytest
from native_models import model

from twodof.export.bodies import joint_tree
from twodof.export.recursions import hybrid_by_factors, hybrid_by_recursion, inverse_dynamics, mass_matrix, task_frame
from twodof.plant.robot import load_robot

TILTS = (0.0, 1e-12, 1e-7, 1e-3, 0.09, 0.11, 1.0, np.pi / 2, np.pi - 1e-9, np.pi)
"""Angles of an axis and the next: parallel, nearly so, skew, and back."""


def random_tree(rng):
    """A URDF of eight joints and two branches, with random axes and bodies."""
    parts = ['<robot name="tree"><link name="l0"/>']
    for i in range(1, 9):
        parent = i - 1 if i != 6 else 3
        kind = "prismatic" if rng.random() < 0.25 else "revolute"
        tilt, turn, axis = rng.choice(TILTS), rng.uniform(-3, 3), rng.choice(np.eye(3))
        x, y, z = rng.normal(0, 0.3, 3) * rng.integers(0, 2, 3)
        c = rng.normal(0, 0.1, 3)
        a, b, ab = rng.uniform(0.01, 0.05, 3)
        parts.append(
            f'<link name="l{i}"><inertial><origin xyz="{c[0]} {c[1]} {c[2]}" rpy="1 2 {turn}"/>'
            f'<mass value="{rng.uniform(0.5, 3)}"/><inertia ixx="{a + ab}" iyy="{b + ab}" '
            f'izz="{a + b}" ixy="0.001" ixz="0.002" iyz="-0.001"/></inertial></link>'
            f'<joint name="j{i}" type="{kind}"><parent link="l{parent}"/><child link="l{i}"/>'
            f'<origin xyz="{x} {y} {z}" rpy="{tilt} 0 {turn}"/>'
            f'<axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>'
            '<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>'
        )
    parts.append('<link name="end"/><joint name="fix" type="fixed"><parent link="l5"/>')
    return "".join(parts) + '<child link="end"/><origin xyz=".1 .2 .3" rpy="1 .5 2"/></joint></robot>'


@pytest.mark.parametrize("seed", range(30))
def test_dynamics_agree_with_pinocchio_for_any_axes(seed):
    rng = np.random.default_rng(seed)
    robot = load_robot(random_tree(rng), "end", "xyz")
    constants, n = joint_tree(robot), len(robot.joints)
    q, v, a = rng.normal(size=(3, n))
    joint = np.array(
        [(x, 0.0) if slides else (np.cos(x), np.sin(x)) for x, slides in zip(q + constants.c, constants.prismatic)]
    )
    reference, gravity = robot.model.copy(), rng.normal(0, 9, 3)
    reference.gravity.linear = gravity
    data = reference.createData()

    def assert_close(ours, theirs):
        scale = max(1.0, np.abs(theirs).max())
        np.testing.assert_allclose(np.array(ours, dtype=float), theirs, rtol=0, atol=1e-12 * scale)

    armature = rng.uniform(0, 2, n)
    tau = inverse_dynamics(constants, constants.body, joint, armature, v, a, gravity)
    assert_close(tau, pin.rnea(reference, data, q, v, a) + armature * a)
    M = mass_matrix(constants, constants.body, joint, armature)
    expected = np.triu(pin.crba(reference, data, q))
    expected += np.triu(expected, 1).T + np.diag(armature)
    assert_close(M, expected)
    every = v, np.ones(n), np.zeros(n)
    solved = hybrid_by_factors(M, *every), hybrid_by_recursion(constants, constants.body, joint, armature, *every)
    for a, _ in solved:
        np.testing.assert_allclose(expected @ a.astype(float), v, rtol=0, atol=1e-11)
    free = rng.integers(0, 2, n)
    split = free * v, free, (1 - free) * v  # effort of free joints, acceleration of the others
    for a, reaction in (
        hybrid_by_factors(M, *split),
        hybrid_by_recursion(constants, constants.body, joint, armature, *split),
    ):
        np.testing.assert_array_equal(a[free == 0], v[free == 0])
        assert_close(reaction * free, np.zeros(n))
        balance = expected @ a.astype(float) - reaction.astype(float)
        np.testing.assert_allclose(balance, free * v, rtol=0, atol=1e-11)
    x, R, J, drift = task_frame(constants, joint, v)
    pin.forwardKinematics(reference, data, q, v, np.zeros(n))
    frame, axes = robot.frame_id, pin.LOCAL_WORLD_ALIGNED
    acceleration = pin.getFrameClassicalAcceleration(reference, data, frame, axes)
    assert_close(drift, acceleration.vector)
    assert_close(J, pin.computeFrameJacobian(reference, data, q, frame, axes))
    place = pin.updateFramePlacement(reference, data, frame)
    assert_close(x, place.translation)
    assert_close(R, place.rotation)


def test_frames_and_bodies_leave_few_constants():
    """A right angle that a URDF rounds (1.57079632679) leaves zeros zero."""
    constants = joint_tree(model("panda").robot)
    end_body = constants.path[-1]
    for i, body in enumerate(constants.body):
        if constants.prismatic[i]:
            continue
        assert not constants.R[i].all()
        if i != end_body:
            assert body.mass == body.moment[2] == body.inertia[1, 1] == 0.0
