/* Recursive dynamics in link frames; each joint's axis is the z axis of its own. */
#include "dynamics.h"

#include <math.h>
#include <string.h>

#include "vector.h"

/* total += a point mass at d from the point that the inertia is about */
static void add_point(double inertia[3][3], double mass, const double d[3])
{
    for (int r = 0; r < 3; r++)
        for (int k = 0; k < 3; k++)
            inertia[r][k] += mass * ((r == k ? dot3(d, d) : 0.0) - d[r] * d[k]);
}

void load_carrier(double payload, const double place[3], Carrier *carrier)
{
    carrier->mass = MASS[CARRIER];
    memcpy(carrier->com, COM[CARRIER], sizeof carrier->com);
    memcpy(carrier->inertia, INERTIA[CARRIER], sizeof carrier->inertia);
    if (payload == 0.0)
        return;
    double from_body[3], from_load[3];
    carrier->mass += payload;
    for (int k = 0; k < 3; k++) {
        const double at = FRAME_P[k] + dot3(FRAME_R[k], place);
        carrier->com[k] = (MASS[CARRIER] * COM[CARRIER][k] + payload * at) / carrier->mass;
        from_body[k] = COM[CARRIER][k] - carrier->com[k];
        from_load[k] = at - carrier->com[k];
    }
    add_point(carrier->inertia, MASS[CARRIER], from_body);
    add_point(carrier->inertia, payload, from_load);
}

/* Newton–Euler, outwards the motion and inwards the forces, f and n at the joint's origin:

       f = m (a + α × c + ω × (ω × c)),   n = c × f + I α + ω × I ω

   Gravity enters as an acceleration of the root upwards.
   Source: Luh, Walker & Paul, "On-line computational scheme for mechanical manipulators",
   ASME J. Dyn. Sys. 102(2), 1980. */
void inverse_dynamics(Placement joint[N_BODIES], const Carrier *carrier, const double v[N_JOINTS],
                      const double a[N_JOINTS], const double gravity[3], double tau[N_JOINTS])
{
    const double still[3] = {0.0, 0.0, 0.0};
    const double lift[3] = {-gravity[0], -gravity[1], -gravity[2]};
    double omega[N_BODIES][3], alpha[N_BODIES][3], acc[N_BODIES][3];
    double f[N_BODIES][3], n[N_BODIES][3];
    for (int i = 0; i < N_BODIES; i++) {
        const int parent = PARENT[i];
        const double *omega_p = parent < 0 ? still : omega[parent];
        const double *alpha_p = parent < 0 ? still : alpha[parent];
        const double vi = rate(v, i), ai = rate(a, i);
        double linear[3], momentum[3] = {0.0, 0.0, 0.0};
        memcpy(linear, parent < 0 ? lift : acc[parent], sizeof linear);
        add_cross(linear, alpha_p, joint[i].p);
        add_centripetal(linear, omega_p, joint[i].p);
        rotate_back(acc[i], joint[i].R, linear);
        rotate_back(omega[i], joint[i].R, omega_p);
        rotate_back(alpha[i], joint[i].R, alpha_p);
        const double coriolis[2] = {omega[i][1] * vi, -omega[i][0] * vi}; /* ω_p × z v */
        if (PRISMATIC[i]) {
            acc[i][0] += 2.0 * coriolis[0];
            acc[i][1] += 2.0 * coriolis[1];
            acc[i][2] += ai;
        } else {
            alpha[i][0] += coriolis[0];
            alpha[i][1] += coriolis[1];
            alpha[i][2] += ai;
            omega[i][2] += vi;
        }
        const double *com = i == CARRIER ? carrier->com : COM[i];
        const double mass = i == CARRIER ? carrier->mass : MASS[i];
        memcpy(f[i], acc[i], sizeof f[i]);
        add_cross(f[i], alpha[i], com);
        add_centripetal(f[i], omega[i], com);
        for (int k = 0; k < 3; k++) {
            const double *row = i == CARRIER ? carrier->inertia[k] : INERTIA[i][k];
            f[i][k] *= mass;
            n[i][k] = dot3(row, alpha[i]);
            momentum[k] = dot3(row, omega[i]);
        }
        add_cross(n[i], omega[i], momentum);
        add_cross(n[i], com, f[i]);
    }
    memset(tau, 0, N_JOINTS * sizeof *tau);
    for (int i = N_BODIES - 1; i >= 0; i--) {
        const int parent = PARENT[i];
        add_to_leader(tau, i, PRISMATIC[i] ? f[i][2] : n[i][2]);
        if (parent >= 0) {
            double force[3] = {0.0, 0.0, 0.0};
            add_rotated(force, joint[i].R, f[i]);
            for (int k = 0; k < 3; k++)
                f[parent][k] += force[k];
            add_rotated(n[parent], joint[i].R, n[i]);
            add_cross(n[parent], joint[i].p, force);
        }
    }
}

#if N_BODIES > N_JOINTS

/* M(q)⁻¹ τ by Cholesky's decomposition of M(q), whose columns are what unit accelerations need. */
void acceleration_of_effort(Placement joint[N_BODIES], const Carrier *carrier,
                            const double tau[N_JOINTS], double a[N_JOINTS])
{
    const double zero[3] = {0.0, 0.0, 0.0}, still[N_JOINTS] = {0.0};
    double L[N_JOINTS][N_JOINTS];
    for (int k = 0; k < N_JOINTS; k++) {
        double unit[N_JOINTS] = {0.0};
        unit[k] = 1.0;
        inverse_dynamics(joint, carrier, still, unit, zero, L[k]);
    }
    for (int k = 0; k < N_JOINTS; k++) {
        for (int j = 0; j < k; j++)
            for (int i = k; i < N_JOINTS; i++)
                L[i][k] -= L[i][j] * L[k][j];
        const double root = sqrt(L[k][k]);
        for (int i = k; i < N_JOINTS; i++)
            L[i][k] /= root;
    }
    for (int i = 0; i < N_JOINTS; i++) {
        a[i] = tau[i];
        for (int k = 0; k < i; k++)
            a[i] -= L[i][k] * a[k];
        a[i] /= L[i][i];
    }
    for (int i = N_JOINTS - 1; i >= 0; i--) {
        for (int k = i + 1; k < N_JOINTS; k++)
            a[i] -= L[k][i] * a[k];
        a[i] /= L[i][i];
    }
}

#else

/* A spatial inertia: n = A α + B a and f = Bᵀ α + C a, at the origin of its frame. */
typedef struct {
    double A[3][3], B[3][3], C[3][3];
} Inertia;

/* The inertia of body i: A = I − m [c]×², B = m [c]×, C = m 1. */
static void body_inertia(int i, const Carrier *carrier, Inertia *inertia)
{
    const double m = i == CARRIER ? carrier->mass : MASS[i];
    const double *c = i == CARRIER ? carrier->com : COM[i], square = m * dot3(c, c);
    const double B[3][3] = {
        {0.0, -m * c[2], m * c[1]}, {m * c[2], 0.0, -m * c[0]}, {-m * c[1], m * c[0], 0.0}};
    for (int r = 0; r < 3; r++)
        for (int k = 0; k < 3; k++) {
            const double one = r == k ? 1.0 : 0.0;
            inertia->A[r][k] = (i == CARRIER ? carrier->inertia[r][k] : INERTIA[i][r][k])
                               + one * square - m * c[r] * c[k];
            inertia->B[r][k] = B[r][k];
            inertia->C[r][k] = one * m;
        }
}

/* S = R S Rᵀ */
static inline void rotate_matrix(double S[3][3], double R[3][3])
{
    double T[3][3];
    for (int r = 0; r < 3; r++)
        for (int k = 0; k < 3; k++)
            T[k][r] = dot3(S[r], R[k]); /* (S Rᵀ)ᵀ */
    for (int r = 0; r < 3; r++)
        for (int k = 0; k < 3; k++)
            S[r][k] = dot3(R[r], T[k]);
}

/* The same of a symmetric S. */
static inline void rotate_symmetric(double S[3][3], double R[3][3])
{
    double T[3][3];
    for (int r = 0; r < 3; r++)
        for (int k = 0; k < 3; k++)
            T[k][r] = dot3(S[r], R[k]);
    for (int r = 0; r < 3; r++)
        for (int k = 0; k <= r; k++)
            S[r][k] = S[k][r] = dot3(R[r], T[k]);
}

/* total += the inertia of a child, whose frame is placed at (R, p). With P = [p]× and rotated
   blocks: C,  G = B + P C,  A + P Bᵀ − G P. */
static void add_child(Inertia *total, Inertia *child, Placement *placement)
{
    const double *p = placement->p;
    rotate_symmetric(child->A, placement->R);
    rotate_matrix(child->B, placement->R);
    rotate_symmetric(child->C, placement->R);
    for (int k = 0; k < 3; k++) {
        double column[3] = {0.0, 0.0, 0.0}; /* of P C; C is symmetric */
        add_cross(column, p, child->C[k]);
        double PBt[3] = {0.0, 0.0, 0.0};    /* column k of P Bᵀ is p × row k of B */
        add_cross(PBt, p, child->B[k]);
        for (int r = 0; r < 3; r++) {
            total->C[r][k] += child->C[r][k];
            total->A[r][k] += child->A[r][k] + PBt[r];
            total->B[r][k] += child->B[r][k] + column[r];
            child->A[r][k] = column[r];
        }
    }
    for (int r = 0; r < 3; r++) { /* row r of G P is row r of G, × p */
        const double G[3] = {child->B[r][0] + child->A[r][0], child->B[r][1] + child->A[r][1],
                             child->B[r][2] + child->A[r][2]};
        add_cross(total->A[r], p, G); /* − G × p */
    }
}

/* Articulated bodies, without velocities and gravity: inwards the inertias that a joint feels,

       U = I s,  D = sᵀ U,  u = τ − sᵀ b,  I − U Uᵀ/D,  b + U u/D  to the parent,

   outwards the accelerations q̈ = (u − Uᵀ a)/D.
   Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 7.3. */
void acceleration_of_effort(Placement joint[N_BODIES], const Carrier *carrier,
                            const double tau[N_JOINTS], double a[N_JOINTS])
{
    Inertia body[N_JOINTS];
    double bias[N_JOINTS][2][3], U[N_JOINTS][2][3], motion[N_JOINTS][2][3]; /* angular, linear */
    double D_inverse[N_JOINTS], u[N_JOINTS];
    memset(bias, 0, sizeof bias);
    for (int i = 0; i < N_JOINTS; i++)
        body_inertia(i, carrier, &body[i]);
    for (int i = N_JOINTS - 1; i >= 0; i--) {
        Inertia *inertia = &body[i];
        for (int k = 0; k < 3; k++) {
            U[i][0][k] = PRISMATIC[i] ? inertia->B[k][2] : inertia->A[k][2];
            U[i][1][k] = PRISMATIC[i] ? inertia->C[k][2] : inertia->B[2][k];
        }
        D_inverse[i] = 1.0 / U[i][PRISMATIC[i]][2];
        u[i] = tau[i] - bias[i][PRISMATIC[i]][2];
        const int parent = PARENT[i];
        if (parent < 0)
            continue;
        for (int k = 0; k < 3; k++) {
            const double angular = U[i][0][k] * D_inverse[i], linear = U[i][1][k] * D_inverse[i];
            for (int j = 0; j < 3; j++) {
                inertia->A[k][j] -= angular * U[i][0][j];
                inertia->B[k][j] -= angular * U[i][1][j];
                inertia->C[k][j] -= linear * U[i][1][j];
            }
            bias[i][0][k] += angular * u[i];
            bias[i][1][k] += linear * u[i];
        }
        double force[3] = {0.0, 0.0, 0.0};
        add_rotated(force, joint[i].R, bias[i][1]);
        for (int k = 0; k < 3; k++)
            bias[parent][1][k] += force[k];
        add_rotated(bias[parent][0], joint[i].R, bias[i][0]);
        add_cross(bias[parent][0], joint[i].p, force);
        add_child(&body[parent], inertia, &joint[i]);
    }
    for (int i = 0; i < N_JOINTS; i++) {
        const int parent = PARENT[i];
        memset(motion[i], 0, sizeof motion[i]);
        if (parent >= 0) {
            double linear[3];
            memcpy(linear, motion[parent][1], sizeof linear);
            add_cross(linear, motion[parent][0], joint[i].p);
            rotate_back(motion[i][0], joint[i].R, motion[parent][0]);
            rotate_back(motion[i][1], joint[i].R, linear);
        }
        a[i] = (u[i] - dot3(U[i][0], motion[i][0]) - dot3(U[i][1], motion[i][1])) * D_inverse[i];
        motion[i][PRISMATIC[i]][2] += a[i];
    }
}

#endif
