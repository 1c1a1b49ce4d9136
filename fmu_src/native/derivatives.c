/* Directional and adjoint derivatives. The first direction at a point costs one complex evaluation; with the second one
   the Jacobian of the accelerations is computed, of which further directions are products. Where the last point had
   several directions, the next one's Jacobian is computed at once. */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "directional.h"
#include "instance.h"

/* Name of the first variable whose value is not finite, or NULL. */
static const char *culprit(const Reference vr[], size_t count, const double value[])
{
    for (size_t i = 0; i < count; i++)
        for (int k = INDEX[vr[i]]; k < INDEX[vr[i] + 1]; k++)
            if (!isfinite(*value++))
                return VARIABLE_NAME[k];
    return NULL;
}

/* The computed variables that the derivatives of the unknowns need; -1, with a logged reason, if there are no such
   derivatives, or if the seed, of the unknowns or of the given variables, is not finite. */
static int wanted(Instance *instance, Call call, const Reference unknown[], size_t n_unknown,
                  const Reference given[], size_t n_given, const double seed[])
{
    const int adjoint = call == GET_ADJOINT_DERIVATIVE;
    const char *name = adjoint ? culprit(unknown, n_unknown, seed) : culprit(given, n_given, seed);
    if (name) {
        report(instance, ERROR, "%s: the %s of %s is not finite", call_name(call), adjoint ? "weight" : "change", name);
        return -1;
    }
    int wants = 0;
    for (size_t i = 0; i < n_unknown; i++) {
        const int k = INDEX[unknown[i]];
        if (k < FIRST_OUTPUT || k >= END_OF_RATES) {
            report(instance, ERROR, "%s: %s is not computed, it has no derivative", call_name(call),
                   VARIABLE_NAME[k]);
            return -1;
        }
        wants |= k >= DER_Q ? WANTS_RATES : k >= Q_MEAS ? WANTS_SAMPLE : k >= TAU ? WANTS_TAU : k >= X ? WANTS_X
                                                                                             : WANTS_STATE;
    }
    for (size_t i = 0; i < n_given; i++)
        if (INDEX[given[i]] >= X) {
            report(instance, ERROR, "%s: %s is neither a state nor an input", call_name(call),
                   VARIABLE_NAME[INDEX[given[i]]]);
            return -1;
        }
    if (!instance->state.initialised && initialise(instance, 0) != OK)
        return -1;
    if (!update_held(instance)) {
        refuse(instance, call, NO_EFFORT);
        return -1;
    }
    update_stops(&instance->state);
    return wants;
}

/* True if the derivatives of the rates are elements of the Jacobian, which is computed if it is worth it, or if there are
   reactions. */
static int has_slopes(Instance *instance, int several, const Reference given[], size_t n_given)
{
    State *state = &instance->state;
    const int reactions = any_reacts(&state->stops);
    for (size_t i = 0; i < n_given && COMMANDS_ACCELERATION && !reactions; i++)
        if (INDEX[given[i]] < TAU_EXT)
            return 0;
    if (!(state->has_rates & SLOPES)) {
        several |= state->has_rates & DIRECTION;
        if (several || reactions || instance->asks_several) {
            update_rates(state);
            acceleration_slopes(&state->plant, &state->stops, &instance->slope[N_JOINTS]);
            state->has_rates |= SLOPES;
        }
        state->has_rates |= DIRECTION;
        instance->asks_several = several != 0;
    }
    return state->has_rates & SLOPES;
}

/* The change of the unknowns if the knowns (states and inputs) change by the seed. */
static Status directional_derivative(void *component, const Reference unknown[], size_t n_unknown,
                                     const Reference given[], size_t n_given, const double seed[],
                                     size_t n_seed, double result[], size_t n_result)
{
    const Call call = GET_DIRECTIONAL_DERIVATIVE;
    Instance *instance = enter(component, call, 1);
    double derivative[FIRST_PARAMETER];
    if (!instance || !known(instance, call, REAL, unknown, n_unknown, result, n_result)
        || !known(instance, call, REAL, given, n_given, seed, n_seed))
        return ERROR;
    int wants = wanted(instance, call, unknown, n_unknown, given, n_given, seed);
    if (wants < 0)
        return ERROR;
    const Stops *stops = &instance->state.stops;
    const int by_product = (wants & WANTS_RATES) && has_slopes(instance, 0, given, n_given);
    if (by_product)
        wants -= WANTS_RATES;
    const double *next = seed;
    if (wants) {
        double change[X] = {0};
        for (size_t i = 0; i < n_given; i++)
            for (int k = INDEX[given[i]]; k < INDEX[given[i] + 1]; k++)
                change[k] += *next++;
        differentiate(instance->state.plant.value, stops->held, stops->slip, stops->rank, wants, change, derivative);
    }
    if (by_product) {
        double *rate = &derivative[DER_Q];
        memset(rate, 0, N_STATES * sizeof *rate);
        next = seed;
        for (size_t i = 0; i < n_given; i++)
            for (int k = INDEX[given[i]]; k < INDEX[given[i] + 1]; k++, next++)
                for (int r = 0; r < N_STATES; r++)
                    rate[r] += instance->slope[r][k] * *next;
    }
    double zero = 0.0; /* NaN after a value that is not finite */
    for (size_t i = 0; i < n_unknown; i++)
        for (int k = INDEX[unknown[i]]; k < INDEX[unknown[i] + 1]; k++)
            zero += 0.0 * (*result++ = derivative[k]);
    if (zero == 0.0)
        return OK;
    return report(instance, DISCARD, "%s: that of %s is not finite", call_name(call),
                  culprit(unknown, n_unknown, result - n_result));
}

#if FMI == 3
/* The change of the unknowns, weighted by the seed, for a change of each given variable by 1. */
Status fmi3GetAdjointDerivative(void *component, const Reference unknown[], size_t n_unknown,
                                const Reference given[], size_t n_given, const double seed[],
                                size_t n_seed, double result[], size_t n_result)
{
    const Call call = GET_ADJOINT_DERIVATIVE;
    Instance *instance = enter(component, call, 1);
    double weight[FIRST_PARAMETER] = {0}, sum[FIRST_PARAMETER] = {0};
    if (!instance || !known(instance, call, REAL, unknown, n_unknown, seed, n_seed)
        || !known(instance, call, REAL, given, n_given, result, n_result))
        return ERROR;
    int wants = wanted(instance, call, unknown, n_unknown, given, n_given, seed);
    if (wants < 0)
        return ERROR;
    const Stops *stops = &instance->state.stops;
    const int by_product = (wants & WANTS_RATES) && has_slopes(instance, n_result > 1, given, n_given);
    if (by_product)
        wants -= WANTS_RATES;
    for (size_t i = 0; i < n_unknown; i++)
        for (int k = INDEX[unknown[i]]; k < INDEX[unknown[i] + 1]; k++)
            weight[k] += *seed++;
    for (size_t i = 0; i < n_given; i++) /* a column of the Jacobian for each value */
        for (int k = INDEX[given[i]]; k < INDEX[given[i] + 1]; k++) {
            double change[X] = {0}, derivative[FIRST_PARAMETER];
            change[k] = 1.0;
            if (wants)
                differentiate(instance->state.plant.value, stops->held, stops->slip, stops->rank, wants, change,
                              derivative);
            sum[k] = 0.0;
            for (int u = FIRST_OUTPUT; u < END_OF_RATES; u++)
                if (weight[u] != 0.0)
                    sum[k] += weight[u] * (by_product && u >= DER_Q ? instance->slope[u - DER_Q][k] : derivative[u]);
            if (!isfinite(sum[k]))
                return report(instance, DISCARD, "%s: that by %s is not finite", call_name(call),
                              VARIABLE_NAME[k]);
        }
    for (size_t i = 0; i < n_given; result += size_of(given[i++]))
        memcpy(result, &sum[INDEX[given[i]]], size_of(given[i]) * sizeof *result);
    return OK;
}
#endif
