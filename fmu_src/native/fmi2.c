/* FMI 2.0: the life of an instance, and the steps of co-simulation. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"
#include "integrator.h"

static const double TIME_TOLERANCE = 1e-9;

static int is_far(double a, double b)
{
    return !(fabs(a - b) <= TIME_TOLERANCE * fmax(1.0, fabs(a)));
}

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

/* Why an instance cannot be made; NULL where it can. */
static const char *why_not(fmi2String name, fmi2Type type, fmi2String guid)
{
    if (!name || !*name)
        return "fmi2Instantiate: the instance has no name";
    if (type != fmi2CoSimulation && type != fmi2ModelExchange)
        return "fmi2Instantiate: the type is neither co-simulation nor Model Exchange";
    if (!guid || strcmp(guid, MODEL_GUID) != 0)
        return "fmi2Instantiate: the GUID is not that of this FMU, " MODEL_GUID;
    return NULL;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean logging_on)
{
    (void)resources, (void)visible;
    if (!functions)
        return NULL;
    Instance draft = {.kind = type,
                      .log = functions->logger,
                      .environment = functions->componentEnvironment,
                      .name = name ? name : "",
                      .verbose = logging_on};
    const char *reason = why_not(name, type, guid);
    if (reason) {
        report(&draft, fmi2Error, "%s", reason);
        return NULL;
    }
    Instance *instance = calloc(1, sizeof *instance + strlen(name) + 1);
    if (!instance) {
        report(&draft, fmi2Error, "fmi2Instantiate: no memory");
        return NULL;
    }
    *instance = draft;
    instance->name = strcpy((char *)(instance + 1), name);
    reset_state(&instance->state);
    return instance;
}

void fmi2FreeInstance(fmi2Component component)
{
    free(component);
}

fmi2Status fmi2SetDebugLogging(fmi2Component component, fmi2Boolean logging_on, size_t count,
                               const fmi2String categories[])
{
    Instance *instance = enter(component, SET_DEBUG_LOGGING);
    int all = count == 0;
    if (!instance || (count > 0 && !categories))
        return fmi2Error;
    for (size_t i = 0; i < count; i++) {
        const char *category = categories[i] ? categories[i] : "";
        if (strcmp(category, "logAll") == 0)
            all = 1;
        else if (strncmp(category, "logStatus", 9) != 0)
            return report(instance, fmi2Error, "fmi2SetDebugLogging: there is no category '%s'",
                          category);
    }
    instance->verbose = logging_on && all;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component component, fmi2Boolean tolerance_defined,
                               fmi2Real tolerance, fmi2Real start_time,
                               fmi2Boolean stop_time_defined, fmi2Real stop_time)
{
    Instance *instance = enter(component, SETUP_EXPERIMENT);
    if (!instance)
        return fmi2Error;
    if (!isfinite(start_time))
        return report(instance, fmi2Error, "fmi2SetupExperiment: the start time is not finite");
    if (stop_time_defined && !(stop_time >= start_time))
        return report(instance, fmi2Error, "fmi2SetupExperiment: stop time %g < start time %g",
                      stop_time, start_time);
    if (tolerance_defined)
        report(instance, fmi2OK, "the tolerance %g of the experiment is ignored: rtol and atol are"
               " parameters", tolerance);
    instance->state.time = start_time;
    instance->state.stop_time = stop_time_defined ? stop_time : HUGE_VAL;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component component)
{
    Instance *instance = enter(component, ENTER_INITIALIZATION);
    if (!instance)
        return fmi2Error;
    instance->state.phase = INITIALIZATION;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component component)
{
    Instance *instance = enter(component, EXIT_INITIALIZATION);
    if (!instance || initialise(instance, 1) != fmi2OK)
        return fmi2Error;
    instance->state.phase = instance->kind == fmi2ModelExchange ? EVENT : STEP;
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component component)
{
    Instance *instance = enter(component, TERMINATE);
    if (!instance)
        return fmi2Error;
    instance->state.phase = TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component component)
{
    Instance *instance = enter(component, RESET);
    if (!instance)
        return fmi2Error;
    reset_state(&instance->state);
    return fmi2OK;
}

/* Say why a step cannot be done, and what would help. */
static fmi2Status discard(Instance *instance, double point, double h, const Obstacle *obstacle)
{
    const double *value = instance->state.plant.value;
    if (obstacle->reason == NOT_FINITE)
        return report(instance, fmi2Discard, "fmi2DoStep at %.12g s: the equations of motion gave"
                      " a value that is not finite", point);
    if (obstacle->reason == MANY_STEPS)
        return report(instance, fmi2Discard, "fmi2DoStep at %.12g s: max_step = %g s divides a step"
                      " of %g s into more than %d integration steps; enlarge max_step or shorten"
                      " the step", point, value[MAX_STEP], h, BUDGET / STAGES);
    char need[80] = "integration steps below the resolution of time";
    if (obstacle->reason == MANY_EVALUATIONS)
        snprintf(need, sizeof need, "more than %d evaluations for the step of %g s", BUDGET, h);
    return report(instance, fmi2Discard, "fmi2DoStep at %.12g s: rtol = %g and atol = %g need %s:"
                  " joint '%s' changes at a rate of %.3g 1/s; shorten the step, lessen damping or"
                  " gains, or enlarge rtol and atol", point, value[RTOL], value[ATOL], need,
                  JOINT_NAME[obstacle->joint], obstacle->rate);
}

fmi2Status fmi2DoStep(fmi2Component component, fmi2Real point, fmi2Real h,
                      fmi2Boolean no_set_state_prior)
{
    Instance *instance = enter(component, DO_STEP);
    (void)no_set_state_prior;
    if (!instance)
        return fmi2Error;
    State *state = &instance->state;
    if (is_far(point, state->time))
        return report(instance, fmi2Error, "fmi2DoStep: the communication point %.12g s is not the"
                      " time of the FMU, %.12g s", point, state->time);
    if (!(h > 0.0 && isfinite(h)))
        return report(instance, fmi2Error, "fmi2DoStep: the step %.12g s must be finite and > 0",
                      h);
    if (point + h > state->stop_time && is_far(point + h, state->stop_time))
        return report(instance, fmi2Error, "fmi2DoStep: the step of %.12g s from %.12g s ends after"
                      " the stop time, %.12g s", h, point, state->stop_time);
    if (check_inputs(instance) != fmi2OK)
        return fmi2Error;
    Obstacle obstacle;
    if (!advance_plant(&state->plant, h, &obstacle)) {
        state->phase = STEP_FAILED;
        return discard(instance, point, h, &obstacle);
    }
    state->time = point + h;
    state->has_x = state->has_tau = state->has_stops = state->has_rates = 0;
    return fmi2OK;
}

fmi2Status fmi2CancelStep(fmi2Component component)
{
    enter(component, CANCEL_STEP);
    return fmi2Error;
}

fmi2Status fmi2GetStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Status *value)
{
    Instance *instance = enter(component, GET_STATUS);
    if (!instance || !value)
        return fmi2Error;
    if (kind != fmi2DoStepStatus)
        return report(instance, fmi2Discard, "fmi2GetStatus: no such status");
    *value = instance->state.phase == STEP_FAILED ? fmi2Discard : fmi2OK;
    return fmi2OK;
}

fmi2Status fmi2GetRealStatus(fmi2Component component, const fmi2StatusKind kind, fmi2Real *value)
{
    Instance *instance = enter(component, GET_STATUS);
    if (!instance || !value)
        return fmi2Error;
    if (kind != fmi2LastSuccessfulTime)
        return report(instance, fmi2Discard, "fmi2GetRealStatus: no such status");
    *value = instance->state.time;
    return fmi2OK;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component component, const fmi2StatusKind kind,
                                fmi2Boolean *value)
{
    Instance *instance = enter(component, GET_STATUS);
    if (!instance || !value)
        return fmi2Error;
    if (kind != fmi2Terminated)
        return report(instance, fmi2Discard, "fmi2GetBooleanStatus: no such status");
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component component, const fmi2StatusKind kind,
                                fmi2Integer *value)
{
    Instance *instance = enter(component, GET_STATUS);
    (void)kind, (void)value;
    return instance ? report(instance, fmi2Discard, "fmi2GetIntegerStatus: no such status")
                    : fmi2Error;
}

fmi2Status fmi2GetStringStatus(fmi2Component component, const fmi2StatusKind kind,
                               fmi2String *value)
{
    Instance *instance = enter(component, GET_STATUS);
    (void)kind, (void)value;
    return instance ? report(instance, fmi2Discard, "fmi2GetStringStatus: no step is pending")
                    : fmi2Error;
}
