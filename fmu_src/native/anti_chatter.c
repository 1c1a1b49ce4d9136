/* Anti-chatter: temporary holds that prevent joints and the rank of J⁺ from switching without end. The rules and their
   derivation are in plant/anti_chatter.py. */
#include <math.h>
#include <string.h>

static const double CHATTER_TIME = 0.5, SHORT_CHATTER_TIME = 1.0 / 4096.0, FIRST_HOLD = 1.0 / 16777216.0,
                    FIRST_RIGID_HOLD = 1.0 / 65536.0, HOLD_GROWTH = 8.0, HOLD_OF_ALL = 1.0 / 512.0;

/* End and length, s, of a hold: of joints at limits, of a joint in friction, or of the rank of J⁺. */
typedef struct {
    double until, length;
} Hold;

/* The holds in a communication step. Times are in s from its start. */
typedef struct {
    int rigid;
    double chatter_time, first;               /* first: first hold of joints, a fraction of the longest */
    double left[N_JOINTS], slipped[N_JOINTS]; /* times of each joint's last release and start of slip */
    double risen, risen_v[N_JOINTS];          /* time of the rank's last rise, and velocities at that time */
    Hold joints, rank, stuck[N_JOINTS];
    int chattering[N_JOINTS], joints_held[N_JOINTS];
    double soon, bound[N_JOINTS];             /* argument of hold_for_a_while, and each joint's longest hold */
} AntiChatter;

static void begin_anti_chatter(AntiChatter *chatter, const Plant *plant)
{
    const Hold none = {-HUGE_VAL, 0.0};
    memset(chatter, 0, sizeof *chatter);
    chatter->rigid = plant->value[RIGID_STOPS] != 0.0;
    chatter->chatter_time = CHATTER_TIME * plant->value[MAX_STEP];
    chatter->first = chatter->rigid ? fmax(FIRST_RIGID_HOLD * coarseness(plant), FIRST_HOLD) : FIRST_HOLD;
    chatter->risen = -HUGE_VAL;
    chatter->joints = chatter->rank = none;
    for (int i = 0; i < N_JOINTS; i++) {
        chatter->left[i] = chatter->slipped[i] = -HUGE_VAL;
        chatter->bound[i] = HUGE_VAL;
        chatter->stuck[i] = none;
    }
}

/* Begin a hold at t. It is longer than the last one if that ended less than `soon` ago. */
static void hold_for_a_while(Hold *hold, double t, double soon, double longest, double first)
{
    const int again = t - hold->until < soon;
    hold->length = again ? fmin(HOLD_GROWTH * hold->length, longest) : first * longest;
    hold->until = t + hold->length;
}

/* Return the longest hold, at most `longest`, whose error at joint i is within the tolerance. A hold of the length
   `passed` has the given error; the error grows with the square of the length. */
static double bounded(double longest, const Step *step, int i, double error, double passed)
{
    const double tolerance = tolerance_of(step->plant, step->y[i]);
    return error > 0.0 ? fmin(longest, passed * sqrt(tolerance / error)) : longest;
}

static int is_at_limit(const Step *step, int i)
{
    const double *value = step->plant->value;
    return !(value[Q_MIN + i] < step->y[i] && step->y[i] < value[Q_MAX + i]);
}

/* The longest hold of joints at limits at t, within the bounds of those that returned in the present sequence of holds. */
static double longest_hold(AntiChatter *chatter, const Step *step, double t)
{
    double longest = chatter->chatter_time;
    for (int i = 0; i < N_JOINTS; i++) {
        if (!chatter->chattering[i] && !(t - chatter->joints.until < chatter->soon))
            chatter->bound[i] = HUGE_VAL;
        longest = is_at_limit(step, i) ? fmin(longest, chatter->bound[i]) : longest;
    }
    return longest;
}

/* Hold the joints that chatter at t, and set `on_hold` for all joints that are held. A repeated hold of HOLD_OF_ALL
   or longer covers all joints at limits. Return the time at which the first hold ends, at most h. */
static double hold_joints(AntiChatter *chatter, const Step *step, double t, double h, int on_hold[N_JOINTS])
{
    double end = chatter->rank.until > t ? fmin(h, chatter->rank.until) : h;
    int any = 0;
    for (int i = 0; i < N_JOINTS; i++)
        any |= chatter->chattering[i];
    const double longest = any ? longest_hold(chatter, step, t) : 0.0;
    if (any)
        hold_for_a_while(&chatter->joints, t, chatter->soon, longest, chatter->first);
    const double length = chatter->joints.length;
    const int all = any && length >= HOLD_OF_ALL * chatter->chatter_time && length > chatter->first * longest;
    for (int i = 0; i < N_JOINTS && (any || !(chatter->joints.until > t)); i++)
        chatter->joints_held[i] = all ? is_at_limit(step, i) : chatter->chattering[i];
    if (chatter->joints.until > t)
        end = fmin(end, chatter->joints.until);
    for (int i = 0; i < N_JOINTS; i++) {
        on_hold[i] = chatter->joints_held[i] || chatter->stuck[i].until > t;
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
}

/* Record a rise of the rank at t. If the rank drops at t, and the effect of the higher rank since its rise is within
   the tolerances, hold the lower rank and return 1. */
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

/* Set `chattering` for the joints that return to a limit soon after they left it, and hold each joint that friction
   stops at once after its release. */
static void find_chatter(AntiChatter *chatter, const Step *step, const Event *event, double t)
{
    for (int i = 0; i < N_JOINTS; i++) {
        const double passed = t - chatter->left[i], speed = fabs(step->y[N_JOINTS + i]);
        double hold = chatter->chatter_time, error = speed * passed;
        if (chatter->rigid) /* mutual impacts repeat too often at a finer tolerance than the usual one */
            error *= coarseness(step->plant);
        if (event->stopped[i] && passed < hold)
            hold = bounded(hold, step, i, error, passed);
        chatter->chattering[i] = event->stopped[i] && passed < (chatter->rigid ? chatter->chatter_time : hold);
        if (chatter->chattering[i]) {
            chatter->bound[i] = hold;
            if (!(passed < FIRST_HOLD * chatter->chatter_time)) /* rounding ends a shorter excursion */
                chatter->soon = fmax(chatter->soon, hold);
        }
        if (event->arrested[i] && t - chatter->slipped[i] < FIRST_HOLD * chatter->chatter_time)
            hold_for_a_while(&chatter->stuck[i], t, SHORT_CHATTER_TIME * chatter->chatter_time,
                             chatter->chatter_time, FIRST_HOLD);
    }
}
