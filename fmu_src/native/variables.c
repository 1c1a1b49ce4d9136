/* Getting and setting variables. A refused call changes no variable. */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "directional.h"
#include "events.h"
#include "instance.h"

typedef enum { REAL, BOOLEAN, OTHER } Type;
static const char *const TYPE_NAME[] = {REAL_NAME, "Boolean"};

/* Whether the references are of variables of a type, of so many values in all. */
static int known(Instance *instance, Call call, Type type, const Reference vr[], size_t count,
                 const void *values, size_t n_values)
{
    size_t wanted = 0;
    if (count > 0 && (!vr || !values)) {
        refuse(instance, call, "null pointer");
        return 0;
    }
    for (size_t i = 0; i < count; i++) {
        if (vr[i] >= N_VARIABLES || EXTENT[vr[i]] == 0) {
            report(instance, ERROR, "%s: there is no variable with value reference %lu",
                   call_name(call), (unsigned long)vr[i]);
            return 0;
        }
        const Type actual = vr[i] >= FIRST_BOOLEAN ? BOOLEAN : REAL;
        if (actual != type) {
            report(instance, ERROR, "%s: %s is of type %s", call_name(call),
                   VARIABLE_NAME[vr[i]], TYPE_NAME[actual]);
            return 0;
        }
        wanted += (size_t)EXTENT[vr[i]];
    }
    if (wanted != n_values) {
        report(instance, ERROR, "%s: %lu values for variables of %lu", call_name(call),
               (unsigned long)n_values, (unsigned long)wanted);
        return 0;
    }
    return 1;
}

/* Before the run q and v are guesses, by their start attributes: what they begin with is theirs to
   compute. */
static int is_guess(const Instance *instance, Reference vr)
{
    return vr >= Q && vr < X && instance->state.phase <= INITIALIZATION;
}

/* Whether a variable may be set now. */
static int settable(Instance *instance, Call call, Reference vr)
{
    if (is_guess(instance, vr))
        return 1;
    if (vr >= Q && vr < X && instance->kind == MODEL_EXCHANGE)
        return allowed(instance, SET_Q_V, VARIABLE_NAME[vr]);
    if (vr >= FIRST_OUTPUT && vr < FIRST_PARAMETER) {
        report(instance, ERROR, "%s: %s is computed and cannot be set", call_name(call),
               VARIABLE_NAME[vr]);
        return 0;
    }
    return allowed(instance, vr < FIRST_OUTPUT ? SET_INPUT : SET_PARAMETER, VARIABLE_NAME[vr]);
}

/* Take over a value; outputs that follow from it are computed anew when they are read. */
static void set(Instance *instance, Reference vr, double value)
{
    State *state = &instance->state;
    if (is_guess(instance, vr)) {
        const int start = Q_START + (int)vr - Q;
        if (value != state->plant.value[start])
            report(instance, WARNING, "%s = %g is ignored before the run: the start is %s = %g",
                   VARIABLE_NAME[vr], value, VARIABLE_NAME[start], state->plant.value[start]);
        return;
    }
    const int is_state = vr >= Q && vr < X;
    state->plant.value[vr] = value;
    state->has_tau = state->has_rates = 0;
    if (is_state)
        state->has_x = 0;
    if (is_state || instance->kind == CO_SIMULATION) /* there a stop is decided at each point */
        state->has_stops = 0;
    if (vr >= FIRST_PARAMETER)
        state->initialised = 0;
}

/* Variables after the derivatives of the states, that FMI 3.0 has: the event indicators and the time. */
#if FMI == 3
enum { END_OF_RATES = EVENT_INDICATORS };
static void update_others(State *state)
{
    update_stops(state);
    event_indicators(&state->plant, &state->stops, &state->plant.value[EVENT_INDICATORS]);
    state->plant.value[TIME] = state->time;
}
#else
enum { END_OF_RATES = FIRST_PARAMETER };
static void update_others(State *state)
{
    (void)state;
}
#endif

/* Make an output right for the present state, inputs and parameters. */
static Status update(Instance *instance, Reference vr)
{
    State *state = &instance->state;
    if (!state->initialised && initialise(instance, 0) != OK)
        return ERROR;
    if (vr >= TAU && check_inputs(instance) != OK)
        return ERROR;
    if (vr >= END_OF_RATES) {
        update_others(state);
    } else if (vr >= DER_Q) {
        update_rates(state);
    } else if (vr >= X && vr < TAU && !state->has_x) {
        compute_position(&state->plant);
        state->has_x = 1;
    } else if (vr >= TAU && !state->has_tau) {
        compute_effort(&state->plant);
        state->has_tau = 1;
    }
    if (!isfinite(state->plant.value[vr]))
        return report(instance, DISCARD, "%s: %s is not finite", call_name(GET_REAL),
                      VARIABLE_NAME[vr]);
    return OK;
}

Status get_reals(void *component, const Reference vr[], size_t count, double value[],
                 size_t n_values)
{
    Instance *instance = enter(component, GET_REAL, 1);
    if (!instance || !known(instance, GET_REAL, REAL, vr, count, value, n_values))
        return ERROR;
    for (size_t i = 0; i < count; i++)
        for (int e = 0; e < EXTENT[vr[i]]; e++)
            if (vr[i] >= FIRST_OUTPUT && vr[i] < FIRST_PARAMETER) {
                const Status status = update(instance, vr[i] + (Reference)e);
                if (status != OK)
                    return status;
            }
    for (size_t i = 0; i < count; value += EXTENT[vr[i++]])
        memcpy(value, &instance->state.plant.value[vr[i]], (size_t)EXTENT[vr[i]] * sizeof *value);
    return OK;
}

Status set_reals(void *component, const Reference vr[], size_t count, const double value[],
                 size_t n_values)
{
    Instance *instance = enter(component, SET_REAL, 1);
    const double *next = value;
    if (!instance || !known(instance, SET_REAL, REAL, vr, count, value, n_values))
        return ERROR;
    for (size_t i = 0; i < count; i++) {
        if (!settable(instance, SET_REAL, vr[i]))
            return ERROR;
        for (int e = 0; e < EXTENT[vr[i]]; e++, next++) {
            if (!isfinite(*next))
                return report(instance, ERROR, "%s = %s is not finite", VARIABLE_NAME[vr[i] + e],
                              isnan(*next) ? "nan" : *next > 0.0 ? "inf" : "-inf");
            if (check_range(instance, (int)vr[i] + e, *next) != OK)
                return ERROR;
        }
    }
    for (size_t i = 0; i < count; i++)
        for (int e = 0; e < EXTENT[vr[i]]; e++)
            set(instance, vr[i] + (Reference)e, *value++);
    return OK;
}

Status get_booleans(void *component, const Reference vr[], size_t count, Boolean value[],
                    size_t n_values)
{
    Instance *instance = enter(component, GET_BOOLEAN, 1);
    if (!instance || !known(instance, GET_BOOLEAN, BOOLEAN, vr, count, value, n_values))
        return ERROR;
    for (size_t i = 0; i < count; i++)
        value[i] = instance->state.plant.value[vr[i]] != 0.0;
    return OK;
}

Status set_booleans(void *component, const Reference vr[], size_t count, const Boolean value[],
                    size_t n_values)
{
    Instance *instance = enter(component, SET_BOOLEAN, 1);
    if (!instance || !known(instance, SET_BOOLEAN, BOOLEAN, vr, count, value, n_values))
        return ERROR;
    for (size_t i = 0; i < count; i++)
        if (!settable(instance, SET_BOOLEAN, vr[i]))
            return ERROR;
    for (size_t i = 0; i < count; i++)
        set(instance, vr[i], value[i] ? 1.0 : 0.0);
    return OK;
}

Status get_others(void *component, const Reference vr[], size_t count, const void *value,
                  size_t n_values)
{
    Instance *instance = enter(component, GET_OTHER, 1);
    return instance && known(instance, GET_OTHER, OTHER, vr, count, value, n_values) ? OK : ERROR;
}

Status set_others(void *component, const Reference vr[], size_t count, const void *value,
                  size_t n_values)
{
    Instance *instance = enter(component, SET_OTHER, 1);
    return instance && known(instance, SET_OTHER, OTHER, vr, count, value, n_values) ? OK : ERROR;
}

/* What of the computed variables derivatives of the unknowns by the knowns need; -1, which is logged,
   where there are none. */
static int wanted(Instance *instance, Call call, const Reference unknown[], size_t n_unknown,
                  const Reference given[], size_t n_given)
{
    int wants = 0;
    for (size_t i = 0; i < n_unknown; i++) {
        const Reference vr = unknown[i];
        if (vr < FIRST_OUTPUT || vr >= END_OF_RATES) {
            report(instance, ERROR, "%s: %s is not computed, it has no derivative", call_name(call),
                   VARIABLE_NAME[vr]);
            return -1;
        }
        wants |= vr >= DER_Q ? WANTS_RATES : vr >= TAU ? WANTS_TAU : vr >= X ? WANTS_X : 0;
    }
    for (size_t i = 0; i < n_given; i++)
        if (given[i] >= X) {
            report(instance, ERROR, "%s: %s is neither a state nor an input", call_name(call),
                   VARIABLE_NAME[given[i]]);
            return -1;
        }
    if (!instance->state.initialised && initialise(instance, 0) != OK)
        return -1;
    update_stops(&instance->state);
    return wants;
}

/* Name of the first variable whose value is not finite, NULL where all are. */
static const char *culprit(const Reference vr[], size_t count, const double value[])
{
    for (size_t i = 0; i < count; i++)
        for (int e = 0; e < EXTENT[vr[i]]; e++)
            if (!isfinite(*value++))
                return VARIABLE_NAME[vr[i] + e];
    return NULL;
}

Status directional_derivative(void *component, const Reference unknown[], size_t n_unknown,
                              const Reference given[], size_t n_given, const double seed[],
                              size_t n_seed, double result[], size_t n_result)
{
    const Call call = GET_DIRECTIONAL_DERIVATIVE;
    Instance *instance = enter(component, call, 1);
    double change[FIRST_PARAMETER] = {0}, derivative[FIRST_PARAMETER];
    if (!instance || !known(instance, call, REAL, unknown, n_unknown, result, n_result)
        || !known(instance, call, REAL, given, n_given, seed, n_seed))
        return ERROR;
    const char *name = culprit(given, n_given, seed);
    if (name)
        return report(instance, ERROR, "%s: the change of %s is not finite", call_name(call), name);
    const int wants = wanted(instance, call, unknown, n_unknown, given, n_given);
    if (wants < 0)
        return ERROR;
    for (size_t i = 0; i < n_given; i++)
        for (int e = 0; e < EXTENT[given[i]]; e++)
            change[given[i] + e] += *seed++;
    differentiate(instance->state.plant.value, instance->state.stops.held, wants, change,
                  derivative);
    for (size_t i = 0; i < n_unknown; i++)
        if ((name = culprit(&unknown[i], 1, &derivative[unknown[i]])))
            return report(instance, DISCARD, "%s: that of %s is not finite", call_name(call), name);
    for (size_t i = 0; i < n_unknown; result += EXTENT[unknown[i++]])
        memcpy(result, &derivative[unknown[i]], (size_t)EXTENT[unknown[i]] * sizeof *result);
    return OK;
}

#if FMI == 3
/* The change of the unknowns, weighted by the seed, for a change of each given variable by 1. */
Status fmi3GetAdjointDerivative(void *component, const Reference unknown[], size_t n_unknown,
                                const Reference given[], size_t n_given, const double seed[],
                                size_t n_seed, double result[], size_t n_result)
{
    const Call call = GET_ADJOINT_DERIVATIVE;
    Instance *instance = enter(component, call, 1);
    double weight[FIRST_PARAMETER] = {0}, sum[FIRST_PARAMETER] = {0};
    if (!instance || !known(instance, call, REAL, unknown, n_unknown, seed, n_seed)
        || !known(instance, call, REAL, given, n_given, result, n_result))
        return ERROR;
    const char *name = culprit(unknown, n_unknown, seed);
    if (name)
        return report(instance, ERROR, "%s: the weight of %s is not finite", call_name(call), name);
    const int wants = wanted(instance, call, unknown, n_unknown, given, n_given);
    if (wants < 0)
        return ERROR;
    for (size_t i = 0; i < n_unknown; i++)
        for (int e = 0; e < EXTENT[unknown[i]]; e++)
            weight[unknown[i] + e] += *seed++;
    for (size_t i = 0; i < n_given; i++) /* a column of the Jacobian for each value */
        for (Reference k = given[i]; k < given[i] + (Reference)EXTENT[given[i]]; k++) {
            double change[FIRST_PARAMETER] = {0}, derivative[FIRST_PARAMETER];
            change[k] = 1.0;
            differentiate(instance->state.plant.value, instance->state.stops.held, wants, change,
                          derivative);
            sum[k] = 0.0;
            for (int u = FIRST_OUTPUT; u < END_OF_RATES; u++)
                if (weight[u] != 0.0)
                    sum[k] += weight[u] * derivative[u];
            if (!isfinite(sum[k]))
                return report(instance, DISCARD, "%s: that by %s is not finite", call_name(call),
                              VARIABLE_NAME[k]);
        }
    for (size_t i = 0; i < n_given; result += EXTENT[given[i++]])
        memcpy(result, &sum[given[i]], (size_t)EXTENT[given[i]] * sizeof *result);
    return OK;
}
#endif
