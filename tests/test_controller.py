"""J⁺b of the controller against numpy's pinv."""

import numpy as np
import pytest

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


@pytest.mark.parametrize("m", [1, 2, 3])
def test_zero_jacobian_gives_zero(m):
    assert apply_pseudo_inverse([[0.0, 0.0]] * m, [1.0] * m, RCOND)[:2] == ([0.0, 0.0], 0)


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
