/* Cost of the first steps of a robot with damping in C, compiled in. */
#define _POSIX_C_SOURCE 199309L
#include <time.h>

#include "fmu.c"

static double now(void)
{
    struct timespec time;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
    return time.tv_sec + 1e-9 * time.tv_nsec;
}

/* Least processor time of each step of 10 ms over rounds, s, from a velocity in every joint; NaN where a call fails. */
FMI2_Export void step_costs(double damping, double velocity, int steps, int rounds, double cost[])
{
    static const fmi2CallbackFunctions callbacks = {NULL, NULL, NULL, NULL, NULL};
    const double h = 0.01;
    fmi2ValueReference reference;
    for (int k = 0; k < steps; k++)
        cost[k] = HUGE_VAL;
    for (int round = 0; round < rounds; round++) {
        fmi2Component arm = fmi2Instantiate("arm", fmi2CoSimulation, MODEL_GUID, "", &callbacks, 0, 0);
        int status = fmi2SetupExperiment(arm, 0, 0.0, 0.0, 0, 0.0);
        for (int i = 0; i < N_JOINTS; i++) {
            reference = FIRST_DAMPING + i;
            status |= fmi2SetReal(arm, &reference, 1, &damping);
            reference = FIRST_SPEED + i;
            status |= fmi2SetReal(arm, &reference, 1, &velocity);
        }
        status |= fmi2EnterInitializationMode(arm) || fmi2ExitInitializationMode(arm);
        for (int k = 0; k < steps; k++) {
            const double begin = now();
            status |= fmi2DoStep(arm, k * h, h, fmi2True);
            const double spent = status == fmi2OK ? now() - begin : NAN;
            cost[k] = spent >= cost[k] ? cost[k] : spent;
        }
        fmi2FreeInstance(arm);
    }
}
