/* The plant: the robot under its control law. */
#ifndef PLANT_H
#define PLANT_H

#include "internal.h"
#include "model.h"

/* All variables of the FMU by value reference: inputs, outputs (q and v are the state; x and tau
   are computed on demand) and parameters. Truth values are 0 or 1. */
typedef struct {
    double value[N_VARIABLES];
} Plant;

enum { N_STATES = 2 * N_JOINTS }; /* q and v follow each other in the table, their derivatives too */

/* q̈ of the equations of motion at a state, with a J⁺ of this rank, of joints that slip in these directions
   (−1, 1; 0, or NULL: without friction), all joints at rest being free. Returns the rank; the margin, which
   may be NULL, is negative where the singular values give another. */
INTERNAL int acceleration(const Plant *plant, const double q[N_JOINTS], const double v[N_JOINTS],
                          const int slip[N_JOINTS], int rank, double a[N_JOINTS], double *margin);

/* The outputs x and xd, and quat and omega where there are such, at the plant's state. */
INTERNAL void compute_position(Plant *plant);

#ifdef IS_COMPLEX
/* Columns of M(q)⁻¹, of so many joints: what an effort of 1 there does to all. */
INTERNAL void inverse_mass(const Plant *plant, const double q[N_JOINTS], int count,
                           const int joints[N_JOINTS], double columns[N_JOINTS][N_JOINTS]);
#else
/* a and λ of M(q) a = τ + λ, as hybrid_dynamics has them. */
INTERNAL void hybrid_motion(const Plant *plant, const double q[N_JOINTS], const double armature[N_JOINTS],
                            const double free[N_JOINTS], const double given[N_JOINTS], double a[N_JOINTS],
                            double reaction[N_JOINTS]);
#endif

/* τ of the control law for a measured state, within limits where there are, J⁺ being of this rank. */
INTERNAL void control_effort(const Plant *plant, const double q[N_JOINTS], const double v[N_JOINTS],
                             int rank, double tau[N_JOINTS]);

/* The output tau, the control effort applied, at the plant's state and inputs, J⁺ being of this rank. That of a
   sampled controller is held: it is what acts. */
INTERNAL void compute_effort(Plant *plant, int rank);

#endif
