/* No control law: joint efforts are inputs, for an external controller. */
#include "control.h"

#include <string.h>

int command(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
            const double q[N_JOINTS], const double v[N_JOINTS], int rank,
            double given[N_JOINTS], double *margin)
{
    (void)joint, (void)q, (void)v, (void)rank;
    if (margin)
        *margin = 1.0;
    memcpy(given, &value[TAU_CMD], N_JOINTS * sizeof *given);
    return 0;
}

#ifndef IS_COMPLEX
static int add_command_by_states(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
                                 const JointMotion motion[N_BODIES], const double given[N_JOINTS], int rank,
                                 double slope[X][N_JOINTS])
{
    (void)value, (void)joint, (void)motion, (void)given, (void)rank, (void)slope;
    return 1;
}
#endif
