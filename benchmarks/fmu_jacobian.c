/* The whole Jacobian of the accelerations by the FMU, compiled in, as columns by q, v and tau_cmd. */
#include "fmu.c"

enum { N = N_JOINTS, STATES = 2 * N };

static Instance *arm;

static int set_point(const double point[3 * N])
{
    fmi2ValueReference effort[N];
    for (int i = 0; i < N; i++)
        effort[i] = FIRST_EFFORT + i;
    return fmi2SetContinuousStates(arm, point, STATES) || fmi2SetReal(arm, effort, N, point + STATES);
}

FMI2_Export int begin(void)
{
    static const fmi2CallbackFunctions callbacks = {NULL, NULL, NULL, NULL, NULL};
    fmi2EventInfo info;
    arm = fmi2Instantiate("arm", fmi2ModelExchange, MODEL_GUID, "", &callbacks, 0, 0);
    return !arm || fmi2SetupExperiment(arm, 0, 0.0, 0.0, 0, 0.0) || fmi2EnterInitializationMode(arm)
           || fmi2ExitInitializationMode(arm) || fmi2NewDiscreteStates(arm, &info) || fmi2EnterContinuousTimeMode(arm);
}

/* A direction of FMI at a time. */
FMI2_Export int by_calls(const double point[3 * N], double result[3 * N * N])
{
    static const fmi2Real one = 1.0;
    fmi2ValueReference unknown[N];
    int status = set_point(point);
    for (int i = 0; i < N; i++)
        unknown[i] = FIRST_RATE + N + i;
    for (int c = 0; c < 3 * N; c++) {
        const fmi2ValueReference known = c < STATES ? FIRST_STATE + c : FIRST_EFFORT + c - STATES;
        status |= fmi2GetDirectionalDerivative(arm, unknown, N, &known, 1, &one, result + c * N);
    }
    return status;
}

/* The engine's function for all directions, called once. */
FMI2_Export int by_engine(const double point[3 * N], double result[3 * N * N])
{
    double slope[X][N];
    const int status = set_point(point);
    update_rates(&arm->state);
    acceleration_slopes(&arm->state.plant, &arm->state.stops, slope);
    for (int c = 0; c < 3 * N; c++)
        for (int i = 0; i < N; i++)
            result[c * N + i] = slope[c < STATES ? Q + c : TAU_CMD + c - STATES][i];
    return status;
}

/* The right-hand side. */
FMI2_Export int by_rates(const double point[3 * N], double result[3 * N * N])
{
    return set_point(point) || fmi2GetDerivatives(arm, result, STATES);
}
