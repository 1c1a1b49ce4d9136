/* Polynomials, and where they change their sign. */
#ifndef POLYNOMIAL_H
#define POLYNOMIAL_H

#include "internal.h"

/* The value of a polynomial of a degree, its constant first. */
INTERNAL double polynomial(const double c[], int degree, double x);

/* Where a polynomial of degree 4 or less changes its sign in (0, 1), in ascending order; how often. Between the
   turning points, at which its derivative does so, it is monotonic. */
INTERNAL int sign_changes(const double c[], int degree, double root[]);

#endif
