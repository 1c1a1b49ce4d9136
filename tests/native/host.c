/* A minimal importer of an FMU's library, for Linux and Windows.

   host LIBRARY GUID FIRST COUNT UNKNOWN KNOWN [REFERENCE VALUE]...
   sets the values, runs 500 steps of 10 ms and prints, at the start and every 10 steps, the COUNT
   variables from value reference FIRST on, and the derivatives of UNKNOWN by KNOWN and by the next one. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include "fmi2FunctionTypes.h"

#ifdef _WIN32
#include <windows.h>
#define OPEN(path) LoadLibraryA(path)
#define FIND(library, name) GetProcAddress(library, name)
typedef HMODULE Library;
#else
#include <dlfcn.h>
#define OPEN(path) dlopen(path, RTLD_NOW | RTLD_LOCAL)
#define FIND(library, name) dlsym(library, name)
typedef void *Library;
#endif

enum { STEPS = 500, EVERY = 10, MOST = 100 };

static void print_message(fmi2ComponentEnvironment environment, fmi2String instance,
                          fmi2Status status, fmi2String category, fmi2String message, ...)
{
    va_list arguments;
    (void)environment;
    fprintf(stderr, "%s: status %d, %s: ", instance, (int)status, category);
    va_start(arguments, message);
    vfprintf(stderr, message, arguments);
    va_end(arguments);
    fputc('\n', stderr);
}

static void *find(Library library, const char *name)
{
    void *function = (void *)FIND(library, name);
    if (!function) {
        fprintf(stderr, "no function %s\n", name);
        exit(3);
    }
    return function;
}

static void check(fmi2Status status, const char *call)
{
    if (status != fmi2OK) {
        fprintf(stderr, "%s: status %d\n", call, (int)status);
        exit(4);
    }
}

#define CALL(function, ...) \
    check(((function##TYPE *)find(library, #function))(__VA_ARGS__), #function)

int main(int argc, char **argv)
{
    static const fmi2CallbackFunctions callbacks = {print_message, calloc, free, NULL, NULL};
    if (argc < 7)
        return 1;
    const fmi2ValueReference first = (fmi2ValueReference)atoi(argv[3]);
    const size_t count = (size_t)atoi(argv[4]);
    fmi2ValueReference reference[MOST];
    fmi2Real output[MOST];
    for (size_t i = 0; i < count && i < MOST; i++)
        reference[i] = first + (fmi2ValueReference)i;

    Library library = OPEN(argv[1]);
    if (!library) {
        fprintf(stderr, "cannot load %s\n", argv[1]);
        return 2;
    }
    fmi2Component c = ((fmi2InstantiateTYPE *)find(library, "fmi2Instantiate"))(
        "host", fmi2CoSimulation, argv[2], "", &callbacks, fmi2False, fmi2True);
    if (!c)
        return 3;
    const fmi2ValueReference unknown = (fmi2ValueReference)atoi(argv[5]);
    for (int i = 7; i + 1 < argc; i += 2) {
        const fmi2ValueReference vr = (fmi2ValueReference)atoi(argv[i]);
        const fmi2Real value = strtod(argv[i + 1], NULL);
        CALL(fmi2SetReal, c, &vr, 1, &value);
    }
    CALL(fmi2SetupExperiment, c, fmi2False, 0.0, 0.0, fmi2False, 0.0);
    CALL(fmi2EnterInitializationMode, c);
    CALL(fmi2ExitInitializationMode, c);
    for (int k = 0; k <= STEPS; k++) {
        if (k > 0)
            CALL(fmi2DoStep, c, (k - 1) * 0.01, 0.01, fmi2True);
        if (k % EVERY)
            continue;
        CALL(fmi2GetReal, c, reference, count, output);
        for (size_t i = 0; i < count; i++)
            printf("%.17g ", output[i]);
        for (int i = 0; i < 2; i++) {
            const fmi2ValueReference known = (fmi2ValueReference)(atoi(argv[6]) + i);
            const fmi2Real one = 1.0;
            fmi2Real slope;
            CALL(fmi2GetDirectionalDerivative, c, &unknown, 1, &known, 1, &one, &slope);
            printf("%.17g ", slope);
        }
        printf("\n");
    }
    CALL(fmi2Terminate, c);
    ((fmi2FreeInstanceTYPE *)find(library, "fmi2FreeInstance"))(c);
    return 0;
}
