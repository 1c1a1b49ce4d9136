/* State events of joint stops, of friction and of J⁺. The indicator of a limit is the distance of the joint from a
   position just past the limit, or, for a joint at rest there, the effort that presses it against the limit. The
   indicator of friction is the velocity in the direction of slip, or, for a joint that sticks, the distance of the
   holding effort from its bounds. If the friction of a joint is 0 and an input, the indicator is
   the friction itself, which may rise. Offsets keep each indicator away from zero after its event. */
#include <float.h>
#include <math.h>
#include <string.h>

/* Distance of an event past a limit, relative to max(1, |limit|): some hundred units in the last place. */
static const double PAST = 1e-13;
/* True if the importer may change friction between events. */
enum { CHANGES_FRICTION = FRICTION >= Q - N_FREE && FRICTION < Q };
/* s: factor of the velocity away from a limit in the indicator of the limit, and of the acceleration in the indicator
   of slip. */
static const double CLEARING = 1.0;
/* Excess over a bound at the release of a joint: rad/s2, m/s2, N·m or N at a limit, and relative for friction. */
static const double PULL = 1e-9;
/* rad/s or m/s: velocity beyond zero at the event that ends slip. */
static const double BACK = 1e-13;
/* rad/s or m/s: a slower impact moves no joint that rests at its limit. Otherwise two joints that push each other off
   their limits in turn would have events without end. */
static const double SLOW = 1e-4;

/* Find the joints that rest at the plant's state, by the rules of stops.h. */
static void find_stops(Plant *plant, Stops *stops)
{
    const int anti_chatter[N_JOINTS] = {0};
    double a[N_JOINTS], effort[N_JOINTS];
    find_regime(plant, &plant->value[Q], anti_chatter, ANY_RANK, 0.0, stops, a, effort, NULL);
}

/* Distance to a position past a limit, increased if the joint moves away at v, so that a solver's error is no event; 1
   without a limit. */
static double room(double limit, double distance, double v)
{
    const double size = fabs(limit);
    return size < DBL_MAX ? distance + PAST * fmax(1.0, size) + CLEARING * fmax(0.0, v) : 1.0;
}

/* One indicator of each joint's upper limit, then of each lower one, of each joint's friction, then of the
   singular values that J⁺ may drop, all but the largest. A change of sign is an event. */
static void event_indicators(const Plant *plant, const Stops *stops, double indicator[N_INDICATORS])
{
    const double *q = &plant->value[Q], *v = &plant->value[V];
    const double *low = &plant->value[Q_MIN], *high = &plant->value[Q_MAX];
    double a[N_JOINTS], effort[N_JOINTS] = {0};
    if (stops->any_watched || stops->any_slip) {
        acceleration(plant, q, v, slip_of(stops), stops->rank, a, NULL);
        restrain(plant, stops, q, a, effort);
    }
    const double rounding = stops->any_watched ? rounding_of(stops, effort) : 0.0;
    for (int i = 0; i < N_JOINTS; i++) {
        double *at[2] = {&indicator[i], &indicator[N_JOINTS + i]}, *friction = &indicator[2 * N_JOINTS + i];
        const int slip = stops->held[i] ? 0 : stops->slip[i];
        const double grips[2] = {grip(plant, stops, i, q[i], effort[i], 1), grip(plant, stops, i, q[i], effort[i], -1)};
        *friction = slip ? slip * v[i] + BACK + CLEARING * fmax(0.0, slip * a[i]) : 1.0;
        if (CHANGES_FRICTION && !stops->slip[i] && !reacts(stops, i))
            *friction = PULL - plant->value[FRICTION + i];
        *at[0] = room(high[i], high[i] - q[i], -v[i]);
        *at[1] = room(low[i], q[i] - low[i], v[i]);
        if (stops->held[i]) /* a joint without a range stays at rest */
            *at[0] = *at[1] = 1.0;
        for (int k = 0; k < 2 && stops->watched[i] && stops->held[i] != STUCK; k++)
            *at[k] = grips[k] < HUGE_VAL ? grips[k] + PULL + rounding : 1.0;
        if (stops->watched[i] && stops->held[i] == STUCK)
            *friction = fmin(grips[0], grips[1]) + PULL * plant->value[FRICTION + i] + rounding;
    }
#ifdef HAS_RCOND
    double ratio[N_ROWS];
    conditioning(q, ratio);
    for (int k = 3 * N_JOINTS; k < N_INDICATORS; k++)
        indicator[k] = plant->value[CONTROL_PERIOD] == 0.0 ? ratio[k - 3 * N_JOINTS + 1] - plant->value[RCOND] : 1.0;
#endif
}

/* Handle an event; return whether the state changed. Only the state decides, so that the result does not depend on
   whether the importer enters event mode early, late or needlessly. */
static int handle_event(Plant *plant, Stops *stops)
{
    const double *low = &plant->value[Q_MIN], *high = &plant->value[Q_MAX];
    double before[N_STATES], y[N_STATES], fastest = 0.0;
    int anti_chatter[N_JOINTS] = {0};
    memcpy(before, &plant->value[Q], sizeof before);
    memcpy(y, before, sizeof y);
    for (int i = 0; i < N_JOINTS; i++) {
        if (stops->held[i] && stops->held[i] != STUCK) /* without the solver's rounding error */
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
