/* Kinematics of the robot's joints and of its task frame. */
#ifndef KINEMATICS_H
#define KINEMATICS_H

#include "internal.h"
#include "model.h"

/* Placement of a joint's frame in its parent's: a = R b + p. Each joint turns about, or slides
   along, the z axis of its frame. */
typedef struct {
    double R[3][3];
    double p[3];
} Placement;

/* The task frame, in the root's axes and along the task axes only. */
typedef struct {
    double x[N_AXES];               /* position, m */
    double xd[N_AXES];              /* velocity, m/s */
    double J[N_AXES][N_JOINTS];     /* Jacobian, so that ẋ = J v */
    double drift[N_AXES];           /* J̇ v, the acceleration where q̈ = 0, m/s2 */
    double column[N_JOINTS][3];     /* of the Jacobian of all three axes */
} TaskFrame;

/* Placements of all joints at the position q. */
INTERNAL void place_joints(const double q[N_JOINTS], Placement joint[N_JOINTS]);

/* The task frame at the velocity v. */
INTERNAL void task_frame(Placement joint[N_JOINTS], const double v[N_JOINTS], TaskFrame *task);

#endif
