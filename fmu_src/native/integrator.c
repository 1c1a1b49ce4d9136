/* Advance the plant over one communication step, with located joint-limit stops. The rules are those of
   plant/integrator.py.

   Every communication step begins afresh with the step min(max_step, h).

   Source: Hairer, Nørsett & Wanner, "Solving ODEs I", II.4 and II.6. */
#include "integrator.h"

#include <math.h>
#include <string.h>

#include "dormand_prince.h"
#include "stops.h"

static const double SAFETY = 0.9, MIN_FACTOR = 0.2, MAX_FACTOR = 10.0;
/* As a part of the first step, 2⁻⁸: where J⁺ drops a singular value the right-hand side jumps, and no
   step across that passes the error test. One of this size, whose stages had different ranks, is
   taken. */
static const double JUMP_STEP = 1.0 / 256.0;
/* As parts of the largest step, and of that: a joint that is back at its limit sooner than the one
   after leaving it is kept there for the other, and each time that this is so again twice as long.
   Where its acceleration only grazes zero, as it may at a singularity, or where joints drive each
   other off, it would else leave and return without end; where it returns but once, nothing is
   changed. */
static const double PATIENCE = 0.25, FIRST_WAIT = 1.0 / 1073741824.0; /* 2⁻³⁰ */
static const double TIME_RESOLUTION = 1.0 / 4503599627370496.0; /* 2⁻⁵² */
/* rad, m and per s: of the difference quotients that tell how fast a joint is. */
static const double NUDGE = 1e-6;

/* Set out at y, where joints may rest at a limit. */
static void set_out(Step *step, const int kept[N_JOINTS])
{
    impact(step->plant, step->y, kept);
    step->rank[0] = evaluate(step, step->y, step->K[0] + N_JOINTS);
    hold(step->plant, step->y, step->K[0] + N_JOINTS, kept, &step->stops);
    memcpy(step->K[0], step->y + N_JOINTS, N_JOINTS * sizeof *step->y);
}

/* Mark the free joints that are past a limit and the watched joints that are let go, at y; whether there are any. */
static int events(Step *step, const double y[N_STATES], int found[N_JOINTS])
{
    const double *low = &step->plant->value[Q_MIN], *high = &step->plant->value[Q_MAX];
    const double *q = y, *v = y + N_JOINTS;
    double a[N_JOINTS], pressed[N_JOINTS];
    int any = 0;
    if (step->stops.any_watched) {
        evaluate(step, y, a);
        restrain(step->plant, &step->stops, q, a, pressed);
    }
    for (int i = 0; i < N_JOINTS; i++) {
        found[i] = (q[i] >= high[i] && (q[i] > high[i] || v[i] > 0.0))
                   || (q[i] <= low[i] && (q[i] < low[i] || v[i] < 0.0));
        if (step->stops.watched[i])
            found[i] |= pressed[i] < 0.0;
        any |= found[i];
    }
    return any;
}

/* What may happen within a step: an event, or a joint's turning back. */
typedef int Happened(Step *step, double passed, int joint);

static int event_happened(Step *step, double passed, int joint)
{
    double y[N_STATES];
    int found[N_JOINTS];
    (void)joint;
    dense_output(step, passed, y);
    return events(step, y, found);
}

static int joint_turned(Step *step, double passed, int joint)
{
    double y[N_STATES];
    dense_output(step, passed, y);
    return y[N_JOINTS + joint] * step->y[N_JOINTS + joint] <= 0.0;
}

/* First time in (0, latest] at which it has happened, to the last bits of the step. */
static double bisect(Step *step, Happened *happened, int joint, double latest)
{
    double before = 0.0;
    while (latest - before > TIME_RESOLUTION * step->size) {
        const double middle = 0.5 * (before + latest);
        if (!(before < middle && middle < latest))
            break;
        if (happened(step, middle, joint))
            latest = middle;
        else
            before = middle;
    }
    return latest;
}

/* When a joint is furthest past a limit, where it is so within the step and back at its end; the
   earliest such time, 0 where there is none. */
static double excursion(Step *step)
{
    double earliest = 0.0;
    for (int i = 0; i < N_JOINTS; i++) {
        const double q = step->y[i], v = step->y[N_JOINTS + i];
        const double limit = step->plant->value[(v > 0.0 ? Q_MAX : Q_MIN) + i];
        if (!(v * step->y_new[N_JOINTS + i] < 0.0 && fabs(v) * step->size > fabs(limit - q)))
            continue;
        double y[N_STATES];
        const double turn = bisect(step, joint_turned, i, step->size);
        dense_output(step, turn, y);
        if ((y[i] - limit) * v > 0.0 && (earliest == 0.0 || turn < earliest))
            earliest = turn;
    }
    return earliest;
}

/* First time in (0, size] at which a limit is reached or left, y_new the state from there on; 0
   where there is none. */
static double first_event(Step *step)
{
    const double *low = &step->plant->value[Q_MIN], *high = &step->plant->value[Q_MAX];
    int found[N_JOINTS];
    const int at_the_end = events(step, step->y_new, found);
    int turned = 0;
    for (int i = 0; i < N_JOINTS; i++)
        turned |= step->y[N_JOINTS + i] * step->y_new[N_JOINTS + i] < 0.0;
    if (!at_the_end && !turned)
        return 0.0;
    interpolate(step);
    double latest = at_the_end ? step->size : excursion(step);
    if (latest == 0.0)
        return 0.0;
    latest = bisect(step, event_happened, 0, latest);
    double reached[N_STATES];
    dense_output(step, latest, reached);
    events(step, reached, found);
    for (int i = 0; i < N_JOINTS; i++) {
        step->stopped[i] = found[i] && !step->stops.held[i];
        step->let_go[i] = found[i] && step->stops.held[i];
        if (step->stopped[i])
            reached[i] = fmin(fmax(reached[i], low[i]), high[i]);
    }
    memcpy(step->y_new, reached, sizeof reached);
    return latest;
}

/* Whether the stages of a step had different ranks: it straddles a jump of J⁺. */
static int ranks_differ(const Step *step)
{
    for (int stage = 1; stage <= STAGES; stage++)
        if (step->rank[stage] != step->rank[0])
            return 1;
    return 0;
}

static int is_finite(const Step *step)
{
    for (int stage = 0; stage <= STAGES; stage++)
        for (int i = 0; i < N_STATES; i++)
            if (!isfinite(step->K[stage][i]))
                return 0;
    return 1;
}

/* Name the joint whose own acceleration answers most to its position or velocity at y: the rate is
   the largest of |∂q̈ᵢ/∂vᵢ| and |∂q̈ᵢ/∂qᵢ|½. */
static void find_fastest(Step *step, Obstacle *obstacle)
{
    double a[N_JOINTS], nudged[N_STATES], answer[N_JOINTS];
    evaluate(step, step->y, a);
    obstacle->joint = 0;
    obstacle->rate = -1.0;
    for (int i = 0; i < N_STATES; i++) {
        const int joint = i % N_JOINTS;
        memcpy(nudged, step->y, sizeof nudged);
        nudged[i] += NUDGE;
        evaluate(step, nudged, answer);
        double rate = fabs(answer[joint] - a[joint]) / NUDGE;
        rate = !isfinite(rate) ? HUGE_VAL : i < N_JOINTS ? sqrt(rate) : rate;
        if (rate > obstacle->rate) {
            obstacle->joint = joint;
            obstacle->rate = rate;
        }
    }
}

/* Integrate from the time t, at y, until a joint reaches or leaves a limit, or until the end: the
   time reached, y being the state there; NaN where that cannot be done. */
static double until_event(Step *step, double t, double end, Obstacle *obstacle)
{
    const double max_step = step->plant->value[MAX_STEP];
    double next = fmin(max_step, end - t), growth = MAX_FACTOR;
    const double jump_step = JUMP_STEP * next;
    memset(step->stopped, 0, sizeof step->stopped);
    memset(step->let_go, 0, sizeof step->let_go);
    while (step->evaluations <= BUDGET) {
        const int last = t + next * (1.0 + 1e-9) >= end;
        const int small = next <= jump_step; /* also where stretched to the end */
        step->size = last ? end - t : next;
        const double norm = dormand_prince(step);
        double factor = norm > 0.0 ? SAFETY * pow(norm, -0.2) : MAX_FACTOR;
        if (norm < 1.0 || (small && isfinite(norm) && ranks_differ(step))) {
            const double passed = first_event(step);
            memcpy(step->y, step->y_new, sizeof step->y);
            if (last && (passed == 0.0 || passed == step->size))
                return end;
            if (passed > 0.0)
                return t + passed;
            t += step->size;
            memcpy(step->K[0], step->K[STAGES], sizeof step->K[0]);
            step->rank[0] = step->rank[STAGES];
            factor = fmax(MIN_FACTOR, fmin(growth, factor));
            if (norm < 1.0) /* else the error says nothing about the next step */
                next = fmin(max_step, step->size * factor);
            growth = MAX_FACTOR;
        } else {
            factor = isfinite(norm) ? fmax(MIN_FACTOR, factor) : MIN_FACTOR;
            next = small ? step->size * factor : fmax(jump_step, step->size * factor);
            growth = 1.0; /* no growth right after a rejection */
            if (next < 10.0 * (nextafter(t, HUGE_VAL) - t)) {
                obstacle->reason = is_finite(step) ? SMALL_STEPS : NOT_FINITE;
                find_fastest(step, obstacle);
                return NAN;
            }
        }
    }
    obstacle->reason = MANY_EVALUATIONS;
    find_fastest(step, obstacle);
    return NAN;
}

/* How a joint is kept at its limit: until when, and for how long. */
typedef struct {
    double until, wait;
} Keeping;

static void keep_for_a_while(Keeping *keeping, double t, double patience)
{
    const int again = t - keeping->until < patience;
    keeping->wait = again ? fmin(2.0 * keeping->wait, patience) : FIRST_WAIT * patience;
    keeping->until = t + keeping->wait;
}

int advance_plant(Plant *plant, double h, Obstacle *obstacle)
{
    const double *low = &plant->value[Q_MIN], *high = &plant->value[Q_MAX];
    const double patience = PATIENCE * fmin(plant->value[MAX_STEP], h);
    double left[N_JOINTS];       /* when each joint last left its limit */
    Keeping keeping[N_JOINTS];
    int kept[N_JOINTS], let_go[N_JOINTS] = {0};
    Step step;
    double t = 0.0;
    if (STAGES * h > BUDGET * plant->value[MAX_STEP]) {
        obstacle->reason = MANY_STEPS;
        return 0;
    }
    step.plant = plant;
    step.evaluations = 0;
    memcpy(step.y, &plant->value[Q], sizeof step.y);
    for (int i = 0; i < N_JOINTS; i++) {
        left[i] = -HUGE_VAL;
        keeping[i] = (Keeping){-HUGE_VAL, 0.0};
    }
    while (t < h) {
        double end = h;
        int held_again = 0;
        for (int i = 0; i < N_JOINTS; i++) {
            kept[i] = keeping[i].until > t;
            if (kept[i])
                end = fmin(end, keeping[i].until);
        }
        set_out(&step, kept);
        for (int i = 0; i < N_JOINTS; i++) {
            if (!step.stops.held[i] && !(low[i] < step.y[i] && step.y[i] < high[i]))
                left[i] = t;
            if (step.stops.watched[i] && let_go[i]) { /* it is pressed again, by rounding */
                keep_for_a_while(&keeping[i], t, patience);
                held_again = 1;
            }
            let_go[i] = 0;
        }
        if (held_again)
            continue;
        t = until_event(&step, t, end, obstacle);
        memcpy(let_go, step.let_go, sizeof let_go);
        for (int i = 0; i < N_JOINTS; i++)
            if (step.stopped[i] && t - left[i] < patience)
                keep_for_a_while(&keeping[i], t, patience);
    }
    if (isnan(t))
        return 0;
    for (int i = 0; i < N_JOINTS; i++)
        kept[i] = keeping[i].until > h;
    impact(plant, step.y, kept);
    memcpy(&plant->value[Q], step.y, sizeof step.y);
    return 1;
}
