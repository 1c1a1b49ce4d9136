/* Instantiation, messages and initialisation of an instance. */
#include "instance.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* Log categories by status; the first switches all of them on. */
static const char *const CATEGORY[] = {
    "logAll", "logStatusWarning", "logStatusDiscard", "logStatusError", "logStatusFatal"};
enum { N_CATEGORIES = sizeof CATEGORY / sizeof *CATEGORY, EVERY_CATEGORY = (1 << N_CATEGORIES) - 1 };

/* Categories that are logged although logging is off: none in FMI 3.0; all but information in 2.0, where logging means
   debug logging. */
enum { CATEGORIES_OFF = FMI == 3 ? 0 : EVERY_CATEGORY - 1 };

Status report(Instance *instance, Status status, const char *format, ...)
{
    char text[512];
    va_list arguments;
    if (!instance->log || instance->silent >> status & 1)
        return status;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    hand_over(instance, status, CATEGORY[status], text);
    return status;
}

/* Set the state to that of a new instance. */
static void reset_state(Instance *instance)
{
    State *state = &instance->state;
    memset(state, 0, sizeof *state);
    memcpy(state->guid, MODEL_GUID, sizeof MODEL_GUID);
    memcpy(state->plant.value, START, sizeof START);
    state->stop_time = HUGE_VAL;
    state->phase = INSTANTIATED;
    state->sampling.clock = instance->has_clock ? INACTIVE : NO_CLOCK;
}

/* Return OK if a variable may have a value; a refusal is logged. */
static Status check_range(Instance *instance, int variable, double value)
{
    for (size_t k = 0; k < sizeof RANGE / sizeof *RANGE; k++) {
        const int index = variable - RANGE[k].first;
        if (index >= 0 && index < RANGE[k].count
            && !(value >= RANGE[k].low && value <= RANGE[k].high))
            return report(instance, ERROR, "%s = %g must be %s", VARIABLE_NAME[variable],
                          value, RANGE[k].words);
    }
    return OK;
}

/* True if the control law can follow the inputs; a refusal is logged. */
static Status check_inputs(Instance *instance)
{
#ifdef HAS_QUAT_DES
    const double *quat = &instance->state.plant.value[QUAT_DES];
    if (quat[0] == 0.0 && quat[1] == 0.0 && quat[2] == 0.0 && quat[3] == 0.0)
        return report(instance, ERROR, "quat_des = 0, 0, 0, 0 is not an orientation; the identity"
                      " is (0, 0, 0, 1)");
#else
    (void)instance;
#endif
    return OK;
}

/* True if the controller's period allows its delay and its sensors. */
static Status check_sampling(Instance *instance)
{
    const double *value = instance->state.plant.value;
    const double period = value[CONTROL_PERIOD], delay = value[CONTROL_DELAY];
    const int of_points = !COMMANDS_ACCELERATION && instance->kind == CO_SIMULATION;
    const int group[] = {Q_RESOLUTION, Q_NOISE, V_NOISE, V_FROM_Q};
    if (IS_CLOCKED && period == 0.0)
        return report(instance, ERROR, "control_period = 0, but a clock samples this controller; set it to more than 0");
    if (delay != 0.0 && period == 0.0)
        return report(instance, ERROR, "control_delay = %g needs a control_period > 0; set that, or leave"
                      " it out", delay);
    if (delay > MOST_PERIODS * period * (1.0 + 1e-12)) /* 0.11 is more than ten times 0.011 in binary numbers */
        return report(instance, ERROR, "control_delay = %.12g must be at most %d times control_period = %.12g;"
                      " reduce it, or increase control_period", delay, MOST_PERIODS, period);
    for (int i = N_JOINTS; i-- > 0 && value[V_FROM_Q] != 0.0;)
        if (value[V_NOISE + i] != 0.0)
            return report(instance, ERROR, "%s = %g has no effect with v_from_q = true; leave one of them out",
                          VARIABLE_NAME[V_NOISE + i], value[V_NOISE + i]);
    for (size_t k = 0; k < sizeof group / sizeof *group && period == 0.0 && !of_points; k++)
        for (int i = group[k]; i < group[k] + (group[k] == V_FROM_Q ? 1 : N_JOINTS); i++)
            if (value[i] != 0.0) {
                char text[24] = "true";
                if (i != V_FROM_Q)
                    snprintf(text, sizeof text, "%g", value[i]);
                return report(instance, ERROR, "%s = %s needs a control_period > 0; set that, or leave it out",
                              VARIABLE_NAME[i], text);
            }
    return OK;
}

/* True if joint limits form ranges and the parameters of sampling are consistent; a refusal is logged. */
static Status check_parameters(Instance *instance)
{
    const double *value = instance->state.plant.value;
    for (int i = 0; i < N_JOINTS; i++)
        if (value[Q_MIN + i] > value[Q_MAX + i])
            return report(instance, ERROR, "q_min[%d] = %g > q_max[%d] = %g (joint '%s')",
                          i + 1, value[Q_MIN + i], i + 1, value[Q_MAX + i], JOINT_NAME[i]);
    return check_sampling(instance);
}

/* Check the parameters and set q and v to their start; a refusal is logged. With warn, clamped values are logged too.
   */
static Status initialise(Instance *instance, int warn)
{
    State *state = &instance->state;
    double *value = state->plant.value;
    const int anti_chatter[N_JOINTS] = {0};
    if (check_parameters(instance) != OK || check_inputs(instance) != OK)
        return ERROR;
    for (int i = 0; i < N_JOINTS && !IS_CONTROLLER; i++) {
        const double start = value[Q_START + i];
        const double low = value[Q_MIN + i], high = value[Q_MAX + i];
        const double q = start < low ? low : start > high ? high : start;
        if (warn && q != start)
            report(instance, WARNING,
                   "q_start[%d] = %g of joint '%s' is outside its limits [%g, %g] and was clamped"
                   " to %g", i + 1, start, JOINT_NAME[i], low, high, q);
        value[Q + i] = q;
        value[V + i] = value[V_START + i];
    }
    if (!IS_CONTROLLER)
        impact(&state->plant, &value[Q], anti_chatter);
    state->sampling = (Sampling){.start = state->time, .time = state->time, .clock = state->sampling.clock};
    for (int i = 0; i < N_JOINTS && value[CONTROL_PERIOD] != 0.0; i++)
        value[TAU + i] = 0.0;
    state->initialised = 1;
    state->has_x = state->has_tau = state->has_stops = state->has_rates = 0;
    return OK;
}

/* Compute the outputs q_meas and v_meas, and a held tau. A sample that is due is taken for these outputs only and not
   stored, because inputs may still change; in continuous-time mode only an event takes samples. False if an effort is
   not finite. */
static int show_samples(State *state)
{
    Sampling draft = state->sampling;
    const int held = state->plant.value[CONTROL_PERIOD] != 0.0;
    return (held && state->phase == CONTINUOUS_TIME) || settle(&draft, &state->plant, state->time);
}

/* Find the joints at rest, unless they are known. */
static void update_stops(State *state)
{
    if (!state->has_stops)
        find_stops(&state->plant, &state->stops);
    state->has_stops = 1;
}

/* Compute the output tau, unless it is known. False if an effort of a sampled controller is not finite. */
static int update_control(Instance *instance)
{
    State *state = &instance->state;
    const int held = state->plant.value[CONTROL_PERIOD] != 0.0;
    if (state->has_tau)
        return 1;
    if (held && !show_samples(state))
        return 0;
    if (!held && instance->kind == MODEL_EXCHANGE) /* there, only an event changes the rank */
        update_stops(state);
    compute_effort(&state->plant, instance->kind == MODEL_EXCHANGE ? state->stops.rank : ANY_RANK);
    state->has_tau = 1;
    return 1;
}

/* Do the same for a sampled controller only, whose output tau is the acting effort. */
static int update_held(Instance *instance)
{
    return instance->state.plant.value[CONTROL_PERIOD] == 0.0 || update_control(instance);
}

/* Compute the derivatives, unless they are known. */
static void update_rates(State *state)
{
    update_stops(state);
    if (!(state->has_rates & RATES))
        compute_rates(&state->plant, &state->stops);
    state->has_rates |= RATES;
}

/* Return a new instance, a copy of the draft; NULL if it has no name or a wrong token. */
static Instance *instantiate(Instance draft, const char *token, int logging_on)
{
    const char *function = call_name(INSTANTIATE), *name = draft.name;
    if (!name || !*name) {
        draft.name = "";
        report(&draft, ERROR, "%s: the instance has no name", function);
        return NULL;
    }
    if (!token || strcmp(token, MODEL_GUID) != 0) {
        report(&draft, ERROR, "%s: the " TOKEN " is not that of this FMU, " MODEL_GUID, function);
        return NULL;
    }
    const size_t matrix = X * sizeof *draft.slope;
    Instance *instance = calloc(1, sizeof *instance + matrix + strlen(name) + 1);
    if (!instance) {
        report(&draft, ERROR, "%s: no memory", function);
        return NULL;
    }
    *instance = draft;
    instance->silent = logging_on ? 0 : EVERY_CATEGORY - CATEGORIES_OFF;
    instance->slope = (double(*)[N_JOINTS])(instance + 1);
    instance->name = strcpy((char *)(instance + 1) + matrix, name);
    reset_state(instance);
    return instance;
}

void STANDARD(FreeInstance)(void *component)
{
    free(component);
}

const char *STANDARD(GetVersion)(void)
{
    return STANDARD(Version);
}

Status STANDARD(SetDebugLogging)(void *component, Boolean on, size_t count,
                                 const char *const categories[])
{
    Instance *instance = enter(component, SET_DEBUG_LOGGING, count == 0 || categories);
    int chosen = count == 0 ? EVERY_CATEGORY : 0;
    if (!instance)
        return ERROR;
    for (size_t i = 0; i < count; i++) {
        const char *category = categories[i] ? categories[i] : "";
        int k = 0;
        while (k < N_CATEGORIES && strcmp(category, CATEGORY[k]) != 0)
            k++;
        if (k == N_CATEGORIES)
            return report(instance, ERROR, "%s: there is no category '%s'",
                          call_name(SET_DEBUG_LOGGING), category);
        chosen |= k == 0 ? EVERY_CATEGORY : 1 << k;
    }
    instance->silent = EVERY_CATEGORY - (on ? chosen : CATEGORIES_OFF);
    return OK;
}

/* Set the times of the experiment; a tolerance is ignored, with a message. */
static Status set_up(Instance *instance, Call call, const double *tolerance, double start,
                     const double *stop)
{
    if (!isfinite(start))
        return refuse(instance, call, "the start time is not finite");
    if (stop && !(*stop >= start))
        return report(instance, ERROR, "%s: stop time %g < start time %g", call_name(call), *stop,
                      start);
    if (tolerance)
        report(instance, OK, "the tolerance %g of the experiment is ignored: rtol and atol are"
               " parameters", *tolerance);
    instance->state.time = start;
    instance->state.stop_time = stop ? *stop : HUGE_VAL;
    return OK;
}

Status STANDARD(ExitInitializationMode)(void *component)
{
    Instance *instance = enter(component, EXIT_INITIALIZATION, 1);
    if (!instance || initialise(instance, 1) != OK)
        return ERROR;
    instance->state.phase = instance->kind == MODEL_EXCHANGE || instance->has_clock ? EVENT : STEP;
    return OK;
}

Status STANDARD(Terminate)(void *component)
{
    return move_on(component, TERMINATE, TERMINATED);
}

Status STANDARD(Reset)(void *component)
{
    Instance *instance = enter(component, RESET, 1);
    if (!instance)
        return ERROR;
    reset_state(instance);
    return OK;
}
