/* Random calls of FMI 2.0 alone. */
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
    const unsigned range = pick(10) ? N_REFERENCES : pick(2) ? N_REFERENCES + 2 : 0xffffffffu;
    for (size_t i = 0; i < MANY; i++) {
        vr[i] = pick(40) ? 1 + pick(range) : 0;
        real[i] = number();
        whole[i] = (int)pick(3) - 1;
        /* the master's choice alone: how long a step takes */
        if (vr[i] == MAX_STEP + 1 && real[i] > 0.0 && real[i] < 1e-3)
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

/* A derivative, or what there is none of. */
static fmi2Status derivatives(Instance *c)
{
    const fmi2ValueReference unknown = pick(N_REFERENCES + 2), known = pick(N_REFERENCES + 2);
    const int right = unknown > FIRST_OUTPUT && unknown <= FIRST_PARAMETER && known > 0 && known <= X;
    const double seed = number();
    double result;
    if (pick(4) == 0)
        return pick(2) ? fmi2SetRealInputDerivatives(c, NULL, 0, NULL, NULL)
                       : fmi2GetRealOutputDerivatives(c, NULL, 0, NULL, NULL);
    const int phase = c->state.phase;
    const fmi2Status status = fmi2GetDirectionalDerivative(c, &unknown, 1, &known, 1, &seed, &result);
    CHECK(status == fmi2Error || (right && isfinite(seed) && phase != INSTANTIATED));
    return status;
}

static fmi2Status find_discrete_states(Instance *c, int right)
{
    fmi2EventInfo info;
    return fmi2NewDiscreteStates(c, right ? &info : NULL);
}

static fmi2Status begin(Instance *c)
{
    const int phase = c->state.phase;
    const int tolerance = (int)pick(2), stop = pick(4) == 0;
    const double start = pick(5) ? 0.0 : number(), end = pick(5) ? 1.0 : number();
    fmi2Status status;
    if (pick(2)) {
        status = fmi2SetupExperiment(c, tolerance, number(), start, stop, end);
        CHECK(status == (phase == INSTANTIATED && isfinite(start) && (!stop || end >= start)
                             ? fmi2OK : fmi2Error));
        return status;
    }
    status = fmi2EnterInitializationMode(c);
    CHECK((status == fmi2OK) == (phase == INSTANTIATED));
    CHECK(c->state.phase == (status == fmi2OK ? INITIALIZATION : phase));
    return status;
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
