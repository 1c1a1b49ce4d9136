/* Joint-limit stops. */
#ifndef STOPS_H
#define STOPS_H

#include "internal.h"

/* The cause of a joint's rest: friction, a rigid stop at a limit (with friction), or a clamp at a limit, which has no
   reaction on the other joints. */
typedef enum { FREE, STUCK, STOPPED, CLAMPED } Rest;

/* The regime of the motion, which only an event changes: the cause of each joint's rest (held), the held joints that
   are released when the holding effort exceeds its bounds (watched), the directions (−1, 1) of slip against friction,
   the rank of J⁺, and the largest effort that acts on a joint where the regime begins, 0 without reactions. */
typedef struct {
    int held[N_JOINTS], watched[N_JOINTS], slip[N_JOINTS];
    int any_held, any_watched, any_slip;
    int rank;
    double acting;
} Stops;

#endif
