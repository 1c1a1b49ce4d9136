/* Kinematics and dynamics of the robot, which mechanism.c, generated from its URDF, computes. Joints that mimic others
   follow them there; all other files know the independent joints only. */
#ifndef MECHANISM_H
#define MECHANISM_H

#include "internal.h"
#include "model.h"

/* Always false, but not known to the compiler: branches on it end basic blocks of mechanism.c. */
static inline int never(void)
{
    static const volatile int no = 0;
    return no;
}

/* Position of a joint: cosine and sine of its angle; for a prismatic joint, c is the displacement. */
typedef struct {
    double c, s;
} JointPosition;

/* The task frame in the root's axes. Rows are the task axes, and with an orientation the rotations about x, y and z. */
typedef struct {
    double x[N_AXES];           /* position, m */
    double J[N_ROWS][N_JOINTS]; /* Jacobian */
    double xd[N_ROWS];          /* velocity J v, m/s and rad/s */
    double drift[N_ROWS];       /* J̇ v, the acceleration for q̈ = 0, m/s2 and rad/s2 */
#if N_ROWS > N_AXES
    double R[3][3];             /* orientation */
#endif
} TaskFrame;

/* A body; the end body carries the task frame, with its payload: mass, mass times centre, and inertia
   about the frame of its joint: xx, xy, yy, xz, yz, zz. Where links have inertias that are inputs, the end body is the
   first of an array, and the others are the bodies that depend on these. */
typedef struct {
    double mass, moment[3], inertia[6];
} EndBody;

#ifdef N_LINK_VALUES
enum { N_LOADED = N_BODIES, LINK_VALUES = Q - N_LINK_VALUES }; /* the last inputs are those of links */
#else
enum { N_LOADED = 1 };
#endif

/* The position of a revolute joint. */
INTERNAL JointPosition turn(double angle);

INTERNAL void place_joints(const double q[N_JOINTS], JointPosition joint[N_BODIES]);

/* The task frame at the velocity v. */
INTERNAL void task_frame(const JointPosition joint[N_BODIES], const double v[N_JOINTS],
                         TaskFrame *task);

/* τ = Jᵀ f, the joint efforts of a force at the task frame, N, in the root's axes. */
INTERNAL void effort_of_force(const JointPosition joint[N_BODIES], const double force[3],
                              double tau[N_JOINTS]);

/* The end_body with a point mass, kg, at an offset in the task frame, m, and all bodies with the values of links. */
#ifdef N_LINK_VALUES
INTERNAL void load_bodies(double payload, const double offset[3], const double link[N_LINK_VALUES], EndBody *end_body);
#else
INTERNAL void load_end_body(double payload, const double offset[3], EndBody *end_body);
#endif

/* τ = M(q) a + h(q, v), joint efforts in N·m or N. Gravity is in the root's axes, m/s2. The diagonal of M includes the
   armature, kg·m2 or kg. */
INTERNAL void inverse_dynamics(const JointPosition joint[N_BODIES], const EndBody *end_body,
                               const double armature[N_JOINTS], const double v[N_JOINTS],
                               const double a[N_JOINTS], const double gravity[3],
                               double tau[N_JOINTS]);

/* Upper bounds of |τ|, except for rounding; they take fewer operations than τ for robots of several joints. */
INTERNAL void effort_bounds(const JointPosition joint[N_BODIES], const EndBody *end_body,
                            const double armature[N_JOINTS], const double v[N_JOINTS],
                            const double a[N_JOINTS], const double gravity[3],
                            double bound[N_JOINTS]);

/* a and λ of M(q) a = τ + λ. For free joints (1), τ is given and λ is 0; for the others (0), a is given and τ is 0.
   Derivatives do not need it. */
#ifndef IS_COMPLEX
INTERNAL void hybrid_dynamics(const JointPosition joint[N_BODIES], const EndBody *end_body,
                              const double armature[N_JOINTS], const double free[N_JOINTS],
                              const double given[N_JOINTS], double a[N_JOINTS],
                              double reaction[N_JOINTS]);
#endif

/* Derivatives of kinematics and dynamics by spatial vectors in the root's axes about the task frame's origin (angular,
   linear; of forces moment, force). At a body's joint: its velocity s at the unit velocity of the joint that it follows,
   ψ = v × s, χ = a × s + v × ψ, where v and a are the motion of the body before it; the motion, the axes and the origin
   of its own body. */
typedef struct {
    double s[6], psi[6], chi[6], velocity[6], acceleration[6], R[3][3], origin[3];
} JointMotion;

/* Constants of a joint: its frame at 0 in that of the body before it, and the ratios of its rotation and of its
   translation to the joint that it follows. */
typedef struct {
    double R[3][3], p[3], ratio[2];
} JointFrame;

/* Terms of all bodies that a joint moves: I s, and the angular part of Bᵀ s, whose linear part is 0. by_q·x and by_v·x
   are the derivatives of their effort on a joint before it, whose motion is x, with respect to q and v. */
typedef struct {
    double coriolis[3], inertial[6], by_q[6], by_v[6];
} JointForce;

/* Sums over all bodies that a joint moves: mass, first moment, inertia, momentum, Coriolis matrix and wrench. */
typedef struct {
    double mass, moment[3], inertia[6], p[3], B[3][3], f[6];
} Load;

#ifndef IS_COMPLEX
/* Set a joint's axes and origin in the root's axes, by its cosine, sine and displacement. */
INTERNAL void joint_frame(const JointFrame *frame, const double position[3], const JointMotion *before,
                          JointMotion *motion);

/* Set the rest of a joint's motion by its velocity and acceleration. */
INTERNAL void joint_motion(const JointFrame *frame, const double rate[2], const JointMotion *before,
                           JointMotion *motion);

/* Compute a joint's terms and load from its body and the load beyond it; joint_force_at_rest does so for v = 0. */
typedef void JointTerms(const EndBody *body, const JointMotion *motion, const Load *beyond, Load *load,
                        JointForce *force);
INTERNAL JointTerms joint_force, joint_force_at_rest;

static inline void cross(const double a[3], const double b[3], double result[3])
{
    result[0] = a[1] * b[2] - a[2] * b[1];
    result[1] = a[2] * b[0] - a[0] * b[2];
    result[2] = a[0] * b[1] - a[1] * b[0];
}

/* sum += factor (m × s) of two spatial motions. */
static inline void add_motion_cross(const double m[6], const double s[6], double factor, double sum[6])
{
    double angular[3], linear[3], further[3];
    cross(m, s, angular);
    cross(m, s + 3, linear);
    cross(m + 3, s, further);
    for (int k = 0; k < 3; k++) {
        sum[k] += factor * angular[k];
        sum[3 + k] += factor * (linear[k] + further[k]);
    }
}

/* M(q), with the armature. */
INTERNAL void mass_matrix(const JointPosition joint[N_BODIES], const EndBody *end_body,
                          const double armature[N_JOINTS], double M[N_JOINTS][N_JOINTS]);
#endif

/* a = M(q)⁻¹ τ, the accelerations that efforts cause beyond those of h(q, v). */
INTERNAL void acceleration_of_effort(const JointPosition joint[N_BODIES], const EndBody *end_body,
                                     const double armature[N_JOINTS], const double tau[N_JOINTS],
                                     double a[N_JOINTS]);

#endif
