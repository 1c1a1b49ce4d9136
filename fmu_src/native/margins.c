/* Margins, which are negative after the end of a regime (stops.h), and the location of their zeros on the dense output of
   a step. The rules and their derivation are in plant/event_search.py. */
#include <math.h>
#include <stddef.h>

static const double TIME_RESOLUTION = 1.0 / 4503599627370496.0; /* 2⁻⁵² */
static const double RELEASE_RESOLUTION = 1.0 / 1024.0, FINEST_RELEASE = 1.0 / 67108864.0; /* 2⁻¹⁰, 2⁻²⁶ */
static const double COARSEST_RELEASE = 1.0 / 32.0;

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

/* Resolution of the time of a release, s. */
static double release_resolution(const Step *step)
{
    const double fraction = fmax(RELEASE_RESOLUTION * coarseness(step->plant), FINEST_RELEASE);
    return fraction * fmin(step->size / COARSEST_RELEASE, step->plant->value[MAX_STEP]);
}

/* First time in (a, b] at which a margin is negative, to the last bits of the step; it is negative at b. The
   interpolation stays near the middle, so that it never needs many more evaluations than bisection.
   Source: Oliveira & Takahashi, "An enhancement of the bisection method", ACM TOMS 47(1), 2020. */
static double locate(Step *step, Margin *margin, int joint, double a, double at_a, double b,
                     double at_b)
{
    const int releases = margin == release_margin;
    const double resolution = releases ? release_resolution(step) : TIME_RESOLUTION * step->size;
    const double k = releases ? 0.0 : 0.01 / (b - a); /* small: margins are smooth */
    double slack = b - a; /* how much longer the interval may be than after bisection */
    while (b - a > resolution) {
        const double middle = 0.5 * (a + b), half = 0.5 * (b - a);
        double x = at_a > at_b ? (b * at_a - a * at_b) / (at_a - at_b) : middle;
        const double shift = fmin(fmax(k * (b - a) * (b - a), 0.25 * resolution), fabs(middle - x));
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
