/* Model Exchange: the importer's solver integrates the states q and v, and finds the events. */
#include <math.h>
#include <string.h>

#include "instance.h"

/* The instance, if the call is allowed and passes the expected number of values, else NULL; computes q and v. */
static Instance *enter_with(void *component, Call call, const void *values, size_t count,
                            size_t wanted)
{
    Instance *instance = enter(component, call, 1);
    if (!instance)
        return NULL;
    if (count != wanted || (wanted > 0 && !values)) {
        report(instance, ERROR, "%s: %s, expected %u", call_name(call),
               values ? "wrong number of values" : "null pointer", (unsigned)wanted);
        return NULL;
    }
    if (instance->state.phase == INITIALIZATION && !instance->state.initialised
        && initialise(instance, 0) != OK)
        return NULL;
    if (instance->state.phase == INSTANTIATED)
        return instance;
    if (check_inputs(instance) != OK)
        return NULL;
    if (!update_held(instance)) {
        refuse(instance, call, NO_EFFORT);
        return NULL;
    }
    return instance;
}

static const char CLOCK_NAME[] = "control_clock"; /* name in FMUs built with --clocked */

/* Refuse a call that leaves out the next tick or comes before it. */
static Status off_tick(Instance *instance, Call call, double tick)
{
    return report(instance, ERROR, "%s: %s ticks next at %.12g s, and the time is %.12g s; tick it in event mode at"
                  " that time, or instantiate without event mode", call_name(call), CLOCK_NAME, tick,
                  instance->state.time);
}

/* True unless a tick is due that the importer has left out. */
static int has_ticked(Instance *instance, Call call)
{
    const State *state = &instance->state;
    const double tick = instant(&state->sampling, &state->plant, state->sampling.k);
    return state->sampling.clock == NO_CLOCK || tick > state->time + slack(&state->plant, state->time)
           || off_tick(instance, call, tick) == OK;
}

/* Report whether the states q and v changed, and the time of the next time event, HUGE_VAL if there is none. */
static Status update_discrete_states(void *component, Boolean *states_changed, double *next_event)
{
    Instance *instance = enter_with(component, NEW_DISCRETE_STATES, states_changed, 1, 1);
    if (!instance)
        return ERROR;
    State draft = instance->state;
    if (!settle(&draft.sampling, &draft.plant, draft.time))
        return refuse(instance, NEW_DISCRETE_STATES, NO_EFFORT);
    update_stops(&draft);
    int changed = 0;
    if (!IS_CONTROLLER) {
        changed = take_passed_stop(&draft.passage, &draft.plant, &draft.stops, draft.time);
        changed |= handle_event(&draft.plant, &draft.stops);
    }
    for (int i = 0; i < N_STATES; i++) /* the velocities of an impact may overflow */
        if (!isfinite(draft.plant.value[Q + i]))
            return report(instance, ERROR, "%s: %s would not be finite",
                          call_name(NEW_DISCRETE_STATES), VARIABLE_NAME[Q + i]);
    draft.has_x = draft.has_tau = draft.has_rates = 0;
    if (draft.sampling.clock == ACTIVE)
        draft.sampling.clock = INACTIVE;
    instance->state = draft;
    *next_event = next_sampling_event(&draft.sampling, &draft.plant);
    *states_changed = changed;
    return OK;
}

Status STANDARD(EnterEventMode)(void *component)
{
    return move_on(component, ENTER_EVENT_MODE, EVENT);
}

Status STANDARD(EnterContinuousTimeMode)(void *component)
{
    Instance *instance = enter(component, ENTER_CONTINUOUS_TIME_MODE, 1);
    if (!instance || !has_ticked(instance, ENTER_CONTINUOUS_TIME_MODE))
        return ERROR;
    State *state = &instance->state;
    state->phase = CONTINUOUS_TIME;
    if (IS_CONTROLLER)
        return OK;
    update_rates(state);
    begin_passage(&state->passage, &state->plant, state->time);
    return OK;
}

Status STANDARD(CompletedIntegratorStep)(void *component, Boolean no_set_state_prior,
                                         Boolean *enter_event_mode, Boolean *terminate)
{
    static const char remedy[] = "the motion goes on without the stop; shorten the solver's steps";
    Instance *instance = enter(component, COMPLETED_INTEGRATOR_STEP, enter_event_mode && terminate);
    (void)no_set_state_prior;
    if (!instance)
        return ERROR;
    *enter_event_mode = *terminate = 0;
    if (IS_CONTROLLER)
        return OK;
    const char *call = call_name(COMPLETED_INTEGRATOR_STEP);
    State *state = &instance->state;
    Passage *passage = &state->passage;
    if (passage->joint)
        report(instance, WARNING, "%s: joint '%s' was at a limit at %.12g s, between two steps of the"
               " solver, and %s was not called at %.12g s: %s", call, JOINT_NAME[passage->joint - 1],
               passage->stop_time, call_name(ENTER_EVENT_MODE), passage->time, remedy);
    update_rates(state);
    const int failed = find_passed_stop(passage, &state->plant, &state->stops, state->time);
    if (failed)
        report(instance, WARNING, "%s: joint '%s' reversed at a limit in the solver's step to %.12g s, which"
               " the FMU cannot integrate: %s", call, JOINT_NAME[failed - 1], state->time, remedy);
    *enter_event_mode = passage->joint != 0;
    return OK;
}

Status STANDARD(SetTime)(void *component, double time)
{
    Instance *instance = enter(component, SET_TIME, 1);
    if (!instance)
        return ERROR;
    if (!isfinite(time))
        return refuse(instance, SET_TIME, "the time is not finite");
    instance->state.time = time;
    instance->state.has_tau = 0;
    if (instance->state.plant.value[CONTROL_PERIOD] != 0.0) /* the held effort may be another one */
        instance->state.has_rates = 0;
    return OK;
}

Status STANDARD(SetContinuousStates)(void *component, const double x[], size_t count)
{
    Instance *instance = enter_with(component, SET_CONTINUOUS_STATES, x, count, N_CONTINUOUS);
    if (!instance)
        return ERROR;
    State *state = &instance->state;
    for (int i = 0; i < N_CONTINUOUS; i++)
        if (!isfinite(x[i]))
            return report(instance, ERROR, "%s: %s is not finite",
                          call_name(SET_CONTINUOUS_STATES), VARIABLE_NAME[Q + i]);
    update_stops(state); /* joints at rest stay at rest until an event */
    if (memcmp(&state->plant.value[Q], x, N_CONTINUOUS * sizeof *x) == 0)
        return OK;
    memcpy(&state->plant.value[Q], x, N_CONTINUOUS * sizeof *x);
    state->has_x = state->has_tau = state->has_rates = 0;
    return OK;
}

Status STANDARD(GetDerivatives)(void *component, double derivatives[], size_t count)
{
    Instance *instance = enter_with(component, GET_DERIVATIVES, derivatives, count, N_CONTINUOUS);
    if (!instance)
        return ERROR;
    const double *rate = &instance->state.plant.value[DER_Q];
    update_rates(&instance->state);
    for (int i = 0; i < N_CONTINUOUS; i++)
        if (!isfinite(rate[i]))
            return report(instance, DISCARD, "%s: %s is not finite",
                          call_name(GET_DERIVATIVES), VARIABLE_NAME[DER_Q + i]);
    memcpy(derivatives, rate, N_CONTINUOUS * sizeof *rate);
    return OK;
}

Status STANDARD(GetEventIndicators)(void *component, double indicators[], size_t count)
{
    Instance *instance =
        enter_with(component, GET_EVENT_INDICATORS, indicators, count, N_EVENTS);
    if (!instance)
        return ERROR;
    update_stops(&instance->state);
    if (N_EVENTS > 0)
        event_indicators(&instance->state.plant, &instance->state.stops, indicators);
    for (int i = 0; i < N_EVENTS; i++)
        if (!isfinite(indicators[i]))
            return report(instance, DISCARD, "%s: the %d. is not finite",
                          call_name(GET_EVENT_INDICATORS), i + 1);
    return OK;
}

Status STANDARD(GetContinuousStates)(void *component, double x[], size_t count)
{
    Instance *instance = enter_with(component, GET_CONTINUOUS_STATES, x, count, N_CONTINUOUS);
    if (!instance)
        return ERROR;
    memcpy(x, &instance->state.plant.value[Q], N_CONTINUOUS * sizeof *x);
    return OK;
}

Status STANDARD(GetNominalsOfContinuousStates)(void *component, double nominals[], size_t count)
{
    Instance *instance = enter_with(component, GET_NOMINALS, nominals, count, N_CONTINUOUS);
    if (!instance)
        return ERROR;
    for (int i = 0; i < N_CONTINUOUS; i++)
        nominals[i] = 1.0;
    return OK;
}
