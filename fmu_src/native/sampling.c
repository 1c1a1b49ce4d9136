/* Sampled control by the equations of plant/sampling.py. Without a control_period the law is continuous, and each
   communication point is a sample of the sensors. */
#include <math.h>
#include <string.h>

enum { MOST_PERIODS = 10 }; /* longest delay */

/* The FMU takes the samples itself (NO_CLOCK), or the importer by a clock, which is active while it ticks. */
typedef enum { NO_CLOCK, INACTIVE, ACTIVE } Clock;

/* Discrete state of the controller and its sensors. The acting effort is the plant's output tau. */
typedef struct {
    double start;            /* t_0, s */
    double time;             /* time of the latest sample, s */
    double k;                /* number of samples so far, an integer */
    double q_meas[N_JOINTS]; /* the latest positions, for velocities by differences */
    double pending[MOST_PERIODS + 1][N_JOINTS]; /* efforts that do not act yet, the oldest first */
    int count;                                  /* number of pending efforts */
    int clock;                                  /* a value of Clock */
    double before[3][N_JOINTS];                 /* tau, q_meas and v_meas before the clock became active */
} Sampling;

/* Tolerances for equal times, relative to max(1 s, |t|) and to the period. */
static const double EQUAL_TIMES = 1e-9, PART_OF_PERIOD = 1e-3;
static const double ALL_WHOLE = 9007199254740992.0; /* 2⁵³: doubles of this size or larger are integers */

static double slack(const Plant *plant, double time)
{
    return fmin(EQUAL_TIMES * fmax(1.0, fabs(time)), PART_OF_PERIOD * plant->value[CONTROL_PERIOD]);
}

static double instant(const Sampling *sampling, const Plant *plant, double k)
{
    return sampling->start + k * plant->value[CONTROL_PERIOD];
}

/* Time from which the oldest pending effort acts. */
static double due(const Sampling *sampling, const Plant *plant)
{
    return sampling->count ? instant(sampling, plant, sampling->k - sampling->count) + plant->value[CONTROL_DELAY]
                           : HUGE_VAL;
}

/* Time of the next sample or of the next change of effort, s; HUGE_VAL without samples. */
static double next_sampling_event(const Sampling *sampling, const Plant *plant)
{
    return plant->value[CONTROL_PERIOD] == 0.0
               ? HUGE_VAL
               : fmin(sampling->clock == NO_CLOCK ? instant(sampling, plant, sampling->k) : HUGE_VAL,
                      due(sampling, plant));
}

static double rounded(double q, double resolution)
{
    const double steps = resolution != 0.0 ? q / resolution : HUGE_VAL;
    return fabs(steps) < ALL_WHOLE ? resolution * (rint(steps) + 0.0) : q; /* +0.0: no negative zero */
}

/* Take a sample of the sensors. */
static void measure(Sampling *sampling, Plant *plant, double time)
{
    double *value = plant->value, period = value[CONTROL_PERIOD];
    const double elapsed = period != 0.0 ? period : time - sampling->time;
    for (int i = 0; i < N_JOINTS; i++) {
        double *q = &value[Q_MEAS + i], *v = &value[V_MEAS + i], noise[2];
        *q = rounded(value[Q + i], value[Q_RESOLUTION + i]);
        *v = value[V + i];
        if (value[Q_NOISE + i] != 0.0 || value[V_NOISE + i] != 0.0) {
            normal_pair(value[SEED], sampling->k, i, noise);
            *q += value[Q_NOISE + i] * noise[0];
            *v += value[V_NOISE + i] * noise[1];
        }
        if (value[V_FROM_Q] != 0.0)
            *v = sampling->k > 0.0 ? (*q - sampling->q_meas[i]) / elapsed : 0.0;
        sampling->q_meas[i] = *q;
    }
    sampling->time = time;
    sampling->k += 1.0;
}

/* Take the sample and apply the efforts that are due at a time, s, and update the outputs tau, q_meas and v_meas; for a
   continuous controller, update q_meas and v_meas only. If an effort is not finite, return false and leave the sampling
   unchanged. */
static int settle(Sampling *sampling, Plant *plant, double time)
{
    const double period = plant->value[CONTROL_PERIOD], by = time + slack(plant, time);
    if (period == 0.0) {
        measure(sampling, plant, time);
        return 1;
    }
    if (sampling->clock != INACTIVE && instant(sampling, plant, sampling->k) <= by) {
        const Sampling before = *sampling;
        /* samples that an importer's solver skipped are lost */
        sampling->k = fmax(sampling->k, fmin(ALL_WHOLE, floor((by - sampling->start) / period)));
        measure(sampling, plant, time);
        double *effort = sampling->pending[sampling->count++];
        control_effort(plant, &plant->value[Q_MEAS], &plant->value[V_MEAS], ANY_RANK, effort);
        for (int i = 0; i < N_JOINTS; i++)
            if (!isfinite(effort[i])) {
                *sampling = before;
                return 0;
            }
    }
    while (sampling->count > MOST_PERIODS || due(sampling, plant) <= by) {
        memcpy(&plant->value[TAU], sampling->pending[0], sizeof sampling->pending[0]);
        memmove(sampling->pending[0], sampling->pending[1], MOST_PERIODS * sizeof sampling->pending[0]);
        sampling->count--;
    }
    return 1;
}

/* True if there are samples: of a controller, or of sensors at communication points. */
static int are_samples(const double value[N_VARIABLES])
{
    int any = value[CONTROL_PERIOD] != 0.0;
#if !COMMANDS_ACCELERATION
    any |= value[V_FROM_Q] != 0.0;
    for (int i = 0; i < N_JOINTS; i++)
        any |= value[Q_RESOLUTION + i] != 0.0 || value[Q_NOISE + i] != 0.0 || value[V_NOISE + i] != 0.0;
#endif
    return any;
}

/* Advance plant and samples from a time by h, s. On failure return false and leave both unchanged. */
static int advance_sampled(Sampling *sampling, Plant *plant, double time, double h, Failure *failure)
{
    const double period = plant->value[CONTROL_PERIOD], max_step = plant->value[MAX_STEP], end = time + h;
    double t = time;
    long *evaluations = &failure->evaluations;
    int last = 0;
    *evaluations = 0;
    if (STAGES * h > BUDGET * fmin(max_step, period != 0.0 ? period : HUGE_VAL)) {
        failure->reason = period != 0.0 && period < max_step ? SHORT_PERIOD : MANY_STEPS;
        return 0;
    }
    if (!are_samples(plant->value))
        return advance_plant(plant, h, evaluations, NULL, failure);
    Sampling samples = *sampling;
    Plant draft = *plant;
    while (!last) {
        failure->reason = NOT_FINITE;
        if (!settle(&samples, &draft, t))
            return 0;
        const double next = next_sampling_event(&samples, &draft);
        last = !(next < end - slack(&draft, end));
        const double length = last && t == time ? h : (last ? end : next) - t;
        if (!advance_plant(&draft, length, evaluations, NULL, failure))
            return 0;
        t = next;
    }
    *sampling = samples;
    *plant = draft;
    return 1;
}

/* True if a state of any numbers is valid at a time. */
static int is_sampling(const Sampling *sampling, const Plant *plant, double time)
{
    const double k = sampling->k, period = plant->value[CONTROL_PERIOD];
    int sound = isfinite(sampling->start) && isfinite(sampling->time) && k >= 0.0 && k < ALL_WHOLE && k == floor(k)
                && sampling->clock >= NO_CLOCK && sampling->clock <= ACTIVE
                && sampling->count >= 0 && sampling->count <= MOST_PERIODS && sampling->count <= k;
    for (int i = 0; i < N_JOINTS; i++) {
        sound = sound && isfinite(sampling->q_meas[i]) && (period == 0.0 || isfinite(plant->value[TAU + i]));
        for (int j = 0; j < 3; j++)
            sound = sound && isfinite(sampling->before[j][i]);
        for (int j = 0; j <= MOST_PERIODS; j++)
            sound = sound && isfinite(sampling->pending[j][i]);
    }
    return sound && (period == 0.0 ? sampling->count == 0
                                   : fabs(instant(sampling, plant, k) - time) <= 2.0 * period);
}
