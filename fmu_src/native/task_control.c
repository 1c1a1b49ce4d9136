/* Operational-space control by resolved acceleration:

       a_cmd = xdd_des + Kd ∘ (xd_des − J v) + Kp ∘ (x_des − x)
       q̈_cmd = J⁺ (a_cmd − J̇ v + Kn J v) − Kn v

   Source: Luh, Walker & Paul, IEEE TAC 25(3), 1980; Khatib, IEEE J-RA 3(1), 1987. */
#include "control.h"

#include "pseudo_inverse.h"

int command(const double value[N_VARIABLES], Placement joint[N_BODIES], const double q[N_JOINTS],
            const double v[N_JOINTS], double given[N_JOINTS])
{
    TaskFrame task;
    double J[N_AXES][N_JOINTS], wanted[N_AXES];
    const double Kn = value[KN];
    (void)q;
    task_frame(joint, v, &task);
    for (int k = 0; k < N_AXES; k++) {
        const int row = AXIS[k];
        double xd = 0.0;
        for (int i = 0; i < N_JOINTS; i++) {
            J[k][i] = task.J[row][i];
            xd += J[k][i] * v[i];
        }
        wanted[k] = value[XDD_DES + k] + value[KD + k] * (value[XD_DES + k] - xd)
                    + value[KP + k] * (value[X_DES + k] - task.x[row]) - task.drift[row] + Kn * xd;
    }
    const int rank = apply_pseudo_inverse(J, wanted, value[RCOND], given);
    for (int i = 0; i < N_JOINTS; i++)
        given[i] -= Kn * v[i];
    return rank;
}
