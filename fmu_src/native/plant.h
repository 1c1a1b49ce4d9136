/* The plant: the robot under operational-space control. */
#ifndef PLANT_H
#define PLANT_H

#include "internal.h"
#include "model.h"

/* All variables of the FMU by value reference: inputs, outputs (q and v are the state; x and tau
   are computed on demand) and parameters. Truth values are 0 or 1. */
typedef struct {
    double value[N_VARIABLES];
} Plant;

/* q̈ of the equations of motion at a state, joint limits left out; the rank that J⁺ was given, the
   number of its singular values that were not dropped. */
INTERNAL int acceleration(const Plant *plant, const double q[N_JOINTS], const double v[N_JOINTS],
                          double a[N_JOINTS]);

/* The output x at the plant's state. */
INTERNAL void compute_position(Plant *plant);

/* The output tau, the control effort applied, at the plant's state and inputs. */
INTERNAL void compute_effort(Plant *plant);

#endif
