/* The FMU for a page, of either version of FMI: an instance that keeps what it logs, and whose
   variables are set and read one by one, whether they are scalars or elements of vectors. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#define EXPORT __attribute__((visibility("default")))

typedef unsigned int Reference; /* of a scalar or of a vector, as FMI has it */

static void *instance;
static char said[1024];

#if FMI == 3
#include "fmi3Functions.h"

static void note(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                 fmi3String message)
{
    (void)environment, (void)status, (void)category;
    snprintf(said, sizeof said, "%s", message);
}

static void *instantiate(void)
{
    return fmi3InstantiateCoSimulation("page", MODEL_GUID, "", false, true, false, false, NULL, 0,
                                       NULL, note, NULL);
}

static int get_vector(Reference first, double value[])
{
    return fmi3GetFloat64(instance, &first, 1, value, (size_t)(PLACE[first + 1] - PLACE[first]));
}

static int set_reals(const Reference vr[], size_t count, const double value[], size_t n_values)
{
    return fmi3SetFloat64(instance, vr, count, value, n_values);
}

static int set_boolean(Reference vr, int value)
{
    const fmi3Boolean truth = value != 0;
    return fmi3SetBoolean(instance, &vr, 1, &truth, 1);
}

static int reset(void)
{
    return fmi3Reset(instance);
}

static int enter_initialization(void)
{
    return fmi3EnterInitializationMode(instance, false, 0.0, 0.0, false, 0.0);
}

static int exit_initialization(void)
{
    return fmi3ExitInitializationMode(instance);
}

EXPORT int engine_step(double t, double h)
{
    fmi3Boolean event, terminates, early;
    double last;
    return fmi3DoStep(instance, t, h, true, &event, &terminates, &early, &last);
}

#else
#include "fmi2Functions.h"

static void note(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                 fmi2String category, fmi2String format, ...)
{
    va_list arguments;
    (void)environment, (void)name, (void)status, (void)category;
    va_start(arguments, format);
    vsnprintf(said, sizeof said, format, arguments);
    va_end(arguments);
}

static void *instantiate(void)
{
    static const fmi2CallbackFunctions FUNCTIONS = {note, calloc, free, NULL, NULL};
    return fmi2Instantiate("page", fmi2CoSimulation, MODEL_GUID, "", &FUNCTIONS, 0, 0);
}

static int get_vector(Reference first, double value[])
{
    return fmi2GetReal(instance, &first, 1, value);
}

static int set_reals(const Reference vr[], size_t count, const double value[], size_t n_values)
{
    (void)n_values;
    return fmi2SetReal(instance, vr, count, value);
}

static int set_boolean(Reference vr, int value)
{
    return fmi2SetBoolean(instance, &vr, 1, &value);
}

static int reset(void)
{
    return fmi2Reset(instance);
}

static int enter_initialization(void)
{
    const int status = fmi2SetupExperiment(instance, 0, 0.0, 0.0, 0, 0.0);
    return status > fmi2Warning ? status : fmi2EnterInitializationMode(instance);
}

static int exit_initialization(void)
{
    return fmi2ExitInitializationMode(instance);
}

EXPORT int engine_step(double t, double h)
{
    return fmi2DoStep(instance, t, h, 1);
}
#endif

static const int WARNING = 1; /* the worst status that is none of a failure */
static double given[N_VARIABLES]; /* what variables were set to last, else their start */

/* The reference of the variable that is at a place, or of the vector that has an element there. */
static Reference reference_of(int place)
{
    Reference vr = 1;
    while (PLACE[vr + 1] <= place)
        vr++;
    return vr;
}

/* Back to the beginning, before initialisation. */
EXPORT int engine_reset(void)
{
    memcpy(given, START, sizeof given);
    return reset();
}

EXPORT int engine_instantiate(void)
{
    instance = instantiate();
    return instance ? engine_reset() : WARNING + 1;
}

/* The last log message, which is then cleared. */
EXPORT const char *engine_message(void)
{
    return said;
}

EXPORT void engine_forget(void)
{
    said[0] = '\0';
}

EXPORT void *engine_allocate(size_t size)
{
    return malloc(size);
}

/* Set Real variables, all or, where one is refused, none. */
EXPORT int engine_set_reals(const int place[], size_t count, const double value[])
{
    static Reference vr[N_VARIABLES];
    static double draft[N_VARIABLES], values[N_VARIABLES];
    size_t vectors = 0, n_values = 0;
    memcpy(draft, given, sizeof draft);
    for (size_t i = 0; i < count; i++)
        draft[place[i]] = value[i];
    for (size_t i = 0; i < count; i++) {
        const Reference own = reference_of(place[i]);
        size_t k = 0;
        while (k < vectors && vr[k] != own)
            k++;
        if (k < vectors)
            continue;
        vr[vectors++] = own;
        for (int element = PLACE[own]; element < PLACE[own + 1]; element++)
            values[n_values++] = draft[element];
    }
    const int status = set_reals(vr, vectors, values, n_values);
    if (status <= WARNING)
        memcpy(given, draft, sizeof given);
    return status;
}

EXPORT int engine_set_boolean(int place, int value)
{
    return set_boolean(reference_of(place), value);
}

EXPORT int engine_get_reals(const int place[], size_t count, double value[])
{
    static double vector[N_VARIABLES];
    Reference latest = 0;
    for (size_t i = 0; i < count; i++) {
        const Reference own = reference_of(place[i]);
        if (own != latest) {
            const int status = get_vector(own, vector);
            if (status > WARNING)
                return status;
            latest = own;
        }
        value[i] = vector[place[i] - PLACE[own]];
    }
    return 0;
}

/* Go through initialisation, at time 0 and without an end. */
EXPORT int engine_initialise(void)
{
    const int status = enter_initialization();
    return status > WARNING ? status : exit_initialization();
}
