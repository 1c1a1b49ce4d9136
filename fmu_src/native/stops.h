/* Joint-limit stops. */
#ifndef STOPS_H
#define STOPS_H

#include "internal.h"
#include "plant.h"

/* The cause of a joint's rest: friction, a rigid stop at a limit (with friction), or a clamp at a limit, which has no
   reaction on the other joints. */
typedef enum { FREE, STUCK, STOPPED, CLAMPED } Rest;

/* The regime of the motion, which only an event changes: the cause of each joint's rest (held), the held joints that
   are released when the holding effort exceeds its bounds (watched), the directions (−1, 1) of slip against friction,
   and the rank of J⁺. */
typedef struct {
    int held[N_JOINTS], watched[N_JOINTS], slip[N_JOINTS];
    int any_held, any_watched, any_slip;
    int rank;
} Stops;

#ifndef IS_COMPLEX
/* Remove the velocity that points into a limit from the state y = (q, v). Joints in anti_chatter stop in both
   directions; without them, mutual impacts could repeat without end in finite time (Zeno), as those of the feet of a
   rocking block. Returns whether a velocity pointed into a limit. */
INTERNAL int impact(const Plant *plant, double y[N_STATES], const int anti_chatter[N_JOINTS]);

/* Fraction of the times within which events at rigid stops are one: they shrink with rtol below its default. */
INTERNAL double coarseness(const Plant *plant);

/* Find the regime at y after an impact, with the given rank of J⁺. a receives q̈ in this regime, effort the result of
   restrain, margin that of acceleration. Resting joints in kept stay at rest even if the holding effort exceeds its
   bounds. Joints whose motion friction or a rigid stop ends within a window, s, stop at once: the window is that of an
   impact, and otherwise 0. */
INTERNAL void find_regime(const Plant *plant, double y[N_STATES], const int kept[N_JOINTS], int rank, double window,
                          Stops *stops, double a[N_JOINTS], double effort[N_JOINTS], double *margin);

/* Distance of a joint's holding effort from its lower (side −1) or upper (side 1) bound; HUGE_VAL without a bound. A
   watched joint is released if one is negative. */
INTERNAL double grip(const Plant *plant, const Stops *stops, int i, double q, double effort, int side);

/* Bound on the rounding error of the holding efforts. */
INTERNAL double rounding_of(const Stops *stops, const double effort[N_JOINTS]);
#endif

/* The directions of slip in a regime; NULL if no joint slips. */
INTERNAL const int *slip_of(const Stops *stops);

/* True if a joint is nearer to its upper limit than to its lower one. */
INTERNAL int is_above(const Plant *plant, double q, int i);

/* Hold joints, so that their acceleration a is 0; effort receives the holding efforts, for a clamp −q̈. */
INTERNAL void restrain(const Plant *plant, const Stops *stops, const double q[N_JOINTS],
                       double a[N_JOINTS], double effort[N_JOINTS]);

/* Compute the derivatives of the plant's state, with joints at rest held. */
INTERNAL void compute_rates(Plant *plant, const Stops *stops);

#ifndef IS_COMPLEX
/* The derivatives of q̈ with respect to efforts and states, and with reactions also to inputs of the law, by the
   variable's index, at a plant with the derivatives of compute_rates. */
INTERNAL void acceleration_slopes(const Plant *plant, const Stops *stops, double slope[N_JOINTS][X]);
#endif

#endif
