/* Getting and setting variables. A refused call changes no variable. INDEX gives the number of values of each
   reference; n_values is the sum. */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "instance.h"

/* Types in the order of the calls that get and set them. */
typedef enum { REAL, BOOLEAN, INTEGER, OTHER } Type;
static const char *const TYPE_NAME[] = {REAL_NAME, "Boolean", INTEGER_NAME};

/* The values of a reference: from begin_of to before end_of. In FMI 2.0 each reference has one. */
static int begin_of(Reference vr)
{
    return FMI == 2 ? (int)(vr - 1) : INDEX[vr];
}

static int end_of(Reference vr)
{
    return FMI == 2 ? (int)vr : INDEX[vr + 1];
}

static size_t size_of(Reference vr)
{
    return (size_t)(end_of(vr) - begin_of(vr));
}

/* True if all references are variables of a type, and have the given total number of values. */
static int known(Instance *instance, Call call, Type type, const Reference vr[], size_t count,
                 const void *values, size_t n_values)
{
    size_t wanted = 0;
    if (count > 0 && (!vr || !values)) {
        refuse(instance, call, "null pointer");
        return 0;
    }
    for (size_t i = 0; i < count; i++) {
        if (vr[i] == 0 || vr[i] > N_REFERENCES) {
            report(instance, ERROR, "%s: there is no variable with value reference %lu",
                   call_name(call), (unsigned long)vr[i]);
            return 0;
        }
        const int index = begin_of(vr[i]);
        const Type actual = index >= FIRST_BOOLEAN ? BOOLEAN : index >= FIRST_INTEGER ? INTEGER : REAL;
        if (actual != type) {
            report(instance, ERROR, "%s: %s is of type %s", call_name(call),
                   VARIABLE_NAME[begin_of(vr[i])], TYPE_NAME[actual]);
            return 0;
        }
        wanted += size_of(vr[i]);
    }
    if (wanted != n_values) {
        report(instance, ERROR, "%s: %lu values for variables of %lu", call_name(call),
               (unsigned long)n_values, (unsigned long)wanted);
        return 0;
    }
    return 1;
}

static int is_state(int variable)
{
    return !IS_CONTROLLER && variable >= Q && variable < X;
}

/* True if a variable may be set now. */
static int settable(Instance *instance, Call call, int variable)
{
    const int phase = instance->state.phase;
    if (is_state(variable) && phase == INSTANTIATED)
        return 1;
    if (is_state(variable) && phase == INITIALIZATION) {
        report(instance, ERROR, "%s: %s follows from %s in initialization mode: set that",
               call_name(call), VARIABLE_NAME[variable], VARIABLE_NAME[variable - Q + Q_START]);
        return 0;
    }
    if (is_state(variable) && instance->kind == MODEL_EXCHANGE)
        return allowed(instance, SET_Q_V, VARIABLE_NAME[variable]);
    if (variable >= FIRST_OUTPUT && variable < FIRST_PARAMETER) {
        report(instance, ERROR, "%s: %s is computed and cannot be set", call_name(call), VARIABLE_NAME[variable]);
        return 0;
    }
    return allowed(instance, variable < FIRST_OUTPUT ? SET_INPUT : SET_PARAMETER, VARIABLE_NAME[variable]);
}

/* True for a parameter that is an input. */
static int is_free(int variable)
{
    return variable >= Q - N_FREE && variable < Q;
}

/* Set a value; dependent outputs are recomputed when they are read. A value of q or v before the run is its start
   value. */
static void set(Instance *instance, int variable, double value)
{
    State *state = &instance->state;
    if (is_state(variable) && state->phase == INSTANTIATED)
        variable += Q_START - Q;
    if (memcmp(&state->plant.value[variable], &value, sizeof value) == 0)
        return;
    state->plant.value[variable] = value;
    state->has_tau = state->has_rates = 0;
    if (is_state(variable) || is_free(variable))
        state->has_x = 0;
    /* in co-simulation, each communication point finds the joints at rest */
    if (is_state(variable) || instance->kind == CO_SIMULATION || IS_CONTROLLER)
        state->has_stops = 0;
    if (variable >= FIRST_PARAMETER || (is_free(variable) && state->phase <= INITIALIZATION))
        state->initialised = 0;
}

/* The variables that only FMI 3.0 has, after the derivatives of the states: event indicators and time. */
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

/* Compute an output for the present state, inputs and parameters. */
static Status update(Instance *instance, int variable)
{
    State *state = &instance->state;
    if (!state->initialised && initialise(instance, 0) != OK)
        return ERROR;
    if (variable >= TAU && check_inputs(instance) != OK)
        return ERROR;
    const int held = state->plant.value[CONTROL_PERIOD] != 0.0;
    if (!held && variable >= Q_MEAS && variable < DER_Q)
        show_samples(state);
    else if (variable >= TAU && (held || variable < Q_MEAS) && !update_control(instance))
        return report(instance, DISCARD, "%s: %s", call_name(GET_REAL), NO_EFFORT);
    if (variable >= END_OF_RATES) {
        update_others(state);
    } else if (variable >= DER_Q) {
        update_rates(state);
    } else if (variable >= X && variable < TAU && !state->has_x) {
        compute_position(&state->plant);
        state->has_x = 1;
    }
    if (!isfinite(state->plant.value[variable]))
        return report(instance, DISCARD, "%s: %s is not finite", call_name(GET_REAL), VARIABLE_NAME[variable]);
    return OK;
}

/* Read a value of a type from an importer's array as a number. */
static double number_in(Type type, const void *values, size_t i)
{
    if (type == REAL)
        return ((const double *)values)[i];
    return type == INTEGER ? (double)((const Integer *)values)[i] : (double)(((const Boolean *)values)[i] != 0);
}

/* Refuse any reference to a type that the FMU does not have; a call without references is valid. */
static Status get_values(void *component, Call call, const Reference vr[], size_t count, void *values, size_t n_values)
{
    Instance *instance = enter(component, call, 1);
    const Type type = (Type)(call - GET_REAL);
    size_t n = 0;
    if (!instance || !known(instance, call, type, vr, count, values, n_values))
        return ERROR;
    for (size_t i = 0; i < count; i++)
        for (int k = begin_of(vr[i]); k < end_of(vr[i]); k++)
            if (k >= FIRST_OUTPUT && k < FIRST_PARAMETER) {
                const Status status = update(instance, k);
                if (status != OK)
                    return status;
            }
    for (size_t i = 0; i < count; i++)
        for (int k = begin_of(vr[i]); k < end_of(vr[i]); k++, n++) {
            const double number = instance->state.plant.value[k];
            if (type == REAL)
                ((double *)values)[n] = number;
            else if (type == INTEGER)
                ((Integer *)values)[n] = (Integer)number;
            else
                ((Boolean *)values)[n] = number != 0.0;
        }
    return OK;
}

/* True if a variable may have a value now. */
static int accepts(Instance *instance, Call call, int variable, double value)
{
    if (!settable(instance, call, variable))
        return 0;
    if (isfinite(value))
        return check_range(instance, variable, value) == OK;
    report(instance, ERROR, "%s = %s is not finite", VARIABLE_NAME[variable],
           isnan(value) ? "nan" : value > 0.0 ? "inf" : "-inf");
    return 0;
}

static Status set_values(void *component, Call call, const Reference vr[], size_t count, const void *values,
                         size_t n_values)
{
    Instance *instance = enter(component, call, 1);
    const Type type = (Type)(call - SET_REAL);
    size_t checked = 0, n = 0;
    if (!instance || !known(instance, call, type, vr, count, values, n_values))
        return ERROR;
    for (size_t i = 0; i < count; i++)
        for (int k = begin_of(vr[i]); k < end_of(vr[i]); k++)
            if (!accepts(instance, call, k, number_in(type, values, checked++)))
                return ERROR;
    for (size_t i = 0; i < count; i++)
        for (int k = begin_of(vr[i]); k < end_of(vr[i]); k++)
            set(instance, k, number_in(type, values, n++));
    return OK;
}
