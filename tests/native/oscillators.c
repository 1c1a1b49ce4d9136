/* An FMU of FMI 3.0 that twodof did not make: uncoupled oscillators, q'' = -w2 q + f, by their closed form.
   It has what ours have not: a size that is a structural parameter, and it may end the run. Other calls,
   which do nothing, are added by the test. */
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"

enum { N = 2, Q = 2, V, F, W2, END };

typedef struct {
    double t, q[N], v[N], f[N], w2[N], end;
} Oscillators;

static const Oscillators START = {0.0, {1.0, 0.5}, {0.0, 0.0}, {0.0, 0.0}, {4.0, 9.0}, 1e9};

static double *place(Oscillators *all, fmi3ValueReference vr)
{
    return vr == Q ? all->q : vr == V ? all->v : vr == F ? all->f : vr == W2 ? all->w2 : &all->end;
}

const char *fmi3GetVersion(void)
{
    return "3.0";
}

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging_on, fmi3Boolean event_mode, fmi3Boolean early_return,
    const fmi3ValueReference required[], size_t n_required, fmi3InstanceEnvironment environment,
    fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    Oscillators *all = malloc(sizeof *all);
    (void)name, (void)token, (void)resources, (void)visible, (void)logging_on, (void)event_mode;
    (void)early_return, (void)required, (void)n_required, (void)environment, (void)log, (void)update;
    *all = START;
    return all;
}

void fmi3FreeInstance(fmi3Instance instance)
{
    free(instance);
}

fmi3Status fmi3Reset(fmi3Instance instance)
{
    *(Oscillators *)instance = START;
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean has_tolerance,
                                       fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean has_stop, fmi3Float64 stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    ((Oscillators *)instance)->t = start;
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                          fmi3Float64 value[], size_t n_values)
{
    for (size_t i = 0; i < count; i++) {
        const size_t size = vr[i] == END ? 1 : N;
        if (size > n_values)
            return fmi3Error;
        memcpy(value, place(instance, vr[i]), size * sizeof *value);
        value += size, n_values -= size;
    }
    return n_values ? fmi3Error : fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                          const fmi3Float64 value[], size_t n_values)
{
    for (size_t i = 0; i < count; i++) {
        const size_t size = vr[i] == END ? 1 : N;
        if (size > n_values)
            return fmi3Error;
        memcpy(place(instance, vr[i]), value, size * sizeof *value);
        value += size, n_values -= size;
    }
    return n_values ? fmi3Error : fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 point, fmi3Float64 h,
                      fmi3Boolean no_set_state_prior, fmi3Boolean *event, fmi3Boolean *terminates,
                      fmi3Boolean *early, fmi3Float64 *last)
{
    Oscillators *all = instance;
    (void)no_set_state_prior;
    for (int i = 0; i < N; i++) {
        const double w = sqrt(all->w2[i]), rest = all->f[i] / all->w2[i];
        const double from = all->q[i] - rest, c = cos(w * h), s = sin(w * h);
        all->q[i] = rest + from * c + all->v[i] / w * s;
        all->v[i] = all->v[i] * c - from * w * s;
    }
    all->t = *last = point + h;
    *event = *early = false;
    *terminates = all->t > all->end;
    return fmi3OK;
}
