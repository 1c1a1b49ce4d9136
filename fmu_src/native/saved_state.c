/* Saving, restoring and serialising the state, which is one plain struct. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "instance.h"

static const char FOREIGN[] = "the state is not one of this FMU";
static const char UNSOUND[] = "invalid FMU state";
static const char OTHER_KIND[] = "the state is one of the FMU's other kind of instance";

/* True if a state, or its bytes, begin with this FMU's GUID. */
static int is_own(const void *state)
{
    return memcmp(state, MODEL_GUID, sizeof MODEL_GUID) == 0;
}

/* Checksum after a serialised state, with which changed bytes are refused: FNV-1a, 64 bits. Source: Fowler, Noll & Vo,
   RFC 9923. */
static uint64_t checksum(const void *bytes)
{
    const unsigned char *byte = bytes;
    uint64_t sum = UINT64_C(0xcbf29ce484222325);
    for (size_t i = 0; i < sizeof(State); i++)
        sum = (sum ^ byte[i]) * UINT64_C(0x100000001b3);
    return sum;
}

enum { SERIALIZED_SIZE = sizeof(State) + sizeof(uint64_t) };

/* True if integers have no fraction and Booleans are 0 or 1; RANGE has the ranges of integers. */
static int are_whole(const double value[])
{
    for (int i = FIRST_INTEGER; i < N_VARIABLES; i++)
        if (!(value[i] == floor(value[i])) || (i >= FIRST_BOOLEAN && value[i] != 0.0 && value[i] != 1.0))
            return 0;
    return 1;
}

/* Check that the values of held, watched and slip are valid; recompute any_*. */
static int are_stops(Stops *stops)
{
    int sound = stops->rank >= 0 && stops->rank <= N_ROWS && stops->acting >= 0.0 && isfinite(stops->acting);
    stops->any_held = stops->any_watched = stops->any_slip = 0;
    for (int i = 0; i < N_JOINTS; i++) {
        const int held = stops->held[i], watched = stops->watched[i], slip = stops->slip[i];
        sound = sound && held >= FREE && held <= CLAMPED && (watched == 0 || (watched == 1 && held));
        sound = sound && slip >= -1 && slip <= 1 && (held == FREE || held == CLAMPED || slip == 0);
        stops->any_held |= held != FREE;
        stops->any_watched |= watched;
        stops->any_slip |= slip != 0;
    }
    return sound;
}

/* True if an importer's step is valid. */
static int is_passage(const Passage *passage)
{
    int sound = isfinite(passage->time) && isfinite(passage->stop_time) && passage->joint >= 0
                && passage->joint <= N_JOINTS && (passage->begun == 0 || passage->begun == 1);
    for (int i = 0; i < N_STATES; i++)
        sound = sound && isfinite(passage->y[i]) && isfinite(passage->reached[i])
                && (!passage->begun || isfinite(passage->a[i % N_JOINTS]));
    return sound;
}

/* Restore a state from untrusted bytes, whose checksum may be forged: check each field and recompute dependent values.
   A refusal is logged. */
static Status take_over(Instance *instance, const void *bytes)
{
    State *state = &instance->state;
    const double *value = state->plant.value;
    memcpy(state, bytes, sizeof *state);
    int sound = can_have(instance, state) && isfinite(state->time)
                && state->stop_time > -HUGE_VAL && are_whole(value)
                && are_stops(&state->stops) && is_passage(&state->passage);
    const int runs = state->phase >= STEP; /* before the run, initialisation reports errors */
    sound = sound && (!runs || is_sampling(&state->sampling, &state->plant, state->time));
    /* a solver may try any state in Model Exchange */
    const int steps = runs && instance->kind == CO_SIMULATION && !IS_CONTROLLER;
    for (int i = 0; i < N_VARIABLES; i++)
        sound = sound && (isfinite(value[i]) || (i >= X && i < FIRST_PARAMETER));
    for (int i = 0; i < N_JOINTS && steps; i++)
        sound = sound && value[Q + i] >= value[Q_MIN + i] && value[Q + i] <= value[Q_MAX + i];
    state->initialised = runs;
    state->has_x = state->has_tau = state->has_rates = 0;
    state->has_stops = runs && !steps && state->has_stops != 0;
    if (!sound)
        return refuse(instance, DESERIALIZE, UNSOUND);
    for (int i = 0; i < N_VARIABLES; i++)
        if (check_range(instance, i, value[i]) != OK)
            return ERROR;
    return runs ? check_parameters(instance) : OK;
}

/* Save the state, into the memory of an earlier saved state or into new memory. */
static Status save(Instance *instance, Call call, const State *state, void **saved)
{
    if (!*saved)
        *saved = calloc(1, sizeof(State));
    if (!*saved)
        return refuse(instance, call, "no memory");
    memcpy(*saved, state, sizeof(State));
    return OK;
}

Status STANDARD(GetFMUstate)(void *component, void **saved)
{
    Instance *instance = enter(component, GET_STATE, saved != NULL);
    return instance ? save(instance, GET_STATE, &instance->state, saved) : ERROR;
}

Status STANDARD(SetFMUstate)(void *component, void *saved)
{
    Instance *instance = enter(component, SET_STATE, saved != NULL);
    if (!instance)
        return ERROR;
    if (!is_own(saved))
        return refuse(instance, SET_STATE, FOREIGN);
    if (!can_have(instance, saved))
        return refuse(instance, SET_STATE, OTHER_KIND);
    memcpy(&instance->state, saved, sizeof(State));
    instance->state.has_rates &= RATES; /* the Jacobian is not saved */
    return OK;
}

Status STANDARD(FreeFMUstate)(void *component, void **saved)
{
    if (!enter(component, FREE_STATE, 1))
        return ERROR;
    if (saved) {
        free(*saved);
        *saved = NULL;
    }
    return OK;
}

Status STANDARD(SerializedFMUstateSize)(void *component, void *saved, size_t *size)
{
    if (!enter(component, SIZE_OF_STATE, saved && size))
        return ERROR;
    *size = SERIALIZED_SIZE;
    return OK;
}

Status STANDARD(SerializeFMUstate)(void *component, void *saved, STANDARD(Byte) bytes[], size_t size)
{
    Instance *instance = enter(component, SERIALIZE, saved && bytes);
    if (!instance)
        return ERROR;
    if (size < SERIALIZED_SIZE)
        return refuse(instance, SERIALIZE, "the buffer is too small");
    const uint64_t sum = checksum(saved);
    memcpy(bytes, saved, sizeof(State));
    memcpy(bytes + sizeof(State), &sum, sizeof sum);
    return OK;
}

Status STANDARD(DeSerializeFMUstate)(void *component, const STANDARD(Byte) bytes[], size_t size, void **saved)
{
    Instance *instance = enter(component, DESERIALIZE, bytes && saved);
    uint64_t sum;
    if (!instance)
        return ERROR;
    if (size != SERIALIZED_SIZE)
        return refuse(instance, DESERIALIZE, FOREIGN);
    memcpy(&sum, bytes + sizeof(State), sizeof sum);
    if (sum != checksum(bytes) || !is_own(bytes))
        return refuse(instance, DESERIALIZE, FOREIGN);
    Instance draft = *instance;
    if (take_over(&draft, bytes) != OK)
        return ERROR;
    return save(instance, DESERIALIZE, &draft.state, saved);
}
