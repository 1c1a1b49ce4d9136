/* Random calls of FMI 3.0 alone, also with arrays of wrong sizes. */
enum { MANY = 4, MOST_VALUES = N_VARIABLES };

static void log_message(fmi3InstanceEnvironment environment, fmi3Status status,
                        fmi3String category, fmi3String message)
{
    (void)environment;
    CHECK(category && message && status <= fmi3Error && strlen(message) < 512);
    logged++;
}

static Instance *create(void)
{
    return pick(2) ? fmi3InstantiateModelExchange("fuzz", MODEL_GUID, "", 0, pick(2), NULL,
                                                  log_message)
                   : fmi3InstantiateCoSimulation("fuzz", MODEL_GUID, NULL, 0, pick(2), 0, pick(2),
                                                 NULL, 0, NULL, log_message, NULL);
}

static Reference of_place(int place)
{
    Reference vr = 1;
    while (INDEX[vr] != place)
        vr++;
    return vr;
}

/* References, mostly right, and how many values they stand for; 0 where one is wrong. */
static size_t references(Reference vr[MANY], size_t *count)
{
    size_t size = 0;
    int right = 1;
    *count = pick(MANY + 1);
    for (size_t i = 0; i < MANY; i++) {
        vr[i] = 1 + pick(N_REFERENCES);
        if (pick(40) == 0)
            vr[i] = pick(2) ? (N_REFERENCES + pick(3)) * pick(2) : pick(1u << 31) << 1;
        if (i < *count) {
            const int exists = vr[i] > 0 && vr[i] <= N_REFERENCES;
            right = right && exists;
            size += exists ? size_of(vr[i]) : 0;
        }
    }
    return right ? size : 0;
}

/* Exactly as much memory as is said, so that none beyond is touched unseen. */
static void *array(size_t size, size_t width)
{
    char *values = malloc(size * width + 1);
    for (size_t i = 0; i < size && width == sizeof(double); i++)
        ((double *)values)[i] = number();
    if (width == 1)
        memset(values, (int)pick(2), size);
    return values;
}

static fmi3Status variables(Instance *c)
{
    Reference vr[MANY];
    size_t count;
    const size_t right = references(vr, &count), size = pick(10) ? right : pick(MOST_VALUES);
    double *real = array(size, sizeof *real);
    bool *truth = array(size, 1);
    const Reference *place = pick(30) ? vr : NULL;
    fmi3Status status = fmi3Error;
    for (size_t i = 0, k = 0; i < count && right; k += size_of(vr[i++]))
        if (INDEX[vr[i]] == MAX_STEP && k < size && !(real[k] < 0.0) && real[k] < 1e-3)
            real[k] = 1e-3; /* the master's choice alone: how long a step takes */
    switch (pick(8)) {
    case 0: status = fmi3GetBoolean(c, place, count, truth, size); break;
    case 1: status = fmi3SetBoolean(c, place, count, truth, size); break;
    case 2: status = fmi3GetInt32(c, place, count, (fmi3Int32 *)real, size); break;
    case 3:
        status = fmi3SetClock(c, place, count, truth); /* which are not told how many there are */
        CHECK(status == fmi3Error || count == 0);
        status = fmi3Error;
        break;
    case 4:
    case 5: status = fmi3GetFloat64(c, place, count, pick(30) ? real : NULL, size); break;
    default: status = fmi3SetFloat64(c, place, count, pick(30) ? real : NULL, size);
    }
    CHECK(status == fmi3Error || size == right);
    free(real), free(truth);
    return status;
}

static fmi3Status derivatives(Instance *c)
{
    Reference unknown[MANY], known[MANY];
    size_t n_unknown, n_known;
    const size_t rows = references(unknown, &n_unknown), columns = references(known, &n_known);
    const size_t wrong = pick(10) == 0;
    const int adjoint = (int)pick(2);
    const size_t n_seed = (adjoint ? rows : columns) + wrong, n = adjoint ? columns : rows;
    double *change = array(n_seed, sizeof *change), *result = array(n, sizeof *result);
    if (pick(2)) /* what has a derivative */
        unknown[0] = of_place(X), known[0] = of_place(Q), n_unknown = n_known = 1;
    const fmi3Status status =
        (adjoint ? fmi3GetAdjointDerivative : fmi3GetDirectionalDerivative)(
            c, unknown, n_unknown, known, n_known, change, n_seed, result, n);
    for (size_t i = 0; i < n && status == fmi3OK; i++)
        CHECK(isfinite(result[i]));
    free(change), free(result);
    return status;
}

static fmi3Status step(Instance *c)
{
    const int phase = c->state.phase;
    const double t = pick(10) ? c->state.time : number();
    bool flags[3];
    double last;
    const fmi3Status status =
        fmi3DoStep(c, t, 0.01, false, flags, flags + 1, flags + 2, pick(30) ? &last : NULL);
    CHECK(status == fmi3Error || phase == STEP);
    if (status == fmi3OK)
        for (int i = Q; i < X; i++)
            CHECK(isfinite(c->state.plant.value[i]));
    return status;
}

static fmi3Status question(Instance *c)
{
    const fmi3String names[2] = {pick(2) ? "logAll" : "logStatusError", pick(3) ? "logAll" : "?"};
    const int exchange = c->kind == MODEL_EXCHANGE;
    size_t size;
    if (pick(2))
        return fmi3SetDebugLogging(c, pick(2), pick(3), pick(9) ? names : NULL);
    const fmi3Status status = fmi3GetNumberOfContinuousStates(c, &size);
    CHECK((status == fmi3OK) == exchange && (!exchange || size == N_STATES));
    return status;
}

static fmi3Status find_discrete_states(Instance *c, int right)
{
    bool flags[5];
    double next;
    return fmi3UpdateDiscreteStates(c, flags, flags + 1, flags + 2, flags + 3,
                                    right ? flags + 4 : NULL, &next);
}

static fmi3Status begin(Instance *c)
{
    const int phase = c->state.phase;
    const double start = pick(5) ? 0.0 : number(), end = pick(5) ? 9.0 : number();
    if (pick(8) == 0)
        return fmi3EnterConfigurationMode(c);
    const fmi3Status status = fmi3EnterInitializationMode(c, pick(2), number(), start, pick(2), end);
    CHECK(status == fmi3Error || (phase == INSTANTIATED && isfinite(start)));
    CHECK(c->state.phase == (status == fmi3OK ? INITIALIZATION : phase));
    return status;
}

static void refuse_to_instantiate(void)
{
    CHECK(!fmi3InstantiateModelExchange("x", "wrong", NULL, 0, 0, NULL, log_message));
    CHECK(!fmi3InstantiateModelExchange(NULL, MODEL_GUID, NULL, 0, 0, NULL, NULL));
    CHECK(!fmi3InstantiateScheduledExecution("x", MODEL_GUID, "", 0, 0, NULL, log_message, NULL,
                                             NULL, NULL));
    CHECK(fmi3Reset(NULL) == fmi3Error);
    fmi3FreeInstance(NULL);
}
