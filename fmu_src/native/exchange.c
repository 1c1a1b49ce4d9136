/* FMI 2.0 Model Exchange: the importer's solver integrates the states q, v, and finds the events. */
#include <math.h>
#include <string.h>

#include "events.h"
#include "instance.h"

enum { N_STATES = 2 * N_JOINTS }; /* q and v follow each other in the table, their derivatives too */

/* The instance where the call is allowed and hands over so many values; its q and v are there. */
static Instance *enter_with(fmi2Component component, Call call, const void *values, size_t count,
                            size_t wanted)
{
    Instance *instance = enter(component, call);
    if (!instance)
        return NULL;
    if (count != wanted || (wanted > 0 && !values)) {
        report(instance, fmi2Error, "%s: %s, %u are wanted", call_name(call),
               values ? "wrong number of values" : "null pointer", (unsigned)wanted);
        return NULL;
    }
    if (instance->state.phase == INITIALIZATION && !instance->state.initialised
        && initialise(instance, 0) != fmi2OK)
        return NULL;
    if (instance->state.phase != INSTANTIATED && check_inputs(instance) != fmi2OK)
        return NULL;
    return instance;
}

fmi2Status fmi2EnterEventMode(fmi2Component component)
{
    Instance *instance = enter(component, ENTER_EVENT_MODE);
    if (!instance)
        return fmi2Error;
    instance->state.phase = EVENT;
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component component, fmi2EventInfo *info)
{
    Instance *instance = enter_with(component, NEW_DISCRETE_STATES, info, 1, 1);
    if (!instance)
        return fmi2Error;
    State *state = &instance->state;
    memset(info, 0, sizeof *info);
    update_stops(state);
    info->valuesOfContinuousStatesChanged = handle_event(&state->plant, &state->stops);
    state->has_x = state->has_tau = state->has_rates = 0;
    return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component component)
{
    Instance *instance = enter(component, ENTER_CONTINUOUS_TIME_MODE);
    if (!instance)
        return fmi2Error;
    instance->state.phase = CONTINUOUS_TIME;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component component, fmi2Boolean no_set_state_prior,
                                       fmi2Boolean *enter_event_mode, fmi2Boolean *terminate)
{
    Instance *instance = enter(component, COMPLETED_INTEGRATOR_STEP);
    (void)no_set_state_prior;
    if (!instance)
        return fmi2Error;
    if (!enter_event_mode || !terminate)
        return report(instance, fmi2Error, "fmi2CompletedIntegratorStep: null pointer");
    *enter_event_mode = *terminate = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component component, fmi2Real time)
{
    Instance *instance = enter(component, SET_TIME);
    if (!instance)
        return fmi2Error;
    if (!isfinite(time))
        return report(instance, fmi2Error, "fmi2SetTime: the time is not finite");
    instance->state.time = time;
    return fmi2OK;
}

fmi2Status fmi2SetContinuousStates(fmi2Component component, const fmi2Real x[], size_t count)
{
    Instance *instance = enter_with(component, SET_CONTINUOUS_STATES, x, count, N_STATES);
    if (!instance)
        return fmi2Error;
    State *state = &instance->state;
    for (int i = 0; i < N_STATES; i++)
        if (!isfinite(x[i]))
            return report(instance, fmi2Error, "fmi2SetContinuousStates: %s is not finite",
                          VARIABLE_NAME[Q + i]);
    update_stops(state); /* what rests does so until an event */
    memcpy(&state->plant.value[Q], x, N_STATES * sizeof *x);
    state->has_x = state->has_tau = state->has_rates = 0;
    return fmi2OK;
}

fmi2Status fmi2GetDerivatives(fmi2Component component, fmi2Real derivatives[], size_t count)
{
    Instance *instance = enter_with(component, GET_DERIVATIVES, derivatives, count, N_STATES);
    if (!instance)
        return fmi2Error;
    const double *rate = &instance->state.plant.value[DER_Q];
    update_rates(&instance->state);
    for (int i = 0; i < N_STATES; i++)
        if (!isfinite(rate[i]))
            return report(instance, fmi2Discard, "fmi2GetDerivatives: %s is not finite",
                          VARIABLE_NAME[DER_Q + i]);
    memcpy(derivatives, rate, N_STATES * sizeof *rate);
    return fmi2OK;
}

fmi2Status fmi2GetEventIndicators(fmi2Component component, fmi2Real indicators[], size_t count)
{
    Instance *instance =
        enter_with(component, GET_EVENT_INDICATORS, indicators, count, N_INDICATORS);
    if (!instance)
        return fmi2Error;
    update_stops(&instance->state);
    event_indicators(&instance->state.plant, &instance->state.stops, indicators);
    for (int i = 0; i < N_INDICATORS; i++)
        if (!isfinite(indicators[i]))
            return report(instance, fmi2Discard, "fmi2GetEventIndicators: the %d. is not finite",
                          i + 1);
    return fmi2OK;
}

fmi2Status fmi2GetContinuousStates(fmi2Component component, fmi2Real x[], size_t count)
{
    Instance *instance = enter_with(component, GET_CONTINUOUS_STATES, x, count, N_STATES);
    if (!instance)
        return fmi2Error;
    memcpy(x, &instance->state.plant.value[Q], N_STATES * sizeof *x);
    return fmi2OK;
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component component, fmi2Real nominals[],
                                             size_t count)
{
    Instance *instance = enter_with(component, GET_NOMINALS, nominals, count, N_STATES);
    if (!instance)
        return fmi2Error;
    for (int i = 0; i < N_STATES; i++)
        nominals[i] = 1.0;
    return fmi2OK;
}
