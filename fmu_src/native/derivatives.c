/* Directional and adjoint derivatives. The first direction at a point costs one complex evaluation. The second
   direction at the same point computes the Jacobian of the accelerations; each further direction is a product with it.
   If the previous point had several directions, the first direction already computes the Jacobian. */
#include <float.h>
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "directional.h"
#include "instance.h"

/* Derivatives of the unknowns by the given variables. */
typedef struct {
    Call call;
    const Reference *unknown, *given;
    size_t n_unknown, n_given;
    int wants; /* flags of the variables that `differentiate` computes */
    int by_product; /* 1: the derivatives of the rates are products with the Jacobian */
} Request;

/* Name of the first variable whose value is not finite, or NULL. */
static const char *culprit(const Reference vr[], size_t count, const double value[])
{
    for (size_t i = 0; i < count; i++)
        for (int k = begin_of(vr[i]); k < end_of(vr[i]); k++)
            if (!isfinite(*value++))
                return VARIABLE_NAME[k];
    return NULL;
}

/* Return the flags of the variables that the request differentiates. If a variable has no derivative, log its name and
   return -1. */
static int wanted(Instance *instance, const Request *request)
{
    int wants = 0;
    for (size_t i = 0; i < request->n_unknown; i++) {
        const int k = begin_of(request->unknown[i]);
        if (k < FIRST_OUTPUT || k >= END_OF_RATES) {
            report(instance, ERROR, "%s: %s is not computed, it has no derivative", call_name(request->call),
                   VARIABLE_NAME[k]);
            return -1;
        }
        wants |= k >= DER_Q ? WANTS_RATES : k >= Q_MEAS ? WANTS_SAMPLE : k >= TAU ? WANTS_TAU : k >= X ? WANTS_X
                                                                                             : WANTS_STATE;
    }
    for (size_t i = 0; i < request->n_given; i++)
        if (begin_of(request->given[i]) >= X) {
            report(instance, ERROR, "%s: %s is neither a state nor an input", call_name(request->call),
                   VARIABLE_NAME[begin_of(request->given[i])]);
            return -1;
        }
    return wants;
}

/* Return the regime in which derivatives are computed. A friction of 0 that is an input begins to act against the motion
   as it rises, so that its derivatives are one-sided. For the other joints, a clamped joint moves on. */
static Stops regime_of(const State *state)
{
    const double *value = state->plant.value;
    double a[N_JOINTS], effort[N_JOINTS];
    Stops stops = state->stops, reacting = state->stops;
    if (!CHANGES_FRICTION)
        return stops;
    for (int i = 0; i < N_JOINTS; i++)
        reacting.held[i] = reacts(&stops, i) ? stops.held[i] : FREE;
    acceleration(&state->plant, &value[Q], &value[V], slip_of(&stops), stops.rank, a, NULL);
    restrain(&state->plant, &reacting, &value[Q], a, effort);
    for (int i = 0; i < N_JOINTS; i++) {
        const double rate = value[V + i] != 0.0 && !stops.held[i] ? value[V + i] : a[i];
        if (value[FRICTION + i] == 0.0 && !reacts(&stops, i))
            stops.slip[i] = (rate > 0.0) - (rate < 0.0);
        stops.any_slip |= stops.slip[i] != 0;
    }
    return stops;
}

/* Return nonzero if the request's derivatives of the rates are products with the Jacobian, and compute the Jacobian if
   necessary: for several directions, and for joints with reactions, which `differentiate` does not consider. Without
   reactions the Jacobian does not contain the columns of the control law's inputs. */
static int has_slopes(Instance *instance, int several, const Request *request)
{
    State *state = &instance->state;
    const int reactions = any_reacts(&state->stops);
    for (size_t i = 0; i < request->n_given && COMMANDS_ACCELERATION && !reactions; i++)
        if (begin_of(request->given[i]) < TAU_EXT)
            return 0;
    several |= state->has_rates & DIRECTION;
    if (!(state->has_rates & SLOPES) && (several || reactions || instance->asks_several)) {
        update_rates(state);
        const Stops stops = regime_of(state);
        acceleration_slopes(&state->plant, &stops, instance->slope);
        state->has_rates |= SLOPES;
    }
    state->has_rates |= DIRECTION;
    instance->asks_several = several != 0;
    return state->has_rates & SLOPES;
}

/* Add a column of the Jacobian, times the change of its variable, to the changes of the states' rates. */
static void add_column(const Instance *instance, int k, double change, double rate[N_STATES])
{
    if (k >= V && k < V + N_JOINTS)
        rate[k - V] += change;
    for (int r = 0; r < N_JOINTS; r++)
        rate[N_JOINTS + r] += instance->slope[k][r] * change;
}

/* True if a reference is that of values from first to before end, at most as many as there are. */
static int is_within(Reference vr, int first, int end, size_t n_values)
{
    return (FMI == 2 || vr - 1 < N_REFERENCES) && begin_of(vr) >= first && begin_of(vr) < end && size_of(vr) <= n_values;
}

static int all_finite(const double rate[N_STATES])
{
    int finite = 1;
    for (int i = 0; i < N_STATES; i++)
        finite &= fabs(rate[i]) <= DBL_MAX; /* without branches, which would take longer than the product */
    return finite;
}

/* Compute the derivatives of rates, if they are products with a known Jacobian. Return 0 if the request needs anything
   else, or if a derivative of the rates is not finite. */
static int multiply(Instance *instance, const Request *request, const double seed[], size_t n_seed,
                    double result[], size_t n_result)
{
    const Reference *unknown = request->unknown, *given = request->given;
    double rate[N_STATES] = {0};
    if (!(instance->state.has_rates & SLOPES) || !unknown || !given || !seed || !result)
        return 0;
    for (size_t i = 0; i < request->n_given; n_seed -= size_of(given[i++])) {
        if (!is_within(given[i], COMMANDS_ACCELERATION ? TAU_EXT : 0, X, n_seed))
            return 0;
        for (int k = begin_of(given[i]); k < end_of(given[i]); k++)
            add_column(instance, k, *seed++, rate);
    }
    for (size_t i = 0; i < request->n_unknown; n_result -= size_of(unknown[i++])) {
        if (!is_within(unknown[i], DER_Q, END_OF_RATES, n_result))
            return 0;
        for (int k = begin_of(unknown[i]); k < end_of(unknown[i]); k++)
            *result++ = rate[k - DER_Q];
    }
    instance->asks_several = 1;
    return all_finite(rate) && n_seed == 0 && n_result == 0;
}

/* Check a request and its seed, and update the state. Return 0 if a variable has no derivative or the seed is not
   finite, and log the reason. */
static int prepare(Instance *instance, Request *request, const double of_unknown[], size_t n_of_unknown,
                   const double of_given[], size_t n_of_given)
{
    const Call call = request->call;
    const int adjoint = call == GET_ADJOINT_DERIVATIVE;
    if (!known(instance, call, REAL, request->unknown, request->n_unknown, of_unknown, n_of_unknown)
        || !known(instance, call, REAL, request->given, request->n_given, of_given, n_of_given))
        return 0;
    const char *name = adjoint ? culprit(request->unknown, request->n_unknown, of_unknown)
                               : culprit(request->given, request->n_given, of_given);
    if (name) {
        report(instance, ERROR, "%s: the %s of %s is not finite", call_name(call), adjoint ? "weight" : "change", name);
        return 0;
    }
    if ((request->wants = wanted(instance, request)) < 0)
        return 0;
    if (!instance->state.initialised && initialise(instance, 0) != OK)
        return 0;
    if (!update_held(instance)) {
        refuse(instance, call, NO_EFFORT);
        return 0;
    }
    update_stops(&instance->state);
    const int several = adjoint && n_of_given > 1;
    request->by_product = (request->wants & WANTS_RATES) && has_slopes(instance, several, request);
    if (request->by_product)
        request->wants -= WANTS_RATES;
    return 1;
}

/* Compute the change of the unknowns for the seed, a change of the knowns (states and inputs). */
static Status directional_derivative(void *component, const Reference unknown[], size_t n_unknown,
                                     const Reference given[], size_t n_given, const double seed[],
                                     size_t n_seed, double result[], size_t n_result)
{
    Request request = {GET_DIRECTIONAL_DERIVATIVE, unknown, given, n_unknown, n_given, 0, 0};
    Instance *instance = enter(component, request.call, 1);
    if (!instance)
        return ERROR;
    if (multiply(instance, &request, seed, n_seed, result, n_result))
        return OK;
    if (!prepare(instance, &request, result, n_result, seed, n_seed))
        return ERROR;
    double change[X] = {0}, derivative[FIRST_PARAMETER] = {0};
    for (size_t i = 0; i < n_given; i++)
        for (int k = begin_of(given[i]); k < end_of(given[i]); k++)
            change[k] += *seed++;
    if (request.wants) {
        const Stops stops = regime_of(&instance->state);
        differentiate(instance->state.plant.value, stops.held, stops.slip, stops.rank, request.wants, change,
                      derivative);
    }
    for (int k = 0; k < X && request.by_product; k++)
        if (change[k] != 0.0)
            add_column(instance, k, change[k], &derivative[DER_Q]);
    double zero = 0.0; /* NaN after a value that is not finite */
    for (size_t i = 0; i < n_unknown; i++)
        for (int k = begin_of(unknown[i]); k < end_of(unknown[i]); k++)
            zero += 0.0 * (*result++ = derivative[k]);
    if (zero == 0.0)
        return OK;
    return report(instance, DISCARD, "%s: that of %s is not finite", call_name(request.call),
                  culprit(unknown, n_unknown, result - n_result));
}

#if FMI == 3
/* Compute, for each known, the sum of its derivatives of the unknowns, weighted by the seed. */
Status fmi3GetAdjointDerivative(void *component, const Reference unknown[], size_t n_unknown,
                                const Reference given[], size_t n_given, const double seed[],
                                size_t n_seed, double result[], size_t n_result)
{
    Request request = {GET_ADJOINT_DERIVATIVE, unknown, given, n_unknown, n_given, 0, 0};
    Instance *instance = enter(component, request.call, 1);
    if (!instance || !prepare(instance, &request, seed, n_seed, result, n_result))
        return ERROR;
    const Stops stops = regime_of(&instance->state);
    double weight[FIRST_PARAMETER] = {0}, sum[FIRST_PARAMETER] = {0};
    for (size_t i = 0; i < n_unknown; i++)
        for (int k = begin_of(unknown[i]); k < end_of(unknown[i]); k++)
            weight[k] += *seed++;
    for (size_t i = 0; i < n_given; i++) /* each value of a known is one column of the Jacobian */
        for (int k = begin_of(given[i]); k < end_of(given[i]); k++) {
            double change[X] = {0}, derivative[FIRST_PARAMETER] = {0};
            change[k] = 1.0;
            if (request.wants)
                differentiate(instance->state.plant.value, stops.held, stops.slip, stops.rank, request.wants,
                              change, derivative);
            if (request.by_product)
                add_column(instance, k, 1.0, &derivative[DER_Q]);
            sum[k] = 0.0;
            for (int u = FIRST_OUTPUT; u < END_OF_RATES; u++)
                if (weight[u] != 0.0)
                    sum[k] += weight[u] * derivative[u];
            if (!isfinite(sum[k]))
                return report(instance, DISCARD, "%s: that by %s is not finite", call_name(request.call),
                              VARIABLE_NAME[k]);
        }
    for (size_t i = 0; i < n_given; result += size_of(given[i++]))
        memcpy(result, &sum[begin_of(given[i])], size_of(given[i]) * sizeof *result);
    return OK;
}
#endif
