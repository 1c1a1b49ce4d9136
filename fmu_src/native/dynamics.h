/* Dynamics of the robot. */
#ifndef DYNAMICS_H
#define DYNAMICS_H

#include "internal.h"
#include "kinematics.h"

/* τ = M(q) a + h(q, v), joint efforts in N·m or N. The gravity is in the root's axes, m/s2. */
INTERNAL void inverse_dynamics(Placement joint[N_JOINTS], const double v[N_JOINTS],
                      const double a[N_JOINTS], const double gravity[3], double tau[N_JOINTS]);

/* a = M(q)⁻¹ τ, the accelerations that efforts cause beyond those of h(q, v). */
INTERNAL void acceleration_of_effort(Placement joint[N_JOINTS], const double tau[N_JOINTS],
                                     double a[N_JOINTS]);

#endif
