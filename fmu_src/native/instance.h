/* One instance of the FMU, and what every FMI function does first. */
#ifndef INSTANCE_H
#define INSTANCE_H

#include "fmi2Functions.h"
#include "internal.h"
#include "plant.h"
#include "stops.h"

typedef enum {
    INSTANTIATED, INITIALIZATION,
    STEP, STEP_FAILED,      /* of co-simulation */
    EVENT, CONTINUOUS_TIME, /* of Model Exchange */
    TERMINATED, N_PHASES
} Phase;

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
    fmi2Type kind;
    fmi2CallbackLogger log;
    fmi2ComponentEnvironment environment;
    const char *name;
    int verbose;
} Instance;

/* The calls of the state machine; setting variables has three rows, by what they are. */
typedef enum {
    SET_DEBUG_LOGGING, SETUP_EXPERIMENT, ENTER_INITIALIZATION, EXIT_INITIALIZATION, TERMINATE,
    RESET, DO_STEP, CANCEL_STEP, GET_STATUS, GET_REAL, GET_INTEGER, GET_BOOLEAN, GET_STRING,
    SET_REAL, SET_INTEGER, SET_BOOLEAN, SET_STRING, SET_INPUT, SET_PARAMETER, SET_Q_V,
    GET_STATE, SET_STATE, FREE_STATE, SIZE_OF_STATE, SERIALIZE, DESERIALIZE, ENTER_EVENT_MODE,
    NEW_DISCRETE_STATES, ENTER_CONTINUOUS_TIME_MODE, COMPLETED_INTEGRATOR_STEP, SET_TIME,
    SET_CONTINUOUS_STATES, GET_DERIVATIVES, GET_EVENT_INDICATORS, GET_CONTINUOUS_STATES,
    GET_NOMINALS, GET_DIRECTIONAL_DERIVATIVE, N_CALLS
} Call;

/* Name of a call, as messages say it. */
INTERNAL const char *call_name(Call call);

/* Whether a call is allowed in the instance's phase; where not, logs it. */
INTERNAL int allowed(Instance *instance, Call call, const char *culprit);

/* Whether an instance of a kind can be in a phase. */
INTERNAL int can_be_in(fmi2Type kind, int phase);

/* The instance of a component where the call is allowed, else NULL; a refusal is logged. */
INTERNAL Instance *enter(fmi2Component component, Call call);

/* Log a printf message; what is below a warning only where logging is on. Returns the status. */
INTERNAL fmi2Status report(Instance *instance, fmi2Status status, const char *format, ...);

/* Set the state to that of a new instance. */
INTERNAL void reset_state(State *state);

/* Whether a variable may have a value; a refusal is logged. */
INTERNAL fmi2Status check_range(Instance *instance, int variable, double value);

/* Whether the control law can follow the inputs; a refusal is logged. */
INTERNAL fmi2Status check_inputs(Instance *instance);

/* Whether the joints' limits make ranges; a refusal is logged. */
INTERNAL fmi2Status check_limits(Instance *instance);

/* Check the parameters and set q and v to their start; a refusal is logged. With warn, what was
   clamped is logged too. */
INTERNAL fmi2Status initialise(Instance *instance, int warn);

/* Find the joints that rest, where that is yet to be done. */
INTERNAL void update_stops(State *state);

/* Compute the derivatives, where that is yet to be done. */
INTERNAL void update_rates(State *state);

#endif
