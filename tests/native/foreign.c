/* An FMI 2.0 FMU of another maker, ẋ = u − x by Euler's method, y = x + 2 u; with one fault where FAULT names one. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include "fmi2Functions.h"

enum { NONE, KEEPS, SHARES, RESTORES_NOTHING, LOSES_BYTES, WRONG_SLOPE, CRASHES, NOT_FINITE, DISCARDS, HANGS,
       READS_CHANGE, COUNTS, GREEDY, ALONE, FRAGILE,
       KEEPS_INPUT, KEEPS_PARAMETER, ONE_SEED, DISCARDS_LARGE, HIGH, UNSET,
       RESTORES_NO_INPUT, BOUNDED, POINTS, ENDS, NAMED, OLD_SLOPE, SHARES_PARAMETER,
       KEEPS_INTEGER, KEEPS_BOOLEAN, LOSES_TUNABLE, LOSES_INTEGER, FLUSHES,
       DESTROYS, READS_STEER, NOT_EXACT, NOT_CONSTANT, WRONG_TIME, KEEPS_HANDLE, LEAVES_POINTER,
       ONE_STATE, NOT_FINITE_AT_START, SMALL_SLOPE, WRONG_TEXT, WRONG_ITEM, KEEPS_TEXT, LOSES_ITEM, READS_TWO,
       DERIVATIVES_STEER, ROUNDS, STRICT,
       KEEPS_ZERO, SHARES_ZERO, LOSES_ZERO, SWITCH_ABORTS };
#ifndef X
#define X 1.0
#endif
typedef struct { double u, x, p; int phase; double t; int k, b, reads, item; char text[16]; double w, s; } M;
static M one;
static double shared;
static int count, living;
static double shared_p, shared_w, flushed;
static char names[8][80];
static M *owners[8];
static void start(M *m) {
    *m = (M){0.0, X, FAULT == UNSET ? NAN : 1.0, 0, 0.0, 3, 0, 0, FAULT == WRONG_ITEM ? 1 : 2};
    strcpy(m->text, FAULT == WRONG_TEXT ? "wrong" : "text");
}
static double y_of(M *m) {
    return (FAULT == SHARES ? shared : m->x) + (FAULT == OLD_SLOPE ? 2.0 + 10.0 * m->t : 2.0) * m->u
        + (FAULT == HIGH ? 1e6 : 0.0) + (FAULT == SHARES_PARAMETER ? shared_p : FAULT == LOSES_TUNABLE ? m->p : 0.0)
        + (FAULT == SHARES_ZERO ? shared_w : m->w) + (FAULT == LOSES_INTEGER ? m->k : FAULT == LOSES_ITEM ? m->item : 0);
}

fmi2Component fmi2Instantiate(fmi2String n, fmi2Type t, fmi2String g, fmi2String r, const fmi2CallbackFunctions *f,
                              fmi2Boolean v, fmi2Boolean l) {
    M *m = FAULT == ALONE && living++ ? NULL : malloc(sizeof *m);
    if (m) start(m);
    flushed = 0.0;
    if (FAULT == NAMED) {  /* a name may not be that of a living instance */
        int k = 0;
        for (int i = 0; i < 8; i++) if (!strcmp(names[i], n)) return NULL;
        while (names[k][0]) k++;
        snprintf(names[k], sizeof *names, "%s", n);
        owners[k] = m;
    }
    return m;
}
void fmi2FreeInstance(fmi2Component c) {
    living = 0;
    for (int i = 0; i < 8; i++) if (owners[i] == c) names[i][0] = 0;
    free(c);
}
fmi2Status fmi2Reset(fmi2Component c) {
    M old = *(M *)c;
    if (old.phase == 9) abort();  /* a fatal failure allows no further call */
    if (FAULT == HANGS) for (;;) sleep(1);
    if (FAULT == GREEDY && fopen("litter", "w") && !malloc((size_t)5 << 30)) abort();
    start(c);
    if (FAULT == KEEPS) ((M *)c)->x = old.x;
    if (FAULT == KEEPS_INPUT) ((M *)c)->u = old.u;
    if (FAULT == KEEPS_PARAMETER) ((M *)c)->p = old.p;
    if (FAULT == KEEPS_ZERO) ((M *)c)->w = old.w;
    if (FAULT == KEEPS_INTEGER) ((M *)c)->k = old.k;
    if (FAULT == KEEPS_BOOLEAN) ((M *)c)->b = old.b;
    if (FAULT == KEEPS_TEXT) memcpy(((M *)c)->text, old.text, sizeof old.text);
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return ((M *)c)->phase ? fmi2Error : fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    shared = ((M *)c)->x;
    shared_p = ((M *)c)->p;
    shared_w = ((M *)c)->w;
    ((M *)c)->phase = 1;
    return fmi2OK;
}
fmi2Status fmi2Terminate(fmi2Component c) { ((M *)c)->phase = 2; return fmi2OK; }
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Real v[]) {
    M *m = c;
    for (size_t i = 0; i < n; i++)
        if (FAULT == BOUNDED && r[i] == 1 && v[i] > 0.0) return fmi2Error;
    for (size_t i = 0; i < n; i++) {
        *(r[i] == 1 ? &m->u : r[i] == 2 ? &m->x : r[i] == 14 ? &m->w : r[i] == 15 ? &m->s : &m->p) = v[i];
        if (r[i] == 15 && v[i] != 0.0 && FAULT != SWITCH_ABORTS) { m->phase = 9; return fmi2Fatal; }
    }
    return fmi2OK;
}
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Real v[]) {
    M *m = c;
    for (size_t i = 0; i < n; i++) {
        int defined = FAULT != (m->t > 0.0 ? NOT_FINITE : NOT_FINITE_AT_START);
        double value[] = {0.0, m->u, FAULT == NOT_EXACT ? m->x + 0.5 : m->x, m->u - m->x,
                          defined ? y_of(m) : NAN, m->p, 0.0, 0.0,
                          FAULT == ROUNDS ? (1e-3 * m->u + 3e5) - 3e5 : 1e-8 * m->u,
                          FAULT == WRONG_TIME ? 1.01 * m->t : m->t, FAULT == NOT_CONSTANT ? 9.8 : 9.81};
        if (r[i] == 14 || r[i] == 15) {
            v[i] = r[i] == 14 ? m->w : m->s;
            continue;
        }
        if (r[i] > 10 && FAULT == FRAGILE) abort();
        if (r[i] > 10) return fmi2Error;
        m->reads++;
        if (FAULT == READS_CHANGE && r[i] == 4) m->x += 1e-3;
        v[i] = value[r[i]];
    }
    return fmi2OK;
}
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean s) {
    M *m = c;
    if (m->phase != 1) return fmi2Error;
    if (m->s != 0.0) abort();
    if (FAULT == DISCARDS && t > 0.05) return fmi2Discard;
    if (FAULT == DISCARDS_LARGE && h > 0.015) return fmi2Discard;
    if (FAULT == ENDS && t + h > 0.1 + 1e-9) return fmi2Discard;
    m->t += h;
    if (s) flushed = m->t;  /* noSetFMUStatePriorToCurrentPoint */
    m->x += h * (m->u - m->x) + (FAULT == READS_STEER ? 1e-3 * m->reads : 0.0);
    shared += h * (m->u - shared);
    return fmi2OK;
}
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *s) {
    if (*s && FAULT == KEEPS_HANDLE) return fmi2OK;
    if (FAULT == ONE_STATE) *s = &one;
    if (!*s) *s = malloc(sizeof(M));
    *(M *)*s = *(M *)c;
    return fmi2OK;
}
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate s) {
    if (FAULT == CRASHES) abort();
    if (FAULT == FLUSHES && ((M *)s)->t < flushed) return fmi2Error;
    double u = ((M *)c)->u, p = ((M *)c)->p, w = ((M *)c)->w;
    int k = ((M *)c)->k, item = ((M *)c)->item;
    if (FAULT != RESTORES_NOTHING) *(M *)c = *(M *)s;
    if (FAULT == DESTROYS) ((M *)s)->x = 0.0;
    if (FAULT == RESTORES_NO_INPUT) ((M *)c)->u = u;
    if (FAULT == LOSES_TUNABLE) ((M *)c)->p = p;
    if (FAULT == LOSES_ZERO) ((M *)c)->w = w;
    if (FAULT == LOSES_INTEGER) ((M *)c)->k = k;
    if (FAULT == LOSES_ITEM) ((M *)c)->item = item;
    return fmi2OK;
}
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *s) {
    if (FAULT != ONE_STATE) free(*s);
    if (FAULT != LEAVES_POINTER) *s = NULL;
    return fmi2OK;
}
fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate s, size_t *n) { *n = sizeof(M); return fmi2OK; }
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate s, fmi2Byte b[], size_t n) {
    for (size_t i = 0; i < n; i++) b[i] = ((char *)s)[i];
    if (FAULT == POINTS) memcpy(b, &s, sizeof s);
    return fmi2OK;
}
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte b[], size_t n, fmi2FMUstate *s) {
    *s = FAULT == ONE_STATE ? &one : malloc(n);
    if (FAULT == POINTS) memcpy(&b, b, sizeof(void *));
    for (size_t i = 0; i < n; i++) ((char *)*s)[i] = FAULT == LOSES_BYTES && i >= sizeof(double) ? 0 : b[i];
    ((M *)*s)->phase = 1;
    return fmi2OK;
}
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference z[], size_t nz,
                                        const fmi2ValueReference v[], size_t nv, const fmi2Real dv[], fmi2Real dz[]) {
    for (size_t i = 0; i < nz; i++) {
        dz[i] = 0.0;
        for (size_t k = 0; k < (FAULT == ONE_SEED ? 1 : nv); k++) {
            double of_y = v[k] == 1 ? 2.0 : 1.0, of_rate = v[k] == 1 ? 1.0 : -1.0;
            double of_z = v[k] == 1 ? FAULT == SMALL_SLOPE ? 5e-8 : FAULT == ROUNDS ? 1e-3 : 1e-8 : 0.0;
            of_y *= FAULT == WRONG_SLOPE ? 1.00001 : 1.0;
            dz[i] += dv[k] * (z[i] == 8 ? of_z : z[i] == 4 ? of_y : of_rate);
        }
    }
    if (FAULT == DERIVATIVES_STEER && ((M *)c)->t > 0.0) ((M *)c)->x += 0.1;
    return fmi2OK;
}

#define NOT_THERE(name, ...) fmi2Status name(fmi2Component c, ##__VA_ARGS__) { return fmi2Error; }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean d, fmi2Real t, fmi2Real s, fmi2Boolean e, fmi2Real f) {
    return fmi2OK;
}
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean l, size_t n, const fmi2String k[]) { return fmi2OK; }
const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }
typedef const fmi2ValueReference R[];
fmi2Status fmi2GetInteger(fmi2Component c, R r, size_t n, fmi2Integer v[]) {
    v[0] = r[0] == 6 ? ++count : r[0] == 11 ? ((M *)c)->item : ((M *)c)->k;
    return fmi2OK;
}
fmi2Status fmi2GetBoolean(fmi2Component c, R r, size_t n, fmi2Boolean v[]) {
    v[0] = r[0] == 13 ? FAULT == READS_TWO ? 2 : ((M *)c)->u > 5e-5 : ((M *)c)->b;
    return fmi2OK;
}
fmi2Status fmi2SetInteger(fmi2Component c, R r, size_t n, const fmi2Integer v[]) {
    if (FAULT == STRICT && r[0] == 7 && v[0] != 3) abort();
    if (v[0] > 3) return fmi2Error;
    *(r[0] == 11 ? &((M *)c)->item : &((M *)c)->k) = v[0];
    return fmi2OK;
}
fmi2Status fmi2SetBoolean(fmi2Component c, R r, size_t n, const fmi2Boolean v[]) { ((M *)c)->b = v[0]; return fmi2OK; }
fmi2Status fmi2GetString(fmi2Component c, R r, size_t n, fmi2String v[]) { v[0] = ((M *)c)->text; return fmi2OK; }
fmi2Status fmi2SetString(fmi2Component c, R r, size_t n, const fmi2String v[]) {
    snprintf(((M *)c)->text, sizeof ((M *)c)->text, "%s", v[0]);
    return fmi2OK;
}
NOT_THERE(fmi2SetRealInputDerivatives, R r, size_t n, const fmi2Integer o[], const fmi2Real v[])
NOT_THERE(fmi2GetRealOutputDerivatives, R r, size_t n, const fmi2Integer o[], fmi2Real v[])
NOT_THERE(fmi2CancelStep)
NOT_THERE(fmi2GetStatus, const fmi2StatusKind k, fmi2Status *v)
NOT_THERE(fmi2GetRealStatus, const fmi2StatusKind k, fmi2Real *v)
NOT_THERE(fmi2GetIntegerStatus, const fmi2StatusKind k, fmi2Integer *v)
NOT_THERE(fmi2GetBooleanStatus, const fmi2StatusKind k, fmi2Boolean *v)
NOT_THERE(fmi2GetStringStatus, const fmi2StatusKind k, fmi2String *v)
