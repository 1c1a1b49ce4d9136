"""Truncated pseudo-inverse of a task Jacobian.

Rows are plain lists of floats: with three rows or fewer, a call into a linear-algebra library costs more than the
arithmetic.
"""

from collections.abc import Sequence
from math import inf, sqrt

import numpy as np

WELL_CONDITIONED = 1e-3  # bound on (σ_min/σ_max)² above which the normal equations lose less than 1e-12
ORTHOGONAL = 2.0**-50
"""Two rows count as orthogonal if the cosine of their angle, or the ratio of their lengths, is below this. If the ratio
is, the shorter row is the rounding error of a linearly dependent row.
"""
VANISHING = 2.0**-43
"""Larger than the rounding errors, m or 1, in a Jacobian of a robot of 100 m. If no singular value is larger, the task
cannot move.
"""
MAX_SWEEPS = 12
PAIRS = {1: (), 2: ((0, 1),), 3: ((0, 1), (0, 2), (1, 2))}


def apply_pseudo_inverse(
    rows: list[list[float]], b: list[float], rcond: float, rank: int | None = None
) -> tuple[list[float], int, float]:
    """Return J⁺b, in which J⁺ keeps as many of the largest singular values as the given rank.

    Args:
        rows: J, m rows of n.
        b: m values.
        rcond: in [0, 1).
        rank: rank of J⁺; None keeps σ > rcond·σ_max, the rule of ``numpy.linalg.pinv``, and none where σ_max is
            rounding error.

    Returns:
        The least-squares solution of smallest norm, n values; the rank; and the rank's margin, which is
        that of ``rank_margin`` or, if positive, a lower bound of it.
    """
    smallest = max(rcond * rcond, WELL_CONDITIONED)
    if rank is not None and rank < len(rows):
        pass
    elif len(rows) == 2:
        r0, r1 = rows
        g00 = g01 = g11 = 0.0
        for x0, x1 in zip(r0, r1):
            g00, g01, g11 = g00 + x0 * x0, g01 + x0 * x1, g11 + x1 * x1
        determinant = g00 * g11 - g01 * g01
        trace = g00 + g11
        scale = trace * trace  # ≥ σ_max⁴
        if determinant > smallest * scale and trace > VANISHING**2:
            y0 = (g11 * b[0] - g01 * b[1]) / determinant
            y1 = (g00 * b[1] - g01 * b[0]) / determinant
            result = [y0 * x0 + y1 * x1 for x0, x1 in zip(r0, r1)]
            return result, 2, sqrt(determinant / scale) - rcond
    elif len(rows) == 3:
        r0, r1, r2 = rows
        g00 = g01 = g02 = g11 = g12 = g22 = 0.0
        for x0, x1, x2 in zip(r0, r1, r2):
            g00, g01, g02 = g00 + x0 * x0, g01 + x0 * x1, g02 + x0 * x2
            g11, g12, g22 = g11 + x1 * x1, g12 + x1 * x2, g22 + x2 * x2
        c00, c01, c02 = g11 * g22 - g12 * g12, g02 * g12 - g01 * g22, g01 * g12 - g02 * g11
        determinant = g00 * c00 + g01 * c01 + g02 * c02
        trace = g00 + g11 + g22
        scale = 0.25 * trace * trace * trace  # ≥ σ_1⁴ σ_2², as λ₁λ₂ ≤ (λ₁ + λ₂)²/4
        if determinant > smallest * scale and trace > VANISHING**2:
            c11, c12, c22 = g00 * g22 - g02 * g02, g01 * g02 - g00 * g12, g00 * g11 - g01 * g01
            y0 = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant
            y1 = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / determinant
            y2 = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / determinant
            result = [y0 * x0 + y1 * x1 + y2 * x2 for x0, x1, x2 in zip(r0, r1, r2)]
            return result, 3, sqrt(determinant / scale) - rcond
    rows, b = _orthogonal(list(rows), list(b))
    squares = [_dot(row, row) for row in rows]
    ratios = _ratios(squares)
    if rank is None:
        rank = sum(ratio > rcond for ratio in ratios)
    result = [0.0] * len(rows[0])
    for k in sorted(range(len(rows)), key=squares.__getitem__, reverse=True)[:rank]:
        factor = b[k] / squares[k] if squares[k] else inf
        result = [r + factor * x for r, x in zip(result, rows[k])]
    return result, rank, rank_margin(ratios, rcond, rank)


def rank_margin(ratios: Sequence[float], rcond: float, rank: int) -> float:
    """Return the smallest distance from rcond of the singular values next to a rank, relative to σ_max.

    It is negative if the rule σ > rcond·σ_max gives another rank.
    """
    margins = [1.0]
    if rank > 0:
        margins.append(ratios[rank - 1] - rcond)
    if rank < len(ratios):
        margins.append(rcond - ratios[rank])
    return min(margins)


def singular_ratios(rows: Sequence[Sequence[float]]) -> list[float]:
    """Return σ/σ_max of a matrix in descending order; all are 0 where σ_max is rounding error."""
    orthogonal, _ = _orthogonal([list(row) for row in rows], [0.0] * len(rows))
    return _ratios([_dot(row, row) for row in orthogonal])


def _ratios(squares: Sequence[float]) -> list[float]:
    largest = max(squares)
    return [sqrt(square / largest) if largest > VANISHING**2 else 0.0 for square in sorted(squares, reverse=True)]


def _orthogonal(rows: list[list[float]], b: list[float]) -> tuple[list[list[float]], list[float]]:
    """Rotate rows and b from the left until the rows are orthogonal.

    Row k becomes σ_k v_kᵀ and b_k becomes u_kᵀb, so J⁺b = Σ_k row_k b_k / |row_k|² over the
    singular values that are kept. Up to three rows by one-sided Jacobi rotations (Hestenes,
    J. SIAM 6(1), 1958), which change the arguments; more by LAPACK.
    """
    if len(rows) > 3:
        U, sigma, Vt = np.linalg.svd(rows, full_matrices=False)
        return (sigma[:, np.newaxis] * Vt).tolist(), (U.T @ b).tolist()
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
    return rows, b


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    total = 0.0
    for x, y in zip(a, b):
        total += x * y
    return total
