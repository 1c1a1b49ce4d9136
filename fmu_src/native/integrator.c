/* Advance the plant over one communication step, with located events of stops and friction. The rules are
   those of plant/integrator.py.

   Every communication step restarts with the step min(max_step, h).

   Source: Hairer, Nørsett & Wanner, "Solving ODEs I", II.4 and II.6. */
#include "integrator.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#include "dormand_prince.h"
#include "event_search.h"
#include "stops.h"

/* Values of the parameter integrator. */
enum { AUTOMATIC, DORMAND_PRINCE, STIFF };
static const double SAFETY = 0.9, MIN_FACTOR = 0.2, MAX_FACTOR = 10.0;
/* Anti-chatter. CHATTER_TIME is a fraction of the largest step, FIRST_HOLD and HOLD_OF_ALL are fractions of
   CHATTER_TIME. A joint that returns to its limit within CHATTER_TIME is held there for FIRST_HOLD. Each repetition
   lengthens the hold by the factor HOLD_GROWTH. A hold of HOLD_OF_ALL or longer covers all joints at limits. Without
   holds, an acceleration that grazes zero, or joints that push each other off their limits, would release and stop
   joints without end. A joint that returns once is held for some picoseconds. The rank of J⁺ is held in the same way if
   it drops soon after a rise: the motion leads back to the jump from both sides, and slides along it. A higher rank is
   never held, because its J⁺ is unbounded. Each joint that friction holds again at the instant of its release, or that
   stops within FIRST_HOLD of it, has a hold of its own: there, rounding decides. */
static const double CHATTER_TIME = 0.5, FIRST_HOLD = 1.0 / 16777216.0, HOLD_GROWTH = 8.0,
                    HOLD_OF_ALL = 1.0 / 512.0;
/* Fraction of CHATTER_TIME that replaces it for the rank and for stops without reaction: near a singularity ordinary
   gains move joints back and forth within microseconds, and without reaction no impact repeats without end. */
static const double SHORT_CHATTER_TIME = 1.0 / 4096.0;
/* Step of the difference quotients that find the fastest joint: rad, m, rad/s or m/s. */
static const double NUDGE = 1e-6;

/* Determine the regime at y, where joints may rest. */
static void set_out(Step *step, const int anti_chatter[N_JOINTS], const int kept[N_JOINTS], int rank_held)
{
    impact(step->plant, step->y, anti_chatter);
    step->evaluations++;
    find_regime(step->plant, step->y, kept, rank_held ? step->stops.rank : ANY_RANK, &step->stops,
                step->K[0] + N_JOINTS, step->effort[0], &step->margin);
    memcpy(step->K[0], step->y + N_JOINTS, N_JOINTS * sizeof *step->y);
}

/* True if inputs and all joints are held, so that nothing changes. */
static int all_rest(const Step *step)
{
    int rest = 1;
    for (int i = 0; i < N_JOINTS; i++)
        rest &= step->stops.held[i] && isfinite(step->effort[0][i]);
    return rest;
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

/* Integrate from the time t and the state y until an event or the end; return the time, with y the state there, or NaN
   on failure. */
static double until_event(Step *step, double t, double end, int rank_held, int *integrator, Event *event,
                          Failure *failure)
{
    const double max_step = step->plant->value[MAX_STEP];
    double next = fmin(max_step, end - t), growth = MAX_FACTOR;
    if (all_rest(step))
        return end;
    while (step->evaluations <= BUDGET) {
        const int last = t + next * (1.0 + 1e-9) >= end;
        step->size = last ? end - t : next;
        const double norm = *integrator == STIFF ? rosenbrock(step) : dormand_prince(step);
        double factor = norm > 0.0 ? SAFETY * pow(norm, *integrator == STIFF ? -1.0 / 3.0 : -0.2) : MAX_FACTOR;
        if (norm < 1.0) {
            const double passed = first_event(step, rank_held, event);
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
        } else if (*integrator == AUTOMATIC && damping_limits(step, fmin(max_step, end - t))) {
            *integrator = STIFF; /* until the end of the communication step */
        } else {
            next = step->size * (isfinite(norm) ? fmax(MIN_FACTOR, factor) : MIN_FACTOR);
            growth = 1.0; /* no growth right after a rejection */
            if (next < 10.0 * (nextafter(end, HUGE_VAL) - end)) {
                failure->reason = is_finite(step) ? SMALL_STEPS : NOT_FINITE;
                find_fastest(step, failure);
                return NAN;
            }
        }
    }
    failure->reason = MANY_EVALUATIONS;
    find_fastest(step, failure);
    return NAN;
}

/* A hold of joints at limits, of a joint in friction, or of the rank of J⁺. */
typedef struct {
    double until, length;
} Hold;

/* Begin a hold at t, longer than the last one if that ended less than `soon` ago. */
static void hold_for_a_while(Hold *hold, double t, double soon, double longest)
{
    const int again = t - hold->until < soon;
    hold->length = again ? fmin(HOLD_GROWTH * hold->length, longest) : FIRST_HOLD * longest;
    hold->until = t + hold->length;
}

static int is_at_limit(const Step *step, int i)
{
    const double *value = step->plant->value;
    return !(value[Q_MIN + i] < step->y[i] && step->y[i] < value[Q_MAX + i]);
}

/* Hold the joints that chatter at t; a long hold covers all joints at limits. */
static void hold_joints(const Step *step, const int chattering[N_JOINTS], Hold *hold, double t,
                        double joint_time, double chatter_time, int anti_chatter[N_JOINTS])
{
    int any = 0;
    for (int i = 0; i < N_JOINTS; i++)
        any |= chattering[i];
    if (any)
        hold_for_a_while(hold, t, joint_time, chatter_time);
    else if (hold->until > t)
        return;
    const int all = any && hold->length >= HOLD_OF_ALL * chatter_time;
    for (int i = 0; i < N_JOINTS; i++)
        anti_chatter[i] = all ? is_at_limit(step, i) : chattering[i];
}

int advance_plant(Plant *plant, double h, long *evaluations, double stopped_at[N_JOINTS], Failure *failure)
{
    const double chatter_time = CHATTER_TIME * fmin(plant->value[MAX_STEP], h);
    const double short_time = SHORT_CHATTER_TIME * chatter_time;
    const double joint_time = plant->value[RIGID_STOPS] != 0.0 ? chatter_time : short_time;
    double left[N_JOINTS], risen = -HUGE_VAL; /* when each joint left its limit, when the rank rose */
    double slipped[N_JOINTS]; /* when each began to slip */
    Hold joints = {-HUGE_VAL, 0.0}, rank = {-HUGE_VAL, 0.0}, stuck[N_JOINTS];
    int anti_chatter[N_JOINTS] = {0}, chattering[N_JOINTS] = {0}, kept[N_JOINTS];
    Event event = {{0}, {0}, {0}};
    int integrator = (int)plant->value[INTEGRATOR];
    Step step;
    double t = 0.0;
    step.plant = plant;
    step.evaluations = *evaluations;
    step.stops.rank = N_ROWS;
    memcpy(step.y, &plant->value[Q], sizeof step.y);
    for (int i = 0; i < N_JOINTS; i++) {
        left[i] = slipped[i] = -HUGE_VAL;
        stuck[i] = rank;
        if (stopped_at)
            stopped_at[i] = HUGE_VAL;
    }
    while (t < h) {
        const int before = step.stops.rank, rank_held = rank.until > t;
        double end = rank_held ? fmin(h, rank.until) : h;
        int again = 0;
        hold_joints(&step, chattering, &joints, t, joint_time, chatter_time, anti_chatter);
        if (joints.until > t)
            end = fmin(end, joints.until);
        for (int i = 0; i < N_JOINTS; i++) {
            kept[i] = anti_chatter[i] || stuck[i].until > t;
            end = stuck[i].until > t ? fmin(end, stuck[i].until) : end;
        }
        set_out(&step, anti_chatter, kept, rank_held);
        for (int i = 0; i < N_JOINTS; i++) {
            const int held_again = step.stops.watched[i] && event.released[i]; /* because of rounding */
            if (!step.stops.held[i] && is_at_limit(&step, i))
                left[i] = t;
            if (!step.stops.held[i] && step.stops.slip[i] && step.y[N_JOINTS + i] == 0.0)
                slipped[i] = t;
            if (held_again && step.stops.held[i] == STUCK)
                hold_for_a_while(&stuck[i], t, short_time, chatter_time);
            chattering[i] = held_again && step.stops.held[i] != STUCK;
            again |= held_again;
        }
        memset(&event, 0, sizeof event);
        if (again)
            continue;
        if (step.stops.rank > before)
            risen = t;
        if (step.stops.rank < before && t - risen < short_time) {
            hold_for_a_while(&rank, t, short_time, chatter_time);
            continue;
        }
        t = until_event(&step, t, end, rank_held, &integrator, &event, failure);
        for (int i = 0; i < N_JOINTS; i++) {
            chattering[i] = event.stopped[i] && t - left[i] < joint_time;
            if (event.arrested[i] && t - slipped[i] < FIRST_HOLD * chatter_time)
                hold_for_a_while(&stuck[i], t, short_time, chatter_time);
            if (stopped_at && event.stopped[i])
                stopped_at[i] = fmin(stopped_at[i], t);
        }
    }
    *evaluations = step.evaluations;
    if (isnan(t))
        return 0;
    if (!(joints.until > h))
        memset(anti_chatter, 0, sizeof anti_chatter);
    impact(plant, step.y, anti_chatter);
    memcpy(&plant->value[Q], step.y, sizeof step.y);
    return 1;
}
