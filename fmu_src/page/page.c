/* The FMU for a page, of either version of FMI: an instance that keeps what it logs, and whose
   variables are set and read one by one, whether they are scalars or elements of vectors. */
#include "fmu.c"

#include <stdint.h>

#define EXPORT(name) __attribute__((export_name(#name))) name

static Instance *instance;
static char said[1024];

#if FMI == 3
static void note(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                 fmi3String message)
{
    (void)environment, (void)status, (void)category;
    snprintf(said, sizeof said, "%s", message);
}
#else
static void note(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                 fmi2String category, fmi2String format, ...)
{
    va_list arguments;
    (void)environment, (void)name, (void)status, (void)category;
    va_start(arguments, format);
    vsnprintf(said, sizeof said, format, arguments);
    va_end(arguments);
}
#endif

int EXPORT(engine_instantiate)(void)
{
    Instance draft = {.kind = CO_SIMULATION, .log = (void (*)(void))note, .name = "page"};
    instance = instantiate(draft, MODEL_GUID, 0);
    return instance ? OK : ERROR;
}

/* Back to the beginning, before initialisation. */
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
    return said;
}

void EXPORT(engine_forget)(void)
{
    said[0] = '\0';
}

void *EXPORT(engine_allocate)(size_t size)
{
    return malloc(size);
}

/* Set numbers, all or, where one is refused, none; other elements of their vectors stay. */
int EXPORT(engine_set_reals)(const int place[], size_t count, const double value[])
{
    static double draft[N_VARIABLES], whole[N_VARIABLES];
    static Reference vr[N_REFERENCES];
    static State before;
    size_t vectors = 0, n_values = 0;
    Status status = OK;
    before = instance->state;
    memcpy(draft, before.plant.value, sizeof draft);
    for (size_t i = 0; i < count; i++)
        draft[place[i]] = value[i];
    for (Reference own = 1; own <= N_REFERENCES && status <= WARNING; own++) {
        const int first = PLACE[own];
        size_t i = 0;
        while (i < count && (place[i] < first || place[i] >= PLACE[own + 1]))
            i++;
        if (i == count)
            continue;
        if (first >= FIRST_INTEGER && fabs(draft[first]) <= INT32_MAX && draft[first] == rint(draft[first])) {
            const Integer integer = (Integer)draft[first];
            status = set_integers(instance, &own, 1, &integer, 1);
            continue;
        }
        vr[vectors++] = own;
        memcpy(&whole[n_values], &draft[first], size_of(own) * sizeof *whole);
        n_values += size_of(own);
    }
    if (status <= WARNING)
        status = set_reals(instance, vr, vectors, whole, n_values);
    if (status > WARNING)
        instance->state = before;
    return status;
}

/* Set a Boolean or an Integer. */
int EXPORT(engine_set_whole)(int place, int value)
{
    Reference vr = 1;
    while (PLACE[vr] != place)
        vr++;
    const Boolean truth = value != 0;
    const Integer number = value;
    return place >= FIRST_BOOLEAN ? set_booleans(instance, &vr, 1, &truth, 1)
                                  : set_integers(instance, &vr, 1, &number, 1);
}

int EXPORT(engine_get_reals)(const int place[], size_t count, double value[])
{
    if (!enter(instance, GET_REAL, 1))
        return ERROR;
    for (size_t i = 0; i < count; i++) {
        const int computed = place[i] >= FIRST_OUTPUT && place[i] < FIRST_PARAMETER;
        const Status status = computed ? update(instance, place[i]) : OK;
        if (status > WARNING)
            return status;
        value[i] = instance->state.plant.value[place[i]];
    }
    return OK;
}

int EXPORT(engine_step)(double t, double h)
{
    return do_step(instance, t, h);
}
