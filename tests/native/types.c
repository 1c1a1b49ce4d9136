/* A co-simulation FMU of FMI 2.0 or 3.0 with a variable of each type, which counts only values set before
   initialisation. SEEN + k shows what was set for value reference k: numbers modulo M, texts as a weighted sum of their
   bytes. q and v are 0. Calls that no importer makes are added by the test. */
#include <stdlib.h>
#include <string.h>

enum { SIZE = 40, ARRAY = 20, COUNT = 3, SEEN = 100, Q = 90, V };
#define M 1000003

typedef struct {
    double seen[SIZE];
    int begun;
} Types;

static void keep(Types *types, unsigned k, double value)
{
    if (!types->begun)
        types->seen[k] = value;
}

static double sum(const char *text)
{
    double whole = 0.0;
    for (int i = 0; text[i]; i++)
        whole += (i + 1) * (unsigned char)text[i];
    return whole;
}

static double shown(const Types *types, unsigned vr)
{
    return vr >= SEEN ? types->seen[vr - SEEN] : 0.0;
}

#if FMI == 2
#include "fmi2Functions.h"

#define SETTER(NAME, TYPE, SHOWN)                                                                                \
    fmi2Status fmi2Set##NAME(fmi2Component c, const fmi2ValueReference vr[], size_t n, const TYPE value[])       \
    {                                                                                                            \
        for (size_t i = 0; i < n; i++)                                                                           \
            keep(c, vr[i], SHOWN);                                                                               \
        return fmi2OK;                                                                                           \
    }
SETTER(Real, fmi2Real, value[i])
SETTER(Integer, fmi2Integer, value[i])
SETTER(Boolean, fmi2Boolean, value[i])
SETTER(String, fmi2String, sum(value[i]))

const char *fmi2GetVersion(void) { return "2.0"; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String where,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)name, (void)type, (void)guid, (void)where, (void)functions, (void)visible, (void)logging;
    return calloc(1, sizeof(Types));
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return ((Types *)c)->begun = 1, fmi2OK; }
fmi2Status fmi2Reset(fmi2Component c) { return *(Types *)c = (Types){.begun = 0}, fmi2OK; }
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[])
{
    for (size_t i = 0; i < n; i++)
        value[i] = shown(c, vr[i]);
    return fmi2OK;
}
#else
#include "fmi3Functions.h"

#define SETTER(NAME, SHOWN)                                                                                      \
    fmi3Status fmi3Set##NAME(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3##NAME value[],  \
                             size_t n_values)                                                                    \
    {                                                                                                            \
        for (size_t i = 0, k = 0; k < n; k++)                                                                    \
            for (unsigned j = 0; j < (vr[k] == ARRAY ? COUNT : 1); j++, i++)                                     \
                if (i < n_values)                                                                                \
                    keep(c, vr[k] + j, SHOWN);                                                                   \
        return fmi3OK;                                                                                           \
    }
SETTER(Float32, value[i])
SETTER(Float64, value[i])
SETTER(Int8, value[i])
SETTER(UInt8, value[i])
SETTER(Int16, value[i])
SETTER(UInt16, value[i])
SETTER(Int32, value[i])
SETTER(UInt32, value[i])
SETTER(Int64, (double)(value[i] % M))
SETTER(UInt64, (double)(value[i] % M))
SETTER(Boolean, value[i])
SETTER(String, sum(value[i]))

const char *fmi3GetVersion(void) { return "3.0"; }
fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference required[], size_t n,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)events, (void)early;
    (void)required, (void)n, (void)environment, (void)log, (void)update;
    return calloc(1, sizeof(Types));
}
void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop)
{
    (void)has_tolerance, (void)tolerance, (void)start, (void)has_stop, (void)stop;
    return ((Types *)c)->begun = 1, fmi3OK;
}
fmi3Status fmi3Reset(fmi3Instance c) { return *(Types *)c = (Types){.begun = 0}, fmi3OK; }
fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 value[], size_t n_values)
{
    for (size_t i = 0; i < n && i < n_values; i++)
        value[i] = shown(c, vr[i]);
    return fmi3OK;
}
fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean final, fmi3Boolean *event,
                      fmi3Boolean *ends, fmi3Boolean *early, fmi3Float64 *last)
{
    (void)c, (void)final;
    *event = *ends = *early = 0;
    *last = t + h;
    return fmi3OK;
}
#endif
