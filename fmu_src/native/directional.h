/* Derivatives along a direction. Knows nothing of the model: its engine is another one than what
   includes this. */
#ifndef DIRECTIONAL_H
#define DIRECTIONAL_H

#include "internal.h"

/* Requested computed variables. */
enum { WANTS_X = 1, WANTS_TAU = 2, WANTS_RATES = 4, WANTS_SAMPLE = 8 };

/* Changes of all variables at value, by index, given those of inputs and states in change.
   held and slip are those of Stops, in which joints stay; the rank is that of J⁺. */
#define differentiate PREFIXED(twodof_differentiate)
HIDDEN void differentiate(const double value[], const int held[], const int slip[], int rank, int wanted,
                          const double change[], double derivative[]);

#endif
