/* Find the stops that an importer's step passed unnoticed. The quintic through position, velocity and acceleration at
   both ends shows whether a joint reversed near or outside its limit. If a joint did, the engine integrates the step
   again from its start, and the engine's stops are the result. */
#include <math.h>
#include <string.h>

/* A step of the importer. */
typedef struct {
    double time, y[N_STATES], a[N_JOINTS]; /* at its start: time (s), state, accelerations */
    double reached[N_STATES];              /* state at `time` after a stop that the step before passed */
    double stop_time;                      /* s: when the stop was reached */
    int joint;                             /* the stop's joint, from 1 on; 0: no stop was passed */
    int begun;                             /* whether the start is known */
} Passage;

/* s: a polynomial does not approximate a longer step. */
static const double LONGEST_STEP = 1.0;
/* Largest value of s²(1 − s)³/2. The quintic differs from the cubic through positions and velocities by less than this
   factor times the difference of their accelerations. */
static const double BULGE = 0.01728;

/* Start a step of the importer at the plant's state; the derivatives must have been computed. */
static void begin_passage(Passage *passage, const Plant *plant, double time)
{
    const double *rate = &plant->value[DER_V];
    memset(passage, 0, sizeof *passage);
    passage->time = time;
    memcpy(passage->y, &plant->value[Q], sizeof passage->y);
    memcpy(passage->a, rate, sizeof passage->a);
    passage->begun = 1;
    for (int i = 0; i < N_JOINTS; i++)
        passage->begun &= isfinite(rate[i]) != 0;
}

/* True if a joint reversed outside its limits, or so near them that the quintic cannot tell. */
static int reversed_outside(const Passage *start, const Passage *end, const Plant *plant, int i)
{
    const double h = end->time - start->time, low = plant->value[Q_MIN + i];
    const double q = start->y[i], high = plant->value[Q_MAX + i], D = end->y[i] - q;
    const double V0 = h * start->y[N_JOINTS + i], V1 = h * end->y[N_JOINTS + i];
    const double A0 = h * h * start->a[i], A1 = h * h * end->a[i];
    const double c[6] = {
        0.0, V0, 0.5 * A0, 10.0 * D - 6.0 * V0 - 4.0 * V1 - 1.5 * A0 + 0.5 * A1,
        -15.0 * D + 8.0 * V0 + 7.0 * V1 + 1.5 * A0 - A1,
        6.0 * D - 3.0 * V0 - 3.0 * V1 - 0.5 * A0 + 0.5 * A1};
    const double slope[5] = {c[1], 2.0 * c[2], 3.0 * c[3], 4.0 * c[4], 5.0 * c[5]};
    const double doubt = BULGE * (fabs(A0 - (6.0 * D - 4.0 * V0 - 2.0 * V1))
                                  + fabs(A1 - (2.0 * V0 + 4.0 * V1 - 6.0 * D)));
    const double room = fmin(high - q, q - low) - doubt;
    double turn[4], reach = 0.0;
    for (int k = 1; k < 6; k++)
        reach += fabs(c[k]);
    const int turns = reach < room ? 0 : sign_changes(slope, 4, turn);
    for (int k = 0; k < turns; k++) {
        const double moved = polynomial(c, 5, turn[k]);
        if ((moved > fmax(0.0, D) && q + moved > high - doubt)
            || (moved < fmin(0.0, D) && q + moved < low + doubt))
            return 1;
    }
    return 0;
}

/* Find a stop that the importer's step to the plant's state passed, and start the next step there. If the engine cannot
   integrate the step, return the joint that reversed at its limit, counted from 1; otherwise 0. */
static int find_passed_stop(Passage *passage, const Plant *plant, const Stops *stops, double time)
{
    const Passage start = *passage;
    const double h = time - start.time;
    int reversed[N_JOINTS], any = 0;
    begin_passage(passage, plant, time);
    if (!start.begun || !passage->begun || !(h > 0.0 && h <= LONGEST_STEP))
        return 0;
    for (int i = 0; i < N_JOINTS; i++) {
        reversed[i] = !stops->held[i] && reversed_outside(&start, passage, plant, i);
        any = reversed[i] ? i + 1 : any;
    }
    if (!any)
        return 0;
    Plant again = *plant;
    Stops at_start = *stops;
    Failure failure;
    long evaluations = 0;
    double stopped_at[N_JOINTS], first = HUGE_VAL;
    memcpy(&again.value[Q], start.y, sizeof start.y);
    handle_event(&again, &at_start); /* removes the motion by the solver's rounding */
    if (!(STAGES * h <= BUDGET * plant->value[MAX_STEP])
        || !advance_plant(&again, h, &evaluations, stopped_at, &failure))
        return any;
    for (int i = 0; i < N_JOINTS; i++)
        if (reversed[i] && stopped_at[i] < first) {
            first = stopped_at[i];
            passage->joint = i + 1;
        }
    passage->stop_time = passage->joint ? start.time + first : 0.0;
    memcpy(passage->reached, &again.value[Q], sizeof passage->reached);
    return 0;
}

/* If the step before the event passed a stop, set the plant to the state after the stop; return whether it did. */
static int take_passed_stop(Passage *passage, Plant *plant, Stops *stops, double time)
{
    const int takes = passage->joint && passage->time == time
                      && memcmp(passage->y, &plant->value[Q], sizeof passage->y) == 0;
    if (takes) {
        memcpy(&plant->value[Q], passage->reached, sizeof passage->reached);
        *stops = (Stops){.rank = stops->rank}; /* handle_event finds the joints at rest from the state */
    }
    passage->joint = 0;
    return takes;
}
