"""J⁺b of the controller against numpy's pinv."""

import numpy as np
import pinocchio as pin
import pytest
from native_models import from_urdf

from twodof.plant.pseudo_inverse import apply_pseudo_inverse

RCOND = 0.01


def with_singular_values(rng, m, n, singular_values):
    u, _ = np.linalg.qr(rng.normal(size=(m, m)))
    v, _ = np.linalg.qr(rng.normal(size=(n, n)))
    k = min(m, n)
    return u[:, :k] * np.asarray(singular_values[:k]) @ v[:, :k].T


@pytest.mark.parametrize("m, n", [(1, 1), (1, 3), (2, 1), (2, 2), (2, 6), (3, 2), (3, 3), (3, 7)])
def test_equals_pinv_for_any_conditioning(m, n):
    rng = np.random.default_rng(10 * m + n)
    for _ in range(300):
        # from well to badly conditioned, but never so near to the cut that rounding decides
        ratios = 10 ** rng.uniform(-4, 0, size=m)
        ratios[np.abs(ratios / RCOND - 1) < 1e-3] = 1.0
        ratios[0] = 1.0
        jacobian = with_singular_values(rng, m, n, rng.uniform(0.1, 2.0) * ratios)
        b = rng.normal(size=m)
        expected = np.linalg.pinv(jacobian, rcond=RCOND) @ b
        result, rank, margin = apply_pseudo_inverse(jacobian.tolist(), b.tolist(), RCOND)
        sigma = np.linalg.svd(jacobian, compute_uv=False)
        assert rank == (sigma > RCOND * sigma[0]).sum()
        assert 0.0 < margin <= np.abs(sigma[1:] / sigma[0] - RCOND).min(initial=1.0) + 1e-12
        scale = max(1.0, np.abs(expected).max())
        assert np.abs(result - expected).max() <= 1e-11 * scale


@pytest.mark.parametrize("m, n", [(2, 2), (2, 6), (3, 3), (3, 7), (6, 7)])
def test_a_given_rank_keeps_the_largest_singular_values(m, n):
    rng = np.random.default_rng(m * n)
    for rank in range(m + 1):
        ratios = np.sort(10 ** rng.uniform(-2.5, 0, size=m))[::-1]
        ratios[0] = 1.0
        jacobian, b = with_singular_values(rng, m, n, ratios), rng.normal(size=m)
        u, sigma, vt = np.linalg.svd(jacobian, full_matrices=False)
        expected = vt[:rank].T @ ((u.T @ b)[:rank] / sigma[:rank])
        result, same, margin = apply_pseudo_inverse(jacobian.tolist(), b.tolist(), RCOND, rank)
        assert same == rank and np.abs(result - expected).max() <= 1e-10
        assert (margin >= 0.0) == (rank == (ratios > RCOND).sum())


@pytest.mark.parametrize("m", [1, 2, 3, 6])
@pytest.mark.parametrize("error", [0.0, 1e-16])
def test_a_jacobian_that_is_zero_but_for_rounding_errors_gives_zero(m, error):
    jacobian = error * np.random.default_rng(m).normal(size=(m, 7))
    assert apply_pseudo_inverse(jacobian.tolist(), [1.0] * m, RCOND)[:2] == ([0.0] * 7, 0)


def test_a_task_across_the_plane_of_an_arm_commands_no_motion():
    """A wall, written as 1.5707963267948966 rad, leaves a Jacobian of 1e-17 m: the effort is Pinocchio's weight."""
    body = (
        '<inertial><origin xyz="0.1 0 0"/><mass value="1"/>'
        '<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    joint = '<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="50" velocity="9"/>'
    urdf = (
        f'<robot name="wall"><link name="base"/><link name="a">{body}</link><link name="b">{body}</link>'
        f'<link name="tip"/><joint name="j1" type="revolute"><parent link="base"/><child link="a"/>{joint}'
        '<origin xyz="0 0 0.3" rpy="1.5707963267948966 0 0"/></joint>'
        f'<joint name="j2" type="revolute"><parent link="a"/><child link="b"/>{joint}<origin xyz="0.2 0 0"/></joint>'
        '<joint name="e" type="fixed"><parent link="b"/><child link="tip"/><origin xyz="0.2 0 0"/></joint></robot>'
    )
    plant = from_urdf(urdf, "tip", "y").plant()
    plant.q, plant.x_des = [0.1, 0.2], [0.05]
    reference = pin.buildModelFromXML(urdf)
    weight = pin.computeGeneralizedGravity(reference, reference.createData(), np.array(plant.q))
    np.testing.assert_allclose(plant.tau, weight, rtol=1e-12)
    plant.step(0.1)
    assert plant.q == [0.1, 0.2]


def test_rcond_zero_keeps_every_singular_value():
    result, *_ = apply_pseudo_inverse([[1.0, 0.0], [0.0, 1e-6]], [1.0, 1.0], 0.0)
    assert result == pytest.approx([1.0, 1e6], rel=1e-12)


def test_a_singular_value_at_the_cut_is_dropped():
    # numpy keeps σ > rcond·σ_max only
    assert apply_pseudo_inverse([[1.0, 0.0], [0.0, 0.25]], [1.0, 1.0], 0.25)[:2] == ([1.0, 0.0], 1)


def test_arguments_are_left_alone():
    rows, b = [[1.0, 1.0], [1.0, 1.0 + 1e-4]], [1.0, 2.0]
    apply_pseudo_inverse(rows, b, RCOND)
    assert rows == [[1.0, 1.0], [1.0, 1.0 + 1e-4]]
    assert b == [1.0, 2.0]
