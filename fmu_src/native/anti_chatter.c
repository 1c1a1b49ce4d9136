/* Anti-chatter: temporary holds that prevent joints and the rank of J⁺ from switching without end. The rules and their
   derivation are in plant/anti_chatter.py. */
#include <math.h>
#include <string.h>

#include "dormand_prince.h"
#include "event_search.h"
#include "stops.h"

static const double CHATTER_TIME = 0.5, SHORT_CHATTER_TIME = 1.0 / 4096.0, FIRST_HOLD = 1.0 / 16777216.0,
                    HOLD_GROWTH = 8.0, HOLD_OF_ALL = 1.0 / 512.0;

/* End and length, s, of a hold: of joints at limits, of a joint in friction, or of the rank of J⁺. */
typedef struct {
    double until, length;
} Hold;

/* The holds in a communication step. Times are in s from its start. */
typedef struct {
    int rigid;
    double chatter_time, first;               /* the latter a fraction, for joints */
    double left[N_JOINTS], slipped[N_JOINTS]; /* last release and start of slip of each joint */
    double risen, risen_v[N_JOINTS];          /* last rise of the rank, and the velocities then */
    Hold joints, rank, stuck[N_JOINTS];
    int chattering[N_JOINTS], joints_held[N_JOINTS];
    double soon, longest;                     /* limits of the next hold of joints, as in hold_for_a_while */
} AntiChatter;

static void begin_anti_chatter(AntiChatter *chatter, const Plant *plant)
{
    const Hold none = {-HUGE_VAL, 0.0};
    memset(chatter, 0, sizeof *chatter);
    chatter->rigid = plant->value[RIGID_STOPS] != 0.0;
    chatter->chatter_time = CHATTER_TIME * plant->value[MAX_STEP];
    chatter->first = chatter->rigid ? fmax(SHORT_CHATTER_TIME * coarseness(plant), FIRST_HOLD) : FIRST_HOLD;
    chatter->risen = -HUGE_VAL;
    chatter->joints = chatter->rank = none;
    for (int i = 0; i < N_JOINTS; i++) {
        chatter->left[i] = chatter->slipped[i] = -HUGE_VAL;
        chatter->stuck[i] = none;
    }
}

/* Begin a hold at t, longer than the last one if that ended less than `soon` ago. */
static void hold_for_a_while(Hold *hold, double t, double soon, double longest, double first)
{
    const int again = t - hold->until < soon;
    hold->length = again ? fmin(HOLD_GROWTH * hold->length, longest) : first * longest;
    hold->until = t + hold->length;
}

/* The longest hold within the tolerance of a joint, if a hold of the length `passed` has the given error. The error
   grows with the square of time. */
static double bounded(double longest, const Step *step, int i, double error, double passed)
{
    const double *value = step->plant->value;
    const double tolerance = value[ATOL] + value[RTOL] * fabs(step->y[i]);
    return error > 0.0 ? fmin(longest, passed * sqrt(tolerance / error)) : longest;
}

static int is_at_limit(const Step *step, int i)
{
    const double *value = step->plant->value;
    return !(value[Q_MIN + i] < step->y[i] && step->y[i] < value[Q_MAX + i]);
}

/* Hold the joints that chatter at t, and find those that stay at rest. A long hold covers all joints at limits. Returns
   the end of the first hold, at most h. */
static double hold_joints(AntiChatter *chatter, const Step *step, double t, double h, int kept[N_JOINTS])
{
    double end = chatter->rank.until > t ? fmin(h, chatter->rank.until) : h;
    int any = 0;
    for (int i = 0; i < N_JOINTS; i++)
        any |= chatter->chattering[i];
    if (any)
        hold_for_a_while(&chatter->joints, t, chatter->soon, chatter->longest, chatter->first);
    const int all = any && chatter->joints.length >= HOLD_OF_ALL * chatter->chatter_time;
    for (int i = 0; i < N_JOINTS && (any || !(chatter->joints.until > t)); i++)
        chatter->joints_held[i] = all ? is_at_limit(step, i) : chatter->chattering[i];
    if (chatter->joints.until > t)
        end = fmin(end, chatter->joints.until);
    for (int i = 0; i < N_JOINTS; i++) {
        kept[i] = chatter->joints_held[i] || chatter->stuck[i].until > t;
        end = chatter->stuck[i].until > t ? fmin(end, chatter->stuck[i].until) : end;
    }
    return end;
}

/* Record which joints leave limits or begin to slip at t. */
static void find_departures(AntiChatter *chatter, const Step *step, double t)
{
    for (int i = 0; i < N_JOINTS; i++) {
        if (!step->stops.held[i] && is_at_limit(step, i))
            chatter->left[i] = t;
        if (!step->stops.held[i] && step->stops.slip[i] && step->y[N_JOINTS + i] == 0.0)
            chatter->slipped[i] = t;
        chatter->chattering[i] = 0;
    }
    chatter->soon = chatter->rigid ? chatter->chatter_time : HOLD_GROWTH * chatter->joints.length;
    chatter->longest = chatter->chatter_time;
}

/* True if the rank drops at t so soon after a rise that it is held: the effect of the higher rank is within the
   tolerances. */
static int changes_back(AntiChatter *chatter, const Step *step, int before, double t)
{
    const double passed = t - chatter->risen, *v = step->y + N_JOINTS;
    double longest = chatter->chatter_time;
    if (step->stops.rank > before) {
        chatter->risen = t;
        memcpy(chatter->risen_v, v, sizeof chatter->risen_v);
    }
    if (step->stops.rank >= before || !(passed < longest))
        return 0;
    for (int i = 0; i < N_JOINTS; i++) {
        const double error = 0.5 * passed * fabs(step->K[0][N_JOINTS + i] * passed - (v[i] - chatter->risen_v[i]));
        longest = bounded(longest, step, i, error, passed);
    }
    if (passed < longest)
        hold_for_a_while(&chatter->rank, t, longest, longest, FIRST_HOLD);
    return passed < longest;
}

/* Find the joints that chatter after an event at t, and hold those that friction has stopped. */
static void find_chatter(AntiChatter *chatter, const Step *step, const Event *event, double t)
{
    for (int i = 0; i < N_JOINTS; i++) {
        const double passed = t - chatter->left[i], speed = fabs(step->y[N_JOINTS + i]);
        double hold = chatter->chatter_time;
        if (event->stopped[i] && passed < hold && !chatter->rigid)
            hold = bounded(hold, step, i, speed * passed, passed);
        chatter->chattering[i] = event->stopped[i] && passed < hold;
        if (chatter->chattering[i]) {
            chatter->longest = fmin(chatter->longest, hold);
            if (!(passed < FIRST_HOLD * chatter->chatter_time)) /* or rounding ended the excursion */
                chatter->soon = fmax(chatter->soon, hold);
        }
        if (event->arrested[i] && t - chatter->slipped[i] < FIRST_HOLD * chatter->chatter_time)
            hold_for_a_while(&chatter->stuck[i], t, SHORT_CHATTER_TIME * chatter->chatter_time,
                             chatter->chatter_time, FIRST_HOLD);
    }
}
