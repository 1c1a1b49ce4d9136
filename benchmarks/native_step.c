/* Cost of the engine in C, compiled in: a communication step of co-simulation, and in Model
   Exchange the right-hand side and a directional derivative. As a program it only runs. */
#include <time.h>

#include "fmu.c"

static fmi2Component begun(fmi2Type type)
{
    static const fmi2CallbackFunctions callbacks = {NULL, NULL, NULL, NULL, NULL};
    fmi2Component arm = fmi2Instantiate("arm", type, MODEL_GUID, "", &callbacks, 0, 0);
    if (arm && !fmi2SetupExperiment(arm, 0, 0.0, 0.0, 0, 0.0) &&
        !fmi2EnterInitializationMode(arm) && !fmi2ExitInitializationMode(arm))
        return arm;
    fmi2FreeInstance(arm);
    return NULL;
}

static double since(clock_t begin, int count)
{
    return (double)(clock() - begin) / CLOCKS_PER_SEC / count;
}

/* Processor time of a step, s, the mean of a run from the start; NaN where a call fails. */
FMI2_Export double step_cost(double h, int steps)
{
    fmi2Component arm = begun(fmi2CoSimulation);
    int status = arm ? fmi2OK : fmi2Error;
    const clock_t begin = clock();
    for (int k = 0; arm && k < steps; k++)
        status |= fmi2DoStep(arm, k * h, h, fmi2True);
    const double cost = since(begin, steps);
    fmi2FreeInstance(arm);
    return status == fmi2OK ? cost : NAN;
}

/* Processor time of the right-hand side (0), of its derivative along a direction of all states (1), or of its
   Jacobian by states and n inputs, a direction at a time (2), s, at states that differ; NaN where a call fails.
   References are those of q[1], of der(q[1]) and of the first of the inputs. */
FMI2_Export double side_cost(int kind, int calls, int known, int unknown, int input, int n)
{
    enum { STATES = 2 * N_JOINTS };
    static const fmi2Real one = 1.0;
    fmi2Component arm = begun(fmi2ModelExchange);
    fmi2EventInfo info;
    fmi2Real state[STATES], rate[STATES], seed[STATES];
    fmi2ValueReference knowns[STATES], unknowns[STATES];
    if (!arm || fmi2NewDiscreteStates(arm, &info) || fmi2EnterContinuousTimeMode(arm) ||
        fmi2GetContinuousStates(arm, state, STATES))
        return NAN;
    for (int i = 0; i < STATES; i++) {
        knowns[i] = known + i;
        unknowns[i] = unknown + i;
        seed[i] = 0.1 * (i + 1);
        state[i] += i < N_JOINTS ? 0.0 : 0.1; /* at rest damping costs nothing */
    }
    /* as they are called from without */
    fmi2SetContinuousStatesTYPE *volatile set = fmi2SetContinuousStates;
    fmi2GetDerivativesTYPE *volatile rates = fmi2GetDerivatives;
    fmi2GetDirectionalDerivativeTYPE *volatile slope = fmi2GetDirectionalDerivative;
    int status = fmi2OK;
    const clock_t begin = clock();
    for (int k = 0; k < calls; k++) {
        state[0] += 1e-9;
        status |= set(arm, state, STATES);
        if (kind < 2)
            status |= kind ? slope(arm, unknowns, STATES, knowns, STATES, seed, rate) : rates(arm, rate, STATES);
        for (int c = 0; c < (kind < 2 ? 0 : STATES + n); c++) {
            const fmi2ValueReference column = c < STATES ? knowns[c] : (fmi2ValueReference)(input + c - STATES);
            status |= slope(arm, unknowns, STATES, &column, 1, &one, rate);
        }
    }
    const double cost = since(begin, calls);
    fmi2FreeInstance(arm);
    return status == fmi2OK ? cost : NAN;
}

int main(void)
{
    return isnan(step_cost(0.01, 20));
}
