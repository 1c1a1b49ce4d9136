/* Events within an integration step. */
#ifndef EVENT_SEARCH_H
#define EVENT_SEARCH_H

#include "dormand_prince.h"
#include "internal.h"

/* The event at the end of a step: joints that reached a limit, and joints that are no longer pressed into
   theirs. */
typedef struct {
    int stopped[N_JOINTS], released[N_JOINTS];
} Event;

/* First time in (0, size] at which the regime of the step ends, y_new becoming the state there; 0 where
   it does not. With rank_held the rank of J⁺ is no matter. */
INTERNAL double first_event(Step *step, int rank_held, Event *event);

/* The value of a polynomial of a degree, its constant first. */
INTERNAL double polynomial(const double c[], int degree, double x);

/* Where a polynomial of degree 4 or less changes its sign in (0, 1), in ascending order; how often. Between the
   turning points, at which its derivative does so, it is monotonic. */
INTERNAL int sign_changes(const double c[], int degree, double root[]);

#endif
