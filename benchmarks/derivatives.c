/* Cost of a directional derivative beside the right-hand side's, in a native FMU as it is shipped:
   Model Exchange, at states that differ, all derivatives along a direction of all states.

       derivatives LIBRARY GUID [joints] [reference of q[1]] [reference of der(q[1])]

   prints µs of processor time each, the best of many short runs. */
#define _POSIX_C_SOURCE 200112L
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "fmi2Functions.h"

enum { CALLS = 500, RUNS = 500, MOST = 128 };

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static void print(fmi2ComponentEnvironment environment, fmi2String instance, fmi2Status status,
                  fmi2String category, fmi2String message, ...)
{
    (void)environment, (void)instance, (void)status, (void)category;
    fprintf(stderr, "%s\n", message);
}

#define LOAD(name) name##TYPE *name = (name##TYPE *)dlsym(library, #name)

int main(int count, char *argument[])
{
    void *library = count == 6 ? dlopen(argument[1], RTLD_NOW) : NULL;
    if (!library)
        return 1;
    LOAD(fmi2Instantiate);
    LOAD(fmi2SetupExperiment);
    LOAD(fmi2EnterInitializationMode);
    LOAD(fmi2ExitInitializationMode);
    LOAD(fmi2NewDiscreteStates);
    LOAD(fmi2EnterContinuousTimeMode);
    LOAD(fmi2SetContinuousStates);
    LOAD(fmi2GetContinuousStates);
    LOAD(fmi2GetDerivatives);
    LOAD(fmi2GetDirectionalDerivative);
    const fmi2CallbackFunctions callbacks = {print, calloc, free, NULL, NULL};
    fmi2Component arm = fmi2Instantiate("arm", fmi2ModelExchange, argument[2], "", &callbacks, 0, 0);
    const size_t states = 2 * strtoul(argument[3], NULL, 10);
    fmi2EventInfo info;
    fmi2Real state[MOST], rate[MOST], seed[MOST], slope[MOST];
    fmi2ValueReference known[MOST], unknown[MOST];
    if (!arm || states > MOST || fmi2SetupExperiment(arm, 0, 0.0, 0.0, 0, 0.0) ||
        fmi2EnterInitializationMode(arm) || fmi2ExitInitializationMode(arm) ||
        fmi2NewDiscreteStates(arm, &info) || fmi2EnterContinuousTimeMode(arm) ||
        fmi2GetContinuousStates(arm, state, states))
        return 1;
    for (size_t i = 0; i < states; i++) {
        known[i] = (fmi2ValueReference)(strtoul(argument[4], NULL, 10) + i);
        unknown[i] = (fmi2ValueReference)(strtoul(argument[5], NULL, 10) + i);
        seed[i] = 0.1 * (double)(i + 1);
        state[i] += i < states / 2 ? 0.0 : 0.1; /* at rest damping costs nothing */
    }
    double best[2] = {1e9, 1e9};
    for (int run = 0; run < 2 * RUNS; run++) {
        const int side = run % 2;
        int status = fmi2OK;
        const double begin = now();
        for (int k = 0; k < CALLS; k++) {
            state[0] += 1e-9;
            status |= fmi2SetContinuousStates(arm, state, states);
            status |= side ? fmi2GetDirectionalDerivative(arm, unknown, states, known, states, seed,
                                                          slope)
                           : fmi2GetDerivatives(arm, rate, states);
        }
        const double cost = (now() - begin) / CALLS;
        best[side] = cost < best[side] ? cost : best[side];
        if (status)
            return 1;
    }
    printf("%.9f %.9f\n", 1e6 * best[0], 1e6 * best[1]);
    return 0;
}
