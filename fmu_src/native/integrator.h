/* Integration of the plant over one communication step. */
#ifndef INTEGRATOR_H
#define INTEGRATOR_H

#include "internal.h"
#include "plant.h"

/* Why a communication step cannot be done. */
typedef struct {
    enum { NOT_FINITE,      /* the equations of motion gave a value that is not */
           MANY_STEPS,      /* max_step alone asks for more than the budget */
           SHORT_PERIOD,    /* control_period does */
           MANY_EVALUATIONS,
           SMALL_STEPS      /* below the resolution of time */
    } reason;
    int joint;   /* where too fast: the joint that changes fastest */
    double rate; /* of its change, 1/s */
} Failure;

/* Advance the plant's state by h seconds, inputs held: Dormand–Prince 5(4) with located
   joint-limit stops. False, and the plant unchanged, where that cannot be done. evaluations is how many there have
   been in the communication step so far, and counts on. stopped_at, which may be
   NULL, has the time within the step at which each joint first reached a limit, HUGE_VAL where none did. */
INTERNAL int advance_plant(Plant *plant, double h, long *evaluations, double stopped_at[N_JOINTS], Failure *failure);

#endif
