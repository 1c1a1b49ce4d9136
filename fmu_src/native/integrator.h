/* Integration of the plant over one communication step. */
#ifndef INTEGRATOR_H
#define INTEGRATOR_H

#include "internal.h"
#include "plant.h"

/* Why a communication step cannot be done. */
typedef struct {
    enum { NOT_FINITE,      /* the equations of motion gave a value that is not finite */
           MANY_STEPS,      /* max_step requires more evaluations than the budget */
           SHORT_PERIOD,    /* control_period requires more than the budget */
           MANY_EVALUATIONS,
           SMALL_STEPS      /* steps below the resolution of time */
    } reason;
    int joint;   /* the joint that changes fastest, for the last two */
    double rate; /* the joint's rate of change, 1/s */
} Failure;

/* Advance the plant's state by h seconds with inputs held, and locate joint stops. On failure return false and leave
   the plant unchanged. evaluations counts those of the communication step so far, and is updated. stopped_at, which may
   be NULL, receives the time within the step at which each joint first reached a limit, or HUGE_VAL. */
INTERNAL int advance_plant(Plant *plant, double h, long *evaluations, double stopped_at[N_JOINTS], Failure *failure);

#endif
