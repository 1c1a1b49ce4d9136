/* Random legal and illegal FMI calls of either version, with NaN, infinities, wrong value references and
   foreign states. It knows in which phase each instance is and checks that every call that is illegal
   there is refused and leaves the instance's state as it was. Compiled with AddressSanitizer and
   UndefinedBehaviorSanitizer or ThreadSanitizer, which end the program at the first fault.

       fuzz SEQUENCES SEED [THREADS]    as many sequences in each thread, at the same time */
#include <math.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmu.c"

#define CHECK(condition)                                                                     \
    do {                                                                                     \
        if (!(condition)) {                                                                  \
            fprintf(stderr, "line %d: not %s\n", __LINE__, #condition);                      \
            exit(1);                                                                         \
        }                                                                                    \
    } while (0)

enum { LONGEST = 40 };
static __thread uint64_t seed;
static __thread long logged, refused, done;

static unsigned pick(unsigned below) /* xorshift64* */
{
    seed ^= seed >> 12, seed ^= seed << 25, seed ^= seed >> 27;
    return (unsigned)((seed * UINT64_C(2685821657736338717)) >> 33) % below;
}

static double number(void)
{
    static const double odd[] = {0.0, -0.0, 1e-320, -1.0, 1e6, -1e6, 1e300, -1e300, 1.7e308};
    switch (pick(8)) {
    case 0: return pick(2) ? NAN : pick(2) ? INFINITY : -INFINITY;
    case 1: return odd[pick(9)];
    default: return (pick(2001) - 1000.0) * 1e-3;
    }
}

#if FMI == 3
#include "fuzz3.h"
#else
#include "fuzz2.h"
#endif

/* Another value in a field of a serialised state, with the checksum right (FNV-1a, RFC 9923). */
static void forge(STANDARD(Byte) *bytes)
{
    State state;
    uint64_t sum = UINT64_C(0xcbf29ce484222325);
    const unsigned vr = pick(N_VARIABLES);
    memcpy(&state, bytes, sizeof state);
    switch (pick(7)) {
    case 6: state.stops.held[pick(N_JOINTS)] = (int)pick(4) - 1, state.has_stops = (int)pick(3); break;
    case 0: state.phase = pick(2) ? (int)pick(N_PHASES + 4) - 2 : (int)(pick(1u << 31) << 1); break;
    case 1: state.time = number(); break;
    case 2: state.stop_time = number(); break;
    case 3: state.initialised = (int)pick(3), state.has_x = (int)pick(3); break;
    default: state.plant.value[vr] = number();
    }
    if (state.plant.value[MAX_STEP] > 0.0 && state.plant.value[MAX_STEP] < 1e-3)
        state.plant.value[MAX_STEP] = 1e-3; /* as in variables() */
    memcpy(bytes, &state, sizeof state);
    for (size_t i = 0; i < sizeof state; i++)
        sum = (sum ^ (unsigned char)bytes[i]) * UINT64_C(0x100000001b3);
    memcpy(bytes + sizeof state, &sum, sizeof sum);
}

static Status saved_states(Instance *c, void **saved)
{
    STANDARD(Byte) bytes[sizeof(State) + 64];
    size_t size = 0;
    void *other = NULL;
    Status status = OK;
    switch (pick(4)) {
    case 0: return STANDARD(GetFMUstate)(c, pick(20) ? saved : NULL);
    case 1: return STANDARD(SetFMUstate)(c, *saved);
    case 2: return STANDARD(FreeFMUstate)(c, pick(20) ? saved : NULL);
    default:
        if (!*saved)
            return STANDARD(SerializedFMUstateSize)(c, NULL, &size);
        CHECK(STANDARD(SerializedFMUstateSize)(c, *saved, &size) == OK && size <= sizeof bytes);
        CHECK(STANDARD(SerializeFMUstate)(c, *saved, bytes, size - 1) == ERROR);
        CHECK(STANDARD(SerializeFMUstate)(c, *saved, bytes, size) == OK);
        if (pick(2)) {
            forge(bytes);
            status = STANDARD(DeSerializeFMUstate)(c, bytes, size, &other);
            CHECK((status == OK) == (other != NULL));
            if (other)
                CHECK(STANDARD(SetFMUstate)(c, other) == OK && c->state.phase < N_PHASES);
            STANDARD(FreeFMUstate)(c, &other);
            return status;
        }
        if (pick(2)) {
            bytes[pick((unsigned)size)] ^= (STANDARD(Byte))(1 << pick(7));
            CHECK(STANDARD(DeSerializeFMUstate)(c, bytes, size, &other) == ERROR && !other);
            return ERROR;
        }
        CHECK(STANDARD(DeSerializeFMUstate)(c, bytes, size - pick(2), pick(2) ? &other : saved)
              <= ERROR);
        if (other)
            status = STANDARD(SetFMUstate)(c, other);
        STANDARD(FreeFMUstate)(c, &other);
        return status;
    }
}

/* The calls of Model Exchange: with what is right they are done where the standard allows them. */
static Status exchange(Instance *c)
{
    enum { ROOM = N_STATES + N_INDICATORS };
    const int phase = c->state.phase, of_kind = c->kind == MODEL_EXCHANGE;
    const int event = of_kind && phase == EVENT, runs = of_kind && phase == CONTINUOUS_TIME;
    const int reads = event || runs || (of_kind && (phase == INITIALIZATION || phase == TERMINATED));
    double x[ROOM];
    Boolean flags[2];
    int finite = 1;
    Status status;
    for (int i = 0; i < ROOM; i++) {
        x[i] = pick(60) ? (pick(2001) - 1000.0) * 4e-3 : number();
        finite = finite && (i >= N_STATES || isfinite(x[i]));
    }
    double *given = pick(30) ? x : NULL;
    const size_t wrong = pick(30) == 0;
    const int right = given && !wrong;
    switch (pick(13)) {
    case 0:
    case 1: return derivatives(c);
    case 2:
        status = STANDARD(EnterEventMode)(c);
        CHECK((status == OK) == (runs || (FMI == 2 && event)) && c->state.phase == (runs ? EVENT : phase));
        return status;
    case 3:
    case 4:
        status = find_discrete_states(c, given != NULL);
        CHECK((status == OK) == (event && given));
        for (int i = 0; i < N_JOINTS && status == OK; i++)
            CHECK(c->state.plant.value[Q + i] >= c->state.plant.value[Q_MIN + i]
                  && c->state.plant.value[Q + i] <= c->state.plant.value[Q_MAX + i]);
        return status;
    case 5:
        status = STANDARD(EnterContinuousTimeMode)(c);
        CHECK((status == OK) == event && c->state.phase == (event ? CONTINUOUS_TIME : phase));
        return status;
    case 6:
        status = STANDARD(CompletedIntegratorStep)(c, 0, flags, given ? flags + 1 : NULL);
        CHECK((status == OK) == (runs && given));
        return status;
    case 7:
        status = STANDARD(SetTime)(c, x[0]);
        CHECK((status == OK) == ((runs || event) && isfinite(x[0])));
        return status;
    case 8:
        status = STANDARD(SetContinuousStates)(c, given, N_STATES + wrong);
        CHECK((status == OK) == (runs && right && finite));
        return status;
    case 9:
        status = STANDARD(GetDerivatives)(c, given, N_STATES + wrong);
        CHECK(status == ERROR || (reads && right));
        return status;
    case 10:
        status = STANDARD(GetEventIndicators)(c, given, N_INDICATORS + wrong);
        CHECK(status == ERROR || (reads && right));
        return status;
    case 11:
        status = STANDARD(GetContinuousStates)(c, given, N_STATES + wrong);
        CHECK(status == ERROR || (reads && right));
        return status;
    default: return STANDARD(GetNominalsOfContinuousStates)(c, given, N_STATES + wrong);
    }
}

/* A call that only the phase makes legal, and the phase after it. */
static Status move(Instance *c)
{
    const int phase = c->state.phase;
    Status status;
    switch (pick(6)) {
    case 0:
    case 1: return begin(c);
    case 2:
    case 3:
        status = STANDARD(ExitInitializationMode)(c);
        CHECK(status == ERROR || phase == INITIALIZATION);
        CHECK(c->state.phase == (status != OK ? phase
                                 : c->kind == MODEL_EXCHANGE ? EVENT : STEP));
        return status;
    case 4:
        if (pick(4))
            return OK;
        status = STANDARD(Terminate)(c);
        CHECK((status == OK) == (phase != TERMINATED && phase >= STEP));
        return status;
    default:
        if (pick(4))
            return OK;
        return STANDARD(Reset)(c);
    }
}

static void sequence(void)
{
    void *saved = NULL;
    Instance *c = create();
    CHECK(c);
    for (unsigned i = 0, length = 1 + pick(LONGEST); i < length; i++) {
        const State before = c->state;
        Status status;
        switch (c->kind == MODEL_EXCHANGE && pick(2) ? 2 : pick(10)) {
        case 0: status = question(c); break;
        case 1: status = saved_states(c, &saved); break;
        case 2: status = exchange(c); break;
        case 3:
        case 4: status = variables(c); break;
        case 5:
        case 6: status = step(c); break;
        default: status = move(c); break;
        }
        CHECK(status == OK || status == DISCARD || status == ERROR);
        if (status == ERROR) {
            refused++;
            CHECK(c->state.phase == before.phase && c->state.time == before.time);
            for (int k = 0; k < N_VARIABLES; k++)
                if (before.initialised || k < FIRST_OUTPUT || k >= FIRST_PARAMETER)
                    CHECK(c->state.plant.value[k] == before.plant.value[k]
                          || (k >= X && k < FIRST_PARAMETER));
        } else {
            done++;
        }
    }
    STANDARD(FreeFMUstate)(c, &saved);
    STANDARD(FreeInstance)(c);
}

typedef struct {
    long sequences;
    uint64_t seed;
} Share;

static void *run(void *given)
{
    const Share *share = given;
    seed = share->seed;
    for (long i = 0; i < share->sequences; i++)
        sequence();
    printf("%ld sequences, %ld calls done, %ld refused, %ld messages\n", share->sequences, done,
           refused, logged);
    return NULL;
}

int main(int count, char *argument[])
{
    enum { MOST = 16 };
    const long sequences = count > 1 ? atol(argument[1]) : 1000;
    const uint64_t first = count > 2 ? strtoull(argument[2], NULL, 10) : 0;
    const int threads = count > 3 ? atoi(argument[3]) : 1;
    pthread_t thread[MOST];
    Share share[MOST];
    CHECK(threads > 0 && threads <= MOST);
    refuse_to_instantiate();
    for (int i = 0; i < threads; i++) {
        share[i] = (Share){sequences, (first + (uint64_t)i) * UINT64_C(0x9e3779b97f4a7c15) + 1};
        CHECK(!pthread_create(&thread[i], NULL, run, &share[i]));
    }
    for (int i = 0; i < threads; i++)
        CHECK(!pthread_join(thread[i], NULL));
    return 0;
}
