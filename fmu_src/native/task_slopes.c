/* Derivatives of the task law with respect to the states, where J has full rank. The law's acceleration q̈_cmd moves the
   task frame with the wanted acceleration w. In the null space of the task, the joints have the acceleration −Kn v.
   Therefore, with N = I − J⁺J

       ẍ(q, v, q̈_cmd) = w(q, v),     N q̈_cmd = −Kn N v
       δq̈_cmd = J⁺ (δw − δẍ) + N (δJᵀ J⁺ᵀ (q̈_cmd + Kn v) − Kn δv)

   Sources: Golub & Pereyra, SIAM J. Numer. Anal. 10(2), 1973; for δẍ, the source of jacobian.c. */
#include "control.h"

#include <string.h>

/* For the joints between the root and the task frame: rows of the derivatives of the wanted and the actual acceleration
   with respect to q and v, and δJᵀ y with respect to q. */
typedef struct {
    double by_q[N_ROWS][N_JOINTS], by_v[N_ROWS][N_JOINTS];
    Matrix rotated;
} TaskSlopes;

/* sum += a × b. */
static void add_cross(const double a[3], const double b[3], double sum[3])
{
    double product[3];
    cross(a, b, product);
    for (int k = 0; k < 3; k++)
        sum[k] += product[k];
}

#if N_ROWS > N_AXES
/* Change of the rotation error e while the frame rotates by s: −(s + e × s/2 + c e × (e × s)),
   c = (1 − θ/2 cot θ/2)/θ² for the angle θ = |e|.
   Source: Chirikjian, "Stochastic Models, Information Theory, and Lie Groups", vol. 2, 2011, section 10.6. */
static void error_slope(const double e[3], const double s[3], double slope[3])
{
    const double square = e[0] * e[0] + e[1] * e[1] + e[2] * e[2], half = 0.5 * sqrt(square), x = half * half;
    const double c = half < 0.1 ? 1.0 / 12.0 + x * (1.0 / 180.0 + x * (1.0 / 1890.0 + x / 18900.0))
                                : (1.0 - half * cos(half) / sin(half)) / square;
    double once[3], twice[3];
    cross(e, s, once);
    cross(e, once, twice);
    for (int k = 0; k < 3; k++)
        slope[k] = -(s[k] + 0.5 * once[k] + c * twice[k]);
}
#endif

/* Velocity and acceleration of the end body. */
static void move_end(const double v[N_JOINTS], const double a[N_JOINTS], const JointMotion motion[N_BODIES],
                     double velocity[6], double acceleration[6])
{
    for (int i = END_BODY; i >= 0; i = PARENT[i])
        for (int k = 0; k < 6; k++) {
            const double rate = v[LEADER[i]];
            velocity[k] += motion[i].s[k] * rate;
            acceleration[k] += motion[i].psi[k] * rate + motion[i].s[k] * a[LEADER[i]];
        }
}

/* Add the rows of δw − δẍ for a body's joint. */
static void add_rows(const double value[N_VARIABLES], const double error[3], const JointMotion *motion,
                     const double velocity[6], const double acceleration[6], int i, TaskSlopes *slopes)
{
    const double *s = motion->s, *omega = velocity;
    double moved[6], by_q[6], by_v[6];
    memcpy(moved, motion->psi, sizeof moved); /* ∂ of the velocity */
    memcpy(by_q, motion->chi, sizeof by_q);   /* ∂ of the acceleration */
    add_motion_cross(velocity, s, -1.0, moved);
    add_motion_cross(velocity, motion->psi, -1.0, by_q);
    add_motion_cross(acceleration, s, -1.0, by_q);
    for (int k = 0; k < 6; k++)
        by_v[k] = motion->psi[k] + moved[k];
    add_cross(omega, s + 3, moved + 3); /* from the body at a point of the root to the task frame */
    add_cross(acceleration, s + 3, by_q + 3);
    add_cross(moved, velocity + 3, by_q + 3);
    add_cross(omega, moved + 3, by_q + 3);
    add_cross(s, velocity + 3, by_v + 3);
    add_cross(omega, s + 3, by_v + 3);
    for (int r = 0; r < N_AXES; r++) {
        const int k = 3 + AXIS[r];
        const double Kd = value[KD + r];
        slopes->by_q[r][LEADER[i]] -= Kd * moved[k] + value[KP + r] * s[k] + by_q[k];
        slopes->by_v[r][LEADER[i]] -= Kd * s[k] + by_v[k];
    }
#if N_ROWS > N_AXES
    double rotated[3];
    error_slope(error, s, rotated);
    for (int k = 0; k < 3; k++) {
        const double Kd = value[KD_ROT + k];
        slopes->by_q[N_AXES + k][LEADER[i]] -= Kd * moved[k] - value[KP_ROT + k] * rotated[k] + by_q[k];
        slopes->by_v[N_AXES + k][LEADER[i]] -= Kd * s[k] + by_v[k];
    }
#else
    (void)error;
#endif
}

/* Add δJᵀ y with respect to q: joint j rotates the columns of J of the joints i after it, and moves the task frame for
   those before it. y has angular and linear components in the root's axes. */
static void add_rotated(const JointMotion motion[N_BODIES], const double y[6], Matrix rotated)
{
    add_force(&y[3], motion, rotated);
    for (int j = END_BODY; j >= 0 && N_ROWS > N_AXES; j = PARENT[j]) {
        double moment[3];
        cross(y, motion[j].s, moment);
        for (int i = END_BODY; i > j; i = PARENT[i])
            rotated[LEADER[i]][LEADER[j]] +=
                moment[0] * motion[i].s[0] + moment[1] * motion[i].s[1] + moment[2] * motion[i].s[2];
    }
}

/* The columns of J⁺, and y = J⁺ᵀ (q̈_cmd + Kn v), with the components of y in the root's axes. */
static void invert(const double value[N_VARIABLES], const TaskFrame *task, const double given[N_JOINTS],
                   double inverse[N_ROWS][N_JOINTS], double y[6])
{
    for (int r = 0; r < N_ROWS; r++) {
        double J[N_ROWS][N_JOINTS], unit[N_ROWS] = {0}, sum = 0.0;
        memcpy(J, task->J, sizeof J);
        unit[r] = 1.0;
        apply_pseudo_inverse(J, unit, value[RCOND], N_ROWS, inverse[r], NULL);
        for (int i = 0; i < N_JOINTS; i++)
            sum += inverse[r][i] * (given[i] + value[KN] * value[V + i]);
        y[r < N_AXES ? 3 + AXIS[r] : r - N_AXES] = sum;
    }
}

static int add_command_by_states(const double value[N_VARIABLES], const JointPosition joint[N_BODIES],
                                 const JointMotion motion[N_BODIES], const double given[N_JOINTS], int rank,
                                 double slope[X][N_JOINTS])
{
    const double Kn = value[KN];
    double inverse[N_ROWS][N_JOINTS], y[6] = {0}, velocity[6] = {0}, error[3] = {0};
    double acceleration[6] = {0.0, 0.0, 0.0, -value[GRAVITY], -value[GRAVITY + 1], -value[GRAVITY + 2]};
    TaskFrame task;
    TaskSlopes slopes;
    if (rank < N_ROWS)
        return 0;
    memset(&slopes, 0, sizeof slopes);
    task_frame(joint, &value[V], &task);
    invert(value, &task, given, inverse, y);
#if N_ROWS > N_AXES
    rotation_error(&value[QUAT_DES], task.R, error);
#endif
    move_end(&value[V], given, motion, velocity, acceleration);
    for (int i = END_BODY; i >= 0; i = PARENT[i])
        add_rows(value, error, &motion[i], velocity, acceleration, i, &slopes);
    add_rotated(motion, y, slopes.rotated);
    for (int r = 0; r < N_ROWS; r++)
        for (int k = 0; k < N_JOINTS; k++) {
            for (int c = 0; c < N_JOINTS; c++)
                slopes.by_q[r][c] -= task.J[r][k] * slopes.rotated[k][c];
            slopes.by_v[r][k] += Kn * task.J[r][k];
        }
    for (int i = 0; i < N_JOINTS; i++) {
        slope[KN][i] -= value[V + i];
        for (int r = 0; r < N_ROWS; r++)
            slope[KN][i] += inverse[r][i] * task.xd[r];
    }
    for (int c = 0; c < N_JOINTS; c++) {
        for (int r = 0; r < N_ROWS; r++)
            for (int i = 0; i < N_JOINTS; i++) {
                slope[Q + c][i] += inverse[r][i] * slopes.by_q[r][c];
                slope[V + c][i] += inverse[r][i] * slopes.by_v[r][c];
            }
        for (int i = 0; i < N_JOINTS; i++)
            slope[Q + c][i] += slopes.rotated[i][c];
        slope[V + c][c] -= Kn;
    }
    return 1;
}
