/* State events of joint stops and of J⁺. A free joint's indicator is its distance to a place just past the
   limit, that of a joint at rest how it is pressed into it. Each is off zero after its event. */
#include "events.h"

#include <float.h>
#include <math.h>
#include <string.h>

#ifdef HAS_RCOND
#include "control.h"
#endif

/* Distance of an event past a limit, as a part of max(1, |limit|): some hundred units in the last
   place. */
static const double PAST = 1e-13;
/* s: what a joint gains in room for its speed away from a limit. */
static const double CLEARING = 1.0;
/* rad/s2, m/s2, N·m or N: how a joint at rest is pulled off where its event is. */
static const double PULL = 1e-9;
/* rad/s or m/s: an impact slower than this drives no other joint off that rests. Two joints that in
   turn drive each other off would else have events without end. */
static const double SLOW = 1e-4;

void find_stops(const Plant *plant, Stops *stops)
{
    const int anti_chatter[N_JOINTS] = {0};
    double a[N_JOINTS], pressed[N_JOINTS];
    stops->rank = acceleration(plant, &plant->value[Q], &plant->value[V], ANY_RANK, a, NULL);
    hold(plant, &plant->value[Q], a, anti_chatter, stops, pressed);
}

/* Distance to a place past a limit, and more where a joint moves away from it, at v: there a solver's
   error is no event. 1 where that is no limit. */
static double room(double limit, double distance, double v)
{
    const double size = fabs(limit);
    return size < DBL_MAX ? distance + PAST * fmax(1.0, size) + CLEARING * fmax(0.0, v) : 1.0;
}

void event_indicators(const Plant *plant, const Stops *stops, double indicator[N_INDICATORS])
{
    const double *q = &plant->value[Q], *v = &plant->value[V];
    const double *low = &plant->value[Q_MIN], *high = &plant->value[Q_MAX];
    double a[N_JOINTS], pressed[N_JOINTS];
    if (stops->any_watched) {
        acceleration(plant, q, v, stops->rank, a, NULL);
        restrain(plant, stops, q, a, pressed);
    }
    for (int i = 0; i < N_JOINTS; i++) {
        double *at[2] = {&indicator[i], &indicator[N_JOINTS + i]};
        *at[0] = room(high[i], high[i] - q[i], -v[i]);
        *at[1] = room(low[i], q[i] - low[i], v[i]);
        if (stops->held[i]) /* at rest where there is no range, for good */
            *at[0] = *at[1] = 1.0;
        if (stops->watched[i])
            *at[is_above(plant, q[i], i) ? 0 : 1] = pressed[i] + PULL;
    }
#ifdef HAS_RCOND
    double ratio[N_ROWS];
    conditioning(q, ratio);
    for (int k = 2 * N_JOINTS; k < N_INDICATORS; k++)
        indicator[k] = plant->value[CONTROL_PERIOD] == 0.0 ? ratio[k - 2 * N_JOINTS + 1] - plant->value[RCOND] : 1.0;
#endif
}

int handle_event(Plant *plant, Stops *stops)
{
    const double *low = &plant->value[Q_MIN], *high = &plant->value[Q_MAX];
    double before[N_STATES], y[N_STATES], fastest = 0.0;
    int anti_chatter[N_JOINTS] = {0};
    memcpy(before, &plant->value[Q], sizeof before);
    memcpy(y, before, sizeof y);
    for (int i = 0; i < N_JOINTS; i++) {
        if (stops->held[i]) { /* whatever a solver's rounding made of it */
            y[i] = is_above(plant, y[i], i) ? high[i] : low[i];
            y[N_JOINTS + i] = 0.0;
        }
        y[i] = fmin(fmax(y[i], low[i]), high[i]);
        if (y[i] == low[i] || y[i] == high[i])
            fastest = fmax(fastest, (y[i] == high[i] ? 1.0 : -1.0) * y[N_JOINTS + i]);
    }
    for (int i = 0; i < N_JOINTS; i++)
        anti_chatter[i] = stops->held[i] && fastest < SLOW;
    impact(plant, y, anti_chatter);
    memcpy(&plant->value[Q], y, sizeof y);
    find_stops(plant, stops);
    return memcmp(before, y, sizeof y) != 0;
}
