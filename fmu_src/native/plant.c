/* The plant's motion under its control law:

       τ = M̂(q) q̈_cmd + ĥ(q, v), or as the law gives it
       q̈ = M(q)⁻¹ (sat(τ) + tau_ext + Jᵀ f_ext − D v − F s − h(q, v))
         = a + M(q)⁻¹ (sat(τ) + tau_ext + Jᵀ f_ext − D v − F s − (M(q) a + h(q, v)))

   for any a, where s are the directions in which joints slip against their friction F. With a = q̈_cmd, the dynamics
   cancel where nothing acts but an unlimited τ, and where M̂ = M and ĥ = h: a payload is in M and h, and in M̂ and ĥ
   where it is known; the armature is in both. Links whose masses are inputs have the URDF's values in M̂ and ĥ. */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "control.h"
#include "mechanism.h"

/* All variables of the FMU by value reference: inputs, outputs (q and v are the state; x and tau
   are computed on demand) and parameters. Booleans are 0 or 1. */
typedef struct {
    double value[N_VARIABLES];
} Plant;

enum { N_STATES = 2 * N_JOINTS }; /* q and v are adjacent in the table, as are their derivatives */

/* States of Model Exchange, and its event indicators, which a controller alone does not have. */
enum { N_CONTINUOUS = IS_CONTROLLER ? 0 : N_STATES, N_EVENTS = IS_CONTROLLER ? 0 : N_INDICATORS };

static double saturated(double tau, double limit)
{
    return RE(tau) > RE(limit) ? limit : RE(tau) < -RE(limit) ? -limit : tau;
}

/* The true robot, or the robot as its control law knows it, which has the URDF's links. */
static void body(const double value[N_VARIABLES], int as_known, EndBody end_body[N_LOADED])
{
    double payload = value[PAYLOAD];
#if COMMANDS_ACCELERATION
    if (as_known && value[PAYLOAD_KNOWN] == 0.0)
        payload = 0.0;
#else
    (void)as_known;
#endif
#ifdef N_LINK_VALUES
    double link[N_LINK_VALUES];
    for (int i = 0; i < N_LINK_VALUES; i++)
        link[i] = as_known ? LINK_KNOWN[i] : value[LINK_VALUES + i];
    load_bodies(payload, &value[PAYLOAD_COM], link, end_body);
#else
    load_end_body(payload, &value[PAYLOAD_COM], end_body);
#endif
}

/* True if a sampled controller holds the effort, which is then the output tau. */
static int is_held(const double value[N_VARIABLES])
{
    return value[CONTROL_PERIOD] != 0.0;
}

/* True if the law's model equals the robot, so that the commanded acceleration is the actual one. */
static int knows_all(const double value[N_VARIABLES])
{
#if COMMANDS_ACCELERATION
#ifdef N_LINK_VALUES
    for (int i = 0; i < N_LINK_VALUES; i++)
        if (value[LINK_VALUES + i] != LINK_KNOWN[i])
            return 0;
#endif
    return !is_held(value) && (value[PAYLOAD] == 0.0 || value[PAYLOAD_KNOWN] != 0.0);
#else
    (void)value;
    return 0;
#endif
}

/* τ for the result of the law, without limits. */
static void wanted_effort(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
                          const double v[N_JOINTS], const double given[N_JOINTS],
                          double tau[N_JOINTS])
{
#if COMMANDS_ACCELERATION
    EndBody known[N_LOADED];
    body(value, 1, known);
    inverse_dynamics(joint, known, &value[ARMATURE], v, given, &value[GRAVITY], tau);
#else
    (void)value, (void)joint, (void)v;
    memcpy(tau, given, N_JOINTS * sizeof *tau);
#endif
}

static void limit_effort(const double value[N_VARIABLES], double tau[N_JOINTS])
{
    for (int i = 0; i < N_JOINTS && value[LIMIT_EFFORT] != 0.0; i++)
        tau[i] = saturated(tau[i], EFFORT[i]);
}

/* True if a commanded torque may exceed its limit; decided without computing the torque. */
static int may_saturate(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
                        const double v[N_JOINTS], const double a[N_JOINTS])
{
    const double with_rounding = 1.0 + 1e-9;
    double bound[N_JOINTS];
    EndBody known[N_LOADED];
    body(value, 1, known);
    effort_bounds(joint, known, &value[ARMATURE], v, a, &value[GRAVITY], bound);
    for (int i = 0; i < N_JOINTS; i++)
        if (!(RE(bound[i] * with_rounding) < RE(EFFORT[i])))
            return 1;
    return 0;
}

/* sum += sat(τ) − (M(q) a + h(q, v)), which is 0 if a is the commanded and the actual acceleration. */
static void add_excess(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
                       const double v[N_JOINTS], const double given[N_JOINTS], int held,
                       const double a[N_JOINTS], double sum[N_JOINTS])
{
    double tau[N_JOINTS], needed[N_JOINTS];
    if (held)
        memcpy(tau, given, sizeof tau);
    else
        wanted_effort(value, joint, v, given, tau);
    memcpy(needed, tau, sizeof needed);
    if (!knows_all(value)) {
        EndBody end_body[N_LOADED];
        body(value, 0, end_body);
        inverse_dynamics(joint, end_body, &value[ARMATURE], v, a, &value[GRAVITY], needed);
    }
    limit_effort(value, tau);
    for (int i = 0; i < N_JOINTS; i++)
        sum[i] += tau[i] - needed[i];
}

/* The commanded acceleration a, or 0, and the efforts that act beyond M a + h. Returns the rank. */
static int find_excess(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
                       const double q[N_JOINTS], const double v[N_JOINTS], const int slip[N_JOINTS], int rank,
                       double a[N_JOINTS], double excess[N_JOINTS], double *margin)
{
    const double *force = &value[F_EXT];
    double effort[N_JOINTS], further[N_JOINTS];
    const int held = is_held(value), accelerates = COMMANDS_ACCELERATION && !held;
    double *given = accelerates ? a : effort;
    if (held) {
        memcpy(given, &value[TAU], sizeof effort);
        rank = 0;
        if (margin)
            *margin = HUGE_VAL;
    } else {
        rank = command(value, joint, q, v, rank, given, margin);
    }
    for (int i = 0; i < N_JOINTS; i++) {
        if (!accelerates)
            a[i] = 0.0;
        excess[i] = value[TAU_EXT + i] - value[DAMPING + i] * v[i];
    }
    for (int i = 0; slip && i < N_JOINTS; i++)
        excess[i] -= value[FRICTION + i] * slip[i];
    if (force[0] != 0.0 || force[1] != 0.0 || force[2] != 0.0) {
        effort_of_force(joint, force, further);
        for (int i = 0; i < N_JOINTS; i++)
            excess[i] += further[i];
    }
    if (!knows_all(value) || (value[LIMIT_EFFORT] != 0.0 && may_saturate(value, joint, v, a)))
        add_excess(value, joint, v, given, held, a, excess);
    return rank;
}

/* True if nothing acts but τ of a law that knows all: within effort limits, the commanded acceleration is the motion. */
INTERNAL int acts_alone(const double value[N_VARIABLES], const int slip[N_JOINTS])
{
    const double *force = &value[F_EXT];
    int others = slip || !knows_all(value) || force[0] != 0.0 || force[1] != 0.0 || force[2] != 0.0;
    for (int i = 0; i < N_JOINTS; i++)
        others |= value[TAU_EXT + i] != 0.0 || value[DAMPING + i] != 0.0;
    return !others;
}

/* q̈ by the equations of motion at a state, with the given rank of J⁺. Joints slip in the given directions (−1, 1; 0 or
   NULL: no friction), and joints at rest are free; `alone` is the result of acts_alone. Returns the rank. The margin,
   which may be NULL, is negative if the singular values give another rank. */
INTERNAL int acceleration_if(const Plant *plant, int alone, const double q[N_JOINTS], const double v[N_JOINTS],
                             const int slip[N_JOINTS], int rank, double a[N_JOINTS], double *margin)
{
    JointPosition joint[N_BODIES];
    double excess[N_JOINTS], further[N_JOINTS];
    const double *value = plant->value;
    const int limited = value[LIMIT_EFFORT] != 0.0;
    int acts = 0;
    if (NEEDS_POSITIONS || limited || !alone)
        place_joints(q, joint);
    if (COMMANDS_ACCELERATION && alone) {
        rank = command(value, joint, q, v, rank, a, margin);
        if (!limited || !may_saturate(value, joint, v, a))
            return rank;
        memset(excess, 0, sizeof excess);
        add_excess(value, joint, v, a, 0, a, excess);
    } else {
        rank = find_excess(value, joint, q, v, slip, rank, a, excess, margin);
    }
    for (int i = 0; i < N_JOINTS; i++)
        acts |= excess[i] != 0.0;
    if (acts) {
        EndBody end_body[N_LOADED];
        body(value, 0, end_body);
        acceleration_of_effort(joint, end_body, &value[ARMATURE], excess, further);
        for (int i = 0; i < N_JOINTS; i++)
            a[i] += further[i];
    }
    return rank;
}

INTERNAL int acceleration(const Plant *plant, const double q[N_JOINTS], const double v[N_JOINTS],
                          const int slip[N_JOINTS], int rank, double a[N_JOINTS], double *margin)
{
    return acceleration_if(plant, acts_alone(plant->value, slip), q, v, slip, rank, a, margin);
}

#ifndef IS_COMPLEX
/* q̈ with reactions that keep some joints at rest, and the reactions, which act on all joints; else as acceleration. */
INTERNAL void acceleration_at_rest(const Plant *plant, const double q[N_JOINTS], const double v[N_JOINTS],
                                   const int slip[N_JOINTS], int rank, const int rests[N_JOINTS], double a[N_JOINTS],
                                   double reaction[N_JOINTS], double *margin)
{
    JointPosition joint[N_BODIES];
    EndBody end_body[N_LOADED];
    double excess[N_JOINTS], free[N_JOINTS], given[N_JOINTS], further[N_JOINTS], effort[N_JOINTS];
    place_joints(q, joint);
    find_excess(plant->value, joint, q, v, slip, rank, a, excess, margin);
    for (int i = 0; i < N_JOINTS; i++) {
        free[i] = rests[i] ? 0.0 : 1.0;
        given[i] = rests[i] ? -a[i] : excess[i];
    }
    body(plant->value, 0, end_body);
    hybrid_dynamics(joint, end_body, &plant->value[ARMATURE], free, given, further, effort);
    for (int i = 0; i < N_JOINTS; i++) {
        a[i] = rests[i] ? 0.0 : a[i] + further[i];
        reaction[i] = rests[i] ? effort[i] - excess[i] : 0.0;
    }
}

/* The largest effort on a joint at the velocities v and accelerations a: the sum of the magnitudes of its parts. Their
   sum itself may be a rounding error. */
static double acting_effort(const Plant *plant, const double q[N_JOINTS], const double v[N_JOINTS],
                            const double a[N_JOINTS])
{
    const double *value = plant->value, still[N_JOINTS] = {0};
    double needed[N_JOINTS], bias[N_JOINTS], further[N_JOINTS], largest = 0.0;
    JointPosition joint[N_BODIES];
    EndBody end_body[N_LOADED];
    place_joints(q, joint);
    body(value, 0, end_body);
    if (is_held(value))
        memcpy(needed, &value[TAU], sizeof needed);
    else if (!COMMANDS_ACCELERATION)
        command(value, joint, q, v, 0, needed, NULL);
    else
        inverse_dynamics(joint, end_body, &value[ARMATURE], v, a, &value[GRAVITY], needed);
    inverse_dynamics(joint, end_body, &value[ARMATURE], v, still, &value[GRAVITY], bias);
    effort_of_force(joint, &value[F_EXT], further);
    for (int i = 0; i < N_JOINTS; i++) {
        const double friction = v[i] != 0.0 ? value[FRICTION + i] : 0.0;
        const double sum = fabs(needed[i]) + fabs(bias[i]) + fabs(further[i]) + fabs(value[TAU_EXT + i])
                           + fabs(value[DAMPING + i] * v[i]) + friction;
        largest = sum <= largest ? largest : sum;
    }
    return largest;
}

/* a and λ of M(q) a = τ + λ, as in hybrid_dynamics. */
static void hybrid_motion(const Plant *plant, const double q[N_JOINTS], const double armature[N_JOINTS],
                          const double free[N_JOINTS], const double given[N_JOINTS], double a[N_JOINTS],
                          double reaction[N_JOINTS])
{
    JointPosition joint[N_BODIES];
    EndBody end_body[N_LOADED];
    place_joints(q, joint);
    body(plant->value, 0, end_body);
    hybrid_dynamics(joint, end_body, armature, free, given, a, reaction);
}
#endif

/* The outputs on request. */
static void compute_equations(Plant *plant, const JointPosition joint[N_BODIES], TaskFrame *task)
{
    (void)plant, (void)joint, (void)task;
#if defined HAS_M || defined HAS_H
    const double still[N_JOINTS] = {0};
    EndBody end_body[N_LOADED];
    body(plant->value, 0, end_body);
#endif
#ifdef HAS_M
    for (int k = 0; k < N_JOINTS; k++) { /* a column for each acceleration of 1 */
        const double weightless[3] = {0};
        double unit[N_JOINTS] = {0}, column[N_JOINTS];
        unit[k] = 1.0;
        inverse_dynamics(joint, end_body, &plant->value[ARMATURE], still, unit, weightless, column);
        for (int i = 0; i < N_JOINTS; i++)
            plant->value[M + i * N_JOINTS + k] = column[i];
    }
#endif
#ifdef HAS_H
    inverse_dynamics(joint, end_body, &plant->value[ARMATURE], &plant->value[V], still, &plant->value[GRAVITY],
                     &plant->value[H]);
#endif
#ifdef HAS_J
    memcpy(&plant->value[J], task->J, sizeof task->J);
#endif
#ifdef HAS_DRIFT
    memcpy(&plant->value[DRIFT], task->drift, sizeof task->drift);
#endif
#ifdef HAS_QUAT
    quaternion(task->R, &plant->value[QUAT]);
#endif
#ifdef HAS_OMEGA
    memcpy(&plant->value[OMEGA], &task->xd[N_AXES], 3 * sizeof *task->xd);
#endif
}

/* Compute the outputs x and xd, and those on request, at the plant's state. */
INTERNAL void compute_position(Plant *plant)
{
    JointPosition joint[N_BODIES];
    TaskFrame task;
    place_joints(&plant->value[Q], joint);
    task_frame(joint, &plant->value[V], &task);
    for (int k = 0; k < N_AXES; k++) {
        plant->value[X + k] = task.x[k];
        plant->value[XD + k] = task.xd[k];
    }
    compute_equations(plant, joint, &task);
}

/* τ of the control law for a measured state, within effort limits, with the given rank of J⁺. */
INTERNAL void control_effort(const Plant *plant, const double q[N_JOINTS], const double v[N_JOINTS], int rank,
                             double tau[N_JOINTS])
{
    const double *value = plant->value;
    double given[N_JOINTS];
    JointPosition joint[N_BODIES];
    place_joints(q, joint);
    command(value, joint, q, v, rank, given, NULL);
    wanted_effort(value, joint, v, given, tau);
    limit_effort(value, tau);
}

/* Compute the output tau, the applied control effort, at the plant's state and inputs, with the given rank of J⁺. The
   effort of a sampled controller is held and stays as it is. */
INTERNAL void compute_effort(Plant *plant, int rank)
{
    if (!is_held(plant->value))
        control_effort(plant, &plant->value[Q], &plant->value[V], rank, &plant->value[TAU]);
}
