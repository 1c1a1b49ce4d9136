/* Operational-space control by resolved acceleration, and the motion that it causes:

       a_cmd = xdd_des + Kd ∘ (xd_des − J v) + Kp ∘ (x_des − x)
       q̈_cmd = J⁺ (a_cmd − J̇ v + Kn J v) − Kn v
       τ     = M(q) q̈_cmd + h(q, v)
       q̈     = M(q)⁻¹ (sat(τ) + tau_ext − D v − h(q, v))
             = q̈_cmd + M(q)⁻¹ (sat(τ) − τ + tau_ext − D v)

   In the last form the dynamics cancel where nothing acts but an unlimited τ.
   Source: Luh, Walker & Paul, IEEE TAC 25(3), 1980; Khatib, IEEE J-RA 3(1), 1987. */
#include "plant.h"

#include "dynamics.h"
#include "kinematics.h"
#include "pseudo_inverse.h"

static int commanded_acceleration(const double value[N_VARIABLES], Placement joint[N_JOINTS],
                                  const double v[N_JOINTS], double a[N_JOINTS])
{
    TaskFrame task;
    double command[N_AXES];
    const double Kn = value[KN];
    task_frame(joint, v, &task);
    for (int k = 0; k < N_AXES; k++) {
        double xd = 0.0;
        for (int i = 0; i < N_JOINTS; i++)
            xd += task.J[k][i] * v[i];
        command[k] = value[XDD_DES + k] + value[KD + k] * (value[XD_DES + k] - xd)
                     + value[KP + k] * (value[X_DES + k] - task.x[k]) - task.drift[k] + Kn * xd;
    }
    const int rank = apply_pseudo_inverse(task.J, command, value[RCOND], a);
    for (int i = 0; i < N_JOINTS; i++)
        a[i] -= Kn * v[i];
    return rank;
}

static double saturated(double tau, double limit)
{
    return tau > limit ? limit : tau < -limit ? -limit : tau;
}

int acceleration(const Plant *plant, const double q[N_JOINTS], const double v[N_JOINTS],
                 double a[N_JOINTS])
{
    const double *value = plant->value;
    Placement joint[N_JOINTS];
    double excess[N_JOINTS]; /* sat(τ) − τ + tau_ext − D v */
    int acts = 0;
    place_joints(q, joint);
    const int rank = commanded_acceleration(value, joint, v, a);
    for (int i = 0; i < N_JOINTS; i++)
        excess[i] = value[TAU_EXT + i] - DAMPING[i] * v[i];
    if (value[LIMIT_EFFORT] != 0.0) {
        double tau[N_JOINTS];
        inverse_dynamics(joint, v, a, &value[GRAVITY], tau);
        for (int i = 0; i < N_JOINTS; i++)
            excess[i] += saturated(tau[i], EFFORT[i]) - tau[i];
    }
    for (int i = 0; i < N_JOINTS; i++)
        acts |= excess[i] != 0.0;
    if (acts) {
        double further[N_JOINTS];
        acceleration_of_effort(joint, excess, further);
        for (int i = 0; i < N_JOINTS; i++)
            a[i] += further[i];
    }
    return rank;
}

void compute_position(Plant *plant)
{
    Placement joint[N_JOINTS];
    TaskFrame task;
    place_joints(&plant->value[Q], joint);
    task_frame(joint, &plant->value[V], &task);
    for (int k = 0; k < N_AXES; k++)
        plant->value[X + k] = task.x[k];
}

void compute_effort(Plant *plant)
{
    double *value = plant->value, *tau = &value[TAU];
    Placement joint[N_JOINTS];
    double a[N_JOINTS];
    place_joints(&value[Q], joint);
    commanded_acceleration(value, joint, &value[V], a);
    inverse_dynamics(joint, &value[V], a, &value[GRAVITY], tau);
    for (int i = 0; i < N_JOINTS && value[LIMIT_EFFORT] != 0.0; i++)
        tau[i] = saturated(tau[i], EFFORT[i]);
}
