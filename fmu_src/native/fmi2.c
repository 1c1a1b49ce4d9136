/* The functions of FMI 2.0 that FMI 3.0 does not have, or has with other arguments. */
#include <math.h>

#include "instance.h"

void hand_over(const Instance *instance, Status status, const char *category, const char *text)
{
    char escaped[1024], *end = escaped; /* a message of FMI 2.0 is a printf format */
    for (const char *c = text; *c; c++) {
        if (*c == '%')
            *end++ = '%';
        *end++ = *c;
    }
    *end = '\0';
    ((fmi2CallbackLogger)instance->log)(instance->environment, instance->name, status, category, escaped);
}

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
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
                      .name = name ? name : ""};
    if (type == fmi2ModelExchange || type == fmi2CoSimulation)
        return instantiate(draft, guid, logging_on);
    report(&draft, ERROR, "fmi2Instantiate: the type is neither co-simulation nor Model Exchange");
    return NULL;
}

fmi2Status fmi2SetupExperiment(fmi2Component component, fmi2Boolean tolerance_defined,
                               fmi2Real tolerance, fmi2Real start_time,
                               fmi2Boolean stop_time_defined, fmi2Real stop_time)
{
    Instance *instance = enter(component, SETUP_EXPERIMENT, 1);
    if (!instance)
        return fmi2Error;
    return set_up(instance, SETUP_EXPERIMENT, tolerance_defined ? &tolerance : NULL, start_time,
                  stop_time_defined ? &stop_time : NULL);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component component)
{
    return move_on(component, ENTER_INITIALIZATION, INITIALIZATION);
}

#define VARIABLES(Name, TYPE)                                                                      \
    fmi2Status fmi2Get##Name(fmi2Component component, const fmi2ValueReference vr[], size_t count, \
                             fmi2##Name value[])                                                   \
    {                                                                                              \
        return get_values(component, GET_##TYPE, vr, count, value, count);                         \
    }                                                                                              \
    fmi2Status fmi2Set##Name(fmi2Component component, const fmi2ValueReference vr[], size_t count, \
                             const fmi2##Name value[])                                             \
    {                                                                                              \
        return set_values(component, SET_##TYPE, vr, count, value, count);                         \
    }
VARIABLES(Real, REAL)
VARIABLES(Boolean, BOOLEAN)
VARIABLES(Integer, INTEGER)
VARIABLES(String, OTHER)

fmi2Status fmi2GetDirectionalDerivative(fmi2Component component, const fmi2ValueReference unknown[], size_t n_unknown,
                                        const fmi2ValueReference known[], size_t n_known,
                                        const fmi2Real seed[], fmi2Real result[])
{
    return directional_derivative(component, unknown, n_unknown, known, n_known, seed, n_known, result, n_unknown);
}

fmi2Status fmi2DoStep(fmi2Component component, fmi2Real point, fmi2Real h, fmi2Boolean no_set_state_prior)
{
    (void)no_set_state_prior;
    return do_step(component, point, h);
}

fmi2Status fmi2CancelStep(fmi2Component component)
{
    enter(component, CANCEL_STEP, 1);
    return fmi2Error;
}

/* Return a status, if the requested kind exists. */
#define STATUS(Name, Type, exists, answer)                                                            \
    fmi2Status fmi2Get##Name(fmi2Component component, const fmi2StatusKind kind, Type *value)         \
    {                                                                                                 \
        Instance *instance = enter(component, GET_STATUS, value != NULL);                             \
        (void)kind;                                                                                   \
        if (!instance)                                                                                \
            return fmi2Error;                                                                         \
        if (!(exists))                                                                                \
            return report(instance, DISCARD, "fmi2GetStatus: no such status");                        \
        *value = (answer);                                                                            \
        return fmi2OK;                                                                                \
    }
STATUS(Status, fmi2Status, kind == fmi2DoStepStatus, instance->state.phase == STEP_FAILED ? fmi2Discard : fmi2OK)
STATUS(RealStatus, fmi2Real, kind == fmi2LastSuccessfulTime, instance->state.time)
STATUS(BooleanStatus, fmi2Boolean, kind == fmi2Terminated, fmi2False)
STATUS(IntegerStatus, fmi2Integer, 0, 0)
STATUS(StringStatus, fmi2String, 0, NULL)

fmi2Status fmi2NewDiscreteStates(fmi2Component component, fmi2EventInfo *info)
{
    fmi2Boolean changed;
    fmi2Real next;
    const fmi2Status status = update_discrete_states(component, info ? &changed : NULL, &next);
    if (status == fmi2OK)
        *info = (fmi2EventInfo){.valuesOfContinuousStatesChanged = changed,
                                .nextEventTimeDefined = isfinite(next) != 0,
                                .nextEventTime = isfinite(next) ? next : 0.0};
    return status;
}

/* Functions of features that modelDescription.xml excludes. */
#if defined __GNUC__
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

UNSUPPORTED(SetRealInputDerivatives, (fmi2Component instance, const fmi2ValueReference vr[], size_t count,
                                      const fmi2Integer order[], const fmi2Real value[]))
UNSUPPORTED(GetRealOutputDerivatives, (fmi2Component instance, const fmi2ValueReference vr[], size_t count,
                                       const fmi2Integer order[], fmi2Real value[]))
