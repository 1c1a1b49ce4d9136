/* Advance the plant over one communication step, with located events of stops and friction. The rules are
   those of plant/integrator.py.

   Every communication step restarts with the step min(max_step, h).

   Source: Hairer, Nørsett & Wanner, "Solving ODEs I", II.4 and II.6. */
#include <math.h>
#include <stddef.h>
#include <string.h>

/* Why a communication step cannot be done. */
typedef struct {
    enum { NOT_FINITE,      /* the equations of motion gave a value that is not finite */
           MANY_STEPS,      /* max_step requires more evaluations than the budget */
           SHORT_PERIOD,    /* control_period requires more than the budget */
           MANY_EVALUATIONS,
           SMALL_STEPS      /* steps below the resolution of time */
    } reason;
    int joint;   /* the joint that changes fastest, for the last two */
    double rate; /* the joint's rate of change, 1/s */
    long evaluations; /* of the equations of motion, also of a step that can be done */
} Failure;

/* Values of the parameter integrator. */
enum { AUTOMATIC, DORMAND_PRINCE, STIFF };
static const double SAFETY = 0.9, MIN_FACTOR = 0.2, MAX_FACTOR = 10.0;
/* Relative tolerance down to which steps share the tolerances. Below it, rounding would fail the error test. */
static const double FINEST_TOLERANCE = 1.0 / 68719476736.0; /* 2⁻³⁶ */
/* Step of the difference quotients that find the fastest joint: rad, m, rad/s or m/s. */
static const double NUDGE = 1e-6;
/* Fraction of the largest step. Joints that an impact moves, and that come to rest within it, stop with the impact. */
static const double WINDOW = 1.0 / 64.0;
/* Largest short step to an event that is expected soon, as a fraction of the largest step; and, for joints that stop
   together, as a multiple of the time to the first stop. */
static const double SHORT = 0.25, LONGER = 1024.0;

/* Determine the regime at y, where joints may rest. */
static void set_out(Step *step, const int anti_chatter[N_JOINTS], const int on_hold[N_JOINTS], int rank_held)
{
    const double *value = step->plant->value;
    const int hits = impact(step->plant, step->y, anti_chatter) && value[RIGID_STOPS] != 0.0;
    step->evaluations++;
    find_regime(step->plant, step->y, on_hold, rank_held ? step->stops.rank : ANY_RANK,
                hits ? WINDOW * value[MAX_STEP] * coarseness(step->plant) : 0.0, &step->stops,
                step->K[0] + N_JOINTS, step->effort[0], &step->margin);
    step->alone = acts_alone(value, slip_of(&step->stops));
    memcpy(step->K[0], step->y + N_JOINTS, N_JOINTS * sizeof *step->y);
    step->rounding = rounding_of(&step->stops, step->effort[0]);
}

/* True if inputs and all joints are held, so that nothing changes. */
static int all_rest(const Step *step)
{
    int rest = 1;
    for (int i = 0; i < N_JOINTS; i++)
        rest &= step->stops.held[i] && isfinite(step->effort[0][i]);
    return rest;
}

/* True if all joints move without friction. */
static int moves_freely(const Step *step)
{
    int free = !step->stops.any_held;
    for (int i = 0; i < N_JOINTS; i++)
        free &= step->stops.slip[i] == 0;
    return free;
}

static int is_finite(const Step *step)
{
    for (int stage = 0; stage <= step->stages; stage++)
        for (int i = 0; i < N_STATES; i++)
            if (!isfinite(step->K[stage][i]))
                return 0;
    return 1;
}

/* Find the joint whose acceleration is most sensitive to its own position or velocity at y: the rate is the largest of
   |∂q̈ᵢ/∂vᵢ| and |∂q̈ᵢ/∂qᵢ|½. */
static void find_fastest(Step *step, Failure *failure)
{
    double a[N_JOINTS], nudged[N_STATES], answer[N_JOINTS], effort[N_JOINTS];
    evaluate(step, step->y, a, effort, NULL);
    failure->joint = 0;
    failure->rate = -1.0;
    for (int i = 0; i < N_STATES; i++) {
        const int joint = i % N_JOINTS;
        memcpy(nudged, step->y, sizeof nudged);
        nudged[i] += NUDGE;
        evaluate(step, nudged, answer, effort, NULL);
        double rate = fabs(answer[joint] - a[joint]) / NUDGE;
        rate = !isfinite(rate) ? HUGE_VAL : i < N_JOINTS ? sqrt(rate) : rate;
        if (rate > failure->rate) {
            failure->joint = joint;
            failure->rate = rate;
        }
    }
}

/* Fraction of the tolerances that a step may use: after a change of the rank, steps share them (plant/regime.py). */
static double share_of_tolerance(const Step *step)
{
    const double *value = step->plant->value;
    if (!step->crossed)
        return 1.0;
    return fmin(1.0, fmax(step->size / value[MAX_STEP], FINEST_TOLERANCE / value[RTOL]));
}

/* First positive time at which distance + v t + a t²/2 is zero, for a distance ≥ 0 and v < 0 or a < 0; or HUGE_VAL. */
static double first_zero(double distance, double v, double a)
{
    const double root = sqrt(fmax(v * v - 2.0 * a * distance, 0.0));
    if (v >= 0.0)
        return -(v + root) / a;
    return v * v < 2.0 * a * distance ? HUGE_VAL : 2.0 * distance / (root - v);
}

/* Time after which a constant acceleration would stop a joint at a limit or by friction, or efforts that go on to change
   as in the last regime would release one, if it is at most `most`; else HUGE_VAL. */
static double expected_event(const Step *step, double most)
{
    const double *low = &step->plant->value[Q_MIN], *high = &step->plant->value[Q_MAX];
    double first = HUGE_VAL;
    for (int i = 0; i < N_JOINTS; i++) {
        const double q = step->y[i], v = step->K[0][i], a = step->K[0][N_JOINTS + i];
        const double reach = (fabs(v) + fabs(a) * most) * most, rate = step->effort_rate[i];
        if (step->stops.watched[i] && rate != 0.0)
            first = fmin(first, fmax(0.0, grip_of(step, i, step->effort[0][i], rate > 0.0 ? 1 : -1)) / fabs(rate));
        if (step->stops.held[i])
            continue;
        if (step->stops.slip[i] * v > 0.0 && step->stops.slip[i] * a < 0.0)
            first = fmin(first, -v / a);
        if (q - low[i] < reach && (v < 0.0 || a < 0.0))
            first = fmin(first, first_zero(q - low[i], v, a));
        if (high[i] - q < reach && (v > 0.0 || a > 0.0))
            first = fmin(first, first_zero(high[i] - q, -v, -a));
    }
    return first <= most ? first : HUGE_VAL;
}

/* Try a short step of one evaluation to the next event, or to the end if a hold of joints ends there; return its length,
   with the event, or 0. It is long enough for joints that stop together. */
static double short_step(Step *step, double left, int hold_ends, int rank_held, Event *event)
{
    const double most = SHORT * step->plant->value[MAX_STEP], expected = expected_event(step, 0.5 * most);
    const double together = fmin(TOGETHER * step->plant->value[MAX_STEP], LONGER * expected);
    step->size = fmin(fmax(2.0 * expected, together), left);
    if (!(step->size > 0.0 && step->size <= most && (hold_ends || expected < HUGE_VAL))
        || !(heun(step) / share_of_tolerance(step) < 1.0))
        return 0.0;
    const double passed = first_event(step, rank_held, event);
    return passed == 0.0 && hold_ends && step->size == left ? left : passed;
}

/* Integrate from the time t and the state y until an event, the end, or the end of the budget; return the time, with y
   the state there, or NaN on failure. A step whose product with the damping rate exceeds STABLE is one of ROS34PW2. */
static double until_event(Step *step, double t, double end, int hold_ends, int rank_held, double *rate,
                          Event *event, Failure *failure)
{
    const double max_step = step->plant->value[MAX_STEP];
    const int automatic = step->plant->value[INTEGRATOR] == AUTOMATIC;
    double next = fmin(max_step, end - t), growth = MAX_FACTOR;
    Modes modes;
    modes.age = NONE;
    int exact = 0; /* whether the decay by damping is that of the modes */
    if (all_rest(step))
        return end;
    const double soon = *rate > 0.0 ? 0.0 : short_step(step, end - t, hold_ends, rank_held, event);
    if (soon > 0.0) {
        memcpy(step->y, step->y_new, sizeof step->y);
        return soon == end - t ? end : t + soon;
    }
    while (step->evaluations <= BUDGET) {
        const int last = t + next * (1.0 + 1e-9) >= end;
        step->size = last ? end - t : next;
        const int stiff = *rate * step->size > STABLE;
        const double error = stiff ? rosenbrock(step, exact ? &modes : NULL) : dormand_prince(step);
        const double share = share_of_tolerance(step);
        const double passed = error < share ? first_event(step, rank_held, event) : 0.0;
        const double norm = (passed > 0.0 ? fmax(error, step->inside) : error) / share;
        const int order = (stiff ? 3 : 5) - step->crossed;
        const double factor = norm > 0.0 ? SAFETY * pow(norm, -1.0 / order) : MAX_FACTOR;
        if (norm < 1.0) {
            memcpy(step->y, step->y_new, sizeof step->y);
            if (last && (passed == 0.0 || passed == step->size))
                return end;
            if (passed > 0.0)
                return t + passed;
            t += step->size;
            memcpy(step->K[0], step->K[step->stages], sizeof step->K[0]);
            if (step->stops.any_held)
                memcpy(step->effort[0], step->effort[step->stages], sizeof step->effort[0]);
            step->margin = step->margin_new;
            next = fmin(max_step, step->size * fmax(MIN_FACTOR, fmin(growth, factor)));
            growth = MAX_FACTOR;
            modes.age += modes.age != NONE;
            exact = 0;
            continue;
        }
        memset(event, 0, sizeof *event);
        const double limiting = automatic && !stiff ? limiting_rate(step, fmin(max_step, end - t)) : 0.0;
        if (limiting > 0.0) {
            *rate = limiting; /* until the end of the communication step */
        } else if (stiff && !exact && passed == 0.0 && moves_freely(step)
                   && (modes.age != NONE || find_modes(step, &modes)) && decays_clear(step, &modes)) {
            exact = 1;
        } else {
            const int again = stiff && growth == 1.0; /* errors of stiff modes hardly depend on the step */
            next = step->size * (isfinite(norm) && !again ? fmax(MIN_FACTOR, factor) : MIN_FACTOR);
            growth = 1.0; /* no growth right after a rejection */
            exact = exact && (modes.age == 0 || (find_modes(step, &modes) && decays_clear(step, &modes)));
            if (next < 10.0 * (nextafter(end, HUGE_VAL) - end)) {
                failure->reason = is_finite(step) ? SMALL_STEPS : NOT_FINITE;
                find_fastest(step, failure);
                return NAN;
            }
        }
    }
    return t;
}

/* Advance the plant's state by h seconds with inputs held, and locate joint stops. On failure return false and leave
   the plant unchanged. evaluations counts those of the communication step so far, and is updated. stopped_at, which may
   be NULL, receives the time within the step at which each joint first reached a limit, or HUGE_VAL. */
static int advance_plant(Plant *plant, double h, long *evaluations, double stopped_at[N_JOINTS], Failure *failure)
{
    if (IS_CONTROLLER)
        return 1;
    int on_hold[N_JOINTS];
    Event event;
    AntiChatter chatter;
    Step step;
    double t = 0.0, rate = plant->value[INTEGRATOR] == STIFF ? HUGE_VAL : 0.0;
    step.plant = plant;
    step.evaluations = *evaluations;
    step.stops.rank = N_ROWS;
    step.crossed = 0;
    memset(step.effort_rate, 0, sizeof step.effort_rate);
    memcpy(step.y, &plant->value[Q], sizeof step.y);
    begin_anti_chatter(&chatter, plant);
    for (int i = 0; stopped_at && i < N_JOINTS; i++)
        stopped_at[i] = HUGE_VAL;
    while (t < h && step.evaluations <= BUDGET) {
        const int before = step.stops.rank, rank_held = chatter.rank.until > t;
        const double end = hold_joints(&chatter, &step, t, h, on_hold);
        set_out(&step, chatter.joints_held, on_hold, rank_held);
        find_departures(&chatter, &step, t);
        memset(&event, 0, sizeof event);
        step.crossed |= t > 0.0 && step.stops.rank != before;
        if (changes_back(&chatter, &step, before, t))
            continue;
        t = until_event(&step, t, end, end < h && !rank_held, rank_held, &rate, &event, failure);
        find_chatter(&chatter, &step, &event, t);
        for (int i = 0; stopped_at && i < N_JOINTS; i++)
            if (event.stopped[i])
                stopped_at[i] = fmin(stopped_at[i], t);
    }
    *evaluations = step.evaluations;
    if (t < h) {
        failure->reason = MANY_EVALUATIONS;
        find_fastest(&step, failure);
    }
    if (!(t >= h))
        return 0;
    if (!(chatter.joints.until > h))
        memset(chatter.joints_held, 0, sizeof chatter.joints_held);
    impact(plant, step.y, chatter.joints_held);
    memcpy(&plant->value[Q], step.y, sizeof step.y);
    return 1;
}
