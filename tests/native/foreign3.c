/* The FMU of foreign.c in FMI 3.0; the test adds calls that no trial makes. */
#include "foreign.c"
#include "fmi3Functions.h"

#define I fmi3Instance c
#define AT const fmi3ValueReference r[], size_t n

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String folder, fmi3Boolean visible,
                                         fmi3Boolean logs, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference intermediate[], size_t n,
                                         fmi3InstanceEnvironment e, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update) {
    return fmi2Instantiate(name, fmi2CoSimulation, token, folder, NULL, visible, logs);
}
void fmi3FreeInstance(I) { fmi2FreeInstance(c); }
fmi3Status fmi3Reset(I) { return (fmi3Status)fmi2Reset(c); }
fmi3Status fmi3EnterInitializationMode(I, fmi3Boolean a, fmi3Float64 tol, fmi3Float64 t, fmi3Boolean b, fmi3Float64 e) {
    return (fmi3Status)fmi2EnterInitializationMode(c);
}
fmi3Status fmi3ExitInitializationMode(I) { return (fmi3Status)fmi2ExitInitializationMode(c); }
fmi3Status fmi3Terminate(I) { return (fmi3Status)fmi2Terminate(c); }
fmi3Status fmi3SetFloat64(I, AT, const fmi3Float64 v[], size_t m) { return (fmi3Status)fmi2SetReal(c, r, n, v); }
fmi3Status fmi3GetFloat64(I, AT, fmi3Float64 v[], size_t m) { return (fmi3Status)fmi2GetReal(c, r, n, v); }
fmi3Status fmi3GetString(I, AT, fmi3String v[], size_t m) { return (fmi3Status)fmi2GetString(c, r, n, v); }
fmi3Status fmi3SetString(I, AT, const fmi3String v[], size_t m) { return (fmi3Status)fmi2SetString(c, r, n, v); }
fmi3Status fmi3GetUInt8(I, AT, fmi3UInt8 v[], size_t m) { v[0] = ((M *)c)->item; return fmi3OK; }
fmi3Status fmi3SetUInt8(I, AT, const fmi3UInt8 v[], size_t m) { ((M *)c)->item = v[0]; return fmi3OK; }
fmi3Status fmi3DoStep(I, fmi3Float64 t, fmi3Float64 h, fmi3Boolean final, fmi3Boolean *event, fmi3Boolean *ends,
                      fmi3Boolean *early, fmi3Float64 *last) {
    *event = *ends = *early = false;
    *last = t + h;
    return (fmi3Status)fmi2DoStep(c, t, h, final);
}
fmi3Status fmi3GetFMUState(I, fmi3FMUState *s) { return (fmi3Status)fmi2GetFMUstate(c, s); }
fmi3Status fmi3SetFMUState(I, fmi3FMUState s) { return (fmi3Status)fmi2SetFMUstate(c, s); }
fmi3Status fmi3FreeFMUState(I, fmi3FMUState *s) { return (fmi3Status)fmi2FreeFMUstate(c, s); }
fmi3Status fmi3SerializedFMUStateSize(I, fmi3FMUState s, size_t *n) {
    return (fmi3Status)fmi2SerializedFMUstateSize(c, s, n);
}
fmi3Status fmi3SerializeFMUState(I, fmi3FMUState s, fmi3Byte b[], size_t n) {
    return (fmi3Status)fmi2SerializeFMUstate(c, s, (fmi2Byte *)b, n);
}
fmi3Status fmi3DeserializeFMUState(I, const fmi3Byte b[], size_t n, fmi3FMUState *s) {
    return (fmi3Status)fmi2DeSerializeFMUstate(c, (const fmi2Byte *)b, n, s);
}
fmi3Status fmi3GetDirectionalDerivative(I, const fmi3ValueReference z[], size_t nz, const fmi3ValueReference v[],
                                        size_t nv, const fmi3Float64 dv[], size_t a, fmi3Float64 dz[], size_t b) {
    return (fmi3Status)fmi2GetDirectionalDerivative(c, z, nz, v, nv, dv, dz);
}
