/* Events within an integration step. */
#ifndef EVENT_SEARCH_H
#define EVENT_SEARCH_H

#include "dormand_prince.h"
#include "internal.h"

/* The event at the end of a step: joints that reached a limit, joints that slipped and have no velocity left,
   and joints that are no longer held. */
typedef struct {
    int stopped[N_JOINTS], arrested[N_JOINTS], released[N_JOINTS];
} Event;

/* First time in (0, size] at which the regime of the step ends, y_new becoming the state there; 0 where
   it does not. With rank_held the rank of J⁺ is no matter. */
INTERNAL double first_event(Step *step, int rank_held, Event *event);

#endif
