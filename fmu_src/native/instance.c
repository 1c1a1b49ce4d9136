/* The state machine of FMI 2.0, messages, and initialisation. */
#include "instance.h"
#include "events.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

static const char *const PHASE_NAME[N_PHASES] = {
    "instantiated", "initialization mode", "step mode", "step failed", "event mode",
    "continuous-time mode", "terminated"};

enum { N = 1 << INSTANTIATED, I = 1 << INITIALIZATION, S = 1 << STEP, F = 1 << STEP_FAILED,
       E = 1 << EVENT, C = 1 << CONTINUOUS_TIME, T = 1 << TERMINATED,
       ANY = N | I | S | F | E | C | T };

/* Of which kind of instance a call is. */
typedef enum { BOTH, SIMULATION, EXCHANGE } Kind;
static const char *const KIND_NAME[] = {"", "co-simulation", "Model Exchange"};

/* FMI 2.0.4, sections 3.2.3 and 4.2.4: each call, the phases in which it is allowed, and where it is of
   one kind alone. A refused call changes nothing, so there is no error phase. */
static const struct {
    const char *name;
    int phases;
    Kind kind;
} CALLS[N_CALLS] = {
    [SET_DEBUG_LOGGING] = {"fmi2SetDebugLogging", ANY},
    [SETUP_EXPERIMENT] = {"fmi2SetupExperiment", N},
    [ENTER_INITIALIZATION] = {"fmi2EnterInitializationMode", N},
    [EXIT_INITIALIZATION] = {"fmi2ExitInitializationMode", I},
    [TERMINATE] = {"fmi2Terminate", S | F | E | C},
    [RESET] = {"fmi2Reset", ANY},
    [DO_STEP] = {"fmi2DoStep", S, SIMULATION},
    [CANCEL_STEP] = {"fmi2CancelStep", 0, SIMULATION}, /* no step is ever pending */
    [GET_STATUS] = {"fmi2GetStatus", S | F | T, SIMULATION},
    [GET_REAL] = {"fmi2GetReal", I | S | F | E | C | T},
    [GET_INTEGER] = {"fmi2GetInteger", I | S | F | E | C | T},
    [GET_BOOLEAN] = {"fmi2GetBoolean", I | S | F | E | C | T},
    [GET_STRING] = {"fmi2GetString", I | S | F | E | C | T},
    [SET_REAL] = {"fmi2SetReal", N | I | S | E | C},
    [SET_INTEGER] = {"fmi2SetInteger", N | I | S | E | C},
    [SET_BOOLEAN] = {"fmi2SetBoolean", N | I | S | E | C},
    [SET_STRING] = {"fmi2SetString", N | I | S | E | C},
    [SET_INPUT] = {"fmi2Set of an input", N | I | S | E | C},
    [SET_PARAMETER] = {"fmi2Set of a parameter", N | I},
    [SET_Q_V] = {"fmi2Set of a state", E | C},
    [GET_STATE] = {"fmi2GetFMUstate", ANY},
    [SET_STATE] = {"fmi2SetFMUstate", ANY},
    [FREE_STATE] = {"fmi2FreeFMUstate", ANY},
    [SIZE_OF_STATE] = {"fmi2SerializedFMUstateSize", ANY},
    [SERIALIZE] = {"fmi2SerializeFMUstate", ANY},
    [DESERIALIZE] = {"fmi2DeSerializeFMUstate", ANY},
    [ENTER_EVENT_MODE] = {"fmi2EnterEventMode", C, EXCHANGE},
    [NEW_DISCRETE_STATES] = {"fmi2NewDiscreteStates", E, EXCHANGE},
    [ENTER_CONTINUOUS_TIME_MODE] = {"fmi2EnterContinuousTimeMode", E, EXCHANGE},
    [COMPLETED_INTEGRATOR_STEP] = {"fmi2CompletedIntegratorStep", C, EXCHANGE},
    [SET_TIME] = {"fmi2SetTime", E | C, EXCHANGE},
    [SET_CONTINUOUS_STATES] = {"fmi2SetContinuousStates", C, EXCHANGE},
    [GET_DERIVATIVES] = {"fmi2GetDerivatives", I | E | C | T, EXCHANGE},
    [GET_EVENT_INDICATORS] = {"fmi2GetEventIndicators", I | E | C | T, EXCHANGE},
    [GET_CONTINUOUS_STATES] = {"fmi2GetContinuousStates", I | E | C | T, EXCHANGE},
    [GET_DIRECTIONAL_DERIVATIVE] = {"fmi2GetDirectionalDerivative", I | S | F | E | C | T},
    [GET_NOMINALS] = {"fmi2GetNominalsOfContinuousStates", N | I | E | C | T, EXCHANGE},
};

const char *call_name(Call call)
{
    return CALLS[call].name;
}

int allowed(Instance *instance, Call call, const char *culprit)
{
    const int phase = instance->state.phase;
    const Kind kind = instance->kind == fmi2ModelExchange ? EXCHANGE : SIMULATION;
    if (CALLS[call].kind != BOTH && CALLS[call].kind != kind) {
        report(instance, fmi2Error, "%s is a call of %s, and the instance is one of %s",
               CALLS[call].name, KIND_NAME[CALLS[call].kind], KIND_NAME[kind]);
        return 0;
    }
    if (CALLS[call].phases >> phase & 1)
        return 1;
    report(instance, fmi2Error, "%s%s%s%s is not allowed in the state '%s'", CALLS[call].name,
           culprit ? " (" : "", culprit ? culprit : "", culprit ? ")" : "", PHASE_NAME[phase]);
    return 0;
}

int can_be_in(fmi2Type kind, int phase)
{
    const int other = kind == fmi2ModelExchange ? S | F : E | C;
    return phase >= 0 && phase < N_PHASES && !(other >> phase & 1);
}

Instance *enter(fmi2Component component, Call call)
{
    return component && allowed(component, call, NULL) ? component : NULL;
}

fmi2Status report(Instance *instance, fmi2Status status, const char *format, ...)
{
    static const char *const CATEGORY[] = {
        "logAll", "logStatusWarning", "logStatusDiscard", "logStatusError", "logStatusFatal"};
    char text[512], escaped[2 * sizeof text], *end = escaped;
    va_list arguments;
    if (!instance->log || (status == fmi2OK && !instance->verbose))
        return status;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    for (const char *c = text; *c; c++) { /* FMI messages are printf formats */
        if (*c == '%')
            *end++ = '%';
        *end++ = *c;
    }
    *end = '\0';
    instance->log(instance->environment, instance->name, status, CATEGORY[status], escaped);
    return status;
}

void reset_state(State *state)
{
    memset(state, 0, sizeof *state);
    memcpy(state->guid, MODEL_GUID, sizeof MODEL_GUID);
    memcpy(state->plant.value, START, sizeof START);
    state->stop_time = HUGE_VAL;
    state->phase = INSTANTIATED;
}

fmi2Status check_range(Instance *instance, int variable, double value)
{
    for (size_t k = 0; k < sizeof RANGE / sizeof *RANGE; k++) {
        const int index = variable - RANGE[k].first;
        if (index >= 0 && index < RANGE[k].count
            && !(value >= RANGE[k].low && value <= RANGE[k].high))
            return report(instance, fmi2Error, "%s = %g must be %s", VARIABLE_NAME[variable],
                          value, RANGE[k].words);
    }
    return fmi2OK;
}

fmi2Status check_inputs(Instance *instance)
{
#if N_ROWS > N_AXES
    const double *quat = &instance->state.plant.value[QUAT_DES];
    if (quat[0] == 0.0 && quat[1] == 0.0 && quat[2] == 0.0 && quat[3] == 0.0)
        return report(instance, fmi2Error, "quat_des = 0, 0, 0, 0 is no orientation; (0, 0, 0, 1)"
                      " turns nothing");
#else
    (void)instance;
#endif
    return fmi2OK;
}

fmi2Status check_limits(Instance *instance)
{
    const double *value = instance->state.plant.value;
    for (int i = 0; i < N_JOINTS; i++)
        if (value[Q_MIN + i] > value[Q_MAX + i])
            return report(instance, fmi2Error, "q_min[%d] = %g > q_max[%d] = %g (joint '%s')",
                          i + 1, value[Q_MIN + i], i + 1, value[Q_MAX + i], JOINT_NAME[i]);
    return fmi2OK;
}

/* Take the velocity that points into a limit at the start, as at any other time. */
static void stop_at_start(Plant *plant)
{
    const int kept[N_JOINTS] = {0};
    double y[2 * N_JOINTS];
    memcpy(y, &plant->value[Q], N_JOINTS * sizeof *y);
    memcpy(y + N_JOINTS, &plant->value[V], N_JOINTS * sizeof *y);
    impact(plant, y, kept);
    memcpy(&plant->value[V], y + N_JOINTS, N_JOINTS * sizeof *y);
}

fmi2Status initialise(Instance *instance, int warn)
{
    State *state = &instance->state;
    double *value = state->plant.value;
    if (check_limits(instance) != fmi2OK || check_inputs(instance) != fmi2OK)
        return fmi2Error;
    for (int i = 0; i < N_JOINTS; i++) {
        const double start = value[Q_START + i];
        const double low = value[Q_MIN + i], high = value[Q_MAX + i];
        const double q = start < low ? low : start > high ? high : start;
        if (warn && q != start)
            report(instance, fmi2Warning,
                   "q_start[%d] = %g of joint '%s' is outside its limits [%g, %g] and was clamped"
                   " to %g", i + 1, start, JOINT_NAME[i], low, high, q);
        value[Q + i] = q;
        value[V + i] = value[V_START + i];
    }
    stop_at_start(&state->plant);
    state->initialised = 1;
    state->has_x = state->has_tau = state->has_stops = state->has_rates = 0;
    return fmi2OK;
}

void update_stops(State *state)
{
    if (!state->has_stops)
        find_stops(&state->plant, &state->stops);
    state->has_stops = 1;
}

void update_rates(State *state)
{
    update_stops(state);
    if (!state->has_rates)
        compute_rates(&state->plant, &state->stops);
    state->has_rates = 1;
}
