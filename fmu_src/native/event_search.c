/* Find the first event within an integration step, on its dense output. The rules and their derivation are in
   plant/event_search.py. */
#include <math.h>
#include <stddef.h>
#include <string.h>

/* Bounds for Dormand and Prince's interpolant; the cubic has smaller ones, 1.07 and 2. */
static const double REACH = 1.66, PACE = 3.72;
enum { LOOKS = 4 };
static const double DOUBT = 0.25;
enum { HALVINGS = 7 };
static const double TIME_RESOLUTION = 1.0 / 4503599627370496.0; /* 2⁻⁵² */
static const double RELEASE_RESOLUTION = 1.0 / 1024.0, FINEST_RELEASE = 1.0 / 67108864.0; /* 2⁻¹⁰, 2⁻²⁶ */
static const double TOGETHER = 1.0 / 33554432.0; /* 2⁻²⁵ */

/* The event at the end of a step: joints that reached a limit, and joints that slipped and came to rest. */
typedef struct {
    int stopped[N_JOINTS], arrested[N_JOINTS];
} Event;

/* A margin at a time within the step, negative after the end of the regime. Some margins have one value for each
   component of the state. */
typedef double Margin(Step *step, double passed, int component);

static void interpolated(const Step *step, double passed, double y[N_STATES])
{
    for (int i = 0; i < N_STATES; i++)
        y[i] = dense_output(step, passed, i);
}

/* Distance to the nearer limit. */
static double limit_margin(Step *step, double passed, int joint)
{
    const double q = dense_output(step, passed, joint);
    const double *value = step->plant->value;
    return fmin(value[Q_MAX + joint] - q, q - value[Q_MIN + joint]);
}

/* Velocity in the direction of slip. */
static double slip_margin(Step *step, double passed, int component)
{
    return step->stops.slip[component - N_JOINTS] * dense_output(step, passed, component);
}

/* Efforts that hold joints at rest. */
static void find_efforts(Step *step, double passed, double effort[N_JOINTS])
{
    double y[N_STATES], a[N_JOINTS];
    interpolated(step, passed, y);
    evaluate(step, y, a, effort, NULL);
}

/* Distance of a joint's holding effort from its bound on one side, beyond rounding: a released joint moves. */
static double grip_of(const Step *step, int i, double effort, int side)
{
    return grip(step->plant, &step->stops, i, step->y[i], effort, side) + step->rounding;
}

static double least_grip(const Step *step, const double effort[N_JOINTS])
{
    double least = HUGE_VAL;
    for (int i = 0; i < N_JOINTS; i++)
        if (step->stops.watched[i])
            least = fmin(least, fmin(grip_of(step, i, effort[i], -1), grip_of(step, i, effort[i], 1)));
    return least;
}

static double release_margin(Step *step, double passed, int component)
{
    double effort[N_JOINTS];
    (void)component;
    find_efforts(step, passed, effort);
    return least_grip(step, effort);
}

/* The margin of the rank; for a held rank, the margin to a lower rank only. */
static double singular_margin(Step *step, double passed, int rank_held)
{
#ifdef HAS_RCOND
    const double rcond = step->plant->value[RCOND];
    const int rank = step->stops.rank;
    double y[N_STATES], ratio[N_ROWS];
    interpolated(step, passed, y);
    conditioning(y, ratio);
    step->evaluations++;
    if (rank_held)
        return rank > 0 ? ratio[rank - 1] - rcond : 1.0;
    return rank_margin(ratio, rcond, rank);
#else
    (void)step, (void)passed, (void)rank_held;
    return 1.0;
#endif
}

/* First time in (a, b] at which a margin is negative, to the last bits of the step; it is negative at b. The
   interpolation stays near the middle, so that it never needs many more evaluations than bisection.
   Source: Oliveira & Takahashi, "An enhancement of the bisection method", ACM TOMS 47(1), 2020. */
static double locate(Step *step, Margin *margin, int joint, double a, double at_a, double b,
                     double at_b)
{
    const double released = fmax(RELEASE_RESOLUTION * coarseness(step->plant), FINEST_RELEASE);
    const double resolution = (margin == release_margin ? released : TIME_RESOLUTION) * step->size;
    const double k = 0.01 / (b - a); /* small, because margins are smooth */
    double slack = b - a; /* how much longer the interval may be than after bisection */
    while (b - a > resolution) {
        const double middle = 0.5 * (a + b), half = 0.5 * (b - a);
        double x = at_a > at_b ? (b * at_a - a * at_b) / (at_a - at_b) : middle;
        const double shift = fmin(k * (b - a) * (b - a), fabs(middle - x));
        x += middle > x ? shift : -shift;
        if (fabs(x - middle) > slack - half)
            x = middle + (x > middle ? slack - half : half - slack);
        if (!(a < x && x < b))
            x = middle;
        if (!(a < x && x < b)) /* a and b are neighbouring numbers */
            break;
        const double at_x = margin(step, x, joint);
        if (at_x < 0.0) {
            b = x;
            at_b = at_x;
        } else {
            a = x;
            at_a = at_x;
        }
        slack = fmax(0.5 * slack, resolution);
    }
    return b;
}

/* First time in (a, b] at which a margin is negative, or HUGE_VAL. Its values at the ends and its largest rate of
   change exclude intervals. */
static double search(Step *step, Margin *margin, int joint, double rate, double a, double at_a,
                     double b, double at_b, int halvings)
{
    if (at_b >= 0.0 && (halvings == 0 || at_a + at_b >= rate * (b - a)))
        return HUGE_VAL;
    if (halvings == 0)
        return locate(step, margin, joint, a, at_a, b, at_b);
    const double middle = 0.5 * (a + b), at_middle = margin(step, middle, joint);
    double first = search(step, margin, joint, rate, a, at_a, middle, at_middle, halvings - 1);
    if (first == HUGE_VAL)
        first = search(step, margin, joint, rate, middle, at_middle, b, at_b, halvings - 1);
    return first;
}

/* First time at which the margin of a component is negative, or HUGE_VAL. If the margin is at first 0, it may dip below
   0 by less than `dip` before it is positive. */
static double first_crossing(Step *step, Margin *margin, int component, double dip)
{
    const double *c = step->Q[component];
    const double slope[4] = {c[0], 2.0 * c[1], 3.0 * c[2], 4.0 * c[3]};
    double turn[4], before = 0.0, at_before = margin(step, 0.0, component);
    const int turns = sign_changes(slope, 3, turn);
    int k = 0;
    for (int i = 0; i < turns; i++)
        turn[i] *= step->size;
    turn[turns] = step->size;
    if (dip > 0.0 && turns > 0 && at_before == 0.0) {
        const double least = margin(step, turn[0], component);
        k = least < 0.0 && least > -dip && margin(step, turn[1], component) >= 0.0;
    }
    for (; k <= turns; k++) {
        const double after = turn[k], at_after = margin(step, after, component);
        if (at_after < 0.0)
            return locate(step, margin, component, before, at_before, after, at_after);
        before = after;
        at_before = at_after;
    }
    return HUGE_VAL;
}

/* True if the holding effort of a joint may exceed its bound on one side within the step. */
static int may_pass(const Step *step, int joint, int side)
{
    double low = HUGE_VAL, high = -HUGE_VAL;
    for (int stage = 0; stage <= step->stages; stage++) {
        const double margin = grip_of(step, joint, step->effort[stage][joint], side);
        low = fmin(low, margin);
        high = fmax(high, margin);
    }
    return low < HUGE_VAL && !(low >= high - low);
}

static int may_be_released(const Step *step, int joint)
{
    return may_pass(step, joint, -1) || may_pass(step, joint, 1);
}

/* The polynomial through five equidistant values from 0 to 1. */
static void fit(const double p[LOOKS + 1], double c[LOOKS + 1])
{
    const double first = p[1] - p[0], second = p[2] - 2.0 * p[1] + p[0];
    const double third = p[3] - 3.0 * p[2] + 3.0 * p[1] - p[0];
    const double fourth = p[4] - 4.0 * p[3] + 6.0 * p[2] - 4.0 * p[1] + p[0];
    c[0] = p[0]; /* Newton's form, multiplied out */
    c[1] = 4.0 * (first - second / 2.0 + third / 3.0 - fourth / 4.0);
    c[2] = 16.0 * (second / 2.0 - third / 2.0 + fourth * 11.0 / 24.0);
    c[3] = 64.0 * (third / 6.0 - fourth / 4.0);
    c[4] = 256.0 * (fourth / 24.0);
}

/* Find minima, possibly below zero, of the polynomial through sampled values of a margin; return their number. */
static int doubtful_minima(const double p[LOOKS + 1], double x[LOOKS])
{
    double c[LOOKS + 1], slope[LOOKS], low = p[0], high = p[0];
    int count = 0;
    fit(p, c);
    for (int k = 1; k <= LOOKS; k++) {
        slope[k - 1] = k * c[k];
        low = fmin(low, p[k]);
        high = fmax(high, p[k]);
    }
    const int turns = sign_changes(slope, LOOKS - 1, x);
    for (int k = 0; k < turns; k++)
        if (polynomial(c, LOOKS, x[k]) < DOUBT * (high - low))
            x[count++] = x[k];
    return count;
}

/* First time before `before` at which a joint is released, or HUGE_VAL. */
static double first_release(Step *step, double before)
{
    double effort[LOOKS + 1][N_JOINTS], look[2 * LOOKS * N_JOINTS];
    int looks = 0, doubt = 0;
    for (int i = 0; i < N_JOINTS; i++)
        doubt |= step->stops.watched[i] && may_be_released(step, i);
    if (!doubt)
        return HUGE_VAL;
    const double instant = TIME_RESOLUTION * step->size;
    if (before <= instant)
        return HUGE_VAL;
    const double at_start = least_grip(step, step->effort[0]);
    const double at_once = at_start > 4.0 * step->rounding ? at_start : release_margin(step, instant, 0);
    if (at_once < 0.0 && at_once < -fabs(release_margin(step, 0.0, 0) - at_start))
        return instant; /* beyond the difference of two ways to compute the efforts; else the joint would be held again */
    memcpy(effort[0], step->effort[0], sizeof *effort);
    memcpy(effort[LOOKS], step->effort[step->stages], sizeof *effort);
    for (int k = 1; k < LOOKS; k++)
        find_efforts(step, step->size * k / LOOKS, effort[k]);
    for (int i = 0; i < N_JOINTS; i++)
        for (int side = -1; side <= 1; side += 2) {
            double p[LOOKS + 1];
            for (int k = 0; k <= LOOKS; k++)
                p[k] = grip_of(step, i, effort[k][i], side);
            if (step->stops.watched[i] && may_pass(step, i, side))
                looks += doubtful_minima(p, look + looks);
        }
    for (int k = 1; k <= LOOKS && step->size * (k - 1) / LOOKS < before; k++) {
        const double a = step->size * (k - 1) / LOOKS, at_a = least_grip(step, effort[k - 1]);
        double b = step->size * k / LOOKS, at_b = least_grip(step, effort[k]);
        for (int j = 0; j < looks; j++) {
            const double passed = look[j] * step->size;
            const double at_look = a < passed && passed < b ? release_margin(step, passed, 0) : 0.0;
            if (at_look < 0.0) {
                b = passed;
                at_b = at_look;
            }
        }
        if (at_b < 0.0)
            return locate(step, release_margin, 0, a, at_a, b, at_b);
    }
    return HUGE_VAL;
}

/* True if the velocity of a joint that slips may pass zero within the step. */
static int may_be_arrested(const Step *step, int joint)
{
    const int i = N_JOINTS + joint;
    double largest = 0.0;
    for (int stage = 0; stage <= step->stages; stage++)
        largest = fabs(step->K[stage][i]) > largest ? fabs(step->K[stage][i]) : largest;
    return !(step->stops.slip[joint] * step->y[i] > REACH * step->size * largest);
}

/* Find the positions that may pass a limit and the velocities that may pass zero within the step. Return a bound on the
   change of the singular values. */
static double sweep(const Step *step, int near[N_STATES])
{
    const double *low = &step->plant->value[Q_MIN], *high = &step->plant->value[Q_MAX];
    double fastest[N_JOINTS] = {0}, change = 0.0;
    for (int stage = 0; stage <= step->stages; stage++)
        for (int i = 0; i < N_JOINTS; i++) { /* faster than fmax, which handles NaN */
            const double speed = fabs(step->K[stage][i]);
            fastest[i] = speed > fastest[i] ? speed : fastest[i];
        }
    for (int i = 0; i < N_JOINTS; i++) {
        const double q = step->y[i], reach = REACH * step->size * fastest[i];
        near[i] = !step->stops.held[i] && !(q - reach > low[i] && q + reach < high[i]);
        near[N_JOINTS + i] = step->stops.slip[i] && !step->stops.held[i] && may_be_arrested(step, i);
        change += SWING[i] * reach;
    }
    return change;
}

/* Determine the event at a time within the step, with state y. */
static void name_event(Step *step, double passed, const double y[N_STATES], Event *event)
{
    const Stops *stops = &step->stops;
    for (int i = 0; i < N_JOINTS; i++) {
        const double margin = limit_margin(step, passed, i), speed = y[N_JOINTS + i];
        const int into = is_above(step->plant, y[i], i) ? speed > 0.0 : speed < 0.0;
        event->stopped[i] = !stops->held[i] && (margin < 0.0 || (margin == 0.0 && into));
        event->arrested[i] = !stops->held[i] && stops->slip[i] * y[N_JOINTS + i] < 0.0;
    }
}

/* First time in (0, size] at which the regime of the step ends; y_new becomes the state there. 0 if it does not end.
   With rank_held, only a drop of the rank of J⁺ counts. */
static double first_event(Step *step, int rank_held, Event *event)
{
    const double *value = step->plant->value;
    int near[N_STATES];
    const double change = sweep(step, near);
    const int near_rank = !(fmax(step->margin, step->margin_new) > change);
    int any = near_rank;
    for (int i = 0; i < N_JOINTS; i++)
        any |= near[i] || near[N_JOINTS + i] || (step->stops.watched[i] && may_be_released(step, i));
    if (!any)
        return 0.0;
    interpolate(step);
    double first = HUGE_VAL, crossing[N_STATES];
    for (int i = 0; i < N_STATES; i++) {
        const int leaves = i < N_JOINTS && step->y[N_JOINTS + i] == 0.0; /* its limit, if it is there */
        crossing[i] = !near[i] ? HUGE_VAL : first_crossing(step, i < N_JOINTS ? limit_margin : slip_margin, i,
                                                           leaves ? value[ATOL] : 0.0);
        first = fmin(first, crossing[i]);
    }
    first = fmin(first, first_release(step, first));
    if (near_rank)
        first = fmin(first, search(step, singular_margin, rank_held,
                                   PACE / REACH * change / step->size, 0.0,
                                   singular_margin(step, 0.0, rank_held), step->size,
                                   singular_margin(step, step->size, rank_held), HALVINGS));
    if (first == HUGE_VAL)
        return 0.0;
    double reached[N_STATES];
    interpolated(step, first, reached);
    name_event(step, first, reached, event);
    memcpy(step->y_new, reached, sizeof reached);
    const double last = first + (value[RIGID_STOPS] != 0.0 ? TOGETHER * value[MAX_STEP] : 0.0);
    for (int i = 0; i < N_JOINTS; i++) {
        event->stopped[i] |= last > first && crossing[i] <= last;
        if (event->stopped[i])
            step->y_new[i] = value[is_above(step->plant, reached[i], i) ? Q_MAX + i : Q_MIN + i];
        if (event->arrested[i])
            step->y_new[N_JOINTS + i] = 0.0;
    }
    return first;
}
