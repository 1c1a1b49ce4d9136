/* A co-simulation FMU of FMI 2.0: tau = Kp (q_des - q) - Kd v of N joints, or 0 if it is not enabled or has seen MOST
   steps; and a count of its steps. */
#include <stdlib.h>

#include "fmi2FunctionTypes.h"

enum { N = 2, Q = 0, V = N, Q_DES = 2 * N, TAU = 3 * N, KP = 4 * N, KD, MOST = 20, MODE = 71 };

typedef struct {
    double value[KD + 1];
    int enabled, steps, seen;
} Controller;

static const Controller START = {.value = {[KP] = 10.0, [KD] = 2.0}, .enabled = 1};

const char *fmi2GetVersion(void) { return "2.0"; }
const char *fmi2GetTypesPlatform(void) { return "default"; }

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String where,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging)
{
    Controller *c = malloc(sizeof *c);
    (void)name, (void)type, (void)guid, (void)where, (void)functions, (void)visible, (void)logging;
    *c = START;
    return c;
}

void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance, fmi2Real start,
                               fmi2Boolean has_stop, fmi2Real stop)
{
    (void)c, (void)has_tolerance, (void)tolerance, (void)start, (void)has_stop, (void)stop;
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return (void)c, fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return (void)c, fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component c) { return (void)c, fmi2OK; }
fmi2Status fmi2Reset(fmi2Component c) { return *(Controller *)c = START, fmi2OK; }

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[])
{
    for (size_t i = 0; i < n; i++)
        ((Controller *)c)->value[vr[i]] = value[i];
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component component, const fmi2ValueReference vr[], size_t n, fmi2Real value[])
{
    Controller *c = component;
    for (int i = 0; i < N; i++)
        c->value[TAU + i] = c->enabled && c->seen < MOST ? c->value[KP] * (c->value[Q_DES + i] - c->value[Q + i])
                                             - c->value[KD] * c->value[V + i] : 0.0;
    for (size_t i = 0; i < n; i++)
        value[i] = c->value[vr[i]];
    return fmi2OK;
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Boolean value[])
{
    (void)vr;
    if (n > 0)
        ((Controller *)c)->enabled = value[0];
    return fmi2OK;
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Boolean value[])
{
    (void)vr;
    for (size_t i = 0; i < n; i++)
        value[i] = ((Controller *)c)->enabled;
    return fmi2OK;
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer value[])
{
    for (size_t i = 0; i < n; i++)
        if (vr[i] != MODE)
            ((Controller *)c)->seen = value[i];
    return fmi2OK;
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Integer value[])
{
    for (size_t i = 0; i < n; i++)
        value[i] = vr[i] == MODE ? 1 : ((Controller *)c)->steps;
    return fmi2OK;
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2String value[])
{
    (void)c, (void)vr;
    for (size_t i = 0; i < n; i++)
        value[i] = "";
    return fmi2OK;
}

/* The calls that no importer makes: FMPy only loads a library that has them all. */
#define NEVER(name) fmi2Status fmi2##name(void) { return fmi2Error; }
NEVER(SetDebugLogging) NEVER(SetString) NEVER(GetFMUstate)
NEVER(SetFMUstate) NEVER(FreeFMUstate) NEVER(SerializedFMUstateSize) NEVER(SerializeFMUstate)
NEVER(DeSerializeFMUstate) NEVER(GetDirectionalDerivative) NEVER(SetRealInputDerivatives)
NEVER(GetRealOutputDerivatives) NEVER(CancelStep) NEVER(GetStatus) NEVER(GetRealStatus) NEVER(GetIntegerStatus)
NEVER(GetBooleanStatus) NEVER(GetStringStatus)

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean last)
{
    (void)t, (void)h, (void)last;
    ((Controller *)c)->steps++;
    return fmi2OK;
}
