/* Cost of one communication step in C, the engine compiled in. As a library, step_cost; as a
   program, which prints µs per step, the best of several runs from the start:

       native_step [h, s] [steps a run] [runs] */
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "fmu.c"

/* Processor time of a step, s, the mean of a run from the start; NaN where a call fails. */
FMI2_Export double step_cost(double h, int steps)
{
    const fmi2CallbackFunctions callbacks = {NULL, NULL, NULL, NULL, NULL};
    fmi2Component arm = fmi2Instantiate("arm", fmi2CoSimulation, MODEL_GUID, "", &callbacks, 0, 0);
    if (!arm)
        return NAN;
    int status = fmi2SetupExperiment(arm, 0, 0.0, 0.0, 0, 0.0);
    status |= fmi2EnterInitializationMode(arm) | fmi2ExitInitializationMode(arm);
    const clock_t begin = clock();
    for (int k = 0; k < steps; k++)
        status |= fmi2DoStep(arm, k * h, h, fmi2True);
    const double cost = (double)(clock() - begin) / CLOCKS_PER_SEC / steps;
    fmi2FreeInstance(arm);
    return status == fmi2OK ? cost : NAN;
}

int main(int count, char *argument[])
{
    const double h = count > 1 ? atof(argument[1]) : 0.01;
    const int steps = count > 2 ? atoi(argument[2]) : 500, runs = count > 3 ? atoi(argument[3]) : 20;
    double best = HUGE_VAL;
    for (int run = 0; run < runs; run++) {
        const double cost = step_cost(h, steps);
        if (isnan(cost))
            return 1;
        best = cost < best ? cost : best;
    }
    printf("%.3f\n", 1e6 * best);
    return 0;
}
