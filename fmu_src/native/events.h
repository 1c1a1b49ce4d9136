/* The plant as a differential equation with events, for solvers that integrate it themselves. */
#ifndef EVENTS_H
#define EVENTS_H

#include "internal.h"
#include "stops.h"

/* The joints that rest at the plant's state, by the rules of stops.h. */
INTERNAL void find_stops(const Plant *plant, Stops *stops);

/* One indicator of each joint's upper limit, then of each lower one, of each joint's friction, then of the
   singular values that J⁺ may drop, all but the largest. An event is where one changes its sign. */
INTERNAL void event_indicators(const Plant *plant, const Stops *stops,
                               double indicator[N_INDICATORS]);

/* Changes at an event: decided by the state alone, so that it is the same whether the importer came
   early, late or for nothing. Whether the state is another now. */
INTERNAL int handle_event(Plant *plant, Stops *stops);

#endif
