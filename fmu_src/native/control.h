/* The control law: one file of <name>_control.c, chosen when the FMU is built. */
#ifndef CONTROL_H
#define CONTROL_H

#include "internal.h"
#include "mechanism.h"

/* The law at a state, inputs held: accelerations q̈_cmd where COMMANDS_ACCELERATION, else efforts τ.
   The rank of its J⁺ and the margin are those of apply_pseudo_inverse; 0 and 1 where it has none.
   The margin may be NULL. */
INTERNAL int command(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
                     const double q[N_JOINTS], const double v[N_JOINTS], int rank,
                     double given[N_JOINTS], double *margin);

#ifdef HAS_RCOND
/* The singular values of J at a position over the largest, which comes first. */
INTERNAL void conditioning(const double q[N_JOINTS], double ratio[N_ROWS]);
#endif

#endif
