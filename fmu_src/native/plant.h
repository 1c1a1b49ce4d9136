/* The plant: the robot under its control law. */
#ifndef PLANT_H
#define PLANT_H

#include "internal.h"
#include "model.h"

/* All variables of the FMU by value reference: inputs, outputs (q and v are the state; x and tau
   are computed on demand) and parameters. Booleans are 0 or 1. */
typedef struct {
    double value[N_VARIABLES];
} Plant;

enum { N_STATES = 2 * N_JOINTS }; /* q and v are adjacent in the table, and so are their derivatives */

/* States of Model Exchange, and its event indicators, which a controller alone does not have. */
enum { N_CONTINUOUS = IS_CONTROLLER ? 0 : N_STATES, N_EVENTS = IS_CONTROLLER ? 0 : N_INDICATORS };

/* q̈ by the equations of motion at a state, with the given rank of J⁺. Joints slip in the given directions (−1, 1; 0 or
   NULL: no friction), and joints at rest are free. Returns the rank. The margin, which may be NULL, is negative if the
   singular values give another rank. */
INTERNAL int acceleration(const Plant *plant, const double q[N_JOINTS], const double v[N_JOINTS],
                          const int slip[N_JOINTS], int rank, double a[N_JOINTS], double *margin);

#ifndef IS_COMPLEX
/* q̈ with reactions that keep some joints at rest, and the reactions, which act on all joints; else as acceleration. */
INTERNAL void acceleration_at_rest(const Plant *plant, const double q[N_JOINTS], const double v[N_JOINTS],
                                   const int slip[N_JOINTS], int rank, const int rests[N_JOINTS],
                                   double a[N_JOINTS], double reaction[N_JOINTS], double *margin);
#endif

/* Compute the outputs x and xd, with an orientation quat and omega, and on request M, h, J and drift, at the plant's
   state. */
INTERNAL void compute_position(Plant *plant);

#ifndef IS_COMPLEX
/* a and λ of M(q) a = τ + λ, as in hybrid_dynamics. */
INTERNAL void hybrid_motion(const Plant *plant, const double q[N_JOINTS], const double armature[N_JOINTS],
                            const double free[N_JOINTS], const double given[N_JOINTS], double a[N_JOINTS],
                            double reaction[N_JOINTS]);
#endif

/* τ of the control law for a measured state, within effort limits, with the given rank of J⁺. */
INTERNAL void control_effort(const Plant *plant, const double q[N_JOINTS], const double v[N_JOINTS],
                             int rank, double tau[N_JOINTS]);

/* Compute the output tau, the applied control effort, at the plant's state and inputs, with the given rank of J⁺. The
   effort of a sampled controller is held and stays as it is. */
INTERNAL void compute_effort(Plant *plant, int rank);

#endif
