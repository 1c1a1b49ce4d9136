"""The truncated pseudo-inverse of a task Jacobian.

With three rows or fewer a call into a linear-algebra library costs more than the arithmetic, so
rows are plain lists of floats.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np

WELL_CONDITIONED = 1e-3
"""Bound on (σ_min/σ_max)² above which the normal equations lose less than 1e-12."""
ORTHOGONAL = 2.0**-50
"""Rows count as orthogonal where the cosine of their angle is below this, or the ratio of their
lengths: the shorter is what rounding has left of a row that depends on others."""
MAX_SWEEPS = 12
PAIRS = {1: (), 2: ((0, 1),), 3: ((0, 1), (0, 2), (1, 2))}


def apply_pseudo_inverse(
    rows: list[list[float]], b: list[float], rcond: float
) -> tuple[list[float], int]:
    """J⁺b and the rank of J⁺, singular values σ ≤ rcond·σ_max dropped.

    The rule is that of ``numpy.linalg.pinv``.

    Args:
        rows: J, m rows of n.
        b: m values.
        rcond: in [0, 1).

    Returns:
        n values, the least-squares solution of smallest norm; and how many singular values of the
        m were not dropped.
    """
    smallest = max(rcond * rcond, WELL_CONDITIONED)
    if len(rows) == 2:
        r0, r1 = rows
        g00 = g01 = g11 = 0.0
        for x0, x1 in zip(r0, r1):
            g00, g01, g11 = g00 + x0 * x0, g01 + x0 * x1, g11 + x1 * x1
        determinant = g00 * g11 - g01 * g01
        trace = g00 + g11
        if determinant > smallest * trace * trace:  # ≤ σ_min²/σ_max²: nothing is dropped
            y0 = (g11 * b[0] - g01 * b[1]) / determinant
            y1 = (g00 * b[1] - g01 * b[0]) / determinant
            return [y0 * x0 + y1 * x1 for x0, x1 in zip(r0, r1)], 2
    elif len(rows) == 3:
        r0, r1, r2 = rows
        g00 = g01 = g02 = g11 = g12 = g22 = 0.0
        for x0, x1, x2 in zip(r0, r1, r2):
            g00, g01, g02 = g00 + x0 * x0, g01 + x0 * x1, g02 + x0 * x2
            g11, g12, g22 = g11 + x1 * x1, g12 + x1 * x2, g22 + x2 * x2
        c00, c01, c02 = g11 * g22 - g12 * g12, g02 * g12 - g01 * g22, g01 * g12 - g02 * g11
        determinant = g00 * c00 + g01 * c01 + g02 * c02
        trace = g00 + g11 + g22
        if 4.0 * determinant > smallest * trace * trace * trace:  # as λ₁λ₂ ≤ (λ₁ + λ₂)²/4
            c11, c12, c22 = g00 * g22 - g02 * g02, g01 * g02 - g00 * g12, g00 * g11 - g01 * g01
            y0 = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant
            y1 = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / determinant
            y2 = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / determinant
            return [y0 * x0 + y1 * x1 + y2 * x2 for x0, x1, x2 in zip(r0, r1, r2)], 3
    elif len(rows) > 3:
        U, sigma, Vt = np.linalg.svd(rows, full_matrices=False)
        kept = sigma > rcond * sigma[0]
        y = (U.T @ b)[kept] / sigma[kept]
        return (y @ Vt[kept]).tolist(), int(kept.sum())
    return _by_singular_values(list(rows), list(b), rcond)


def _by_singular_values(
    rows: list[list[float]], b: list[float], rcond: float
) -> tuple[list[float], int]:
    """The same by one-sided Jacobi rotations (Hestenes, J. SIAM 6(1), 1958); changes its arguments.

    Rotations from the left make the rows orthogonal: row k becomes σ_k v_kᵀ and b_k becomes
    u_kᵀb, so J⁺b = Σ_k row_k b_k / |row_k|² over the singular values that are kept.
    """
    for _ in range(MAX_SWEEPS):
        rotated = False
        for i, j in PAIRS[len(rows)]:
            ri, rj = rows[i], rows[j]
            ii, ij, jj = _dot(ri, ri), _dot(ri, rj), _dot(rj, rj)
            shorter, longer = sorted((ii, jj))
            if abs(ij) > ORTHOGONAL * sqrt(ii * jj) and shorter > ORTHOGONAL**2 * longer:
                rotated = True
                zeta = (jj - ii) / (2.0 * ij)
                t = 1.0 / (abs(zeta) + sqrt(1.0 + zeta * zeta))
                c = 1.0 / sqrt(1.0 + t * t)
                s = c * t if zeta >= 0.0 else -c * t
                rows[i] = [c * x - s * y for x, y in zip(ri, rj)]
                rows[j] = [s * x + c * y for x, y in zip(ri, rj)]
                b[i], b[j] = c * b[i] - s * b[j], s * b[i] + c * b[j]
        if not rotated:
            break
    squares = [_dot(row, row) for row in rows]
    smallest = rcond * rcond * max(squares)
    result, rank = [0.0] * len(rows[0]), 0
    for row, bk, square in zip(rows, b, squares):
        if square > smallest:
            rank += 1
            result = [r + bk / square * x for r, x in zip(result, row)]
    return result, rank


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    total = 0.0
    for x, y in zip(a, b):
        total += x * y
    return total
