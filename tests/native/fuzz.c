/* Random legal and illegal FMI calls, with NaN, infinities, wrong value references and foreign
   states. It knows in which phase each instance is and checks that every call that is illegal there is
   refused and leaves the instance's state as it was. */
#include "fuzz.h"

enum { MANY = 6 };

static void log_message(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                        fmi2String category, fmi2String message, ...)
{
    (void)environment;
    CHECK(name && category && message && status <= fmi2Error && strlen(message) < 1000);
    logged++;
}

static const fmi2CallbackFunctions CALLBACKS = {log_message, calloc, free, NULL, NULL};

static Instance *create(void)
{
    const fmi2Type kind = pick(2) ? fmi2CoSimulation : fmi2ModelExchange;
    return fmi2Instantiate("fuzz", kind, MODEL_GUID, "", &CALLBACKS, 0, (int)pick(2));
}

static fmi2Status variables(Instance *c)
{
    fmi2ValueReference vr[MANY];
    double real[MANY];
    int whole[MANY];
    fmi2String text[MANY] = {"", "", "", "", "", ""};
    const size_t count = pick(MANY + 1);
    const unsigned range = pick(10) ? N_VARIABLES : pick(2) ? N_VARIABLES + 2 : 0xffffffffu;
    for (size_t i = 0; i < MANY; i++) {
        vr[i] = pick(range);
        real[i] = number();
        whole[i] = (int)pick(3) - 1;
        /* the master's choice alone: how long a step takes */
        if (vr[i] == MAX_STEP && real[i] > 0.0 && real[i] < 1e-3)
            real[i] = 1e-3;
    }
    const fmi2ValueReference *place = pick(30) ? vr : NULL;
    switch (pick(9)) {
    case 0: return fmi2GetBoolean(c, place, count, whole);
    case 1: return fmi2SetBoolean(c, place, count, whole);
    case 2: return pick(2) ? fmi2GetInteger(c, place, count, whole)
                           : fmi2SetInteger(c, place, count, whole);
    case 3: return pick(2) ? fmi2GetString(c, place, count, text)
                           : fmi2SetString(c, place, count, text);
    case 4:
    case 5: return fmi2GetReal(c, place, count, pick(30) ? real : NULL);
    default: return fmi2SetReal(c, place, count, pick(30) ? real : NULL);
    }
}

/* Another value in a field of a serialised state, with the checksum right (FNV-1a, RFC 9923). */
static void forge(fmi2Byte *bytes)
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

static fmi2Status saved_states(Instance *c, fmi2FMUstate *saved)
{
    fmi2Byte bytes[sizeof(State) + 64];
    size_t size = 0;
    fmi2FMUstate other = NULL;
    fmi2Status status = fmi2OK;
    switch (pick(4)) {
    case 0: return fmi2GetFMUstate(c, pick(20) ? saved : NULL);
    case 1: return fmi2SetFMUstate(c, *saved);
    case 2: return fmi2FreeFMUstate(c, pick(20) ? saved : NULL);
    default:
        if (!*saved)
            return fmi2SerializedFMUstateSize(c, NULL, &size);
        CHECK(fmi2SerializedFMUstateSize(c, *saved, &size) == fmi2OK && size <= sizeof bytes);
        CHECK(fmi2SerializeFMUstate(c, *saved, bytes, size - 1) == fmi2Error);
        CHECK(fmi2SerializeFMUstate(c, *saved, bytes, size) == fmi2OK);
        if (pick(2)) {
            forge(bytes);
            status = fmi2DeSerializeFMUstate(c, bytes, size, &other);
            CHECK((status == fmi2OK) == (other != NULL));
            if (other)
                CHECK(fmi2SetFMUstate(c, other) == fmi2OK && c->state.phase < N_PHASES);
            fmi2FreeFMUstate(c, &other);
            return status;
        }
        if (pick(2)) {
            bytes[pick((unsigned)size)] ^= (fmi2Byte)(1 << pick(7));
            CHECK(fmi2DeSerializeFMUstate(c, bytes, size, &other) == fmi2Error && !other);
            return fmi2Error;
        }
        CHECK(fmi2DeSerializeFMUstate(c, bytes, size - pick(2), pick(2) ? &other : saved)
              <= fmi2Error);
        if (other)
            status = fmi2SetFMUstate(c, other);
        fmi2FreeFMUstate(c, &other);
        return status;
    }
}

static fmi2Status step(Instance *c)
{
    const double h = pick(10) ? 1e-3 * (1 + pick(20)) : number();
    const double t = pick(10) ? c->state.time : number();
    const int is_time = fabs(t - c->state.time) <= 1e-9 * fmax(1.0, fabs(t));
    const int legal = c->state.phase == STEP && is_time && h > 0.0 && isfinite(h);
    if (legal && h > 0.02)
        return fmi2OK; /* the master's choice alone: how long a step takes */
    const fmi2Status status = fmi2DoStep(c, t, h, (int)pick(2));
    CHECK(legal || status == fmi2Error);
    if (status == fmi2OK)
        for (int i = Q; i < X; i++)
            CHECK(isfinite(c->state.plant.value[i]));
    return status;
}

static fmi2Status question(Instance *c)
{
    const fmi2StatusKind kind = (fmi2StatusKind)pick(4);
    const fmi2String names[2] = {pick(2) ? "logAll" : "logStatusError", pick(3) ? "logAll" : "?"};
    double real;
    int whole;
    fmi2Status status;
    fmi2String text;
    switch (pick(7)) {
    case 0: return fmi2GetStatus(c, kind, pick(9) ? &status : NULL);
    case 1: return fmi2GetRealStatus(c, kind, pick(9) ? &real : NULL);
    case 2: return fmi2GetIntegerStatus(c, kind, &whole);
    case 3: return fmi2GetBooleanStatus(c, kind, pick(9) ? &whole : NULL);
    case 4: return fmi2GetStringStatus(c, kind, &text);
    case 5: return fmi2CancelStep(c);
    default: return fmi2SetDebugLogging(c, (int)pick(2), pick(3), pick(9) ? names : NULL);
    }
}

/* The calls of Model Exchange: with what is right they are done where the standard allows them. */
static fmi2Status exchange(Instance *c)
{
    enum { N_STATES = 2 * N_JOINTS, ROOM = N_STATES + N_INDICATORS };
    const int phase = c->state.phase, of_kind = c->kind == MODEL_EXCHANGE;
    const int event = of_kind && phase == EVENT, runs = of_kind && phase == CONTINUOUS_TIME;
    const int reads = event || runs || (of_kind && (phase == INITIALIZATION || phase == TERMINATED));
    double x[ROOM];
    int flags[2], finite = 1;
    fmi2EventInfo info;
    fmi2Status status;
    for (int i = 0; i < ROOM; i++) {
        x[i] = pick(60) ? (pick(2001) - 1000.0) * 4e-3 : number();
        finite = finite && (i >= N_STATES || isfinite(x[i]));
    }
    if (pick(8) == 0) {
        const fmi2ValueReference unknown = pick(N_VARIABLES + 1), known = pick(N_VARIABLES + 1);
        const int right = unknown >= FIRST_OUTPUT && unknown < FIRST_PARAMETER && known < X;
        status = fmi2GetDirectionalDerivative(c, &unknown, 1, &known, 1, x, x + 1);
        CHECK(status == fmi2Error || (right && isfinite(x[0]) && phase != INSTANTIATED));
        return status;
    }
    double *given = pick(30) ? x : NULL;
    const size_t wrong = pick(30) == 0;
    const int right = given && !wrong;
    switch (pick(13)) {
    case 0: return fmi2SetRealInputDerivatives(c, NULL, 0, NULL, NULL);
    case 1: return fmi2GetRealOutputDerivatives(c, NULL, 0, NULL, NULL);
    case 2:
        status = fmi2EnterEventMode(c);
        CHECK((status == fmi2OK) == runs && c->state.phase == (runs ? EVENT : phase));
        return status;
    case 3:
    case 4:
        status = fmi2NewDiscreteStates(c, given ? &info : NULL);
        CHECK((status == fmi2OK) == (event && given));
        for (int i = 0; i < N_JOINTS && status == fmi2OK; i++)
            CHECK(c->state.plant.value[Q + i] >= c->state.plant.value[Q_MIN + i]
                  && c->state.plant.value[Q + i] <= c->state.plant.value[Q_MAX + i]);
        return status;
    case 5:
        status = fmi2EnterContinuousTimeMode(c);
        CHECK((status == fmi2OK) == event && c->state.phase == (event ? CONTINUOUS_TIME : phase));
        return status;
    case 6:
        status = fmi2CompletedIntegratorStep(c, 0, flags, given ? flags + 1 : NULL);
        CHECK((status == fmi2OK) == (runs && given));
        return status;
    case 7:
        status = fmi2SetTime(c, x[0]);
        CHECK((status == fmi2OK) == ((runs || event) && isfinite(x[0])));
        return status;
    case 8:
        status = fmi2SetContinuousStates(c, given, N_STATES + wrong);
        CHECK((status == fmi2OK) == (runs && right && finite));
        return status;
    case 9:
        status = fmi2GetDerivatives(c, given, N_STATES + wrong);
        CHECK(status == fmi2Error || (reads && right));
        return status;
    case 10:
        status = fmi2GetEventIndicators(c, given, N_INDICATORS + wrong);
        CHECK(status == fmi2Error || (reads && right));
        return status;
    case 11:
        status = fmi2GetContinuousStates(c, given, N_STATES + wrong);
        CHECK(status == fmi2Error || (reads && right));
        return status;
    default: return fmi2GetNominalsOfContinuousStates(c, given, N_STATES + wrong);
    }
}

/* A call that only the phase makes legal, and the phase after it. */
static fmi2Status move(Instance *c)
{
    const int phase = c->state.phase;
    const int tolerance = (int)pick(2), stop = pick(4) == 0;
    const double start = pick(5) ? 0.0 : number(), end = pick(5) ? 1.0 : number();
    fmi2Status status = fmi2Error;
    switch (pick(6)) {
    case 0:
        status = fmi2SetupExperiment(c, tolerance, number(), start, stop, end);
        CHECK(status == (phase == INSTANTIATED && isfinite(start) && (!stop || end >= start)
                             ? fmi2OK : fmi2Error));
        return status;
    case 1:
        status = fmi2EnterInitializationMode(c);
        CHECK((status == fmi2OK) == (phase == INSTANTIATED));
        CHECK(c->state.phase == (status == fmi2OK ? INITIALIZATION : phase));
        return status;
    case 2:
    case 3:
        status = fmi2ExitInitializationMode(c);
        CHECK(status == fmi2Error || phase == INITIALIZATION);
        CHECK(c->state.phase == (status != fmi2OK ? phase
                                 : c->kind == MODEL_EXCHANGE ? EVENT : STEP));
        return status;
    case 4:
        if (pick(4))
            return fmi2OK;
        status = fmi2Terminate(c);
        CHECK((status == fmi2OK) == (phase != TERMINATED && phase >= STEP));
        return status;
    default:
        if (pick(4))
            return fmi2OK;
        return fmi2Reset(c);
    }
}

static void sequence(void)
{
    fmi2FMUstate saved = NULL;
    Instance *c = create();
    CHECK(c);
    for (unsigned i = 0, length = 1 + pick(LONGEST); i < length; i++) {
        const State before = c->state;
        fmi2Status status;
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
        CHECK(status == fmi2OK || status == fmi2Discard || status == fmi2Error);
        if (status == fmi2Error) {
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
    fmi2FreeFMUstate(c, &saved);
    fmi2FreeInstance(c);
}

static void refuse_to_instantiate(void)
{
    CHECK(!fmi2Instantiate("x", fmi2CoSimulation, "wrong", "", &CALLBACKS, 0, 0));
    CHECK(!fmi2Instantiate("x", fmi2CoSimulation, NULL, NULL, &CALLBACKS, 0, 0));
    CHECK(!fmi2Instantiate("x", (fmi2Type)2, MODEL_GUID, "", &CALLBACKS, 0, 0));
    CHECK(!fmi2Instantiate("", fmi2CoSimulation, MODEL_GUID, "", &CALLBACKS, 0, 0));
    CHECK(!fmi2Instantiate("x", fmi2CoSimulation, MODEL_GUID, "", NULL, 0, 0));
    CHECK(fmi2DoStep(NULL, 0.0, 0.01, 0) == fmi2Error);
    fmi2FreeInstance(NULL);
}
