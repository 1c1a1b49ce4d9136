/* Joint-limit stops. */
#ifndef STOPS_H
#define STOPS_H

#include "internal.h"
#include "plant.h"

/* The cause of a joint's rest: its friction, a stop at a limit that pushes (with its friction), or a clamp at a
   limit, which has no reaction on the other joints. */
typedef enum { FREE, STUCK, STOPPED, CLAMPED } Rest;

/* The regime of the motion, which only an event changes: how joints rest, those of them that are free once the
   effort that holds them is beyond its bounds, the directions (−1, 1) in which joints slip against their
   friction, and the rank of J⁺. */
typedef struct {
    int held[N_JOINTS], watched[N_JOINTS], slip[N_JOINTS];
    int any_held, any_watched, any_slip;
    int rank;
} Stops;

#ifndef IS_COMPLEX
/* Remove the velocity that points into a limit from the state y = (q, v). Joints in anti_chatter stop in
   both directions: otherwise mutual impacts, as of the feet of a rocking block, would repeat for ever in
   finite time (Zeno). */
INTERNAL void impact(const Plant *plant, double y[N_STATES], const int anti_chatter[N_JOINTS]);

/* Find the regime at y after an impact, with a J⁺ of this rank; a is q̈ in it, effort that of restrain, margin
   that of acceleration. Joints in kept that are at rest stay there whatever holds them. */
INTERNAL void find_regime(const Plant *plant, const double y[N_STATES], const int kept[N_JOINTS], int rank,
                          Stops *stops, double a[N_JOINTS], double effort[N_JOINTS], double *margin);

/* The distance of the effort that holds a joint to its bounds: on the side of −1 or of 1, HUGE_VAL where that has
   no bound; a joint that is watched is free where one is negative. */
INTERNAL double grip(const Plant *plant, const Stops *stops, int i, double q, double effort, int side);

/* A bound on the rounding of these efforts. */
INTERNAL double rounding_of(const Stops *stops, const double effort[N_JOINTS]);
#endif

/* The directions of slip in a regime, NULL where no joint slips. */
INTERNAL const int *slip_of(const Stops *stops);

/* True if a joint is nearer to its upper limit than to its lower one. */
INTERNAL int is_above(const Plant *plant, double q, int i);

/* Make the acceleration of held joints 0; the effort that holds each, of a clamp the negative acceleration. */
INTERNAL void restrain(const Plant *plant, const Stops *stops, const double q[N_JOINTS],
                       double a[N_JOINTS], double effort[N_JOINTS]);

/* The derivatives of the plant's state, joints that rest being held. */
INTERNAL void compute_rates(Plant *plant, const Stops *stops);

#endif
