/* The steps of co-simulation. */
#include <math.h>
#include <stdio.h>

#include "instance.h"

static const double TIME_TOLERANCE = 1e-9;

static int is_far(double point, double time)
{
    return !(fabs(point - time) <= TIME_TOLERANCE * fmax(1.0, fabs(time)));
}

/* Log why a step cannot be done, and the remedy. */
static Status discard(Instance *instance, double point, double h, const Failure *failure)
{
    const char *call = call_name(DO_STEP);
    const double *value = instance->state.plant.value;
    if (failure->reason == NOT_FINITE)
        return report(instance, DISCARD, "%s at %.12g s: the equations of motion gave a value"
                      " that is not finite: inputs, payload or speeds are too large, or joint '%s', which changes at a rate of"
                      " %.3g 1/s, needs armature or a lock", call, point, JOINT_NAME[failure->joint], failure->rate);
    if (failure->reason == MANY_STEPS || failure->reason == SHORT_PERIOD) {
        const int limit = failure->reason == MANY_STEPS ? MAX_STEP : CONTROL_PERIOD;
        return report(instance, DISCARD, "%s at %.12g s: %s = %g s divides a step of %g s into more than %d"
                      " integration steps; increase %s or shorten the step", call, point, VARIABLE_NAME[limit],
                      value[limit], h, BUDGET / STAGES, VARIABLE_NAME[limit]);
    }
    char need[80] = "integration steps below the resolution of time";
    if (failure->reason == MANY_EVALUATIONS)
        snprintf(need, sizeof need, "more than %d evaluations for the step of %g s", BUDGET, h);
    return report(instance, DISCARD, "%s at %.12g s: rtol = %g and atol = %g need %s:"
                  " joint '%s' changes at a rate of %.3g 1/s; shorten the step, reduce damping or"
                  " gains, or increase rtol and atol", call, point, value[RTOL], value[ATOL], need,
                  JOINT_NAME[failure->joint], failure->rate);
}

static Status do_step(void *component, double point, double h)
{
    Instance *instance = enter(component, DO_STEP, 1);
    if (!instance)
        return ERROR;
    const char *call = call_name(DO_STEP);
    State *state = &instance->state;
    if (is_far(point, state->time))
        return report(instance, ERROR, "%s: the communication point %.12g s is not the"
                      " time of the FMU, %.12g s", call, point, state->time);
    if (!(h > 0.0 && isfinite(h)))
        return report(instance, ERROR, "%s: the step %.12g s must be finite and > 0", call,
                      h);
    if (point + h > state->stop_time && is_far(point + h, state->stop_time))
        return report(instance, ERROR, "%s: the step of %.12g s from %.12g s ends after"
                      " the stop time, %.12g s", call, h, point, state->stop_time);
    const double tick = instant(&state->sampling, &state->plant, state->sampling.k);
    if (state->sampling.clock != NO_CLOCK && tick < point + h - slack(&state->plant, point + h))
        return report(instance, ERROR, "%s: the step of %.12g s from %.12g s passes the tick of the clock at %.12g s;"
                      " end it there", call, h, point, tick);
    if (check_inputs(instance) != OK)
        return ERROR;
    Failure failure;
    const int advanced = advance_sampled(&state->sampling, &state->plant, point, h, &failure);
    instance->evaluations += (double)failure.evaluations;
    if (!advanced) {
        state->phase = AFTER_DISCARD;
        return discard(instance, point, h, &failure);
    }
    state->time = point + h;
    state->has_x = state->has_tau = state->has_stops = state->has_rates = 0;
    return OK;
}
