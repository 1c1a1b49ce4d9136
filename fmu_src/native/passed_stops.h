/* Stops that a joint reaches and leaves within one step of the importer's solver: no event indicator has another
   sign at its end. */
#ifndef PASSED_STOPS_H
#define PASSED_STOPS_H

#include "internal.h"
#include "stops.h"

/* A step of the importer. */
typedef struct {
    double time, y[N_STATES], a[N_JOINTS]; /* its start: s, the state and the accelerations */
    double reached[N_STATES];              /* the state at time, of a step before that passed a stop */
    double stop_time;                      /* s: when that stop was reached, */
    int joint;                             /* by this joint, counted from 1; 0: no stop was passed */
    int begun;                             /* whether there is a start */
} Passage;

/* Start a step of the importer at the plant's state, whose derivatives are computed. */
INTERNAL void begin_passage(Passage *passage, const Plant *plant, double time);

/* Find a stop that the importer's step to the plant's state has passed, and start the next one there. Where
   the engine cannot integrate the step, the joint, counted from 1, that turned at its limit, else 0. */
INTERNAL int find_passed_stop(Passage *passage, const Plant *plant, const Stops *stops, double time);

/* At an event at the end of a step that passed a stop: put the plant where the stop has led. Whether it does. */
INTERNAL int take_passed_stop(Passage *passage, Plant *plant, Stops *stops, double time);

#endif
