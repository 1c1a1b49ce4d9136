/* Find the first event within an integration step, on its dense output. The rules and their derivation are in
   plant/event_search.py. */
#include <math.h>
#include <string.h>

/* Bounds for Dormand and Prince's interpolant; the cubic has smaller ones, 1.07 and 2. */
static const double REACH = 1.66, PACE = 3.72;
enum { HALVINGS = 7, LOOKS = 10 }; /* most halvings of an interval, most times examined for a joint */
static const double DOUBT = 0.25, LATE = 1.0 / 256.0;
static const double TOGETHER = 1.0 / 33554432.0; /* 2⁻²⁵ */
/* Weights of the efforts at the start, at both thirds and at the end of a stiff step. */
static const double THROUGH_THIRDS[N_INCREMENTS + 1][4] = {
    {1, -2.75, 3, -1.125}, {0, 4.5, -7.5, 3.375}, {0, -2.25, 6, -3.375}, {0, 0, 0, 0}, {0, 0.5, -1.5, 1.125}};

/* The event at the end of a step: joints that reached a limit, and joints that slipped and came to rest. */
typedef struct {
    int stopped[N_JOINTS], arrested[N_JOINTS];
} Event;

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

/* Range of the grip of a joint on one side over the stages if it may be negative within the step; otherwise 0. */
static double doubtful_range(const Step *step, int joint, int side)
{
    double low = HUGE_VAL, high = -HUGE_VAL;
    for (int stage = 0; stage <= step->stages; stage++) {
        const double margin = grip_of(step, joint, step->effort[stage][joint], side);
        low = fmin(low, margin);
        high = fmax(high, margin);
    }
    return low < HUGE_VAL && !(low >= high - low) ? high - low : 0.0;
}

static int may_be_released(const Step *step, int joint)
{
    return doubtful_range(step, joint, -1) != 0.0 || doubtful_range(step, joint, 1) != 0.0;
}

/* The holding effort of a joint, multiplied by a factor, as a polynomial over the step: the rate of the dense output of
   its integral. */
static void effort_polynomial(const Step *step, const double weight[][4], int joint, double factor, double c[4])
{
    for (int k = 0; k < 4; k++) {
        c[k] = 0.0;
        for (int s = 0; s <= step->stages; s++)
            c[k] += factor * (k + 1) * weight[s][k] * step->effort[s][joint];
    }
}

/* Times just after the grips of a joint, as polynomials over the step, pass 0, and times of extrema that may be below 0;
   return their number. */
static int find_looks(const Step *step, const double weight[][4], int joint, double look[LOOKS])
{
    int looks = 0;
    for (int side = -1; side <= 1; side += 2) {
        const double range = doubtful_range(step, joint, side);
        double c[4], root[3], turn[2];
        if (range == 0.0)
            continue;
        effort_polynomial(step, weight, joint, -side, c);
        c[0] = grip_of(step, joint, step->effort[0][joint], side);
        const double slope[3] = {c[1], 2.0 * c[2], 3.0 * c[3]};
        const int roots = sign_changes(c, 3, root), turns = sign_changes(slope, 2, turn);
        for (int k = 0; k < roots; k++) /* where rounding does not decide the sign */
            look[looks++] = root[k] * step->size + LATE * release_resolution(step);
        for (int k = 0; k < turns; k++)
            if (polynomial(c, 3, turn[k]) < DOUBT * range)
                look[looks++] = turn[k] * step->size;
    }
    return looks;
}

/* First time before `before` at which a joint is released, or HUGE_VAL. */
static double first_release(Step *step, double before)
{
    const double instant = TIME_RESOLUTION * step->size, end = fmin(before, step->size);
    const double at_start = least_grip(step, step->effort[0]);
    const double (*weight)[4] = step->P;
    double look[LOOKS * N_JOINTS], a = 0.0, at_a = at_start;
    int looks = 0, doubt = 0;
    for (int i = 0; i < N_JOINTS; i++)
        doubt |= step->stops.watched[i] && may_be_released(step, i);
    if (!doubt || before <= instant)
        return HUGE_VAL;
    const double at_once = at_start > 4.0 * step->rounding ? at_start : release_margin(step, instant, 0);
    if (at_once < 0.0 && at_once < -fabs(release_margin(step, 0.0, 0) - at_start))
        return instant; /* beyond the difference of two ways to compute the efforts; else the joint would be held again */
    if (step->P == CUBIC) { /* its derivatives are not those at the stages */
        weight = THROUGH_THIRDS;
        for (int k = 1; k < 3; k++)
            find_efforts(step, step->size * k / 3, step->effort[k]);
    }
    for (int i = 0; i < N_JOINTS; i++)
        if (step->stops.watched[i])
            looks += find_looks(step, weight, i, look + looks);
    for (;;) {
        double b = end;
        for (int j = 0; j < looks; j++)
            b = a < look[j] && look[j] < b ? look[j] : b;
        const double at_b = b < step->size ? release_margin(step, b, 0) : least_grip(step, step->effort[step->stages]);
        if (at_b < 0.0)
            return locate(step, release_margin, 0, a, at_a, b, at_b);
        if (b == end)
            return HUGE_VAL;
        a = b;
        at_a = at_b;
    }
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

/* True if no joint can reach a limit, and the rank of J⁺ cannot change, during the decay of the modes within the step: the
   dense output does not follow it. */
static int decays_clear(const Step *step, const Modes *modes)
{
    const double *low = &step->plant->value[Q_MIN], *high = &step->plant->value[Q_MAX];
    double distance[N_JOINTS], change = 0.0;
    excursions(modes, step->y + N_JOINTS, step->K[0] + N_JOINTS, step->size, distance);
    for (int i = 0; i < N_JOINTS; i++) {
        const double q = step->y[i], reach = REACH * distance[i];
        if (!(q - reach > low[i] && q + reach < high[i]))
            return 0;
        change += SWING[i] * reach;
    }
    return step->margin > change;
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

/* Bound on the rate of change of the singular values within the step, per s. */
static double swing_rate(const Step *step)
{
    double rate = 0.0;
    for (int i = 0; i < N_JOINTS; i++) {
        double low = step->K[0][i], high = low;
        for (int stage = 1; stage <= step->stages; stage++) {
            low = fmin(low, step->K[stage][i]);
            high = fmax(high, step->K[stage][i]);
        }
        rate += SWING[i] * 0.5 * (fabs(low + high) + PACE * (high - low));
    }
    return rate;
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

/* Find the rates of the holding efforts at a time within the step; 0 in a stiff one. */
static void find_effort_rates(Step *step, double passed)
{
    const double x = passed / step->size;
    double c[4] = {0.0};
    for (int i = 0; i < N_JOINTS; i++) {
        const int known = step->stops.watched[i] && step->P != CUBIC;
        if (known)
            effort_polynomial(step, step->P, i, 1.0 / step->size, c);
        step->effort_rate[i] = known ? c[1] + x * (2.0 * c[2] + 3.0 * c[3] * x) : 0.0;
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
        first = fmin(first, search(step, singular_margin, rank_held, swing_rate(step), 0.0,
                                   singular_margin(step, 0.0, rank_held), step->size,
                                   singular_margin(step, step->size, rank_held), HALVINGS));
    if (first == HUGE_VAL)
        return 0.0;
    double reached[N_STATES];
    find_effort_rates(step, first);
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
