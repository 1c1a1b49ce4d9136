/* The functions of FMI 2.0, and the table of their calls. */
#include "instance.h"

/* FMI 2.0.4, sections 3.2.3 and 4.2.4: each call, the phases in which it is allowed, and where it is of
   one kind alone. A refused call changes nothing, so there is no error phase. */
const Rule *rule_of(Call call)
{
    static const Rule RULES[N_CALLS] = {
        [INSTANTIATE] = {"fmi2Instantiate", 0},
        [SET_DEBUG_LOGGING] = {"fmi2SetDebugLogging", ANY},
        [SETUP_EXPERIMENT] = {"fmi2SetupExperiment", N},
        [ENTER_INITIALIZATION] = {"fmi2EnterInitializationMode", N},
        [EXIT_INITIALIZATION] = {"fmi2ExitInitializationMode", I},
        [TERMINATE] = {"fmi2Terminate", S | F | M | C},
        [RESET] = {"fmi2Reset", ANY},
        [DO_STEP] = {"fmi2DoStep", S, CO_SIMULATION},
        [CANCEL_STEP] = {"fmi2CancelStep", 0, CO_SIMULATION}, /* no step is ever pending */
        [GET_STATUS] = {"fmi2GetStatus", S | F | T, CO_SIMULATION},
        [GET_REAL] = {"fmi2GetReal", I | S | F | M | C | T},
        [GET_BOOLEAN] = {"fmi2GetBoolean", I | S | F | M | C | T},
        [GET_OTHER] = {"fmi2Get of an Integer or String", I | S | F | M | C | T},
        [SET_REAL] = {"fmi2SetReal", N | I | S | M | C},
        [SET_BOOLEAN] = {"fmi2SetBoolean", N | I | S | M | C},
        [SET_OTHER] = {"fmi2Set of an Integer or String", N | I | S | M | C},
        [SET_INPUT] = {"fmi2Set of an input", N | I | S | M | C},
        [SET_PARAMETER] = {"fmi2Set of a parameter", N | I},
        [SET_Q_V] = {"fmi2Set of a state", M | C},
        [GET_STATE] = {"fmi2GetFMUstate", ANY},
        [SET_STATE] = {"fmi2SetFMUstate", ANY},
        [FREE_STATE] = {"fmi2FreeFMUstate", ANY},
        [SIZE_OF_STATE] = {"fmi2SerializedFMUstateSize", ANY},
        [SERIALIZE] = {"fmi2SerializeFMUstate", ANY},
        [DESERIALIZE] = {"fmi2DeSerializeFMUstate", ANY},
        [ENTER_EVENT_MODE] = {"fmi2EnterEventMode", C, MODEL_EXCHANGE},
        [NEW_DISCRETE_STATES] = {"fmi2NewDiscreteStates", M, MODEL_EXCHANGE},
        [ENTER_CONTINUOUS_TIME_MODE] = {"fmi2EnterContinuousTimeMode", M, MODEL_EXCHANGE},
        [COMPLETED_INTEGRATOR_STEP] = {"fmi2CompletedIntegratorStep", C, MODEL_EXCHANGE},
        [SET_TIME] = {"fmi2SetTime", M | C, MODEL_EXCHANGE},
        [SET_CONTINUOUS_STATES] = {"fmi2SetContinuousStates", C, MODEL_EXCHANGE},
        [GET_DERIVATIVES] = {"fmi2GetDerivatives", I | M | C | T, MODEL_EXCHANGE},
        [GET_EVENT_INDICATORS] = {"fmi2GetEventIndicators", I | M | C | T, MODEL_EXCHANGE},
        [GET_CONTINUOUS_STATES] = {"fmi2GetContinuousStates", I | M | C | T, MODEL_EXCHANGE},
        [GET_DIRECTIONAL_DERIVATIVE] = {"fmi2GetDirectionalDerivative", I | S | F | M | C | T},
        [GET_NOMINALS] = {"fmi2GetNominalsOfContinuousStates", N | I | M | C | T, MODEL_EXCHANGE},
    };
    return &RULES[call];
}

void hand_over(const Instance *instance, Status status, const char *category, const char *text)
{
    char escaped[1024], *end = escaped; /* a message of FMI 2.0 is a printf format */
    for (const char *c = text; *c; c++) {
        if (*c == '%')
            *end++ = '%';
        *end++ = *c;
    }
    *end = '\0';
    ((fmi2CallbackLogger)instance->log)(instance->environment, instance->name, (fmi2Status)status,
                                        category, escaped);
}

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean logging_on)
{
    (void)resources, (void)visible;
    if (!functions)
        return NULL;
    Instance draft = {.kind = type == fmi2ModelExchange ? MODEL_EXCHANGE : CO_SIMULATION,
                      .log = (void (*)(void))functions->logger,
                      .environment = functions->componentEnvironment,
                      .name = name ? name : "", .verbose = logging_on};
    if (type == fmi2ModelExchange || type == fmi2CoSimulation)
        return instantiate(draft, guid);
    report(&draft, ERROR, "fmi2Instantiate: the type is neither co-simulation nor Model Exchange");
    return NULL;
}

void fmi2FreeInstance(fmi2Component component)
{
    free(component);
}

fmi2Status fmi2SetDebugLogging(fmi2Component component, fmi2Boolean logging_on, size_t count,
                               const fmi2String categories[])
{
    return (fmi2Status)set_debug_logging(component, logging_on, count, categories);
}

fmi2Status fmi2SetupExperiment(fmi2Component component, fmi2Boolean tolerance_defined,
                               fmi2Real tolerance, fmi2Real start_time,
                               fmi2Boolean stop_time_defined, fmi2Real stop_time)
{
    Instance *instance = enter(component, SETUP_EXPERIMENT);
    if (!instance)
        return fmi2Error;
    return (fmi2Status)set_up(instance, SETUP_EXPERIMENT, tolerance_defined ? &tolerance : NULL,
                              start_time, stop_time_defined ? &stop_time : NULL);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component component)
{
    return (fmi2Status)move_on(component, ENTER_INITIALIZATION, INITIALIZATION);
}

fmi2Status fmi2ExitInitializationMode(fmi2Component component)
{
    return (fmi2Status)exit_initialization(component);
}

fmi2Status fmi2Terminate(fmi2Component component)
{
    return (fmi2Status)move_on(component, TERMINATE, TERMINATED);
}

fmi2Status fmi2Reset(fmi2Component component)
{
    return (fmi2Status)reset(component);
}

fmi2Status fmi2GetReal(fmi2Component component, const fmi2ValueReference vr[], size_t count,
                       fmi2Real value[])
{
    return (fmi2Status)get_reals(component, vr, count, value, count);
}

fmi2Status fmi2SetReal(fmi2Component component, const fmi2ValueReference vr[], size_t count,
                       const fmi2Real value[])
{
    return (fmi2Status)set_reals(component, vr, count, value, count);
}

fmi2Status fmi2GetBoolean(fmi2Component component, const fmi2ValueReference vr[], size_t count,
                          fmi2Boolean value[])
{
    return (fmi2Status)get_booleans(component, vr, count, value, count);
}

fmi2Status fmi2SetBoolean(fmi2Component component, const fmi2ValueReference vr[], size_t count,
                          const fmi2Boolean value[])
{
    return (fmi2Status)set_booleans(component, vr, count, value, count);
}

#define OTHER_TYPE(Name)                                                                           \
    fmi2Status fmi2Get##Name(fmi2Component component, const fmi2ValueReference vr[], size_t count, \
                             fmi2##Name value[])                                                   \
    {                                                                                              \
        return (fmi2Status)other_variables(component, GET_OTHER, vr, count, value, count);         \
    }                                                                                              \
    fmi2Status fmi2Set##Name(fmi2Component component, const fmi2ValueReference vr[], size_t count, \
                             const fmi2##Name value[])                                             \
    {                                                                                              \
        return (fmi2Status)other_variables(component, SET_OTHER, vr, count, value, count);         \
    }
OTHER_TYPE(Integer)
OTHER_TYPE(String)

fmi2Status fmi2GetDirectionalDerivative(fmi2Component component,
                                        const fmi2ValueReference unknown[], size_t n_unknown,
                                        const fmi2ValueReference known[], size_t n_known,
                                        const fmi2Real seed[], fmi2Real result[])
{
    return (fmi2Status)directional_derivative(component, unknown, n_unknown, known, n_known, seed,
                                              n_known, result, n_unknown);
}

fmi2Status fmi2GetFMUstate(fmi2Component component, fmi2FMUstate *saved)
{
    return (fmi2Status)save_state(component, saved);
}

fmi2Status fmi2SetFMUstate(fmi2Component component, fmi2FMUstate saved)
{
    return (fmi2Status)restore_state(component, saved);
}

fmi2Status fmi2FreeFMUstate(fmi2Component component, fmi2FMUstate *saved)
{
    return (fmi2Status)free_state(component, saved);
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component component, fmi2FMUstate saved, size_t *size)
{
    return (fmi2Status)size_of_state(component, saved, size);
}

fmi2Status fmi2SerializeFMUstate(fmi2Component component, fmi2FMUstate saved, fmi2Byte bytes[],
                                 size_t size)
{
    return (fmi2Status)serialize_state(component, saved, bytes, size);
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component component, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *saved)
{
    return (fmi2Status)deserialize_state(component, bytes, size, saved);
}

fmi2Status fmi2DoStep(fmi2Component component, fmi2Real point, fmi2Real h,
                      fmi2Boolean no_set_state_prior)
{
    (void)no_set_state_prior;
    return (fmi2Status)do_step(component, point, h);
}

fmi2Status fmi2CancelStep(fmi2Component component)
{
    enter(component, CANCEL_STEP);
    return fmi2Error;
}

/* Whether there is such a status to tell, and a place for it; refusals are logged. */
static fmi2Status ask(fmi2Component component, int exists, const void *value)
{
    Instance *instance = enter(component, GET_STATUS);
    if (!instance || !value)
        return fmi2Error;
    return exists ? fmi2OK
                  : (fmi2Status)report(instance, DISCARD, "fmi2GetStatus: no such status");
}

fmi2Status fmi2GetStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Status *value)
{
    const fmi2Status answer = ask(component, kind == fmi2DoStepStatus, value);
    if (answer == fmi2OK)
        *value = ((Instance *)component)->state.phase == STEP_FAILED ? fmi2Discard : fmi2OK;
    return answer;
}

fmi2Status fmi2GetRealStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Real *value)
{
    const fmi2Status answer = ask(component, kind == fmi2LastSuccessfulTime, value);
    if (answer == fmi2OK)
        *value = ((Instance *)component)->state.time;
    return answer;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component component, const fmi2StatusKind kind,
                                fmi2Boolean *value)
{
    const fmi2Status answer = ask(component, kind == fmi2Terminated, value);
    if (answer == fmi2OK)
        *value = fmi2False;
    return answer;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component component, const fmi2StatusKind kind,
                                fmi2Integer *value)
{
    (void)kind;
    return ask(component, 0, value);
}

fmi2Status fmi2GetStringStatus(fmi2Component component, const fmi2StatusKind kind,
                               fmi2String *value)
{
    (void)kind;
    return ask(component, 0, value);
}

fmi2Status fmi2EnterEventMode(fmi2Component component)
{
    return (fmi2Status)move_on(component, ENTER_EVENT_MODE, EVENT);
}

fmi2Status fmi2NewDiscreteStates(fmi2Component component, fmi2EventInfo *info)
{
    fmi2Boolean changed;
    const Status status = update_discrete_states(component, info ? &changed : NULL);
    if (status == OK)
        *info = (fmi2EventInfo){.valuesOfContinuousStatesChanged = changed};
    return (fmi2Status)status;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component component)
{
    return (fmi2Status)move_on(component, ENTER_CONTINUOUS_TIME_MODE, CONTINUOUS_TIME);
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component component, fmi2Boolean no_set_state_prior,
                                       fmi2Boolean *event_mode, fmi2Boolean *terminates)
{
    (void)no_set_state_prior;
    return (fmi2Status)complete_integrator_step(component, event_mode, terminates);
}

fmi2Status fmi2SetTime(fmi2Component component, fmi2Real time)
{
    return (fmi2Status)set_time(component, time);
}

fmi2Status fmi2SetContinuousStates(fmi2Component component, const fmi2Real x[], size_t count)
{
    return (fmi2Status)set_continuous_states(component, x, count);
}

fmi2Status fmi2GetDerivatives(fmi2Component component, fmi2Real derivatives[], size_t count)
{
    return (fmi2Status)get_derivatives(component, derivatives, count);
}

fmi2Status fmi2GetEventIndicators(fmi2Component component, fmi2Real indicators[], size_t count)
{
    return (fmi2Status)get_event_indicators(component, indicators, count);
}

fmi2Status fmi2GetContinuousStates(fmi2Component component, fmi2Real x[], size_t count)
{
    return (fmi2Status)get_continuous_states(component, x, count);
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component component, fmi2Real nominals[],
                                             size_t count)
{
    return (fmi2Status)get_nominals(component, nominals, count);
}

/* What the modelDescription says that there is not. Some importers bind every name of the standard. */
static fmi2Status unsupported(fmi2Component component, const char *function)
{
    if (component)
        report(component, ERROR, "%s is not supported by this FMU", function);
    return fmi2Error;
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component component, const fmi2ValueReference vr[],
                                       size_t count, const fmi2Integer order[],
                                       const fmi2Real value[])
{
    (void)vr, (void)count, (void)order, (void)value;
    return unsupported(component, "fmi2SetRealInputDerivatives");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component component, const fmi2ValueReference vr[],
                                        size_t count, const fmi2Integer order[], fmi2Real value[])
{
    (void)vr, (void)count, (void)order, (void)value;
    return unsupported(component, "fmi2GetRealOutputDerivatives");
}
