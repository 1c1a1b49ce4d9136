/* Orientations as unit quaternions x, y, z, w, the order of ROS. With the quaternion (a, w) of R_des Rᵀ, the error is 2
   atan2(|a|, w) a/|a|.
   Source: Siciliano, Sciavicco, Villani & Oriolo, "Robotics", 2009, sections 2.6 and 3.7.3. */
#include "internal.h"

#include <math.h>

/* The unit quaternion of a rotation matrix, w ≥ 0. */
INTERNAL void quaternion(double R[3][3], double q[4])
{
    const double trace = R[0][0] + R[1][1] + R[2][2];
    int i = 0; /* index of the axis' largest component */
    if (RE(R[1][1]) > RE(R[0][0]))
        i = 1;
    if (RE(R[2][2]) > RE(R[i][i]))
        i = 2;
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    if (RE(trace) > 0.0) { /* w is large enough to divide by */
        const double twice = sqrt(trace + 1.0);
        q[3] = 0.5 * twice;
        q[0] = (R[2][1] - R[1][2]) * 0.5 / twice;
        q[1] = (R[0][2] - R[2][0]) * 0.5 / twice;
        q[2] = (R[1][0] - R[0][1]) * 0.5 / twice;
    } else {
        const double twice = sqrt(R[i][i] - R[j][j] - R[k][k] + 1.0);
        q[i] = 0.5 * twice;
        q[j] = (R[j][i] + R[i][j]) * 0.5 / twice;
        q[k] = (R[k][i] + R[i][k]) * 0.5 / twice;
        q[3] = (R[k][j] - R[j][k]) * 0.5 / twice;
    }
    const double sign = RE(q[3]) < 0.0 ? -1.0 : 1.0;
    for (int c = 0; c < 4; c++)
        q[c] *= sign;
}

#ifdef HAS_QUAT_DES
/* log(R_des Rᵀ), the shortest rotation from R to R_des, rad about the root's axes, at most π. The target is the
   quaternion of R_des, of any length but 0. */
INTERNAL void rotation_error(const double target[4], double R[3][3], double error[3])
{
    double a[4], b[4], largest = 0.0;
    for (int c = 0; c < 4; c++)
        largest = fmax(largest, fabs(target[c]));
    for (int c = 0; c < 4; c++) /* scaling prevents overflow and underflow of the length */
        a[c] = target[c] / largest;
    quaternion(R, b);
    const double x = a[0] * b[3] - a[3] * b[0] - a[1] * b[2] + a[2] * b[1];
    const double y = a[1] * b[3] - a[3] * b[1] - a[2] * b[0] + a[0] * b[2];
    const double z = a[2] * b[3] - a[3] * b[2] - a[0] * b[1] + a[1] * b[0];
    const double w = a[3] * b[3] + a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const double sine = sqrt(x * x + y * y + z * z);
    const double angle = 2.0 * atan2(sine, fabs(w));
    const double factor = (RE(w) >= 0.0 ? 1.0 : -1.0) * (RE(sine) == 0.0 ? 2.0 : angle / sine);
    error[0] = factor * x;
    error[1] = factor * y;
    error[2] = factor * z;
}
#endif
