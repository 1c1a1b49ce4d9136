/* Many steps of FMUs in one call, in addition to the functions of FMI: calls from Python, seven for a step of a plant
   and its controller, take longer than the step of a small robot. The importer prepares the calls of a step, also those
   of FMUs of other vendors. If the arguments change, the name must change too. */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>

#include "instance.h"

typedef struct {
    int kind; /* version of FMI; negative for doStep */
    void (*function)(void);
    void *instance;
    const unsigned *references;
    size_t count;
    double *values;
    size_t size;   /* number of values */
    size_t stride; /* from the values of a step to those of the next one */
    char *heard;   /* set to 1 if the instance logs an error */
} Prepared;

typedef int Access2(void *, const unsigned *, size_t, double *);
typedef int Access3(void *, const unsigned *, size_t, double *, size_t);
typedef int Step2(void *, double, double, int);
typedef int Step3(void *, double, double, bool, bool *, bool *, bool *, double *);

/* Status of a call in step k; -1 if the FMU ends the run. */
INTERNAL int made(const Prepared *call, size_t k, double t, double h)
{
    double *values = call->values + k * call->stride, last;
    bool event, ends = false, early;
    int status;
    *call->heard = 0;
    switch (call->kind) {
    case 2:
        return ((Access2 *)call->function)(call->instance, call->references, call->count, values);
    case 3:
        return ((Access3 *)call->function)(call->instance, call->references, call->count, values, call->size);
    case -2:
        return ((Step2 *)call->function)(call->instance, t, h, 1);
    default:
        status = ((Step3 *)call->function)(call->instance, t, h, true, &event, &ends, &early, &last);
        return ends && status < 2 ? -1 : status;
    }
}

#ifdef _WIN32
#define EXPORTED __declspec(dllexport)
#elif defined __GNUC__
#define EXPORTED __attribute__((visibility("default")))
#else
#define EXPORTED
#endif

/* Evaluations of the equations of motion in all steps of an instance so far: the cost of a run, on any machine. */
EXPORTED double PREFIXED(twodof_evaluations)(const Instance *instance) { return instance->evaluations; }

/* Do one step from each of the times; return the number of rows of outputs. A row that is not finite is the last one.
   failed receives the index of the call that was refused and its status; without a refusal, the index is count. */
EXPORTED int PREFIXED(twodof_span)(const Prepared *calls, int count, const double *times, double h, int steps,
                                   const double *rows, size_t width, int failed[2])
{
    for (int k = 0; k < steps; k++) {
        for (failed[0] = 0; failed[0] < count; failed[0]++) {
            failed[1] = made(&calls[failed[0]], (size_t)k, times[k], h);
            if (failed[1] < 0 || failed[1] > 1)
                return k;
        }
        double sum = 0.0;
        for (size_t i = 0; i < width; i++)
            sum += rows[(size_t)k * width + i];
        if (!isfinite(sum))
            return k + 1;
    }
    return steps;
}
