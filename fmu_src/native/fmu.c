/* All files of the FMU, except the derivatives, in one compilation unit, because their functions are static. Each file
   uses only files that are included before it. The headers declare functions that an earlier file, or the derivatives,
   call. */
#include "engine.c"
#include "dormand_prince.c"
#include "polynomial.c"
#include "damping.c"
#include "rosenbrock.c"
#include "margins.c"
#include "event_search.c"
#include "anti_chatter.c"
#include "integrator.c"
#include "noise.c"
#include "sampling.c"
#include "events.c"
#include "passed_stops.c"
#include "calls.c"
#include "instance.c"
#include "simulation.c"
#include "exchange.c"
#include "variables.c"
#include "derivatives.c"
#include "saved_state.c"
#include "spans.c"
#if FMI == 3
#include "fmi3.c"
#else
#include "fmi2.c"
#endif
