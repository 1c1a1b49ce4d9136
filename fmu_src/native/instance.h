/* One instance of the FMU, what every FMI function does first, and what the functions do that the
   versions of FMI have with other arguments. All are given what the importer hands over, refuse what is
   not allowed and log why.

   A function that both versions have with the same arguments is where its subject is, under its name in
   the version: STANDARD(Reset) is fmi2Reset or fmi3Reset. The faces, fmi2.c and fmi3.c, have the rest. */
#ifndef INSTANCE_H
#define INSTANCE_H

#include <stddef.h>

#include "internal.h"
#include "passed_stops.h"
#include "plant.h"
#include "sampling.h"
#include "stops.h"

#if FMI == 3
#include "fmi3Functions.h"
#define OF_VERSION(name) fmi3##name
#define TEXT_OF_VERSION(name) "fmi3" #name
#define REAL_NAME "Float64"
#define INTEGER_NAME "Int32"
#define OTHER_NAME "another type"
#define TOKEN "instantiation token"
/* The same names in another spelling. */
#define DeSerializeFMUstate DeserializeFMUState
#define FreeFMUstate FreeFMUState
#define GetDerivatives GetContinuousStateDerivatives
#define GetFMUstate GetFMUState
#define NewDiscreteStates UpdateDiscreteStates
#define SerializeFMUstate SerializeFMUState
#define SerializedFMUstateSize SerializedFMUStateSize
#define SetFMUstate SetFMUState
#else
#include "fmi2Functions.h"
#define OF_VERSION(name) fmi2##name
#define TEXT_OF_VERSION(name) "fmi2" #name
#define REAL_NAME "Real"
#define INTEGER_NAME "Integer"
#define OTHER_NAME "a String"
#define TOKEN "GUID"
#ifdef PREFIX /* FMPy's copy of the header was changed to ignore it */
#undef fmi2FullName
#define fmi2FullName(name) PREFIXED(name)
#endif
#endif

/* A name of the standard in this version, and as messages say it. */
#define STANDARD(name) OF_VERSION(name)
#define CALL_NAME(name) TEXT_OF_VERSION(name)

typedef STANDARD(Status) Status;
typedef STANDARD(Boolean) Boolean;
#if FMI == 3
typedef fmi3Int32 Integer;
#else
typedef fmi2Integer Integer;
#endif
typedef STANDARD(ValueReference) Reference;
#define OK STANDARD(OK)
#define WARNING STANDARD(Warning)
#define DISCARD STANDARD(Discard)
#define ERROR STANDARD(Error)

/* These have the same numbers in all versions of FMI. */
typedef enum { BOTH_KINDS, MODEL_EXCHANGE, CO_SIMULATION } Kind;

typedef enum {
    INSTANTIATED, INITIALIZATION,
    STEP, STEP_FAILED,      /* of co-simulation */
    EVENT, CONTINUOUS_TIME, /* of Model Exchange */
    TERMINATED, N_PHASES
} Phase;

/* In FMI 3.0 co-simulation may go on after a step that was discarded. */
enum { AFTER_DISCARD = FMI == 3 ? STEP : STEP_FAILED };

/* All that getFMUstate saves. Plain data without pointers. */
typedef struct {
    char guid[sizeof MODEL_GUID + 8 - sizeof MODEL_GUID % 8]; /* of the model that it belongs to */
    Plant plant;
    double time;      /* s */
    double stop_time; /* s, HUGE_VAL where there is none */
    Passage passage;  /* in Model Exchange: the importer's step */
    Sampling sampling;
    Stops stops;      /* in Model Exchange a discrete state, which events alone change */
    int phase;
    int initialised;  /* the outputs q and v are those of the parameters and the state */
    int has_x;        /* the output x is computed */
    int has_tau;      /* the output tau is computed, with held efforts q_meas and v_meas too */
    int has_stops;    /* the joints that rest are found */
    int has_rates;    /* the derivatives are computed */
} State;

typedef struct {
    State state;
    Kind kind;
    void (*log)(void); /* the importer's callback, as the face knows it */
    void *environment; /* which that is given */
    const char *name;
    int silent; /* the categories of messages that are off, a bit each; none before it is made */
} Instance;

/* The calls; setting variables has three rows, by what they are. */
typedef enum {
    INSTANTIATE, SET_DEBUG_LOGGING, SETUP_EXPERIMENT, ENTER_INITIALIZATION, EXIT_INITIALIZATION,
    TERMINATE, RESET, DO_STEP, CANCEL_STEP, GET_STATUS, GET_REAL, GET_BOOLEAN, GET_INTEGER,
    GET_OTHER, SET_REAL, SET_BOOLEAN, SET_INTEGER, SET_OTHER, SET_INPUT, SET_PARAMETER, SET_Q_V, GET_STATE, SET_STATE, FREE_STATE,
    SIZE_OF_STATE, SERIALIZE, DESERIALIZE, ENTER_EVENT_MODE, NEW_DISCRETE_STATES,
    ENTER_CONTINUOUS_TIME_MODE, COMPLETED_INTEGRATOR_STEP, SET_TIME, SET_CONTINUOUS_STATES,
    GET_DERIVATIVES, GET_EVENT_INDICATORS, GET_CONTINUOUS_STATES, GET_NOMINALS,
    GET_DIRECTIONAL_DERIVATIVE, GET_ADJOINT_DERIVATIVE, COUNT_STATES, N_CALLS
} Call;

static const char NO_EFFORT[] = "the control law gave an effort that is not finite: inputs, payload or speeds are too"
                                " large";

/* --- what a face has --- */

/* Hand a message, of less than 512 bytes, to the importer. */
INTERNAL void hand_over(const Instance *instance, Status status, const char *category,
                        const char *text);

/* --- calls.c --- */

/* Name of a call, as messages say it. */
INTERNAL const char *call_name(Call call);

/* Whether an instance of a kind can be in a phase. */
INTERNAL int can_be_in(Kind kind, int phase);

/* Whether a call is allowed in the instance's phase; where not, logs it. */
INTERNAL int allowed(Instance *instance, Call call, const char *culprit);

/* The instance where the call is allowed and has the pointers that it needs, else NULL; a refusal is
   logged. */
INTERNAL Instance *enter(void *component, Call call, int has_pointers);

/* Log why a call is refused. */
INTERNAL Status refuse(Instance *instance, Call call, const char *reason);

/* Where the call is allowed, what it does is to change the phase. */
INTERNAL Status move_on(void *component, Call call, Phase phase);

/* Refuse a call of what the modelDescription says that there is not. Importers bind every name. */
INTERNAL Status unsupported(Instance *instance, const char *function);

/* --- instance.c --- */

/* Log a printf message, where the status's category is on. Returns the status. */
INTERNAL Status report(Instance *instance, Status status, const char *format, ...);

/* A new instance as the draft says; NULL where it has no name or another token. */
INTERNAL Instance *instantiate(Instance draft, const char *token, int logging_on);

/* Take over the times of the experiment; a tolerance is ignored, with a message. */
INTERNAL Status set_up(Instance *instance, Call call, const double *tolerance, double start,
                       const double *stop);

/* Whether a variable may have a value; a refusal is logged. */
INTERNAL Status check_range(Instance *instance, int variable, double value);

/* Whether the control law can follow the inputs; a refusal is logged. */
INTERNAL Status check_inputs(Instance *instance);

/* Whether the joints' limits make ranges, and parameters of sampling go together; a refusal is logged. */
INTERNAL Status check_parameters(Instance *instance);

/* Check the parameters and set q and v to their start; a refusal is logged. With warn, what was
   clamped is logged too. */
INTERNAL Status initialise(Instance *instance, int warn);

/* Compute the outputs q_meas and v_meas, and tau where it is held. A sample that is due is taken for them alone, for
   inputs may still change; in continuous-time mode an event alone takes one. False where an effort is not finite. */
INTERNAL int show_samples(State *state);

/* Compute the output tau, where that is yet to be done; else as above. */
INTERNAL int update_control(Instance *instance);

/* The same where these are what acts: of a sampled controller. */
INTERNAL int update_held(Instance *instance);

/* Find the joints that rest, where that is yet to be done. */
INTERNAL void update_stops(State *state);

/* Compute the derivatives, where that is yet to be done. */
INTERNAL void update_rates(State *state);

/* --- simulation.c --- */

INTERNAL Status do_step(void *component, double point, double h);

/* --- exchange.c --- */

/* Reports whether the states q and v have changed, and the time of the next event, HUGE_VAL where none is known. */
INTERNAL Status update_discrete_states(void *component, Boolean *states_changed, double *next_event);

/* --- variables.c: each reference is of so many values as PLACE says, in all n_values --- */

/* Of a type that the FMU does not have any reference is refused, none is fine. */
INTERNAL Status get_values(void *component, Call call, const Reference vr[], size_t count, void *values,
                           size_t n_values);

INTERNAL Status set_values(void *component, Call call, const Reference vr[], size_t count,
                           const void *values, size_t n_values);

/* The change of the unknowns where the knowns, states and inputs, change by the seed. */
INTERNAL Status directional_derivative(void *component, const Reference unknown[],
                                       size_t n_unknown, const Reference known[], size_t n_known,
                                       const double seed[], size_t n_seed, double result[],
                                       size_t n_result);

#endif
