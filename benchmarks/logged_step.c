/* Cost of one logged communication step in C, with the engine compiled in: the lower bound of a run with its bag.
   It consists of doStep, getReal of q, v, x and tau, a serialised JointState in an MCAP record, and fwrite. */
#include <stdio.h>
#include <string.h>
#include <time.h>

#include "fmu.c"

enum { HEAD = 31, BEFORE = 60, SIZE = BEFORE + 16 * N_JOINTS };

/* Processor time of a step, s, the mean of a run from the start; NaN if a call fails. */
FMI2_Export double logged_cost(double h, int steps, const char *path, int logs)
{
    const fmi2CallbackFunctions callbacks = {NULL, NULL, NULL, NULL, NULL};
    fmi2Component arm = fmi2Instantiate("arm", fmi2CoSimulation, MODEL_GUID, "", &callbacks, 0, 0);
    FILE *file = fopen(path, "wb");
    if (!arm || !file)
        return NAN;
    int status = fmi2SetupExperiment(arm, 0, 0.0, 0.0, 0, 0.0);
    status |= fmi2EnterInitializationMode(arm) | fmi2ExitInitializationMode(arm);
    enum { COUNT = FIRST_PARAMETER - FIRST_OUTPUT };
    fmi2ValueReference references[COUNT];
    for (int i = 0; i < COUNT; i++)
        references[i] = FIRST_OUTPUT + 1 + i;
    double values[COUNT];
    unsigned char record[HEAD + SIZE] = {5};
    const clock_t begin = clock();
    for (int k = 0; k < steps; k++) {
        status |= fmi2DoStep(arm, k * h, h, fmi2True);
        if (!logs)
            continue;
        status |= fmi2GetReal(arm, references, COUNT, values);
        const unsigned long long stamp = 1700000000000000000ull + (k + 1) * 10000000ull;
        const unsigned int time[2] = {stamp / 1000000000u, stamp % 1000000000u};
        memcpy(record + 15, &stamp, 8);
        memcpy(record + 23, &stamp, 8);
        memcpy(record + HEAD + 4, time, 8);
        memcpy(record + HEAD + BEFORE, values, 16 * N_JOINTS);
        status |= fwrite(record, sizeof record, 1, file) != 1;
    }
    status |= fclose(file);
    const double cost = (double)(clock() - begin) / CLOCKS_PER_SEC / steps;
    fmi2FreeInstance(arm);
    return status == fmi2OK ? cost : NAN;
}
