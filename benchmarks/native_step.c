/* Cost of one communication step in C: compiled with an FMU's sources; prints µs per step, the
   best of several runs from the start.

       native_step [h, s] [steps a run] [runs] */
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "fmi2Functions.h"
#include "model.h"

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

int main(int count, char *argument[])
{
    const double h = count > 1 ? atof(argument[1]) : 0.01;
    const int steps = count > 2 ? atoi(argument[2]) : 500, runs = count > 3 ? atoi(argument[3]) : 20;
    const fmi2CallbackFunctions callbacks = {NULL, NULL, NULL, NULL, NULL};
    fmi2Component arm = fmi2Instantiate("arm", fmi2CoSimulation, MODEL_GUID, "", &callbacks, 0, 0);
    double best = HUGE_VAL;
    for (int run = 0; run < runs; run++) {
        int status = fmi2Reset(arm);
        status |= fmi2SetupExperiment(arm, 0, 0.0, 0.0, 0, 0.0);
        status |= fmi2EnterInitializationMode(arm) | fmi2ExitInitializationMode(arm);
        const double begin = now();
        for (int k = 0; k < steps; k++)
            status |= fmi2DoStep(arm, k * h, h, fmi2True);
        const double cost = (now() - begin) / steps;
        best = cost < best ? cost : best;
        if (status != fmi2OK)
            return 1;
    }
    fmi2FreeInstance(arm);
    printf("%.3f\n", 1e6 * best);
    return 0;
}
