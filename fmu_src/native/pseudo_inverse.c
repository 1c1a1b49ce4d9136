/* The truncated pseudo-inverse of the task Jacobian; the rules and thresholds are those of plant/pseudo_inverse.py. */
#include "internal.h"

#include <math.h>

/* Bound on (σ_min/σ_max)² above which the normal equations lose less than 1e-12. */
static const double WELL_CONDITIONED = 1e-3;
/* Two rows count as orthogonal if the cosine of their angle, or the ratio of their lengths, is below 2⁻⁵⁰. If the ratio
   is, the shorter row is the rounding error of a linearly dependent row. */
static const double ORTHOGONAL = 1.0 / 1125899906842624.0;
/* m or 1: 2⁻⁴³, larger than the rounding errors in a Jacobian of a robot of 100 m. If no singular value is larger, the
   task cannot move. */
static const double VANISHING = 1.0 / 8796093022208.0;
enum { MAX_SWEEPS = 12 };

static double dot(const double a[N_JOINTS], const double b[N_JOINTS])
{
    double total = 0.0;
    for (int i = 0; i < N_JOINTS; i++)
        total += a[i] * b[i];
    return total;
}

/* y = (J Jᵀ)⁻¹ b by cofactors; false if a singular value may have to be dropped. bound, unless it is NULL, receives a
   lower bound of (σ_min/σ_max)². */
static int solve_normal_equations(double J[N_ROWS][N_JOINTS], const double b[N_ROWS],
                                  double smallest, double y[N_ROWS], double *bound)
{
#if N_ROWS == 2
    const double g00 = dot(J[0], J[0]), g01 = dot(J[0], J[1]), g11 = dot(J[1], J[1]);
    const double determinant = g00 * g11 - g01 * g01;
    const double trace = g00 + g11;
    const double scale = trace * trace; /* ≥ σ_max⁴ */
    if (!(RE(determinant) > RE(smallest * scale)) || !(RE(trace) > RE(VANISHING * VANISHING)))
        return 0;
    y[0] = (g11 * b[0] - g01 * b[1]) / determinant;
    y[1] = (g00 * b[1] - g01 * b[0]) / determinant;
    if (bound)
        *bound = determinant / scale;
    return 1;
#elif N_ROWS == 3
    const double g00 = dot(J[0], J[0]), g01 = dot(J[0], J[1]), g02 = dot(J[0], J[2]);
    const double g11 = dot(J[1], J[1]), g12 = dot(J[1], J[2]), g22 = dot(J[2], J[2]);
    const double c00 = g11 * g22 - g12 * g12, c01 = g02 * g12 - g01 * g22;
    const double c02 = g01 * g12 - g02 * g11, c11 = g00 * g22 - g02 * g02;
    const double c12 = g01 * g02 - g00 * g12, c22 = g00 * g11 - g01 * g01;
    const double determinant = g00 * c00 + g01 * c01 + g02 * c02;
    const double trace = g00 + g11 + g22;
    const double scale = 0.25 * trace * trace * trace; /* ≥ σ_max⁴ σ₂²/σ_max², as λ₁λ₂ ≤ (λ₁ + λ₂)²/4 */
    if (!(RE(determinant) > RE(smallest * scale)) || !(RE(trace) > RE(VANISHING * VANISHING)))
        return 0;
    y[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant;
    y[1] = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / determinant;
    y[2] = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / determinant;
    if (bound)
        *bound = determinant / scale;
    return 1;
#else
    (void)J, (void)b, (void)smallest, (void)y, (void)bound;
    return 0;
#endif
}

/* One-sided Jacobi: rotations from the left make the rows orthogonal, row k becomes σ_k v_kᵀ and
   b_k becomes u_kᵀ b. Source: Hestenes, J. SIAM 6(1), 1958. */
static void orthogonalise(double J[N_ROWS][N_JOINTS], double b[N_ROWS])
{
    int rotated = 1;
    for (int sweep = 0; sweep < MAX_SWEEPS && rotated; sweep++) {
        rotated = 0;
        for (int i = 0; i < N_ROWS; i++)
            for (int j = i + 1; j < N_ROWS; j++) {
                const double ii = dot(J[i], J[i]), ij = dot(J[i], J[j]), jj = dot(J[j], J[j]);
                if (!(RE(fabs(ij)) > RE(ORTHOGONAL * sqrt(ii * jj)))
                    || !(RE(ii) > RE(ORTHOGONAL * ORTHOGONAL * jj))
                    || !(RE(jj) > RE(ORTHOGONAL * ORTHOGONAL * ii)))
                    continue;
                rotated = 1;
                const double zeta = (jj - ii) / (2.0 * ij);
                const double t = 1.0 / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
                const double c = 1.0 / sqrt(1.0 + t * t);
                const double s = RE(zeta) >= 0.0 ? c * t : -c * t;
                for (int k = 0; k < N_JOINTS; k++) {
                    const double x = J[i][k], y = J[j][k];
                    J[i][k] = c * x - s * y;
                    J[j][k] = s * x + c * y;
                }
                const double bi = b[i], bj = b[j];
                b[i] = c * bi - s * bj;
                b[j] = s * bi + c * bj;
            }
    }
}

#ifdef IS_COMPLEX
/* The rows are orthogonal, but their variations are not. To first order, rotate the dropped rows out of the kept ones,
   and correct b for the rest. */
static void vary(double J[N_ROWS][N_JOINTS], double b[N_ROWS], const double square[N_ROWS], const int kept[N_ROWS])
{
    double part[N_ROWS];
    for (int i = 0; i < N_ROWS; i++)
        for (int j = 0; j < N_ROWS && kept[i]; j++) {
            if (kept[j])
                continue;
            const double t = dot(J[i], J[j]) / (square[i] - square[j]), old = b[i];
            for (int k = 0; k < N_JOINTS; k++) {
                const double x = J[i][k];
                J[i][k] += t * J[j][k];
                J[j][k] -= t * x;
            }
            b[i] += t * b[j];
            b[j] -= t * old;
        }
    for (int k = 0; k < N_ROWS; k++)
        part[k] = kept[k] ? b[k] / square[k] : 0.0;
    for (int i = 0; i < N_ROWS; i++)
        for (int j = 0; j < N_ROWS; j++)
            if (i != j)
                b[i] -= dot(J[i], J[j]) * part[j];
}
#endif

/* σ/σ_max of orthogonal rows in descending order, all 0 where σ_max is rounding error; index has the rank order of the
   rows. */
static void sort_rows(double J[N_ROWS][N_JOINTS], double square[N_ROWS], double ratio[N_ROWS], int index[N_ROWS])
{
    double largest = 0.0;
    for (int k = 0; k < N_ROWS; k++) {
        square[k] = dot(J[k], J[k]);
        largest = fmax(largest, square[k]);
        index[k] = 0;
        for (int j = 0; j < k; j++)
            index[RE(square[j]) < RE(square[k]) ? j : k]++;
    }
    for (int k = 0; k < N_ROWS; k++)
        ratio[index[k]] = RE(largest) > RE(VANISHING * VANISHING) ? sqrt(square[k] / largest) : 0.0;
}

/* Distance of the singular values next to a rank from rcond, as ratios to the largest; negative if the rule σ >
   rcond·σ_max gives another rank. */
INTERNAL double rank_margin(const double ratio[N_ROWS], double rcond, int rank)
{
    double margin = 1.0;
    if (rank > 0)
        margin = ratio[rank - 1] - rcond;
    if (rank < N_ROWS && RE(rcond - ratio[rank]) < RE(margin))
        margin = rcond - ratio[rank];
    return margin;
}

/* y of J⁺ b = Jᵀ y; makes the rows of J orthogonal and rotates b. Other arguments as in apply_pseudo_inverse. */
static int solve_by_singular_values(double J[N_ROWS][N_JOINTS], double b[N_ROWS], double rcond,
                                    int rank, double y[N_ROWS], double *margin)
{
    double square[N_ROWS], ratio[N_ROWS];
    int index[N_ROWS], kept[N_ROWS];
    orthogonalise(J, b);
    sort_rows(J, square, ratio, index);
    if (rank == ANY_RANK)
        for (rank = 0; rank < N_ROWS && RE(ratio[rank]) > RE(rcond);)
            rank++;
    if (margin)
        *margin = rank_margin(ratio, rcond, rank);
    for (int k = 0; k < N_ROWS; k++)
        kept[k] = index[k] < rank;
#ifdef IS_COMPLEX
    vary(J, b, square, kept);
#endif
    for (int k = 0; k < N_ROWS; k++)
        y[k] = kept[k] ? b[k] / square[k] : 0.0;
    return rank;
}

/* result = J⁺ b, the least-squares solution of smallest norm. J⁺ keeps as many of the largest singular values as the
   rank says; ANY_RANK keeps σ > rcond·σ_max. Returns the rank. The margin, unless it is NULL, is that of rank_margin
   or, if positive, a lower bound of it. J and b are working memory. */
INTERNAL int apply_pseudo_inverse(double J[N_ROWS][N_JOINTS], double b[N_ROWS], double rcond, int rank,
                                  double result[N_JOINTS], double *margin)
{
    const double smallest = fmax(rcond * rcond, WELL_CONDITIONED);
    double y[N_ROWS];
    if ((rank == ANY_RANK || rank == N_ROWS)
        && solve_normal_equations(J, b, smallest, y, margin)) {
        rank = N_ROWS;
        if (margin)
            *margin = sqrt(*margin) - rcond;
    } else {
        rank = solve_by_singular_values(J, b, rcond, rank, y, margin);
    }
    for (int i = 0; i < N_JOINTS; i++) {
        result[i] = y[0] * J[0][i];
        for (int k = 1; k < N_ROWS; k++)
            result[i] += y[k] * J[k][i];
    }
    return rank;
}

/* σ/σ_max of J in descending order; all are 0 where σ_max is rounding error. J is working memory. */
INTERNAL void singular_ratios(double J[N_ROWS][N_JOINTS], double ratio[N_ROWS])
{
    double nothing[N_ROWS] = {0}, square[N_ROWS];
    int index[N_ROWS];
    orthogonalise(J, nothing);
    sort_rows(J, square, ratio, index);
}
