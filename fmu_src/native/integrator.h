/* Integration of the plant over one communication step. */
#ifndef INTEGRATOR_H
#define INTEGRATOR_H

#include "internal.h"
#include "plant.h"

/* Advance the plant's state by h seconds, inputs held: Dormand–Prince 5(4) with located
   joint-limit stops. False, and the plant unchanged, where the equations of motion gave a value
   that is not finite. */
INTERNAL int advance_plant(Plant *plant, double h);

#endif
