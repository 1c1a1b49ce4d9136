/* The truncated pseudo-inverse of the task Jacobian. */
#ifndef PSEUDO_INVERSE_H
#define PSEUDO_INVERSE_H

#include "internal.h"
#include "model.h"

/* result = J⁺ b, the least-squares solution of smallest norm, where J⁺ keeps as many of the largest
   singular values as the rank says; ANY_RANK keeps σ > rcond·σ_max. Returns the rank. The margin, where
   asked for, is that of rank_margin or, where positive, a lower bound of it. J and b are used as
   working memory. */
INTERNAL int apply_pseudo_inverse(double J[N_ROWS][N_JOINTS], double b[N_ROWS], double rcond,
                                  int rank, double result[N_JOINTS], double *margin);

/* Distance of the singular values next to a rank from rcond, as ratios to the largest; negative where
   the rule σ > rcond·σ_max gives another rank. */
INTERNAL double rank_margin(const double ratio[N_ROWS], double rcond, int rank);

/* The singular values of J over the largest, in descending order; 0 where all are 0. J is used as
   working memory. */
INTERNAL void singular_ratios(double J[N_ROWS][N_JOINTS], double ratio[N_ROWS]);

#endif
