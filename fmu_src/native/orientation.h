/* Orientations as ROS has them: unit quaternions x, y, z, w. */
#ifndef ORIENTATION_H
#define ORIENTATION_H

#include "internal.h"

/* The unit quaternion of a rotation matrix, w ≥ 0. */
INTERNAL void quaternion(double R[3][3], double q[4]);

/* log(R_des Rᵀ), rad about the root's axes: the short way from R to R_des, at most π. The target is
   the quaternion of R_des, not 0, of any length. */
INTERNAL void rotation_error(const double target[4], double R[3][3], double error[3]);

#endif
