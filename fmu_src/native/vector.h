/* Vectors of three and rotations, as plain arrays. */
#ifndef VECTOR_H
#define VECTOR_H

static inline double dot3(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* sum += a × b */
static inline void add_cross(double sum[3], const double a[3], const double b[3])
{
    sum[0] += a[1] * b[2] - a[2] * b[1];
    sum[1] += a[2] * b[0] - a[0] * b[2];
    sum[2] += a[0] * b[1] - a[1] * b[0];
}

/* sum += ω × (ω × r), the centripetal acceleration of a point at r */
static inline void add_centripetal(double sum[3], const double omega[3], const double r[3])
{
    double velocity[3] = {0.0, 0.0, 0.0};
    add_cross(velocity, omega, r);
    add_cross(sum, omega, velocity);
}

/* sum += R a */
static inline void add_rotated(double sum[3], double R[3][3], const double a[3])
{
    for (int i = 0; i < 3; i++)
        sum[i] += R[i][0] * a[0] + R[i][1] * a[1] + R[i][2] * a[2];
}

/* result = Rᵀ a */
static inline void rotate_back(double result[3], double R[3][3], const double a[3])
{
    for (int i = 0; i < 3; i++)
        result[i] = R[0][i] * a[0] + R[1][i] * a[1] + R[2][i] * a[2];
}

#endif
