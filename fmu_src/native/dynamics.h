/* Dynamics of the robot. */
#ifndef DYNAMICS_H
#define DYNAMICS_H

#include "internal.h"
#include "kinematics.h"

/* The body that carries the task frame, with its payload: mass, centre of mass, inertia about it. */
typedef struct {
    double mass, com[3], inertia[3][3];
} Carrier;

/* The carrier with a point mass, kg, at a place in the task frame, m. */
INTERNAL void load_carrier(double payload, const double place[3], Carrier *carrier);

/* τ = M(q) a + h(q, v), joint efforts in N·m or N. The gravity is in the root's axes, m/s2. */
INTERNAL void inverse_dynamics(Placement joint[N_BODIES], const Carrier *carrier,
                               const double v[N_JOINTS], const double a[N_JOINTS],
                               const double gravity[3], double tau[N_JOINTS]);

/* a = M(q)⁻¹ τ, the accelerations that efforts cause beyond those of h(q, v). */
INTERNAL void acceleration_of_effort(Placement joint[N_BODIES], const Carrier *carrier,
                                     const double tau[N_JOINTS], double a[N_JOINTS]);

#endif
