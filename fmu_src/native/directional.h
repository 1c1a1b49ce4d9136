/* Derivatives along a direction. The types of the engine do not appear here, because directional.c compiles another
   engine than the files that include this header. */
#ifndef DIRECTIONAL_H
#define DIRECTIONAL_H

#include "internal.h"

/* Requested computed variables. The law's result takes the place of the accelerations. */
enum { WANTS_X = 1, WANTS_TAU = 2, WANTS_RATES = 4, WANTS_SAMPLE = 8, WANTS_STATE = 16, WANTS_LAW = 32 };

/* Changes of all variables, by index, for the changes of inputs and states in change. The variables have the values in
   value; held, slip and the rank of J⁺ are the regime (see Stops), which stays. */
#define differentiate PREFIXED(twodof_differentiate)
HIDDEN void differentiate(const double value[], const int held[], const int slip[], int rank, int wanted,
                          const double change[], double derivative[]);

#endif
