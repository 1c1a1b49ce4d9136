/* Kinematics: from the root outwards along the joints that move the task frame.

       R_i = R_p R(q_i),  o_i = o_p + r,  r = R_p p(q_i)
       J_i = z_i × (x − o_i), or z_i of a sliding joint
   and with q̈ = 0
       ω_i = ω_p + z_i v_i,   α_i = α_p + ω_p × z_i v_i
       a_i = a_p + α_p × r + ω_p × (ω_p × r), and 2 ω_p × z_i v_i of a sliding joint

   Source: Siciliano, Sciavicco, Villani & Oriolo, "Robotics", 2009, sections 3.1 and 7.3. */
#include "kinematics.h"

#include <math.h>
#include <string.h>

#include "vector.h"

void place_joints(const double q[N_JOINTS], Placement joint[N_BODIES])
{
    for (int i = 0; i < N_BODIES; i++) {
        const double position = rate(q, i) + OFFSET[i];
        const double c = PRISMATIC[i] ? 1.0 : cos(position);
        const double s = PRISMATIC[i] ? 0.0 : sin(position);
        const double slide = PRISMATIC[i] ? position : 0.0;
        for (int k = 0; k < 3; k++) {
            const double *row = JOINT_R[i][k];
            joint[i].R[k][0] = c * row[0] + s * row[1];
            joint[i].R[k][1] = c * row[1] - s * row[0];
            joint[i].R[k][2] = row[2];
            joint[i].p[k] = JOINT_P[i][k] + slide * row[2];
        }
    }
}

/* R = R S */
static void turn(double R[3][3], double S[3][3])
{
    for (int k = 0; k < 3; k++) {
        double row[3];
        rotate_back(row, S, R[k]);
        memcpy(R[k], row, sizeof row);
    }
}

/* Columns of the Jacobian from the joints' origins and axes. */
static void jacobian(TaskFrame *task, double origin[N_PATH + 1][3], double axis[N_PATH + 1][3])
{
    memset(task->J, 0, sizeof task->J);
    for (int k = 0; k < N_PATH; k++) {
        double linear[3] = {0.0, 0.0, 0.0}, arm[3];
        for (int d = 0; d < 3; d++)
            arm[d] = task->x[d] - origin[k][d];
        if (PRISMATIC[PATH[k]])
            memcpy(linear, axis[k], sizeof linear);
        else
            add_cross(linear, axis[k], arm);
        for (int d = 0; d < 3; d++) {
            add_to_leader(task->J[d], PATH[k], linear[d]);
            add_to_leader(task->J[3 + d], PATH[k], PRISMATIC[PATH[k]] ? 0.0 : axis[k][d]);
        }
    }
}

void task_frame(Placement joint[N_BODIES], const double v[N_JOINTS], TaskFrame *task)
{
    double R[3][3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
    double x[3] = {0.0, 0.0, 0.0};
    double omega[3] = {0.0, 0.0, 0.0}, alpha[3] = {0.0, 0.0, 0.0}, a[3] = {0.0, 0.0, 0.0};
    double origin[N_PATH + 1][3], axis[N_PATH + 1][3];
    for (int k = 0; k <= N_PATH; k++) {
        const int i = k < N_PATH ? PATH[k] : 0;
        if (k == 0 && k < N_PATH) { /* its parent is the root, which rests */
            memcpy(x, joint[i].p, sizeof x);
            memcpy(R, joint[i].R, sizeof R);
        } else {
            double r[3] = {0.0, 0.0, 0.0};
            add_rotated(r, R, k < N_PATH ? joint[i].p : FRAME_P);
            for (int d = 0; d < 3; d++)
                x[d] += r[d];
            add_cross(a, alpha, r);
            add_centripetal(a, omega, r);
            if (k == N_PATH)
                break;
            turn(R, joint[i].R);
        }
        double motion[3], coriolis[3] = {0.0, 0.0, 0.0};
        for (int d = 0; d < 3; d++) {
            origin[k][d] = x[d];
            axis[k][d] = R[d][2];
            motion[d] = R[d][2] * rate(v, i);
        }
        add_cross(coriolis, omega, motion);
        for (int d = 0; d < 3; d++) {
            if (PRISMATIC[i]) {
                a[d] += 2.0 * coriolis[d];
            } else {
                alpha[d] += coriolis[d];
                omega[d] += motion[d];
            }
        }
    }
    memcpy(task->x, x, sizeof x);
    memcpy(task->R, FRAME_R, sizeof R);
    turn(R, task->R);
    memcpy(task->R, R, sizeof R);
    memcpy(task->drift, a, sizeof a);
    memcpy(task->drift + 3, alpha, sizeof alpha);
    jacobian(task, origin, axis);
}
