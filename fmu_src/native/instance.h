/* One instance of the FMU, what every FMI function does first, and what the functions do that all
   versions of FMI have. These are given what the importer hands over, refuse what is not allowed and log
   why. The faces, fmi2.c and fmi3.c, have the functions themselves and the table of their calls. */
#ifndef INSTANCE_H
#define INSTANCE_H

#include <stddef.h>

#include "internal.h"
#include "plant.h"
#include "stops.h"

#if FMI == 3
#include "fmi3Functions.h"
#define REAL_NAME "Float64"
#define TOKEN "instantiation token"
typedef fmi3Boolean Boolean;
typedef fmi3ValueReference Reference;
#else
#include "fmi2Functions.h"
#define REAL_NAME "Real"
#define TOKEN "GUID"
typedef fmi2Boolean Boolean;
typedef fmi2ValueReference Reference;
#ifdef PREFIX /* FMPy's copy of the header was changed to ignore it */
#undef fmi2FullName
#define fmi2FullName(name) PREFIXED(name)
#endif
#endif

/* These have the same numbers in all versions of FMI. */
typedef enum { OK, WARNING, DISCARD, ERROR } Status;
typedef enum { BOTH_KINDS, MODEL_EXCHANGE, CO_SIMULATION } Kind;

typedef enum {
    INSTANTIATED, INITIALIZATION,
    STEP, STEP_FAILED,      /* of co-simulation */
    EVENT, CONTINUOUS_TIME, /* of Model Exchange */
    TERMINATED, N_PHASES
} Phase;

/* Sets of phases; M is event mode. */
enum { N = 1 << INSTANTIATED, I = 1 << INITIALIZATION, S = 1 << STEP, F = 1 << STEP_FAILED,
       M = 1 << EVENT, C = 1 << CONTINUOUS_TIME, T = 1 << TERMINATED,
       ANY = N | I | S | F | M | C | T };

/* All that getFMUstate saves. Plain data without pointers. */
typedef struct {
    char guid[sizeof MODEL_GUID + 8 - sizeof MODEL_GUID % 8]; /* of the model that it belongs to */
    Plant plant;
    double time;      /* s */
    double stop_time; /* s, HUGE_VAL where there is none */
    Stops stops;      /* in Model Exchange a discrete state, which events alone change */
    int phase;
    int initialised;  /* the outputs q and v are those of the parameters and the state */
    int has_x;        /* the output x is computed */
    int has_tau;      /* the output tau is computed */
    int has_stops;    /* the joints that rest are found */
    int has_rates;    /* the derivatives are computed */
} State;

typedef struct {
    State state;
    Kind kind;
    void (*log)(void); /* the importer's callback, as the face knows it */
    void *environment; /* which that is given */
    const char *name;
    int verbose;
} Instance;

/* The calls; setting variables has three rows, by what they are. */
typedef enum {
    INSTANTIATE, SET_DEBUG_LOGGING, SETUP_EXPERIMENT, ENTER_INITIALIZATION, EXIT_INITIALIZATION,
    TERMINATE, RESET, DO_STEP, CANCEL_STEP, GET_STATUS, GET_REAL, GET_BOOLEAN, GET_OTHER, SET_REAL,
    SET_BOOLEAN, SET_OTHER, SET_INPUT, SET_PARAMETER, SET_Q_V, GET_STATE, SET_STATE, FREE_STATE,
    SIZE_OF_STATE, SERIALIZE, DESERIALIZE, ENTER_EVENT_MODE, NEW_DISCRETE_STATES,
    ENTER_CONTINUOUS_TIME_MODE, COMPLETED_INTEGRATOR_STEP, SET_TIME, SET_CONTINUOUS_STATES,
    GET_DERIVATIVES, GET_EVENT_INDICATORS, GET_CONTINUOUS_STATES, GET_NOMINALS,
    GET_DIRECTIONAL_DERIVATIVE, GET_ADJOINT_DERIVATIVE, COUNT_STATES, N_CALLS
} Call;

/* A call's name, as messages say it, the phases in which it is allowed, and of which kind it is, where of one alone. */
typedef struct {
    const char *name;
    int phases;
    Kind kind;
} Rule;

/* --- what a face has --- */

/* The rule of a call. */
INTERNAL const Rule *rule_of(Call call);

/* Hand a message, of less than 512 bytes, to the importer. */
INTERNAL void hand_over(const Instance *instance, Status status, const char *category,
                        const char *text);

/* --- instance.c --- */

/* Name of a call, as messages say it. */
INTERNAL const char *call_name(Call call);

/* Whether a call is allowed in the instance's phase; where not, logs it. */
INTERNAL int allowed(Instance *instance, Call call, const char *culprit);

/* Whether an instance of a kind can be in a phase. */
INTERNAL int can_be_in(Kind kind, int phase);

/* The instance where the call is allowed, else NULL; a refusal is logged. */
INTERNAL Instance *enter(void *component, Call call);

/* Log a printf message; what is below a warning only where logging is on. Returns the status. */
INTERNAL Status report(Instance *instance, Status status, const char *format, ...);

/* A new instance as the draft says; NULL where it has no name or another token. */
INTERNAL Instance *instantiate(Instance draft, const char *token);

INTERNAL Status set_debug_logging(void *component, int on, size_t count,
                                  const char *const categories[]);

/* Take over the times of the experiment; its tolerance is told to be ignored. */
INTERNAL Status set_up(Instance *instance, Call call, const double *tolerance, double start,
                       const double *stop);

INTERNAL Status exit_initialization(void *component);

/* Where the call is allowed, what it does is to change the phase. */
INTERNAL Status move_on(void *component, Call call, Phase phase);

INTERNAL Status reset(void *component);

/* Whether a variable may have a value; a refusal is logged. */
INTERNAL Status check_range(Instance *instance, int variable, double value);

/* Whether the control law can follow the inputs; a refusal is logged. */
INTERNAL Status check_inputs(Instance *instance);

/* Whether the joints' limits make ranges; a refusal is logged. */
INTERNAL Status check_limits(Instance *instance);

/* Check the parameters and set q and v to their start; a refusal is logged. With warn, what was
   clamped is logged too. */
INTERNAL Status initialise(Instance *instance, int warn);

/* Find the joints that rest, where that is yet to be done. */
INTERNAL void update_stops(State *state);

/* Compute the derivatives, where that is yet to be done. */
INTERNAL void update_rates(State *state);

/* --- simulation.c --- */

INTERNAL Status do_step(void *component, double point, double h);

/* --- exchange.c: q and v are the states --- */

/* Whether the states are others is told. */
INTERNAL Status update_discrete_states(void *component, Boolean *states_changed);

INTERNAL Status complete_integrator_step(void *component, Boolean *enter_event_mode,
                                         Boolean *terminate);

INTERNAL Status set_time(void *component, double time);

INTERNAL Status set_continuous_states(void *component, const double x[], size_t count);

INTERNAL Status get_continuous_states(void *component, double x[], size_t count);

INTERNAL Status get_derivatives(void *component, double derivatives[], size_t count);

INTERNAL Status get_event_indicators(void *component, double indicators[], size_t count);

INTERNAL Status get_nominals(void *component, double nominals[], size_t count);

/* --- variables.c: each reference is of so many values as EXTENT says, in all n_values --- */

INTERNAL Status get_reals(void *component, const Reference vr[], size_t count, double value[],
                          size_t n_values);

INTERNAL Status set_reals(void *component, const Reference vr[], size_t count,
                          const double value[], size_t n_values);

INTERNAL Status get_booleans(void *component, const Reference vr[], size_t count, Boolean value[],
                             size_t n_values);

INTERNAL Status set_booleans(void *component, const Reference vr[], size_t count,
                             const Boolean value[], size_t n_values);

/* Variables of a type that the FMU does not have: any reference is refused, none is fine. */
INTERNAL Status other_variables(void *component, Call call, const Reference vr[], size_t count,
                                const void *value, size_t n_values);

/* The change of the unknowns where the knowns, states and inputs, change by the seed. */
INTERNAL Status directional_derivative(void *component, const Reference unknown[],
                                       size_t n_unknown, const Reference known[], size_t n_known,
                                       const double seed[], size_t n_seed, double result[],
                                       size_t n_result);

#if FMI == 3
/* The change of the unknowns, weighted by the seed, for a change of each known by 1. */
INTERNAL Status adjoint_derivative(void *component, const Reference unknown[], size_t n_unknown,
                                   const Reference known[], size_t n_known, const double seed[],
                                   size_t n_seed, double result[], size_t n_result);
#endif

/* --- saved_state.c --- */

INTERNAL Status save_state(void *component, void **saved);

INTERNAL Status restore_state(void *component, const void *saved);

INTERNAL Status free_state(void *component, void **saved);

INTERNAL Status size_of_state(void *component, const void *saved, size_t *size);

INTERNAL Status serialize_state(void *component, const void *saved, void *bytes, size_t size);

INTERNAL Status deserialize_state(void *component, const void *bytes, size_t size, void **saved);

#endif
