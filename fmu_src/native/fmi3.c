/* The functions of FMI 3.0, and the table of their calls. */
#include "instance.h"

/* FMI 3.0.2, sections 2.3, 3.2 and 4.2: as in fmi2.c. */
const Rule *rule_of(Call call)
{
    static const Rule RULES[N_CALLS] = {
        [INSTANTIATE] = {"fmi3Instantiate", 0},
        [SET_DEBUG_LOGGING] = {"fmi3SetDebugLogging", ANY},
        [ENTER_INITIALIZATION] = {"fmi3EnterInitializationMode", N},
        [EXIT_INITIALIZATION] = {"fmi3ExitInitializationMode", I},
        [TERMINATE] = {"fmi3Terminate", S | F | M | C},
        [RESET] = {"fmi3Reset", ANY},
        [DO_STEP] = {"fmi3DoStep", S, CO_SIMULATION},
        [GET_REAL] = {"fmi3GetFloat64", I | S | F | M | C | T},
        [GET_BOOLEAN] = {"fmi3GetBoolean", I | S | F | M | C | T},
        [GET_OTHER] = {"fmi3Get of another type", I | S | F | M | C | T},
        [SET_REAL] = {"fmi3SetFloat64", N | I | S | M | C},
        [SET_BOOLEAN] = {"fmi3SetBoolean", N | I | S | M | C},
        [SET_OTHER] = {"fmi3Set of another type", N | I | S | M | C},
        [SET_INPUT] = {"fmi3Set of an input", N | I | S | M | C},
        [SET_PARAMETER] = {"fmi3Set of a parameter", N | I},
        [SET_Q_V] = {"fmi3Set of a state", M | C},
        [GET_STATE] = {"fmi3GetFMUState", ANY},
        [SET_STATE] = {"fmi3SetFMUState", ANY},
        [FREE_STATE] = {"fmi3FreeFMUState", ANY},
        [SIZE_OF_STATE] = {"fmi3SerializedFMUStateSize", ANY},
        [SERIALIZE] = {"fmi3SerializeFMUState", ANY},
        [DESERIALIZE] = {"fmi3DeserializeFMUState", ANY},
        [ENTER_EVENT_MODE] = {"fmi3EnterEventMode", C, MODEL_EXCHANGE},
        [NEW_DISCRETE_STATES] = {"fmi3UpdateDiscreteStates", M, MODEL_EXCHANGE},
        [ENTER_CONTINUOUS_TIME_MODE] = {"fmi3EnterContinuousTimeMode", M, MODEL_EXCHANGE},
        [COMPLETED_INTEGRATOR_STEP] = {"fmi3CompletedIntegratorStep", C, MODEL_EXCHANGE},
        [SET_TIME] = {"fmi3SetTime", M | C, MODEL_EXCHANGE},
        [SET_CONTINUOUS_STATES] = {"fmi3SetContinuousStates", C, MODEL_EXCHANGE},
        [GET_DERIVATIVES] = {"fmi3GetContinuousStateDerivatives", I | M | C | T, MODEL_EXCHANGE},
        [GET_EVENT_INDICATORS] = {"fmi3GetEventIndicators", I | M | C | T, MODEL_EXCHANGE},
        [GET_CONTINUOUS_STATES] = {"fmi3GetContinuousStates", I | M | C | T, MODEL_EXCHANGE},
        [GET_NOMINALS] = {"fmi3GetNominalsOfContinuousStates", N | I | M | C | T, MODEL_EXCHANGE},
        [GET_DIRECTIONAL_DERIVATIVE] = {"fmi3GetDirectionalDerivative", I | S | F | M | C | T},
        [GET_ADJOINT_DERIVATIVE] = {"fmi3GetAdjointDerivative", I | S | F | M | C | T},
        [COUNT_STATES] = {"fmi3GetNumberOf", ANY, MODEL_EXCHANGE},
    };
    return &RULES[call];
}

void hand_over(const Instance *instance, Status status, const char *category, const char *text)
{
    ((fmi3LogMessageCallback)instance->log)(instance->environment, (fmi3Status)status, category,
                                            text);
}

const char *fmi3GetVersion(void)
{
    return fmi3Version;
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
                      .environment = environment, .name = name, .verbose = logging_on};
    if (!event_mode && n_required == 0)
        return instantiate(draft, token);
    report(&draft, ERROR, "fmi3InstantiateCoSimulation: this FMU has no %s",
           event_mode ? "event mode in co-simulation" : "intermediate update");
    return NULL;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging_on,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)resources, (void)visible;
    return instantiate((Instance){.kind = MODEL_EXCHANGE, .log = (void (*)(void))log,
                                  .environment = environment, .name = name,
                                  .verbose = logging_on}, token);
}

void fmi3FreeInstance(fmi3Instance instance)
{
    free(instance);
}

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean logging_on, size_t count,
                               const fmi3String categories[])
{
    return (fmi3Status)set_debug_logging(instance, logging_on, count, categories);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean tolerance_defined,
                                       fmi3Float64 tolerance, fmi3Float64 start_time,
                                       fmi3Boolean stop_time_defined, fmi3Float64 stop_time)
{
    Instance *own = enter(instance, ENTER_INITIALIZATION);
    if (!own || set_up(own, ENTER_INITIALIZATION, tolerance_defined ? &tolerance : NULL, start_time,
                       stop_time_defined ? &stop_time : NULL) != OK)
        return fmi3Error;
    own->state.phase = INITIALIZATION;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    return (fmi3Status)exit_initialization(instance);
}

fmi3Status fmi3Terminate(fmi3Instance instance)
{
    return (fmi3Status)move_on(instance, TERMINATE, TERMINATED);
}

fmi3Status fmi3Reset(fmi3Instance instance)
{
    return (fmi3Status)reset(instance);
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                          fmi3Float64 value[], size_t n_values)
{
    return (fmi3Status)get_reals(instance, vr, count, value, n_values);
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                          const fmi3Float64 value[], size_t n_values)
{
    return (fmi3Status)set_reals(instance, vr, count, value, n_values);
}

fmi3Status fmi3GetBoolean(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                          fmi3Boolean value[], size_t n_values)
{
    return (fmi3Status)get_booleans(instance, vr, count, value, n_values);
}

fmi3Status fmi3SetBoolean(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                          const fmi3Boolean value[], size_t n_values)
{
    return (fmi3Status)set_booleans(instance, vr, count, value, n_values);
}

#define OTHER_TYPE(Name)                                                                           \
    fmi3Status fmi3Get##Name(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,   \
                             fmi3##Name value[], size_t n_values)                                  \
    {                                                                                              \
        return (fmi3Status)other_variables(instance, GET_OTHER, vr, count, value, n_values);       \
    }                                                                                              \
    fmi3Status fmi3Set##Name(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,   \
                             const fmi3##Name value[], size_t n_values)                            \
    {                                                                                              \
        return (fmi3Status)other_variables(instance, SET_OTHER, vr, count, value, n_values);       \
    }
OTHER_TYPE(Float32)
OTHER_TYPE(Int8)
OTHER_TYPE(UInt8)
OTHER_TYPE(Int16)
OTHER_TYPE(UInt16)
OTHER_TYPE(Int32)
OTHER_TYPE(UInt32)
OTHER_TYPE(Int64)
OTHER_TYPE(UInt64)
OTHER_TYPE(String)

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                         size_t size[], fmi3Binary value[], size_t n_values)
{
    (void)size;
    return (fmi3Status)other_variables(instance, GET_OTHER, vr, count, value, n_values);
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                         const size_t size[], const fmi3Binary value[], size_t n_values)
{
    (void)size;
    return (fmi3Status)other_variables(instance, SET_OTHER, vr, count, value, n_values);
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                        fmi3Clock value[])
{
    return (fmi3Status)other_variables(instance, GET_OTHER, vr, count, value, count);
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                        const fmi3Clock value[])
{
    return (fmi3Status)other_variables(instance, SET_OTHER, vr, count, value, count);
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknown[],
                                        size_t n_unknown, const fmi3ValueReference known[],
                                        size_t n_known, const fmi3Float64 seed[], size_t n_seed,
                                        fmi3Float64 result[], size_t n_result)
{
    return (fmi3Status)directional_derivative(instance, unknown, n_unknown, known, n_known, seed,
                                              n_seed, result, n_result);
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknown[],
                                    size_t n_unknown, const fmi3ValueReference known[],
                                    size_t n_known, const fmi3Float64 seed[], size_t n_seed,
                                    fmi3Float64 result[], size_t n_result)
{
    return (fmi3Status)adjoint_derivative(instance, unknown, n_unknown, known, n_known, seed,
                                          n_seed, result, n_result);
}

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *saved)
{
    return (fmi3Status)save_state(instance, saved);
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState saved)
{
    return (fmi3Status)restore_state(instance, saved);
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *saved)
{
    return (fmi3Status)free_state(instance, saved);
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState saved, size_t *size)
{
    return (fmi3Status)size_of_state(instance, saved, size);
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState saved, fmi3Byte bytes[],
                                 size_t size)
{
    return (fmi3Status)serialize_state(instance, saved, bytes, size);
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *saved)
{
    return (fmi3Status)deserialize_state(instance, bytes, size, saved);
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 point, fmi3Float64 h,
                      fmi3Boolean no_set_state_prior, fmi3Boolean *event_needed,
                      fmi3Boolean *terminates, fmi3Boolean *early_return, fmi3Float64 *last_time)
{
    (void)no_set_state_prior;
    if (!instance)
        return fmi3Error;
    if (!event_needed || !terminates || !early_return || !last_time)
        return (fmi3Status)report(instance, ERROR, "fmi3DoStep: null pointer");
    const Status status = do_step(instance, point, h);
    if (status == ERROR)
        return fmi3Error;
    *event_needed = *terminates = *early_return = false;
    *last_time = ((Instance *)instance)->state.time;
    return (fmi3Status)status;
}

fmi3Status fmi3EnterEventMode(fmi3Instance instance)
{
    return (fmi3Status)move_on(instance, ENTER_EVENT_MODE, EVENT);
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *needs_update,
                                    fmi3Boolean *terminates, fmi3Boolean *nominals_changed,
                                    fmi3Boolean *states_changed, fmi3Boolean *next_event_defined,
                                    fmi3Float64 *next_event)
{
    if (!needs_update || !terminates || !nominals_changed || !next_event_defined || !next_event)
        states_changed = NULL;
    const Status status = update_discrete_states(instance, states_changed);
    if (status == OK) {
        *needs_update = *terminates = *nominals_changed = *next_event_defined = false;
        *next_event = 0.0;
    }
    return (fmi3Status)status;
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance)
{
    return (fmi3Status)move_on(instance, ENTER_CONTINUOUS_TIME_MODE, CONTINUOUS_TIME);
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance,
                                       fmi3Boolean no_set_state_prior,
                                       fmi3Boolean *event_mode,
                                       fmi3Boolean *terminates)
{
    (void)no_set_state_prior;
    return (fmi3Status)complete_integrator_step(instance, event_mode, terminates);
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time)
{
    return (fmi3Status)set_time(instance, time);
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 x[], size_t count)
{
    return (fmi3Status)set_continuous_states(instance, x, count);
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 x[], size_t count)
{
    return (fmi3Status)get_continuous_states(instance, x, count);
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[],
                                             size_t count)
{
    return (fmi3Status)get_derivatives(instance, derivatives, count);
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 indicators[], size_t count)
{
    return (fmi3Status)get_event_indicators(instance, indicators, count);
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[],
                                             size_t count)
{
    return (fmi3Status)get_nominals(instance, nominals, count);
}

/* Hand over the size of a vector. */
static Status tell(fmi3Instance instance, size_t size, size_t *count)
{
    Instance *own = enter(instance, COUNT_STATES);
    if (!own || !count)
        return ERROR;
    *count = size;
    return OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *count)
{
    return (fmi3Status)tell(instance, N_INDICATORS, count);
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *count)
{
    return (fmi3Status)tell(instance, N_STATES, count);
}
