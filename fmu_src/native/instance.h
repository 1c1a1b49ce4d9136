/* One instance of the FMU, what every FMI function does first, and what the functions do that the
   versions of FMI have with other arguments. All are given what the importer hands over, refuse what is
   not allowed and log why.

   A function that both versions have with the same arguments is where its subject is, under its name in
   the version: STANDARD(Reset) is fmi2Reset or fmi3Reset. The faces, fmi2.c and fmi3.c, have the rest. */
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

/* Hand a message, of less than 512 bytes, to the importer, as the face knows it. */
INTERNAL void hand_over(const Instance *instance, Status status, const char *category,
                        const char *text);

/* Log a printf message, where the status's category is on. Returns the status. */
INTERNAL Status report(Instance *instance, Status status, const char *format, ...);

#endif
