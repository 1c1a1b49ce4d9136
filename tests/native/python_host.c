/* The life of an instance of a Python FMU in a program that is not Python; libpython is preloaded.

   python_host LIBRARY GUID RESOURCES
   makes an instance, takes one step of 10 ms, frees the instance and ends as programs do. */
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>

#include "fmi2FunctionTypes.h"

static void print_message(fmi2ComponentEnvironment environment, fmi2String instance,
                          fmi2Status status, fmi2String category, fmi2String message, ...)
{
    (void)environment, (void)status;
    fprintf(stderr, "%s: %s: %s\n", instance, category, message);
}

static void *find(void *library, const char *name)
{
    void *function = dlsym(library, name);
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
    void *library = argc == 4 ? dlopen(argv[1], RTLD_NOW | RTLD_LOCAL) : NULL;
    if (!library) {
        fprintf(stderr, "cannot load the library: %s\n", argc == 4 ? dlerror() : "no arguments");
        return 2;
    }
    fmi2Component c = ((fmi2InstantiateTYPE *)find(library, "fmi2Instantiate"))(
        "host", fmi2CoSimulation, argv[2], argv[3], &callbacks, fmi2False, fmi2False);
    if (!c)
        return 3;
    CALL(fmi2SetupExperiment, c, fmi2False, 0.0, 0.0, fmi2False, 0.0);
    CALL(fmi2EnterInitializationMode, c);
    CALL(fmi2ExitInitializationMode, c);
    CALL(fmi2DoStep, c, 0.0, 0.01, fmi2True);
    CALL(fmi2Terminate, c);
    ((fmi2FreeInstanceTYPE *)find(library, "fmi2FreeInstance"))(c);
    return 0;
}
