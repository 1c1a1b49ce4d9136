/* One step of Dormand–Prince 5(4) and its interpolant. */
#ifndef DORMAND_PRINCE_H
#define DORMAND_PRINCE_H

#include "internal.h"
#include "plant.h"
#include "stops.h"

enum { STAGES = 6 }; /* evaluations of the equations of motion in one step */

/* One integration step from y to y_new in one regime, by Dormand–Prince, ROS34PW2 or Heun. The first and the last of the
   derivatives K are those at the ends; the last stage is y_new. */
typedef struct {
    const Plant *plant;
    double size;                           /* s */
    double y[N_STATES], y_new[N_STATES];
    int stages;                            /* number of stages, at most STAGES */
    const double (*P)[4];                  /* weights of K in the dense output */
    double K[STAGES + 1][N_STATES];
    double effort[STAGES + 1][N_JOINTS];   /* the efforts that hold joints at rest */
    double rounding;                       /* bound on the rounding error of the holding efforts */
    long evaluations;                      /* evaluations of the equations of motion so far */
    double Q[N_STATES][4];                 /* coefficients of the dense output */
    double margin, margin_new;             /* margins of the rank at y and y_new */
    int crossed;                           /* whether the rank has changed in the communication step */
    Stops stops;
} Step;

/* q̈ at a state in the regime of the step, the efforts that hold joints at rest, and the margin of the rank,
   which may be NULL. */
INTERNAL void evaluate(Step *step, const double y[N_STATES], double a[N_JOINTS],
                       double effort[N_JOINTS], double *margin);

/* Root mean square of error/tolerance. */
INTERNAL double error_norm(const Step *step, const double error[N_STATES]);

/* Fill y_new, K[1…6] and P from y and K[0]; return the norm of the error. A step passes if it is below 1. */
INTERNAL double dormand_prince(Step *step);

/* The same with a method of second order, with K[0…1], of which K[1] is at the state of Euler's method; its error is
   the norm. */
INTERNAL double heun(Step *step);

/* Fill Q, for dense_output. */
INTERNAL void interpolate(Step *step);

/* A component of the state at a time within the step. */
INTERNAL double dense_output(const Step *step, double passed, int component);

#endif
