/* The input clock of a sampled controller, in instances with event mode: the importer ticks it at each sample. Without
   event mode the FMU takes the samples itself. FMI 3.0.2, sections 2.2.8.4 and 2.3.4. */
#include <string.h>

#include "instance.h"

/* The instance, if the call is allowed and its references are of the clock; otherwise NULL, with a message. */
static Instance *enter_clock(void *component, Call call, const Reference vr[], size_t count, const void *values)
{
    Instance *instance = enter(component, call, count == 0 || (vr && values));
    for (size_t i = 0; instance && i < count; i++)
        if (vr[i] != CLOCK) {
            report(instance, ERROR, "%s: the value reference %lu is not of the clock %s", call_name(call),
                   (unsigned long)vr[i], CLOCK_NAME);
            return NULL;
        }
    return instance;
}

fmi3Status fmi3GetClock(fmi3Instance component, const fmi3ValueReference vr[], size_t count, fmi3Clock value[])
{
    const Instance *instance = enter_clock(component, GET_CLOCK, vr, count, value);
    for (size_t i = 0; instance && i < count; i++)
        value[i] = instance->state.sampling.clock == ACTIVE;
    return instance ? OK : ERROR;
}

fmi3Status fmi3SetClock(fmi3Instance component, const fmi3ValueReference vr[], size_t count, const fmi3Clock value[])
{
    Instance *instance = enter_clock(component, SET_CLOCK, vr, count, value);
    if (!instance || count == 0)
        return instance ? OK : ERROR;
    State *state = &instance->state;
    Sampling *sampling = &state->sampling;
    double *number = state->plant.value;
    const double tick = instant(sampling, &state->plant, sampling->k);
    const int clock = value[count - 1] ? ACTIVE : INACTIVE;
    if (clock == sampling->clock)
        return OK;
    if (clock == ACTIVE && fabs(tick - state->time) > slack(&state->plant, state->time))
        return off_tick(instance, SET_CLOCK, tick);
    const int group[] = {TAU, Q_MEAS, V_MEAS};
    for (size_t k = 0; k < sizeof group / sizeof *group; k++)
        if (clock == ACTIVE)
            memcpy(sampling->before[k], &number[group[k]], sizeof sampling->before[k]);
        else
            memcpy(&number[group[k]], sampling->before[k], sizeof sampling->before[k]);
    sampling->clock = clock;
    state->has_tau = 0;
    return OK;
}

fmi3Status fmi3EnterStepMode(fmi3Instance component)
{
    Instance *instance = enter(component, ENTER_STEP_MODE, 1);
    return instance && has_ticked(instance, ENTER_STEP_MODE) ? move_on(component, ENTER_STEP_MODE, STEP) : ERROR;
}

/* The interval is a parameter, which both the importer's call and the variable control_period set. */
fmi3Status fmi3SetIntervalDecimal(fmi3Instance component, const fmi3ValueReference vr[], size_t count,
                                  const fmi3Float64 intervals[])
{
    Instance *instance = enter_clock(component, SET_INTERVAL, vr, count, intervals);
    for (size_t i = 0; instance && i < count; i++) {
        if (!accepts(instance, SET_INTERVAL, CONTROL_PERIOD, intervals[i]))
            return ERROR;
        set(instance, CONTROL_PERIOD, intervals[i]);
    }
    return instance ? OK : ERROR;
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance component, const fmi3ValueReference vr[], size_t count,
                                  fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
{
    const Instance *instance = enter_clock(component, GET_INTERVAL, vr, count, qualifiers ? intervals : NULL);
    for (size_t i = 0; instance && i < count; i++) {
        intervals[i] = instance->state.plant.value[CONTROL_PERIOD];
        qualifiers[i] = fmi3IntervalChanged;
    }
    return instance ? OK : ERROR;
}

/* The first tick is at the start time. */
fmi3Status fmi3GetShiftDecimal(fmi3Instance component, const fmi3ValueReference vr[], size_t count,
                               fmi3Float64 shifts[])
{
    const Instance *instance = enter_clock(component, GET_INTERVAL, vr, count, shifts);
    for (size_t i = 0; instance && i < count; i++)
        shifts[i] = 0.0;
    return instance ? OK : ERROR;
}
