/* The control law: one file of <name>_control.c, chosen when the FMU is built. */
#ifndef CONTROL_H
#define CONTROL_H

#include "internal.h"
#include "mechanism.h"

/* What the law makes of a state, inputs held: accelerations q̈_cmd where COMMANDS_ACCELERATION, else
   efforts τ. The rank of its J⁺, the number of singular values that were not dropped; 0 where it
   has none. */
INTERNAL int command(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
                     const double q[N_JOINTS], const double v[N_JOINTS], double given[N_JOINTS]);

#ifdef HAS_RCOND
/* The singular values of J at a position over the largest, which comes first. */
INTERNAL void conditioning(const double q[N_JOINTS], double ratio[N_ROWS]);
#endif

#endif
