/* The derivatives of q̈ with respect to states and efforts together. From M q̈ + h = τ + λ, in the rows of joints that no
   reaction λ holds:

       M δq̈ = δτ − ∂ID(q, v, q̈)         ID(q, v, a) = M(q) a + h(q, v)
       δτ   = M̂ δq̈_cmd + ∂ÎD(q, v, q̈_cmd),  0 for an effort at its limit

   where M̂ and ÎD are those of the robot as its law knows it. If the law knows the whole robot and no effort is limited,
   the difference of both ∂ID is that for the acceleration q̈ − q̈_cmd without velocity and gravity, and δq̈ contains
   δq̈_cmd.
   Source: Carpentier & Mansard, "Analytical derivatives of rigid body dynamics algorithms", RSS 2018. */
#include "control.h"
#include "directional.h"
#include "stops.h"

#include <math.h>
#include <string.h>

static double dot_of(const double a[], const double b[], int count)
{
    double sum = 0.0;
    for (int k = 0; k < count; k++)
        sum += a[k] * b[k];
    return sum;
}

/* Add the products of M with the vectors b from first to before end to those of sum, except those of tau_ext. */
static void add_products(Matrix M, double b[X][N_JOINTS], int first, int end, double sum[X][N_JOINTS])
{
    for (int c = first; c < end; c++) {
        double product[N_JOINTS];
        if (c >= TAU_EXT && c < F_EXT)
            continue;
        memcpy(product, sum[c], sizeof product);
        for (int k = 0; k < N_JOINTS; k++)
            for (int i = 0; i < N_JOINTS; i++)
                product[i] += M[k][i] * b[c][k];
        memcpy(sum[c], product, sizeof product);
    }
}

/* Compute the motions of all joints, from the root outwards. Gravity is an upward acceleration of the root. */
static void joint_motions(const JointPosition joint[N_BODIES], const double v[N_JOINTS], const double a[N_JOINTS],
                          const double gravity[3], JointMotion motion[N_BODIES])
{
    const JointMotion root = {.acceleration = {0.0, 0.0, 0.0, -gravity[0], -gravity[1], -gravity[2]},
                              .R = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}}};
    double x[3];
    for (int i = 0; i < N_BODIES; i++) {
        const double revolute[3] = {joint[i].c, joint[i].s, 0.0}, slid[3] = {1.0, 0.0, joint[i].c};
        const JointMotion *before = PARENT[i] < 0 ? &root : &motion[PARENT[i]];
        joint_frame(&FRAME[i], FRAME[i].ratio[1] == 0.0 ? revolute : slid, before, &motion[i]);
    }
    for (int k = 0; k < 3; k++)
        x[k] = motion[END_BODY].origin[k] + dot_of(motion[END_BODY].R[k], END_P, 3);
    for (int i = 0; i < N_BODIES; i++) {
        const double rate[2] = {v[LEADER[i]], a[LEADER[i]]};
        for (int k = 0; k < 3; k++)
            motion[i].origin[k] -= x[k];
        joint_motion(&FRAME[i], rate, PARENT[i] < 0 ? &root : &motion[PARENT[i]], &motion[i]);
    }
}

/* Compute the terms of all joints, from the last one inwards. */
static void joint_forces(JointTerms *terms, const EndBody *end_body, const JointMotion motion[N_BODIES],
                         JointForce force[N_BODIES])
{
    enum { SIZE = sizeof(Load) / sizeof(double) };
    Load beyond[N_BODIES] = {{0}}, load;
    for (int i = N_BODIES; i-- > 0;) {
        terms(LOADED[i] < 0 ? &BODY[i] : &end_body[LOADED[i]], &motion[i], &beyond[i], &load, &force[i]);
        for (int k = 0; k < SIZE && PARENT[i] >= 0; k++)
            ((double *)&beyond[PARENT[i]])[k] += ((double *)&load)[k];
    }
}

/* Change χ and the accelerations to those at rest without gravity. */
static void bring_to_rest(const double a[N_JOINTS], JointMotion motion[N_BODIES])
{
    static const double root[6];
    for (int i = 0; i < N_BODIES; i++) {
        JointMotion *m = &motion[i];
        const double *before = PARENT[i] < 0 ? root : motion[PARENT[i]].acceleration;
        memset(m->chi, 0, sizeof m->chi);
        add_motion_cross(before, m->s, 1.0, m->chi);
        for (int k = 0; k < 6; k++)
            m->acceleration[k] = before[k] + m->s[k] * a[LEADER[i]];
    }
}

/* Add the weighted rows of ∂ID with respect to q and, unless at rest, v to slope. */
static void add_inverse_dynamics(const JointMotion motion[N_BODIES], const JointForce force[N_BODIES], int at_rest,
                                 const double weight[N_JOINTS], double slope[X][N_JOINTS])
{
    for (int i = 0; i < N_BODIES; i++)
        for (int j = i; j >= 0; j = PARENT[j]) {
            const JointForce *f = &force[i];
            const JointMotion *m = &motion[j];
            const int r = LEADER[i], c = LEADER[j];
            slope[Q + c][r] += weight[r] * (2.0 * dot_of(f->coriolis, m->psi, 3) + dot_of(f->inertial, m->chi, 6));
            if (i != j)
                slope[Q + r][c] += weight[c] * dot_of(f->by_q, m->s, 6);
            if (at_rest)
                continue;
            slope[V + c][r] += weight[r] * 2.0 * (dot_of(f->coriolis, m->s, 3) + dot_of(f->inertial, m->psi, 6));
            if (i != j)
                slope[V + r][c] += weight[c] * dot_of(f->by_v, m->s, 6);
        }
}

/* The Jacobian's columns J_i rotate with the joints j before them. */
static void add_force(const double f[3], const JointMotion motion[N_BODIES], Matrix slope)
{
    for (int j = END_BODY; j >= 0; j = PARENT[j]) {
        const double *z = motion[j].s;
        const double moment[3] = {f[1] * z[2] - f[2] * z[1], f[2] * z[0] - f[0] * z[2], f[0] * z[1] - f[1] * z[0]};
        for (int i = END_BODY; i >= j; i = PARENT[i]) {
            const double turn = dot_of(moment, &motion[i].s[3], 3);
            slope[LEADER[i]][LEADER[j]] += turn;
            if (i != j)
                slope[LEADER[j]][LEADER[i]] += turn;
        }
    }
}

/* Invert M in the rows and columns of free joints, by Gauss and Jordan; the others become 0. */
static void invert_mass(Matrix M, const Stops *stops)
{
    for (int k = N_JOINTS; k-- > 0;) {
        const double inverse = reacts(stops, k) ? 0.0 : 1.0 / M[k][k];
        double row[N_JOINTS];
        for (int j = 0; j < N_JOINTS; j++) {
            row[j] = j == k ? inverse : M[k][j] * inverse;
            M[k][j] = 0.0;
        }
        for (int i = 0; i < N_JOINTS; i++) {
            const double share = M[i][k];
            M[i][k] = 0.0;
            for (int j = 0; j < N_JOINTS; j++)
                M[i][j] -= share * row[j];
        }
        memcpy(M[k], row, sizeof row);
    }
}

/* Add the derivatives of the law's result with respect to states, and inputs from column `first` on, to slope. */
static void add_command(const double value[N_VARIABLES], const JointPosition joint[N_BODIES], const Stops *stops,
                        int first, const double given[N_JOINTS], const JointMotion motion[N_BODIES],
                        double slope[X][N_JOINTS])
{
    const int by_states = add_command_by_states(value, joint, motion, given, stops->rank, slope);
    for (int k = first; k < X; k++) {
        if (k >= TAU_EXT && (by_states || k < F_EXT + 3 || (k >= Q - N_FREE && k < Q)))
            continue;
        double change[X] = {0}, derivative[FIRST_PARAMETER];
        change[k] = 1.0;
        differentiate(value, stops->held, stops->slip, stops->rank, WANTS_LAW, change, derivative);
        for (int i = 0; i < N_JOINTS; i++)
            slope[k][i] += derivative[DER_V + i];
    }
}

/* Set acts to 0 for efforts of the law at their limit and else to 1. Return true if none is. */
static int all_act(const double value[N_VARIABLES], const JointPosition joint[N_BODIES], const double given[N_JOINTS],
                   double acts[N_JOINTS])
{
    const int limited = value[LIMIT_EFFORT] != 0.0;
    double tau[N_JOINTS] = {0};
    int all = 1;
    if (limited)
        wanted_effort(value, joint, &value[V], given, tau);
    for (int i = 0; i < N_JOINTS; i++) {
        acts[i] = !limited || fabs(tau[i]) <= EFFORT[i];
        all = all && acts[i] != 0.0;
    }
    return all;
}

/* Add δτ of a law for its acceleration `given`, by the model that it knows, to slope. */
static void add_law(const double value[N_VARIABLES], const JointPosition joint[N_BODIES], const Stops *stops, int first,
                    const double given[N_JOINTS], const double acts[N_JOINTS], double slope[X][N_JOINTS])
{
    double change[X][N_JOINTS] = {{0}};
    JointMotion motion[N_BODIES];
    JointForce force[N_BODIES];
    EndBody known[N_LOADED];
    Matrix M;
    body(value, 1, known);
    joint_motions(joint, &value[V], given, &value[GRAVITY], motion);
    joint_forces(joint_force, known, motion, force);
    add_inverse_dynamics(motion, force, 0, acts, slope);
    add_command(value, joint, stops, first, given, motion, change);
    mass_matrix(joint, known, &value[ARMATURE], M);
    for (int i = 0; i < N_JOINTS; i++)
        for (int k = 0; k < N_JOINTS; k++)
            M[k][i] *= acts[i];
    add_products(M, change, first, X, slope);
}

/* Set the columns of the parameters that are inputs to M ∂q̈ with constant reactions. */
static void add_free_parameters(const Plant *plant, const Stops *stops, const double reaction[N_JOINTS], Matrix M,
                                double slope[X][N_JOINTS])
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
            slope[k][i] = dot_of(M[i], &derivative[DER_V], N_JOINTS);
    }
}

/* Add ∂(Jᵀ f) of the external force with respect to q and f to slope; return false if ∂(Jᵀ f)/∂q is 0. */
static int add_external_force(const double f[3], const JointMotion motion[N_BODIES], double slope[X][N_JOINTS])
{
    Matrix rotated = {{0}};
    for (int i = END_BODY; i >= 0; i = PARENT[i])
        for (int k = 0; k < 3; k++)
            slope[F_EXT + k][LEADER[i]] += motion[i].s[3 + k];
    if (f[0] == 0.0 && f[1] == 0.0 && f[2] == 0.0)
        return 0;
    add_force(f, motion, rotated);
    for (int i = 0; i < N_JOINTS; i++)
        for (int k = 0; k < N_JOINTS; k++)
            slope[Q + k][i] += rotated[i][k];
    return 1;
}

/* Set slope to the part of δq̈ that no effort causes, and effort to the M δq̈ of all efforts but tau_ext and damping.
   a is the acceleration on which reactions act. Returns false if no effort depends on q and v. */
static int set_efforts(const double value[N_VARIABLES], const JointPosition joint[N_BODIES], const Stops *stops,
                       const EndBody *end_body, int first, double a[N_JOINTS], double acts[N_JOINTS],
                       double slope[X][N_JOINTS], double effort[X][N_JOINTS])
{
    const double *v = &value[V];
    double given[N_JOINTS], minus[N_JOINTS];
    JointMotion motion[N_BODIES];
    JointForce force[N_BODIES];
    int cancels = 0, moves = 1;
    if (!is_held(value)) {
        command(value, joint, &value[Q], v, stops->rank, given, NULL);
        cancels = all_act(value, joint, given, acts) && knows_all(value) && !any_reacts(stops);
        if (cancels) {
            joint_motions(joint, v, given, &value[GRAVITY], motion);
            add_command(value, joint, stops, first, given, motion, slope);
        } else if (COMMANDS_ACCELERATION) {
            add_law(value, joint, stops, first, given, acts, effort);
        }
    }
    for (int i = 0; i < N_JOINTS; i++)
        minus[i] = -1.0;
    for (int i = 0; i < N_JOINTS && cancels; i++) {
        moves = (i > 0 && moves) || a[i] != given[i];
        a[i] -= given[i];
    }
    if (moves) {
        if (cancels)
            bring_to_rest(a, motion);
        else
            joint_motions(joint, v, a, &value[GRAVITY], motion);
        joint_forces(cancels ? joint_force_at_rest : joint_force, end_body, motion, force);
        add_inverse_dynamics(motion, force, cancels, minus, effort);
    }
    return add_external_force(&value[F_EXT], motion, effort) || moves;
}

/* The derivatives of q̈ with respect to efforts and states, and with reactions also to inputs of the law: a row for each
   variable, by its index, at a plant with the derivatives of compute_rates. */
INTERNAL void acceleration_slopes(const Plant *plant, const Stops *stops, double slope[X][N_JOINTS])
{
    const double *value = plant->value, *v = &value[V];
    double a[N_JOINTS], acts[N_JOINTS] = {0}, reaction[N_JOINTS] = {0}, effort[X][N_JOINTS];
    JointPosition joint[N_BODIES];
    EndBody end_body[N_LOADED];
    Matrix M;
    Stops reacting = *stops;
    int clamped = 0;
    const int first = COMMANDS_ACCELERATION && any_reacts(stops) ? 0 : TAU_EXT;
    memset(slope[first], 0, (X - first) * sizeof *slope);
    memset(effort[first], 0, (X - first) * sizeof *effort);
    for (int i = 0; i < N_JOINTS; i++) {
        reacting.held[i] = reacts(stops, i) ? stops->held[i] : FREE;
        clamped |= stops->held[i] == CLAMPED;
    }
    place_joints(&value[Q], joint);
    memcpy(a, &value[DER_V], sizeof a);
    if (clamped || N_FREE) { /* for the other joints, a clamped joint moves on */
        acceleration(plant, &value[Q], v, slip_of(stops), stops->rank, a, NULL);
        restrain(plant, &reacting, &value[Q], a, reaction);
    }
    body(value, 0, end_body);
    const int moves = set_efforts(value, joint, stops, end_body, first, a, acts, slope, effort);
    mass_matrix(joint, end_body, &value[ARMATURE], M);
    if (N_FREE)
        add_free_parameters(plant, stops, reaction, M, effort);
    invert_mass(M, stops);
    add_products(M, effort, first, moves ? X : Q, slope);
    for (int k = 0; k < N_JOINTS; k++)
        for (int i = 0; i < N_JOINTS; i++) {
            slope[TAU_EXT + k][i] = M[k][i];
            slope[V + k][i] -= M[k][i] * value[DAMPING + k];
#if !COMMANDS_ACCELERATION
            slope[TAU_CMD + k][i] = acts[k] * M[k][i];
#endif
        }
    for (int i = 0; i < N_JOINTS; i++)
        for (int c = 0; c < X && stops->held[i]; c++)
            slope[c][i] = 0.0;
}
