/* The FMU for a page: an instance that keeps what it logs, and memory for what it is handed. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

#include "fmi2Functions.h"
#include "model.h"

#define EXPORT __attribute__((visibility("default")))

static char said[1024];

static void note(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                 fmi2String category, fmi2String format, ...)
{
    va_list arguments;
    (void)environment, (void)name, (void)status, (void)category;
    va_start(arguments, format);
    vsnprintf(said, sizeof said, format, arguments);
    va_end(arguments);
}

EXPORT fmi2Component engine_instantiate(void)
{
    static const fmi2CallbackFunctions FUNCTIONS = {note, calloc, free, NULL, NULL};
    return fmi2Instantiate("page", fmi2CoSimulation, MODEL_GUID, "", &FUNCTIONS, 0, 0);
}

/* What it has logged last, and from then on nothing until it logs again. */
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
