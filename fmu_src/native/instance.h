/* An instance of the FMU, and names that both versions of FMI share. Each function of the standard checks the
   importer's arguments, refuses calls that are not allowed, and logs the reason.

   A function with the same arguments in both versions is in the file of its subject, under its name in the version:
   STANDARD(Reset) is fmi2Reset or fmi3Reset. The other functions are in fmi2.c and fmi3.c. */
#ifndef INSTANCE_H
#define INSTANCE_H

#include <stddef.h>

#include "internal.h"

#if FMI == 3
#include "fmi3Functions.h"
#define OF_VERSION(name) fmi3##name
#define TEXT_OF_VERSION(name) "fmi3" #name
#define REAL_NAME "Float64"
#define INTEGER_NAME "Int32"
#define OTHER_NAME "another type"
#define TOKEN "instantiation token"
/* Names that differ only in spelling. */
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
#ifdef PREFIX /* FMPy's copy of the header ignores the prefix */
#undef fmi2FullName
#define fmi2FullName(name) PREFIXED(name)
#endif
#endif

/* A name of the standard in this version, as an identifier and as text. */
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
typedef enum { BOTH_KINDS, MODEL_EXCHANGE, CO_SIMULATION, EVENT_MODE /* of either kind */ } Kind;

typedef enum {
    INSTANTIATED, INITIALIZATION,
    STEP, STEP_FAILED,      /* in co-simulation */
    EVENT,                  /* in Model Exchange, or with a clock */
    CONTINUOUS_TIME,        /* in Model Exchange */
    TERMINATED, N_PHASES
} Phase;

/* In FMI 3.0 co-simulation may go on after a step that was discarded. */
enum { AFTER_DISCARD = FMI == 3 ? STEP : STEP_FAILED };

/* Results for the present states, inputs and parameters: the states' derivatives, those along one direction, and the
   Jacobian. */
typedef enum { RATES = 1, DIRECTION = 2, SLOPES = 4 } Known;

/* All that getFMUstate saves. Plain data without pointers. */
typedef struct {
    char guid[sizeof MODEL_GUID + 8 - sizeof MODEL_GUID % 8]; /* GUID of the state's model */
    Plant plant;
    double time;      /* s */
    double stop_time; /* s, HUGE_VAL without one */
    Passage passage;  /* in Model Exchange: the importer's step */
    Sampling sampling;
    Stops stops;      /* in Model Exchange a discrete state, which only events change */
    int phase;
    int initialised;  /* q and v agree with the parameters and the state */
    int has_x;        /* the output x is computed */
    int has_tau;      /* tau is computed; for a sampled controller also q_meas and v_meas */
    int has_stops;    /* the joints at rest are known */
    int has_rates;    /* bits of Known */
} State;

typedef struct {
    State state;
    Kind kind;
    void (*log)(void); /* the importer's callback; fmi2.c and fmi3.c know its type */
    void *environment; /* argument of the callback */
    const char *name;
    double (*slope)[N_JOINTS]; /* the Jacobian: derivatives of the accelerations, for each input and state */
    int asks_several;   /* whether the last point had several directions */
    double evaluations; /* of the equations of motion, in all steps */
    int has_clock;      /* whether the importer ticks the clock */
    int silent; /* bit mask of the log categories that are off; 0 before instantiation */
} Instance;

/* The calls. Calls that set variables are also checked by the kind of variable: SET_INPUT, SET_PARAMETER, SET_Q_V. */
typedef enum {
    INSTANTIATE, SET_DEBUG_LOGGING, SETUP_EXPERIMENT, ENTER_INITIALIZATION, EXIT_INITIALIZATION,
    TERMINATE, RESET, DO_STEP, CANCEL_STEP, GET_STATUS, GET_REAL, GET_BOOLEAN, GET_INTEGER,
    GET_OTHER, SET_REAL, SET_BOOLEAN, SET_INTEGER, SET_OTHER, SET_INPUT, SET_PARAMETER, SET_Q_V, GET_STATE, SET_STATE, FREE_STATE,
    SIZE_OF_STATE, SERIALIZE, DESERIALIZE, ENTER_EVENT_MODE, NEW_DISCRETE_STATES, ENTER_STEP_MODE,
    GET_CLOCK, SET_CLOCK, GET_INTERVAL, SET_INTERVAL,
    ENTER_CONTINUOUS_TIME_MODE, COMPLETED_INTEGRATOR_STEP, SET_TIME, SET_CONTINUOUS_STATES,
    GET_DERIVATIVES, GET_EVENT_INDICATORS, GET_CONTINUOUS_STATES, GET_NOMINALS,
    GET_DIRECTIONAL_DERIVATIVE, GET_ADJOINT_DERIVATIVE, COUNT_STATES, N_CALLS
} Call;

static const char NO_EFFORT[] = "the control law gave an effort that is not finite: inputs, payload or speeds are too"
                                " large";

/* Pass a message of less than 512 bytes to the importer, in the form of this version of FMI. */
INTERNAL void hand_over(const Instance *instance, Status status, const char *category,
                        const char *text);

/* Log a printf message if the status's category is on; return the status. */
INTERNAL Status report(Instance *instance, Status status, const char *format, ...);

#endif
