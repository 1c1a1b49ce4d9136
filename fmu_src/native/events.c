/* State events of joint stops, of friction and of J⁺. A free joint's indicator is its distance to a place just
   past the limit, that of a joint at rest how it is pressed into it; of friction it is the velocity in the
   direction of slip, and of a joint that sticks how far the effort that holds it is within its bounds. Each
   is off zero after its event. */
#include "stops.h"

#include <float.h>
#include <math.h>
#include <string.h>

#ifdef HAS_RCOND
#include "control.h"
#endif

/* Distance of an event past a limit, as a part of max(1, |limit|): some hundred units in the last
   place. */
static const double PAST = 1e-13;
/* s: what a joint gains in room for its speed away from a limit, and in velocity for its acceleration. */
static const double CLEARING = 1.0;
/* rad/s2, m/s2, N·m or N, and of friction a part of it: how a joint at rest is pulled off where its event is. */
static const double PULL = 1e-9;
/* rad/s or m/s: how far beyond zero a velocity is where its event is. */
static const double BACK = 1e-13;
/* rad/s or m/s: an impact slower than this drives no other joint off that rests. Two joints that in
   turn drive each other off would else have events without end. */
static const double SLOW = 1e-4;

/* The joints that rest at the plant's state, by the rules of stops.h. */
static void find_stops(const Plant *plant, Stops *stops)
{
    const int anti_chatter[N_JOINTS] = {0};
    double a[N_JOINTS], effort[N_JOINTS];
    find_regime(plant, &plant->value[Q], anti_chatter, ANY_RANK, stops, a, effort, NULL);
}

/* Distance to a place past a limit, and more where a joint moves away from it, at v: there a solver's
   error is no event. 1 where that is no limit. */
static double room(double limit, double distance, double v)
{
    const double size = fabs(limit);
    return size < DBL_MAX ? distance + PAST * fmax(1.0, size) + CLEARING * fmax(0.0, v) : 1.0;
}

/* One indicator of each joint's upper limit, then of each lower one, of each joint's friction, then of the
   singular values that J⁺ may drop, all but the largest. An event is where one changes its sign. */
static void event_indicators(const Plant *plant, const Stops *stops, double indicator[N_INDICATORS])
{
    const double *q = &plant->value[Q], *v = &plant->value[V];
    const double *low = &plant->value[Q_MIN], *high = &plant->value[Q_MAX];
    double a[N_JOINTS], effort[N_JOINTS];
    if (stops->any_watched || stops->any_slip) {
        acceleration(plant, q, v, slip_of(stops), stops->rank, a, NULL);
        restrain(plant, stops, q, a, effort);
    }
    const double rounding = stops->any_watched ? rounding_of(stops, effort) : 0.0;
    for (int i = 0; i < N_JOINTS; i++) {
        double *at[2] = {&indicator[i], &indicator[N_JOINTS + i]}, *rubs = &indicator[2 * N_JOINTS + i];
        const int slip = stops->held[i] ? 0 : stops->slip[i], side = is_above(plant, q[i], i) ? 1 : -1;
        *rubs = slip ? slip * v[i] + BACK + CLEARING * fmax(0.0, slip * a[i]) : 1.0;
        *at[0] = room(high[i], high[i] - q[i], -v[i]);
        *at[1] = room(low[i], q[i] - low[i], v[i]);
        if (stops->held[i]) /* at rest where there is no range, for good */
            *at[0] = *at[1] = 1.0;
        if (stops->watched[i] && stops->held[i] != STUCK)
            *at[side > 0 ? 0 : 1] = grip(plant, stops, i, q[i], effort[i], side) + PULL + rounding;
        else if (stops->watched[i])
            *rubs = fmin(grip(plant, stops, i, q[i], effort[i], -1), grip(plant, stops, i, q[i], effort[i], 1))
                    + PULL * plant->value[FRICTION + i] + rounding;
    }
#ifdef HAS_RCOND
    double ratio[N_ROWS];
    conditioning(q, ratio);
    for (int k = 3 * N_JOINTS; k < N_INDICATORS; k++)
        indicator[k] = plant->value[CONTROL_PERIOD] == 0.0 ? ratio[k - 3 * N_JOINTS + 1] - plant->value[RCOND] : 1.0;
#endif
}

/* Changes at an event: decided by the state alone, so that it is the same whether the importer came
   early, late or for nothing. Whether the state is another now. */
static int handle_event(Plant *plant, Stops *stops)
{
    const double *low = &plant->value[Q_MIN], *high = &plant->value[Q_MAX];
    double before[N_STATES], y[N_STATES], fastest = 0.0;
    int anti_chatter[N_JOINTS] = {0};
    memcpy(before, &plant->value[Q], sizeof before);
    memcpy(y, before, sizeof y);
    for (int i = 0; i < N_JOINTS; i++) {
        if (stops->held[i] && stops->held[i] != STUCK) /* whatever a solver's rounding made of it */
            y[i] = is_above(plant, y[i], i) ? high[i] : low[i];
        if (stops->held[i] || stops->slip[i] * y[N_JOINTS + i] < 0.0)
            y[N_JOINTS + i] = 0.0;
        y[i] = fmin(fmax(y[i], low[i]), high[i]);
        if (y[i] == low[i] || y[i] == high[i])
            fastest = fmax(fastest, (y[i] == high[i] ? 1.0 : -1.0) * y[N_JOINTS + i]);
    }
    for (int i = 0; i < N_JOINTS; i++)
        anti_chatter[i] = stops->held[i] && stops->held[i] != STUCK && fastest < SLOW;
    impact(plant, y, anti_chatter);
    memcpy(&plant->value[Q], y, sizeof y);
    find_stops(plant, stops);
    return memcmp(before, y, sizeof y) != 0;
}
