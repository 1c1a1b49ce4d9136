/* Dormand–Prince 5(4) over one communication step, with located joint-limit stops. The rules are
   those of plant/integrator.py, which are SciPy's RK45 with stops.

   Every communication step begins afresh with the step min(max_step, h).

   Sources: Dormand & Prince, J. Comp. Appl. Math. 6(1), 1980; Shampine, Math. Comp. 46, 1986;
   Hairer, Nørsett & Wanner, "Solving ODEs I", II.4. */
#include "integrator.h"

#include <math.h>
#include <string.h>

#include "stops.h"

/* Row s weighs the derivatives of stages 0…s; the last row is the fifth-order solution. */
static const double A[STAGES][STAGES] = {
    {1.0 / 5, 0, 0, 0, 0, 0},
    {3.0 / 40, 9.0 / 40, 0, 0, 0, 0},
    {44.0 / 45, -56.0 / 15, 32.0 / 9, 0, 0, 0},
    {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729, 0, 0},
    {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656, 0},
    {35.0 / 384, 0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84},
};
static const double E[STAGES + 1] = {
    -71.0 / 57600, 0, 71.0 / 16695, -71.0 / 1920, 17253.0 / 339200, -22.0 / 525, 1.0 / 40};
static const double P[STAGES + 1][4] = {
    {1, -8048581381.0 / 2820520608, 8663915743.0 / 2820520608, -12715105075.0 / 11282082432},
    {0, 0, 0, 0},
    {0, 131558114200.0 / 32700410799, -68118460800.0 / 10900136933, 87487479700.0 / 32700410799},
    {0, -1754552775.0 / 470086768, 14199869525.0 / 1410260304, -10690763975.0 / 1880347072},
    {0, 127303824393.0 / 49829197408, -318862633887.0 / 49829197408,
     701980252875.0 / 199316789632},
    {0, -282668133.0 / 205662961, 2019193451.0 / 616988883, -1453857185.0 / 822651844},
    {0, 40617522.0 / 29380423, -110615467.0 / 29380423, 69997945.0 / 29380423},
};
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

/* One integration step, from y to y_new. */
typedef struct {
    const Plant *plant;
    double size;                /* s */
    double y[N_STATES], y_new[N_STATES];
    double K[STAGES + 1][N_STATES]; /* derivatives at the stages, */
    int rank[STAGES + 1];       /* of J⁺ there */
    long evaluations;           /* of the equations of motion so far */
    double Q[N_STATES][4];      /* coefficients of the dense output */
    Stops stops;
    int stopped[N_JOINTS];      /* joints that reached a limit at the end of the step, */
    int let_go[N_JOINTS];       /* and joints that are no longer pressed into theirs there */
} Step;

/* q̈ at a state, and its rank. */
static int evaluate(Step *step, const double y[N_STATES], double a[N_JOINTS])
{
    step->evaluations++;
    return acceleration(step->plant, y, y + N_JOINTS, a);
}

/* Set out at y, where joints may rest at a limit. */
static void set_out(Step *step, const int kept[N_JOINTS])
{
    impact(step->plant, step->y, kept);
    step->rank[0] = evaluate(step, step->y, step->K[0] + N_JOINTS);
    hold(step->plant, step->y, step->K[0] + N_JOINTS, kept, &step->stops);
    memcpy(step->K[0], step->y + N_JOINTS, N_JOINTS * sizeof *step->y);
}

/* Fill y_new and K[1…6] from y and K[0]; the norm of the error, which passes where below 1. */
static double dormand_prince(Step *step)
{
    const double rtol = step->plant->value[RTOL], atol = step->plant->value[ATOL];
    double *y_new = step->y_new, sum = 0.0;
    for (int stage = 1; stage <= STAGES; stage++) {
        double weight[STAGES], *a = step->K[stage] + N_JOINTS;
        for (int s = 0; s < stage; s++)
            weight[s] = step->size * A[stage - 1][s];
        for (int i = 0; i < N_STATES; i++) {
            double change = 0.0;
            for (int s = 0; s < stage; s++)
                change += weight[s] * step->K[s][i];
            y_new[i] = step->y[i] + change;
        }
        memcpy(step->K[stage], y_new + N_JOINTS, N_JOINTS * sizeof *y_new);
        step->rank[stage] = evaluate(step, y_new, a);
        if (step->stops.any_held) {
            double pressed[N_JOINTS];
            restrain(step->plant, &step->stops, y_new, a, pressed);
        }
    }
    for (int i = 0; i < N_STATES; i++) {
        double error = 0.0;
        for (int s = 0; s <= STAGES; s++)
            error += E[s] * step->K[s][i];
        const double size = fabs(step->y[i]), size_new = fabs(y_new[i]);
        const double ratio =
            step->size * error / (atol + rtol * (size > size_new ? size : size_new));
        sum += ratio * ratio;
    }
    return sqrt(sum / N_STATES);
}

/* State at a time within the step, by the fourth-order interpolant. */
static void dense_output(const Step *step, double passed, double y[N_STATES])
{
    const double x = passed / step->size;
    for (int i = 0; i < N_STATES; i++) {
        const double *c = step->Q[i];
        const double slope = c[0] + c[1] * x + c[2] * (x * x) + c[3] * (x * x * x);
        y[i] = passed == step->size ? step->y_new[i] : step->y[i] + step->size * x * slope;
    }
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
    for (int i = 0; i < N_STATES; i++)
        for (int k = 0; k < 4; k++) {
            step->Q[i][k] = 0.0;
            for (int s = 0; s <= STAGES; s++)
                step->Q[i][k] += step->K[s][i] * P[s][k];
        }
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
    memcpy(step.y, &plant->value[Q], N_JOINTS * sizeof *step.y);
    memcpy(step.y + N_JOINTS, &plant->value[V], N_JOINTS * sizeof *step.y);
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
    memcpy(&plant->value[Q], step.y, N_JOINTS * sizeof *step.y);
    memcpy(&plant->value[V], step.y + N_JOINTS, N_JOINTS * sizeof *step.y);
    return 1;
}
