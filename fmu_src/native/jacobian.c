/* The derivatives of q̈ with respect to states and efforts together. From M q̈ + h = τ + λ, in the rows of joints that no
   reaction λ holds:

       M δq̈ = δτ − ∂ID(q, v, q̈)         ID(q, v, a) = M(q) a + h(q, v)
       δτ   = M̂ δq̈_cmd + ∂ÎD(q, v, q̈_cmd),  0 for an effort at its limit

   where M̂ and ÎD are those of the robot as its law knows it. If it knows all and no effort is limited, the difference of
   both ∂ID is that for the acceleration q̈ − q̈_cmd without velocity and gravity, and δq̈ contains δq̈_cmd.
   Source: Carpentier & Mansard, "Analytical derivatives of rigid body dynamics algorithms", RSS 2018. */
#include "directional.h"
#include "stops.h"

#include <math.h>
#include <string.h>

/* Terms of all bodies, and the mass matrix. */
typedef struct {
    JointMotion motion[N_BODIES];
    JointForce force[N_BODIES];
    double M[N_JOINTS][N_JOINTS];
} Dynamics;

static double dot_of(const double a[], const double b[], int count)
{
    double sum = 0.0;
    for (int k = 0; k < count; k++)
        sum += a[k] * b[k];
    return sum;
}

/* Compute the terms of inverse dynamics. */
static void compute_dynamics(const double value[N_VARIABLES], const JointPosition joint[N_BODIES], int as_known,
                             const double v[N_JOINTS], const double a[N_JOINTS], const double gravity[3],
                             Dynamics *all)
{
    EndBody end_body;
    body(value, as_known, &end_body);
    joint_forces(joint, &end_body, &value[ARMATURE], v, a, gravity, all->motion, all->force);
    memset(all->M, 0, sizeof all->M);
    for (int i = 0; i < N_JOINTS; i++)
        all->M[i][i] = value[ARMATURE + i];
    for (int i = 0; i < N_BODIES; i++)
        for (int j = i; j >= 0; j = PARENT[j]) {
            const double mass = RATIO[i] * RATIO[j] * dot_of(all->force[i].inertial, all->motion[j].s, 6);
            all->M[LEADER[i]][LEADER[j]] += mass;
            if (i != j)
                all->M[LEADER[j]][LEADER[i]] += mass;
        }
}

/* Add the weighted rows of ∂ID by q and v to slope. */
static void add_inverse_dynamics(const Dynamics *all, const double weight[N_JOINTS], double slope[N_JOINTS][X])
{
    for (int i = 0; i < N_BODIES; i++)
        for (int j = i; j >= 0; j = PARENT[j]) {
            const JointForce *f = &all->force[i];
            const JointMotion *m = &all->motion[j];
            const int r = LEADER[i], c = LEADER[j];
            const double row = RATIO[i] * RATIO[j] * weight[r], column = RATIO[i] * RATIO[j] * weight[c];
            slope[r][Q + c] += row * (2.0 * dot_of(f->coriolis, m->psi, 3) + dot_of(f->inertial, m->chi, 6));
            slope[r][V + c] += 2.0 * row * (dot_of(f->coriolis, m->s, 3) + dot_of(f->inertial, m->psi, 6));
            if (i == j)
                continue;
            slope[c][Q + r] += column * dot_of(f->by_q, m->s, 6);
            slope[c][V + r] += column * dot_of(f->by_v, m->s, 6);
        }
}

/* Add ∂(Jᵀ f)/∂q of the external force, with the Jacobian's columns J_i, which turn with the joints j before them. */
static void add_external_force(const double f[3], const JointMotion motion[N_BODIES], double slope[N_JOINTS][X])
{
    for (int i = END_BODY; i >= 0; i = PARENT[i])
        for (int j = i; j >= 0; j = PARENT[j]) {
            const double *z = motion[j].s, *J = &motion[i].s[3];
            const double turn = f[0] * (z[1] * J[2] - z[2] * J[1]) + f[1] * (z[2] * J[0] - z[0] * J[2])
                                + f[2] * (z[0] * J[1] - z[1] * J[0]);
            slope[LEADER[i]][Q + LEADER[j]] += RATIO[i] * RATIO[j] * turn;
            if (i != j)
                slope[LEADER[j]][Q + LEADER[i]] += RATIO[i] * RATIO[j] * turn;
        }
}

/* slope = M⁻¹ slope, from a column on, in the rows of free joints, with M = Lᵀ D L from the last joint inwards; 0 in the others. */
static void divide_by_mass(double M[N_JOINTS][N_JOINTS], const Stops *stops, int first, double slope[N_JOINTS][X])
{
    for (int k = N_JOINTS; k-- > 0;) {
        const double inverse = reacts(stops, k) ? 0.0 : 1.0 / M[k][k];
        for (int i = k; i-- > 0;) {
            const double share = M[k][i] * inverse;
            for (int j = 0; j <= i && share != 0.0; j++)
                M[i][j] -= share * M[k][j];
            for (int c = first; c < X && share != 0.0; c++)
                slope[i][c] -= share * slope[k][c];
            M[k][i] = share;
        }
        for (int c = first; c < X; c++)
            slope[k][c] *= inverse;
    }
    for (int k = 1; k < N_JOINTS; k++)
        for (int i = 0; i < k; i++)
            for (int c = first; c < X && M[k][i] != 0.0; c++)
                slope[k][c] -= M[k][i] * slope[i][c];
}

/* Add the derivatives of the law's result by states and, from a column on, inputs to slope. */
static void add_command(const double value[N_VARIABLES], const JointPosition joint[N_BODIES], const Stops *stops,
                        int first, const double given[N_JOINTS], const JointMotion motion[N_BODIES],
                        double slope[N_JOINTS][X])
{
    const int end = add_command_by_states(value, joint, motion, given, stops->rank, slope) ? Q : X;
    for (int k = first; k < end && COMMANDS_ACCELERATION; k++) {
        double change[X] = {0}, derivative[FIRST_PARAMETER];
        if (k >= TAU_EXT && k < F_EXT + 3)
            continue;
        change[k] = 1.0;
        differentiate(value, stops->held, stops->slip, stops->rank, WANTS_LAW, change, derivative);
        for (int i = 0; i < N_JOINTS; i++)
            slope[i][k] += derivative[DER_V + i];
    }
}

/* Set slope to δτ of the law for its result; acts receives 0 for efforts at their limit and else 1. Returns true, and
   slope stays 0, if δτ cancels except for δq̈_cmd. */
static int set_law(const double value[N_VARIABLES], const JointPosition joint[N_BODIES], const Stops *stops, int first,
                   const double given[N_JOINTS], double acts[N_JOINTS], Dynamics *all, double slope[N_JOINTS][X])
{
    double tau[N_JOINTS], column[N_JOINTS];
    int cancels = knows_all(value) && !any_reacts(stops);
    wanted_effort(value, joint, &value[V], given, tau);
    for (int i = 0; i < N_JOINTS; i++) {
        acts[i] = value[LIMIT_EFFORT] == 0.0 || fabs(tau[i]) <= EFFORT[i];
        cancels = cancels && acts[i] != 0.0;
    }
    if (cancels || !COMMANDS_ACCELERATION)
        return cancels;
    compute_dynamics(value, joint, 1, &value[V], given, &value[GRAVITY], all);
    add_command(value, joint, stops, first, given, all->motion, slope);
    for (int c = first; c < X; c++) {
        for (int i = 0; i < N_JOINTS; i++)
            column[i] = slope[i][c];
        for (int i = 0; i < N_JOINTS; i++)
            slope[i][c] = acts[i] * dot_of(all->M[i], column, N_JOINTS);
    }
    add_inverse_dynamics(all, acts, slope);
    return 0;
}

/* Set the columns of the parameters that are inputs to M ∂q̈ with constant reactions. */
static void add_free_parameters(const Plant *plant, const Stops *stops, const double reaction[N_JOINTS],
                                const Dynamics *all, double slope[N_JOINTS][X])
{
    const int moves[N_JOINTS] = {FREE};
    Plant acting = *plant;
    for (int i = 0; i < N_JOINTS; i++)
        acting.value[TAU_EXT + i] += reaction[i];
    for (int k = Q - N_FREE; k < Q; k++) {
        double change[X] = {0}, derivative[FIRST_PARAMETER];
        change[k] = 1.0;
        differentiate(acting.value, moves, stops->slip, stops->rank, WANTS_RATES, change, derivative);
        for (int i = 0; i < N_JOINTS; i++)
            slope[i][k] = dot_of(all->M[i], &derivative[DER_V], N_JOINTS);
    }
}

void acceleration_slopes(const Plant *plant, const Stops *stops, double slope[N_JOINTS][X])
{
    const double *value = plant->value, *v = &value[V], nothing[N_JOINTS + 3] = {0};
    double a[N_JOINTS], given[N_JOINTS], acts[N_JOINTS] = {0}, minus[N_JOINTS], reaction[N_JOINTS] = {0};
    JointPosition joint[N_BODIES];
    Dynamics all;
    Stops reacting = *stops;
    const int first = COMMANDS_ACCELERATION && any_reacts(stops) ? 0 : TAU_EXT;
    int clamped = 0, cancels = 0, deviates = 0;
    memset(slope, 0, N_JOINTS * sizeof *slope);
    for (int i = 0; i < N_JOINTS; i++) {
        reacting.held[i] = reacts(stops, i) ? stops->held[i] : FREE;
        clamped |= stops->held[i] == CLAMPED;
        minus[i] = -1.0;
    }
    place_joints(&value[Q], joint);
    memcpy(a, &value[DER_V], sizeof a);
    if (clamped || N_FREE) { /* for the other joints, a clamped joint moves on */
        acceleration(plant, &value[Q], v, slip_of(stops), stops->rank, a, NULL);
        restrain(plant, &reacting, &value[Q], a, reaction);
    }
    if (!is_held(value)) {
        command(value, joint, &value[Q], v, stops->rank, given, NULL);
        cancels = set_law(value, joint, stops, first, given, acts, &all, slope);
    }
    for (int i = 0; i < N_JOINTS && cancels; i++) {
        a[i] -= given[i];
        deviates |= a[i] != 0.0;
    }
    if (cancels && !deviates) {
        compute_dynamics(value, joint, 0, v, given, &value[GRAVITY], &all);
    } else {
        compute_dynamics(value, joint, 0, cancels ? nothing : v, a, cancels ? nothing : &value[GRAVITY], &all);
        add_inverse_dynamics(&all, minus, slope);
    }
    add_external_force(&value[F_EXT], all.motion, slope);
    for (int i = END_BODY; i >= 0; i = PARENT[i])
        for (int k = 0; k < 3; k++)
            slope[LEADER[i]][F_EXT + k] += RATIO[i] * all.motion[i].s[3 + k];
    for (int i = 0; i < N_JOINTS; i++) {
        slope[i][TAU_EXT + i] = 1.0;
        slope[i][V + i] -= value[DAMPING + i];
    }
    if (N_FREE)
        add_free_parameters(plant, stops, reaction, &all, slope);
    divide_by_mass(all.M, stops, first, slope);
    if (cancels && deviates)
        compute_dynamics(value, joint, 0, v, given, &value[GRAVITY], &all);
    if (cancels)
        add_command(value, joint, stops, first, given, all.motion, slope);
    for (int i = 0; i < N_JOINTS; i++) {
        if (stops->held[i])
            memset(slope[i], 0, sizeof slope[i]);
#if !COMMANDS_ACCELERATION
        for (int k = 0; k < N_JOINTS; k++)
            slope[i][TAU_CMD + k] = acts[k] * slope[i][TAU_EXT + k];
#endif
    }
}
