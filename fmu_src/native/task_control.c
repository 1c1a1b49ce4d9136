/* Operational-space control by resolved acceleration:

       a_cmd = xdd_des + Kd ∘ (xd_des − J v) + Kp ∘ (x_des − x)
       α_cmd = alpha_des + Kd_rot ∘ (omega_des − ω) + Kp_rot ∘ log(R_des Rᵀ)   with an orientation
       q̈_cmd = J⁺ (a_cmd − J̇ v + Kn J v) − Kn v

   Source: Luh, Walker & Paul, IEEE TAC 25(3), 1980; Khatib, IEEE J-RA 3(1), 1987. */
#include "control.h"

#include <math.h>

/* A row of the law: value references of its inputs, and its error. */
typedef struct {
    int xd_des, xdd_des, Kp, Kd;
    double error;
} Row;

static void law(const double value[N_VARIABLES], TaskFrame *task, Row row[N_ROWS])
{
    for (int k = 0; k < N_AXES; k++) {
        const Row linear = {XD_DES + k, XDD_DES + k, KP + k, KD + k,
                            value[X_DES + k] - task->x[k]};
        row[k] = linear;
    }
#if N_ROWS > N_AXES
    double error[3];
    rotation_error(&value[QUAT_DES], task->R, error);
    for (int k = 0; k < 3; k++) {
        const Row angular = {OMEGA_DES + k, ALPHA_DES + k, KP_ROT + k, KD_ROT + k, error[k]};
        row[N_AXES + k] = angular;
    }
#endif
}

/* 2⁻⁴⁸ m or rad: smaller errors are rounding errors, which would move stiff joints at rest. */
static const double ROUNDING = 1.0 / 281474976710656.0;

int command(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
            const double q[N_JOINTS], const double v[N_JOINTS], int rank,
            double given[N_JOINTS], double *margin)
{
    TaskFrame task;
    Row row[N_ROWS];
    double wanted[N_ROWS];
    const double Kn = value[KN];
    (void)q;
    task_frame(joint, v, &task);
    law(value, &task, row);
    for (int k = 0; k < N_ROWS; k++) {
        if (RE(fabs(row[k].error)) < RE(ROUNDING))
            row[k].error -= RE(row[k].error);
        wanted[k] = value[row[k].xdd_des] + value[row[k].Kd] * (value[row[k].xd_des] - task.xd[k])
                    + value[row[k].Kp] * row[k].error - task.drift[k] + Kn * task.xd[k];
    }
    rank = apply_pseudo_inverse(task.J, wanted, value[RCOND], rank, given, margin);
    for (int i = 0; i < N_JOINTS; i++)
        given[i] -= Kn * v[i];
    return rank;
}

void conditioning(const double q[N_JOINTS], double ratio[N_ROWS])
{
    const double still[N_JOINTS] = {0};
    JointPosition joint[N_BODIES];
    TaskFrame task;
    place_joints(q, joint);
    task_frame(joint, still, &task);
    singular_ratios(task.J, ratio);
}
