/* Events within an integration step. */
#ifndef EVENT_SEARCH_H
#define EVENT_SEARCH_H

#include "dormand_prince.h"
#include "internal.h"

/* The event at the end of a step: joints that reached a limit, and joints that slipped and came to rest. */
typedef struct {
    int stopped[N_JOINTS], arrested[N_JOINTS];
} Event;

/* First time in (0, size] at which the regime of the step ends; y_new becomes the state there. 0 if it does not end.
   With rank_held, only a drop of the rank of J⁺ counts. */
INTERNAL double first_event(Step *step, int rank_held, Event *event);

#endif
