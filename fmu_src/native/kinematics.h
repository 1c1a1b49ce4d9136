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

/* The task frame in the root's axes. Rows 0 to 2 are of its origin, rows 3 to 5 of its turning. */
typedef struct {
    double x[3];            /* position, m */
    double R[3][3];         /* orientation */
    double J[6][N_JOINTS];  /* Jacobian: the velocity is J v, m/s and rad/s */
    double drift[6];        /* J̇ v, the acceleration where q̈ = 0, m/s2 and rad/s2 */
} TaskFrame;

/* How fast joint i moves: those that mimic another follow it. N_JOINTS of the N_BODIES joints move
   on their own; what is done to these alone has N_JOINTS values. */
static inline double rate(const double v[N_JOINTS], int i)
{
#if N_BODIES > N_JOINTS
    return RATIO[i] * v[LEADER[i]];
#else
    return v[i];
#endif
}

/* Add to the joint that moves joint i what this contributes. */
static inline void add_to_leader(double sum[N_JOINTS], int i, double value)
{
#if N_BODIES > N_JOINTS
    sum[LEADER[i]] += RATIO[i] * value;
#else
    sum[i] += value;
#endif
}

/* Placements of all joints at the position q. */
INTERNAL void place_joints(const double q[N_JOINTS], Placement joint[N_BODIES]);

/* The task frame at the velocity v. */
INTERNAL void task_frame(Placement joint[N_BODIES], const double v[N_JOINTS], TaskFrame *task);

#endif
