/* Joint-limit stops. */
#ifndef STOPS_H
#define STOPS_H

#include "internal.h"
#include "plant.h"

/* The regime of the motion, which only an event changes: joints at rest at a limit, those of them that
   leave it when they are no longer pressed, and the rank of J⁺. */
typedef struct {
    int held[N_JOINTS], watched[N_JOINTS];
    int any_held, any_watched;
    int rank;
} Stops;

#ifndef IS_COMPLEX
/* Remove the velocity that points into a limit from the state y = (q, v). Joints in anti_chatter stop in
   both directions: otherwise mutual impacts, as of the feet of a rocking block, would repeat for ever in
   finite time (Zeno). */
INTERNAL void impact(const Plant *plant, double y[N_STATES], const int anti_chatter[N_JOINTS]);

/* Find the joints that rest at y after an impact; a, q̈ without stops, becomes q̈ with them. Joints in
   anti_chatter stay at their limits whatever the contact force. pressed is that of restrain. */
INTERNAL void hold(const Plant *plant, const double y[N_STATES], double a[N_JOINTS],
                   const int anti_chatter[N_JOINTS], Stops *stops, double pressed[N_JOINTS]);
#endif

/* Whether a joint is nearer to its upper limit than to its lower one. */
INTERNAL int is_above(const Plant *plant, double q, int i);

/* Make the acceleration of held joints 0; how each is pressed into its limit. */
INTERNAL void restrain(const Plant *plant, const Stops *stops, const double q[N_JOINTS],
                       double a[N_JOINTS], double pressed[N_JOINTS]);

/* The derivatives of the plant's state, joints that rest being held. */
INTERNAL void compute_rates(Plant *plant, const Stops *stops);

#endif
