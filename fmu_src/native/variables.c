/* FMI 2.0: getting and setting variables. A refused call changes no variable. */
#include <math.h>
#include <stddef.h>

#include "directional.h"
#include "instance.h"

/* Types of variables; there are no integers and no strings. */
typedef enum { REAL, BOOLEAN, NONE } Type;
static const char *const TYPE_NAME[] = {"Real", "Boolean"};

/* Whether the value references are of variables of a type. */
static int known(Instance *instance, Call call, Type type, const fmi2ValueReference vr[],
                 size_t count, const void *values)
{
    if (count > 0 && (!vr || !values)) {
        report(instance, fmi2Error, "%s: null pointer", call_name(call));
        return 0;
    }
    for (size_t i = 0; i < count; i++) {
        if (vr[i] >= N_VARIABLES) {
            report(instance, fmi2Error, "%s: there is no variable with value reference %u",
                   call_name(call), vr[i]);
            return 0;
        }
        const Type actual = vr[i] >= FIRST_BOOLEAN ? BOOLEAN : REAL;
        if (actual != type) {
            report(instance, fmi2Error, "%s: %s is of type %s", call_name(call),
                   VARIABLE_NAME[vr[i]], TYPE_NAME[actual]);
            return 0;
        }
    }
    return 1;
}

/* Before the run q and v are guesses, by their start attributes: what they begin with is theirs to
   compute. */
static int is_guess(const Instance *instance, fmi2ValueReference vr)
{
    return vr >= Q && vr < X && instance->state.phase <= INITIALIZATION;
}

/* Whether a variable may be set now. */
static int settable(Instance *instance, Call call, fmi2ValueReference vr)
{
    if (is_guess(instance, vr))
        return 1;
    if (vr >= Q && vr < X && instance->kind == fmi2ModelExchange)
        return allowed(instance, SET_Q_V, VARIABLE_NAME[vr]);
    if (vr >= FIRST_OUTPUT && vr < FIRST_PARAMETER) {
        report(instance, fmi2Error, "%s: %s is computed and cannot be set", call_name(call),
               VARIABLE_NAME[vr]);
        return 0;
    }
    return allowed(instance, vr < FIRST_OUTPUT ? SET_INPUT : SET_PARAMETER, VARIABLE_NAME[vr]);
}

/* Take over a value; outputs that follow from it are computed anew when they are read. */
static void set(Instance *instance, fmi2ValueReference vr, double value)
{
    State *state = &instance->state;
    if (is_guess(instance, vr)) {
        const int start = Q_START + (int)vr - Q;
        if (value != state->plant.value[start])
            report(instance, fmi2Warning, "%s = %g is ignored before the run: the start is %s = %g",
                   VARIABLE_NAME[vr], value, VARIABLE_NAME[start], state->plant.value[start]);
        return;
    }
    const int is_state = vr >= Q && vr < X;
    state->plant.value[vr] = value;
    state->has_tau = state->has_rates = 0;
    if (is_state)
        state->has_x = 0;
    if (is_state || instance->kind == fmi2CoSimulation) /* there a stop is decided at each point */
        state->has_stops = 0;
    if (vr >= FIRST_PARAMETER)
        state->initialised = 0;
}

/* Make an output right for the present state, inputs and parameters. */
static fmi2Status update(Instance *instance, fmi2ValueReference vr)
{
    State *state = &instance->state;
    if (!state->initialised && initialise(instance, 0) != fmi2OK)
        return fmi2Error;
    if (vr >= TAU && check_inputs(instance) != fmi2OK)
        return fmi2Error;
    if (vr >= DER_Q) {
        update_rates(state);
    } else if (vr >= X && vr < TAU && !state->has_x) {
        compute_position(&state->plant);
        state->has_x = 1;
    } else if (vr >= TAU && !state->has_tau) {
        compute_effort(&state->plant);
        state->has_tau = 1;
    }
    if (!isfinite(state->plant.value[vr]))
        return report(instance, fmi2Discard, "fmi2GetReal: %s is not finite", VARIABLE_NAME[vr]);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component component, const fmi2ValueReference vr[], size_t count,
                       fmi2Real value[])
{
    Instance *instance = enter(component, GET_REAL);
    if (!instance || !known(instance, GET_REAL, REAL, vr, count, value))
        return fmi2Error;
    for (size_t i = 0; i < count; i++)
        if (vr[i] >= FIRST_OUTPUT && vr[i] < FIRST_PARAMETER) {
            const fmi2Status status = update(instance, vr[i]);
            if (status != fmi2OK)
                return status;
        }
    for (size_t i = 0; i < count; i++)
        value[i] = instance->state.plant.value[vr[i]];
    return fmi2OK;
}

/* What of the computed variables the derivative of one needs. */
static int wants(fmi2ValueReference vr)
{
    return vr >= DER_Q ? WANTS_RATES : vr >= TAU ? WANTS_TAU : vr >= X ? WANTS_X : 0;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component component, const fmi2ValueReference unknown[],
                                        size_t n_unknown, const fmi2ValueReference given[],
                                        size_t n_given, const fmi2Real seed[], fmi2Real result[])
{
    const Call call = GET_DIRECTIONAL_DERIVATIVE;
    Instance *instance = enter(component, call);
    double change[FIRST_PARAMETER] = {0}, derivative[FIRST_PARAMETER];
    int wanted = 0;
    if (!instance || !known(instance, call, REAL, unknown, n_unknown, result)
        || !known(instance, call, REAL, given, n_given, seed))
        return fmi2Error;
    for (size_t i = 0; i < n_unknown; i++) {
        if (unknown[i] < FIRST_OUTPUT || unknown[i] >= FIRST_PARAMETER)
            return report(instance, fmi2Error, "%s: %s is not computed, it has no derivative",
                          call_name(call), VARIABLE_NAME[unknown[i]]);
        wanted |= wants(unknown[i]);
    }
    for (size_t i = 0; i < n_given; i++) {
        if (given[i] >= X)
            return report(instance, fmi2Error, "%s: %s is neither a state nor an input",
                          call_name(call), VARIABLE_NAME[given[i]]);
        if (!isfinite(seed[i]))
            return report(instance, fmi2Error, "%s: the change of %s is not finite",
                          call_name(call), VARIABLE_NAME[given[i]]);
        change[given[i]] += seed[i];
    }
    if (!instance->state.initialised && initialise(instance, 0) != fmi2OK)
        return fmi2Error;
    update_stops(&instance->state);
    differentiate(instance->state.plant.value, instance->state.stops.held, wanted, change,
                  derivative);
    for (size_t i = 0; i < n_unknown; i++)
        if (!isfinite(derivative[unknown[i]]))
            return report(instance, fmi2Discard, "%s: that of %s is not finite", call_name(call),
                          VARIABLE_NAME[unknown[i]]);
    for (size_t i = 0; i < n_unknown; i++)
        result[i] = derivative[unknown[i]];
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component component, const fmi2ValueReference vr[], size_t count,
                       const fmi2Real value[])
{
    Instance *instance = enter(component, SET_REAL);
    if (!instance || !known(instance, SET_REAL, REAL, vr, count, value))
        return fmi2Error;
    for (size_t i = 0; i < count; i++) {
        if (!settable(instance, SET_REAL, vr[i]))
            return fmi2Error;
        if (!isfinite(value[i]))
            return report(instance, fmi2Error, "%s = %s is not finite", VARIABLE_NAME[vr[i]],
                          isnan(value[i]) ? "nan" : value[i] > 0.0 ? "inf" : "-inf");
        if (check_range(instance, (int)vr[i], value[i]) != fmi2OK)
            return fmi2Error;
    }
    for (size_t i = 0; i < count; i++)
        set(instance, vr[i], value[i]);
    return fmi2OK;
}

fmi2Status fmi2GetBoolean(fmi2Component component, const fmi2ValueReference vr[], size_t count,
                          fmi2Boolean value[])
{
    Instance *instance = enter(component, GET_BOOLEAN);
    if (!instance || !known(instance, GET_BOOLEAN, BOOLEAN, vr, count, value))
        return fmi2Error;
    for (size_t i = 0; i < count; i++)
        value[i] = instance->state.plant.value[vr[i]] != 0.0 ? fmi2True : fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetBoolean(fmi2Component component, const fmi2ValueReference vr[], size_t count,
                          const fmi2Boolean value[])
{
    Instance *instance = enter(component, SET_BOOLEAN);
    if (!instance || !known(instance, SET_BOOLEAN, BOOLEAN, vr, count, value))
        return fmi2Error;
    for (size_t i = 0; i < count; i++)
        if (!settable(instance, SET_BOOLEAN, vr[i]))
            return fmi2Error;
    for (size_t i = 0; i < count; i++)
        set(instance, vr[i], value[i] ? 1.0 : 0.0);
    return fmi2OK;
}

/* Integers and strings: any reference is refused, none is fine. */
static fmi2Status none(fmi2Component component, Call call, const fmi2ValueReference vr[],
                       size_t count, const void *values)
{
    Instance *instance = enter(component, call);
    return instance && known(instance, call, NONE, vr, count, values) ? fmi2OK : fmi2Error;
}

fmi2Status fmi2GetInteger(fmi2Component component, const fmi2ValueReference vr[], size_t count,
                          fmi2Integer value[])
{
    return none(component, GET_INTEGER, vr, count, value);
}

fmi2Status fmi2SetInteger(fmi2Component component, const fmi2ValueReference vr[], size_t count,
                          const fmi2Integer value[])
{
    return none(component, SET_INTEGER, vr, count, value);
}

fmi2Status fmi2GetString(fmi2Component component, const fmi2ValueReference vr[], size_t count,
                         fmi2String value[])
{
    return none(component, GET_STRING, vr, count, value);
}

fmi2Status fmi2SetString(fmi2Component component, const fmi2ValueReference vr[], size_t count,
                         const fmi2String value[])
{
    return none(component, SET_STRING, vr, count, value);
}
