/* The FMU for a page, of either version of FMI: an instance that stores its last log message, and whose scalars and
   elements of vectors are set and read one by one. */
#include "fmu.c"

#define EXPORT(name) __attribute__((export_name(#name))) name

static Instance *instance;
static char last_message[1024];

#if FMI == 3
static void note(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                 fmi3String message)
{
    (void)environment, (void)status, (void)category;
    snprintf(last_message, sizeof last_message, "%s", message);
}
#else
static void note(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                 fmi2String category, fmi2String format, ...)
{
    va_list arguments;
    (void)environment, (void)name, (void)status, (void)category;
    va_start(arguments, format);
    vsnprintf(last_message, sizeof last_message, format, arguments);
    va_end(arguments);
}
#endif

int EXPORT(engine_instantiate)(void)
{
    Instance draft = {.kind = CO_SIMULATION, .log = (void (*)(void))note, .name = "page"};
    instance = instantiate(draft, MODEL_GUID, 0);
    return instance ? OK : ERROR;
}

/* Reset to the state before initialisation. */
int EXPORT(engine_reset)(void)
{
    return STANDARD(Reset)(instance);
}

/* Go through initialisation, at time 0 and without an end. */
int EXPORT(engine_initialise)(void)
{
    const Status status = move_on(instance, ENTER_INITIALIZATION, INITIALIZATION);
    return status > WARNING ? status : STANDARD(ExitInitializationMode)(instance);
}

/* The last log message, which is then cleared. */
const char *EXPORT(engine_message)(void)
{
    return last_message;
}

void EXPORT(engine_forget)(void)
{
    last_message[0] = '\0';
}

void *EXPORT(engine_allocate)(size_t size)
{
    return malloc(size);
}

/* Set variables of any type: all, or none if a value is refused. */
int EXPORT(engine_set)(const int index[], size_t count, const double value[])
{
    if (!enter(instance, SET_REAL, 1))
        return ERROR;
    for (size_t i = 0; i < count; i++) {
        if (!accepts(instance, SET_REAL, index[i], value[i]))
            return ERROR;
        if (index[i] >= FIRST_INTEGER && index[i] < FIRST_BOOLEAN && value[i] != rint(value[i]))
            return report(instance, ERROR, "%s = %g must be a whole number", VARIABLE_NAME[index[i]], value[i]);
    }
    for (size_t i = 0; i < count; i++)
        set(instance, index[i], index[i] >= FIRST_BOOLEAN ? value[i] != 0.0 : value[i]);
    return OK;
}

int EXPORT(engine_get)(const int index[], size_t count, double value[])
{
    if (!enter(instance, GET_REAL, 1))
        return ERROR;
    for (size_t i = 0; i < count; i++) {
        const int computed = index[i] >= FIRST_OUTPUT && index[i] < FIRST_PARAMETER;
        const Status status = computed ? update(instance, index[i]) : OK;
        if (status > WARNING)
            return status;
        value[i] = instance->state.plant.value[index[i]];
    }
    return OK;
}

int EXPORT(engine_step)(double t, double h)
{
    return do_step(instance, t, h);
}
