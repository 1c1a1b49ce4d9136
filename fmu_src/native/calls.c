/* The calls of the standard: names, phases in which each is allowed, and refusals. */
#include "instance.h"

static const char *const PHASE_NAME[N_PHASES] = {
    "instantiated", "initialization mode", "step mode", "step failed", "event mode",
    "continuous-time mode", "terminated"};

static const char *const KIND_NAME[] = {"", "Model Exchange", "co-simulation", IS_CLOCKED ? "event mode" : "Model Exchange"};

#define PHASE(phase) (1 << (phase))

/* Sets of phases. */
enum {
    RUNS = PHASE(STEP) | PHASE(STEP_FAILED) | PHASE(EVENT) | PHASE(CONTINUOUS_TIME),
    READS = PHASE(INITIALIZATION) | RUNS | PHASE(TERMINATED),
    ANY = PHASE(INSTANTIATED) | READS,
    GETS = FMI == 3 ? ANY : READS,
    SETS = PHASE(INSTANTIATED) | PHASE(INITIALIZATION) | PHASE(STEP) | PHASE(EVENT) | PHASE(CONTINUOUS_TIME),
    ENTERS = PHASE(CONTINUOUS_TIME) | (FMI == 3 ? PHASE(STEP) : PHASE(EVENT)),
    SOLVES = PHASE(INITIALIZATION) | PHASE(EVENT) | PHASE(CONTINUOUS_TIME) | PHASE(TERMINATED)
};

/* Name of a call, the phases in which it is allowed, and the kind of instance. A refused call changes nothing, so there
   is no error phase. FMI 2.0.4, sections 3.2.3 and 4.2.4; FMI 3.0.2, sections 2.3, 3.2 and 4.2. */
static const struct {
    const char *name;
    int phases;
    Kind kind;
} RULE[N_CALLS] = {
    [INSTANTIATE] = {CALL_NAME(Instantiate), 0, BOTH_KINDS},
    [SET_DEBUG_LOGGING] = {CALL_NAME(SetDebugLogging), ANY, BOTH_KINDS},
    [SETUP_EXPERIMENT] = {CALL_NAME(SetupExperiment), PHASE(INSTANTIATED), BOTH_KINDS},
    [ENTER_INITIALIZATION] = {CALL_NAME(EnterInitializationMode), PHASE(INSTANTIATED), BOTH_KINDS},
    [EXIT_INITIALIZATION] = {CALL_NAME(ExitInitializationMode), PHASE(INITIALIZATION), BOTH_KINDS},
    [TERMINATE] = {CALL_NAME(Terminate), RUNS, BOTH_KINDS},
    [RESET] = {CALL_NAME(Reset), ANY, BOTH_KINDS},
    [DO_STEP] = {CALL_NAME(DoStep), PHASE(STEP), CO_SIMULATION},
    [CANCEL_STEP] = {CALL_NAME(CancelStep), 0, CO_SIMULATION}, /* no step is ever pending */
    [GET_STATUS] = {CALL_NAME(GetStatus), PHASE(STEP) | PHASE(STEP_FAILED) | PHASE(TERMINATED), CO_SIMULATION},
    [GET_REAL] = {CALL_NAME(Get) REAL_NAME, GETS, BOTH_KINDS},
    [GET_BOOLEAN] = {CALL_NAME(GetBoolean), GETS, BOTH_KINDS},
    [GET_INTEGER] = {CALL_NAME(Get) INTEGER_NAME, GETS, BOTH_KINDS},
    [GET_OTHER] = {CALL_NAME(Get) " of " OTHER_NAME, GETS, BOTH_KINDS},
    [SET_REAL] = {CALL_NAME(Set) REAL_NAME, SETS, BOTH_KINDS},
    [SET_BOOLEAN] = {CALL_NAME(SetBoolean), SETS, BOTH_KINDS},
    [SET_INTEGER] = {CALL_NAME(Set) INTEGER_NAME, SETS, BOTH_KINDS},
    [SET_OTHER] = {CALL_NAME(Set) " of " OTHER_NAME, SETS, BOTH_KINDS},
    [SET_INPUT] = {CALL_NAME(Set) " of an input", SETS, BOTH_KINDS},
    [SET_PARAMETER] = {CALL_NAME(Set) " of a parameter", PHASE(INSTANTIATED) | PHASE(INITIALIZATION), BOTH_KINDS},
    [SET_Q_V] = {CALL_NAME(Set) " of a state", PHASE(EVENT) | PHASE(CONTINUOUS_TIME), BOTH_KINDS},
    [GET_STATE] = {CALL_NAME(GetFMUstate), ANY, BOTH_KINDS},
    [SET_STATE] = {CALL_NAME(SetFMUstate), ANY, BOTH_KINDS},
    [FREE_STATE] = {CALL_NAME(FreeFMUstate), ANY, BOTH_KINDS},
    [SIZE_OF_STATE] = {CALL_NAME(SerializedFMUstateSize), ANY, BOTH_KINDS},
    [SERIALIZE] = {CALL_NAME(SerializeFMUstate), ANY, BOTH_KINDS},
    [DESERIALIZE] = {CALL_NAME(DeSerializeFMUstate), ANY, BOTH_KINDS},
    [ENTER_EVENT_MODE] = {CALL_NAME(EnterEventMode), ENTERS, EVENT_MODE},
    [NEW_DISCRETE_STATES] = {CALL_NAME(NewDiscreteStates), PHASE(EVENT), EVENT_MODE},
    [ENTER_STEP_MODE] = {CALL_NAME(EnterStepMode), PHASE(EVENT), CO_SIMULATION},
    [GET_CLOCK] = {CALL_NAME(GetClock), PHASE(EVENT), EVENT_MODE},
    [SET_CLOCK] = {CALL_NAME(SetClock), PHASE(EVENT), EVENT_MODE},
    [GET_INTERVAL] = {CALL_NAME(GetInterval), READS, BOTH_KINDS},
    [SET_INTERVAL] = {CALL_NAME(SetIntervalDecimal), PHASE(INITIALIZATION), BOTH_KINDS},
    [ENTER_CONTINUOUS_TIME_MODE] = {CALL_NAME(EnterContinuousTimeMode), PHASE(EVENT), MODEL_EXCHANGE},
    [COMPLETED_INTEGRATOR_STEP] = {CALL_NAME(CompletedIntegratorStep), PHASE(CONTINUOUS_TIME), MODEL_EXCHANGE},
    [SET_TIME] = {CALL_NAME(SetTime), PHASE(EVENT) | PHASE(CONTINUOUS_TIME), MODEL_EXCHANGE},
    [SET_CONTINUOUS_STATES] = {CALL_NAME(SetContinuousStates), PHASE(CONTINUOUS_TIME), MODEL_EXCHANGE},
    [GET_DERIVATIVES] = {CALL_NAME(GetDerivatives), SOLVES, MODEL_EXCHANGE},
    [GET_EVENT_INDICATORS] = {CALL_NAME(GetEventIndicators), SOLVES, MODEL_EXCHANGE},
    [GET_CONTINUOUS_STATES] = {CALL_NAME(GetContinuousStates), SOLVES, MODEL_EXCHANGE},
    [GET_NOMINALS] = {CALL_NAME(GetNominalsOfContinuousStates), PHASE(INSTANTIATED) | SOLVES, MODEL_EXCHANGE},
    [GET_DIRECTIONAL_DERIVATIVE] = {CALL_NAME(GetDirectionalDerivative), READS, BOTH_KINDS},
    [GET_ADJOINT_DERIVATIVE] = {CALL_NAME(GetAdjointDerivative), READS, BOTH_KINDS},
    [COUNT_STATES] = {CALL_NAME(GetNumberOf), ANY, MODEL_EXCHANGE},
};

/* Name of a call in messages. */
static const char *call_name(Call call)
{
    return RULE[call].name;
}

/* True if an instance of this kind can have the phase and the clock of a state. */
static int can_have(const Instance *instance, const State *state)
{
    const int phase = state->phase, event = instance->has_clock ? 0 : PHASE(EVENT);
    const int other = instance->kind == MODEL_EXCHANGE ? PHASE(STEP) | PHASE(STEP_FAILED)
                                                       : PHASE(CONTINUOUS_TIME) | event;
    return phase >= 0 && phase < N_PHASES && !(other >> phase & 1)
           && (state->sampling.clock != NO_CLOCK) == instance->has_clock;
}

/* True if a call is allowed in the instance's phase; log a refusal. */
static int allowed(Instance *instance, Call call, const char *culprit)
{
    const int phase = instance->state.phase;
    const Kind kind = RULE[call].kind;
    const int is_of_kind = kind == EVENT_MODE ? instance->kind == MODEL_EXCHANGE || instance->has_clock
                                              : kind == BOTH_KINDS || kind == instance->kind;
    if (!is_of_kind) {
        report(instance, ERROR, "%s is a call of %s, and the instance is one of %s",
               call_name(call), KIND_NAME[kind], KIND_NAME[instance->kind]);
        return 0;
    }
    if (RULE[call].phases >> phase & 1)
        return 1;
    report(instance, ERROR, "%s%s%s%s is not allowed in the state '%s'", call_name(call),
           culprit ? " (" : "", culprit ? culprit : "", culprit ? ")" : "", PHASE_NAME[phase]);
    return 0;
}

/* Log why a call is refused. */
static Status refuse(Instance *instance, Call call, const char *reason)
{
    return report(instance, ERROR, "%s: %s", call_name(call), reason);
}

/* The instance, if the call is allowed and has the pointers that it needs; otherwise NULL, and the refusal is logged.
   */
static Instance *enter(void *component, Call call, int has_pointers)
{
    if (!component || !allowed(component, call, NULL))
        return NULL;
    if (has_pointers)
        return component;
    refuse(component, call, "null pointer");
    return NULL;
}

/* Change the phase, if the call is allowed. */
static Status move_on(void *component, Call call, Phase phase)
{
    Instance *instance = enter(component, call, 1);
    if (!instance)
        return ERROR;
    instance->state.phase = phase;
    return OK;
}

/* Refuse a call of a feature that modelDescription.xml excludes. Importers bind every name. */
static Status unsupported(Instance *instance, const char *function)
{
    if (instance)
        report(instance, ERROR, "%s is not supported by this FMU", function);
    return ERROR;
}

/* Define such a function, whose parameters begin with the instance. */
#define UNSUPPORTED(Name, parameters)                  \
    Status STANDARD(Name) parameters                   \
    {                                                  \
        return unsupported(instance, CALL_NAME(Name)); \
    }
