/* The control law: one file of <name>_control.c, chosen when the FMU is built. */
#ifndef CONTROL_H
#define CONTROL_H

#include "internal.h"
#include "mechanism.h"

/* True if the law depends on the task frame. */
#ifdef HAS_RCOND
enum { NEEDS_POSITIONS = 1 };
#else
enum { NEEDS_POSITIONS = 0 };
#endif

/* The law at a state with inputs held: accelerations q̈_cmd if COMMANDS_ACCELERATION is defined, otherwise efforts τ.
   Rank and margin are those of apply_pseudo_inverse; they are 0 and 1 for a law without J⁺. The margin may be NULL. */
INTERNAL int command(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
                     const double q[N_JOINTS], const double v[N_JOINTS], int rank,
                     double given[N_JOINTS], double *margin);

#ifndef IS_COMPLEX
typedef double Matrix[N_JOINTS][N_JOINTS];

/* Add ∂(Jᵀ f)/∂q of a force at the task frame to slope. */
static void add_force(const double f[3], const JointMotion motion[N_BODIES], Matrix slope);

/* Add the derivatives of the law's accelerations `given` with respect to q and v to slope, for the motions under the
   law. Returns false, and adds nothing, where J does not have full rank. */
static int add_command_by_states(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
                                 const JointMotion motion[N_BODIES], const double given[N_JOINTS], int rank,
                                 double slope[X][N_JOINTS]);
#endif

#ifdef HAS_RCOND
/* σ/σ_max of J at a position, in descending order. */
INTERNAL void conditioning(const double q[N_JOINTS], double ratio[N_ROWS]);
#endif

#endif
