/* One step of Dormand–Prince 5(4) and its interpolant. */
#ifndef DORMAND_PRINCE_H
#define DORMAND_PRINCE_H

#include "internal.h"
#include "plant.h"
#include "stops.h"

enum { STAGES = 6 }; /* evaluations of the equations of motion that it costs */

/* One integration step, from y to y_new. */
typedef struct {
    const Plant *plant;
    double size;                /* s */
    double y[N_STATES], y_new[N_STATES];
    double K[STAGES + 1][N_STATES]; /* derivatives at the stages, */
    int rank[STAGES + 1];       /* of J⁺ there */
    long evaluations;           /* of the equations of motion so far */
    double Q[N_STATES][4];      /* coefficients of the dense output */
    Stops stops;
    int stopped[N_JOINTS];      /* joints that reached a limit at the end of the step, */
    int let_go[N_JOINTS];       /* and joints that are no longer pressed into theirs there */
} Step;

/* q̈ at a state, and its rank. */
INTERNAL int evaluate(Step *step, const double y[N_STATES], double a[N_JOINTS]);

/* Fill y_new and K[1…6] from y and K[0]; the norm of the error, which passes where below 1. */
INTERNAL double dormand_prince(Step *step);

/* Fill Q, for dense_output. */
INTERNAL void interpolate(Step *step);

/* State at a time within the step, by the fourth-order interpolant. */
INTERNAL void dense_output(const Step *step, double passed, double y[N_STATES]);

#endif
