/* The functions of FMI 3.0 that FMI 2.0 does not have, or has with other arguments. */
#include <math.h>

#include "instance.h"

void hand_over(const Instance *instance, Status status, const char *category, const char *text)
{
    ((fmi3LogMessageCallback)instance->log)(instance->environment, status, category, text);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                         fmi3Boolean visible, fmi3Boolean logging_on,
                                         fmi3Boolean event_mode, fmi3Boolean early_return,
                                         const fmi3ValueReference required[], size_t n_required,
                                         fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback intermediate_update)
{
    (void)resources, (void)visible, (void)early_return, (void)required, (void)intermediate_update;
    Instance draft = {.kind = CO_SIMULATION, .log = (void (*)(void))log,
                      .environment = environment, .name = name, .has_clock = event_mode};
    if ((!event_mode || IS_CLOCKED) && n_required == 0)
        return instantiate(draft, token, logging_on);
    report(&draft, ERROR, "fmi3InstantiateCoSimulation: this FMU has no %s",
           event_mode && !IS_CLOCKED ? "event mode in co-simulation" : "intermediate update");
    return NULL;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging_on,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)resources, (void)visible;
    return instantiate((Instance){.kind = MODEL_EXCHANGE, .log = (void (*)(void))log,
                                  .environment = environment, .name = name, .has_clock = IS_CLOCKED}, token,
                       logging_on);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean tolerance_defined,
                                       fmi3Float64 tolerance, fmi3Float64 start_time,
                                       fmi3Boolean stop_time_defined, fmi3Float64 stop_time)
{
    Instance *own = enter(instance, ENTER_INITIALIZATION, 1);
    if (!own || set_up(own, ENTER_INITIALIZATION, tolerance_defined ? &tolerance : NULL, start_time,
                       stop_time_defined ? &stop_time : NULL) != fmi3OK)
        return fmi3Error;
    own->state.phase = INITIALIZATION;
    return fmi3OK;
}

#define VARIABLES(Name, TYPE)                                                                      \
    fmi3Status fmi3Get##Name(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,   \
                             fmi3##Name value[], size_t n_values)                                  \
    {                                                                                              \
        return get_values(instance, GET_##TYPE, vr, count, value, n_values);                       \
    }                                                                                              \
    fmi3Status fmi3Set##Name(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,   \
                             const fmi3##Name value[], size_t n_values)                            \
    {                                                                                              \
        return set_values(instance, SET_##TYPE, vr, count, value, n_values);                       \
    }
VARIABLES(Float64, REAL)
VARIABLES(Boolean, BOOLEAN)
VARIABLES(Int32, INTEGER)
VARIABLES(Float32, OTHER)
VARIABLES(Int8, OTHER)
VARIABLES(UInt8, OTHER)
VARIABLES(Int16, OTHER)
VARIABLES(UInt16, OTHER)
VARIABLES(UInt32, OTHER)
VARIABLES(Int64, OTHER)
VARIABLES(UInt64, OTHER)
VARIABLES(String, OTHER)

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                         size_t size[], fmi3Binary value[], size_t n_values)
{
    (void)size;
    return get_values(instance, GET_OTHER, vr, count, value, n_values);
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                         const size_t size[], const fmi3Binary value[], size_t n_values)
{
    (void)size;
    return set_values(instance, SET_OTHER, vr, count, value, n_values);
}

#if IS_CLOCKED
#include "clock.c"
#else
fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference vr[], size_t count, fmi3Clock value[])
{
    return get_values(instance, GET_OTHER, vr, count, value, count);
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference vr[], size_t count, const fmi3Clock value[])
{
    return set_values(instance, SET_OTHER, vr, count, value, count);
}
#endif

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknown[],
                                        size_t n_unknown, const fmi3ValueReference known[],
                                        size_t n_known, const fmi3Float64 seed[], size_t n_seed,
                                        fmi3Float64 result[], size_t n_result)
{
    return directional_derivative(instance, unknown, n_unknown, known, n_known, seed, n_seed, result, n_result);
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 point, fmi3Float64 h,
                      fmi3Boolean no_set_state_prior, fmi3Boolean *event_needed,
                      fmi3Boolean *terminates, fmi3Boolean *early_return, fmi3Float64 *last_time)
{
    (void)no_set_state_prior;
    if (!enter(instance, DO_STEP, event_needed && terminates && early_return && last_time))
        return fmi3Error;
    const fmi3Status status = do_step(instance, point, h);
    if (status == fmi3Error)
        return fmi3Error;
    *event_needed = *terminates = *early_return = false;
    *last_time = ((Instance *)instance)->state.time;
    return status;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *needs_update,
                                    fmi3Boolean *terminates, fmi3Boolean *nominals_changed,
                                    fmi3Boolean *states_changed, fmi3Boolean *next_event_defined,
                                    fmi3Float64 *next_event)
{
    if (!needs_update || !terminates || !nominals_changed || !next_event_defined || !next_event)
        states_changed = NULL;
    fmi3Float64 next;
    const fmi3Status status = update_discrete_states(instance, states_changed, &next);
    if (status == fmi3OK) {
        *needs_update = *terminates = *nominals_changed = false;
        *next_event_defined = isfinite(next) != 0;
        *next_event = *next_event_defined ? next : 0.0;
    }
    return status;
}

/* Return the size of a vector. */
static fmi3Status tell(fmi3Instance instance, size_t size, size_t *count)
{
    if (!enter(instance, COUNT_STATES, count != NULL))
        return fmi3Error;
    *count = size;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *count)
{
    return tell(instance, N_EVENTS, count);
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *count)
{
    return tell(instance, N_CONTINUOUS, count);
}

/* Functions of features that modelDescription.xml excludes: clocks, structural parameters, event mode in
   co-simulation, scheduled execution, dependencies of elements. */
#if defined __GNUC__
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token,
                                               fmi3String resources, fmi3Boolean visible,
                                               fmi3Boolean logging_on,
                                               fmi3InstanceEnvironment environment,
                                               fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback clock_update,
                                               fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock)
{
    Instance draft = {.log = (void (*)(void))log, .environment = environment};
    report(&draft, ERROR, "fmi3InstantiateScheduledExecution is not supported by this FMU");
    return NULL;
}

UNSUPPORTED(GetNumberOfVariableDependencies,
            (fmi3Instance instance, fmi3ValueReference valueReference, size_t *nDependencies))
UNSUPPORTED(GetVariableDependencies,
            (fmi3Instance instance, fmi3ValueReference dependent,
             size_t elementIndicesOfDependent[], fmi3ValueReference independents[],
             size_t elementIndicesOfIndependents[], fmi3DependencyKind dependencyKinds[],
             size_t nDependencies))
UNSUPPORTED(EnterConfigurationMode, (fmi3Instance instance))
UNSUPPORTED(ExitConfigurationMode, (fmi3Instance instance))
UNSUPPORTED(EvaluateDiscreteStates, (fmi3Instance instance))
UNSUPPORTED(GetOutputDerivatives,
            (fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
             const fmi3Int32 orders[], fmi3Float64 value[], size_t n_values))
#if !IS_CLOCKED
UNSUPPORTED(EnterStepMode, (fmi3Instance instance))
UNSUPPORTED(GetIntervalDecimal,
            (fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
             fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[]))
UNSUPPORTED(GetShiftDecimal,
            (fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
             fmi3Float64 shifts[]))
UNSUPPORTED(SetIntervalDecimal,
            (fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
             const fmi3Float64 intervals[]))
#endif
UNSUPPORTED(GetIntervalFraction,
            (fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
             fmi3UInt64 counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[]))
UNSUPPORTED(GetShiftFraction,
            (fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
             fmi3UInt64 counters[], fmi3UInt64 resolutions[]))
UNSUPPORTED(SetIntervalFraction,
            (fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
             const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]))
UNSUPPORTED(SetShiftDecimal,
            (fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
             const fmi3Float64 shifts[]))
UNSUPPORTED(SetShiftFraction,
            (fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
             const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]))
UNSUPPORTED(ActivateModelPartition,
            (fmi3Instance instance, fmi3ValueReference clockReference,
             fmi3Float64 activationTime))
