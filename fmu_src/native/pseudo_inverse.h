/* The truncated pseudo-inverse of the task Jacobian. */
#ifndef PSEUDO_INVERSE_H
#define PSEUDO_INVERSE_H

#include "internal.h"
#include "model.h"

/* result = J⁺ b, singular values σ ≤ rcond·σ_max dropped: the least-squares solution of smallest
   norm. The rank: how many were not dropped. J and b are used as working memory. */
INTERNAL int apply_pseudo_inverse(double J[N_ROWS][N_JOINTS], double b[N_ROWS], double rcond,
                                  double result[N_JOINTS]);

/* The singular values of J over the largest, which comes first; 0 where that is 0. J is used as
   working memory. */
INTERNAL void singular_ratios(double J[N_ROWS][N_JOINTS], double ratio[N_ROWS]);

#endif
