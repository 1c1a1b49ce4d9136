/* Joint-space control: q̈_cmd = a_des + Kd ∘ (v_des − v) + Kp ∘ (q_des − q).
   Source: Siciliano, Sciavicco, Villani & Oriolo, "Robotics", 2009, section 8.5.2. */
#include "control.h"

int command(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
            const double q[N_JOINTS], const double v[N_JOINTS], int rank,
            double given[N_JOINTS], double *margin)
{
    (void)joint, (void)rank;
    if (margin)
        *margin = 1.0;
    for (int i = 0; i < N_JOINTS; i++)
        given[i] = value[A_DES + i] + value[KD + i] * (value[V_DES + i] - v[i])
                   + value[KP + i] * (value[Q_DES + i] - q[i]);
    return 0;
}

#ifndef IS_COMPLEX
static int add_command_by_states(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
                                 const JointMotion motion[N_BODIES], const double given[N_JOINTS], int rank,
                                 double slope[X][N_JOINTS])
{
    (void)joint, (void)motion, (void)given, (void)rank;
    for (int i = 0; i < N_JOINTS; i++) {
        slope[Q + i][i] -= value[KP + i];
        slope[V + i][i] -= value[KD + i];
    }
    return 1;
}
#endif
