/* Sampled control: when the controller measures, what it sees, and when its efforts act. */
#ifndef SAMPLING_H
#define SAMPLING_H

#include "integrator.h"
#include "internal.h"
#include "plant.h"

enum { MOST_PERIODS = 10 }; /* of a delay */

/* Discrete state of the controller and its sensors. What acts is the output tau of the plant. */
typedef struct {
    double start;            /* t_0, s */
    double time;             /* of the latest sample, s */
    double k;                /* samples so far, a whole number */
    double q_meas[N_JOINTS]; /* the latest, of which the next may be a difference */
    double pending[MOST_PERIODS + 1][N_JOINTS]; /* efforts that do not act yet, the oldest first, */
    int count;                                  /* so many */
} Sampling;

/* Do all that is due at a time, s: the outputs tau, q_meas and v_meas follow, of a continuous controller the last
   two alone. False, and all unchanged, where an effort is not finite. */
INTERNAL int settle(Sampling *sampling, Plant *plant, double time);

/* When the next sample is taken or the next effort acts, s; HUGE_VAL where there are no samples. */
INTERNAL double next_sampling_event(const Sampling *sampling, const Plant *plant);

/* Advance plant and samples from a time by h, s. False, and both unchanged, where that cannot be done. */
INTERNAL int advance_sampled(Sampling *sampling, Plant *plant, double time, double h, Failure *failure);

/* Whether the state, its numbers whatever they are, is one that a plant can be in at a time. */
INTERNAL int is_sampling(const Sampling *sampling, const Plant *plant, double time);

#endif
