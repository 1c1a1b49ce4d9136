/* The default run in MuJoCo, RK4 at 1 ms, and the cost of a step of 10 ms. It is in C, because MuJoCo's Python package
   makes the library read the clock at each stage (mjcb_time), which more than doubles the cost and cannot be undone.

       mujoco_step URDF free|controlled STEPS

   prints the processor time of a step, s, and the joint angles at the end, rad. The URDF is the
   shipped arm's without its shapes, so nothing collides. Limits are off. The controller has
   the tutorial's equations, with M, h, J and its drift from MuJoCo, in each of RK4's stages. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include <mujoco/mujoco.h>

enum { N = 2, STEPS_OF_MUJOCO = 10 };
static const mjtNum TIMESTEP = 0.001, GRAVITY = -9.81, LINK = 0.15, KP = 50, KD = 40;
static const mjtNum Q_START[N] = {0.5, 0.35}, X_DES[N] = {0.2, 0.05};

static void control(const mjModel *model, mjData *data)
{
    const int link2 = model->nbody - 1;
    const mjtNum *p = data->xpos + 3 * link2, *R = data->xmat + 9 * link2;
    const mjtNum x[3] = {p[0] + LINK * R[0], p[1] + LINK * R[3], p[2] + LINK * R[6]};
    mjtNum J[3][N], drift[3][N], a[N], acceleration[N];
    mj_jac(model, data, *J, NULL, x, link2);
    mj_jacDot(model, data, *drift, NULL, x, link2);
    for (int k = 0; k < N; k++) {
        a[k] = KP * (X_DES[k] - x[k]);
        for (int i = 0; i < N; i++)
            a[k] -= (KD * J[k][i] + drift[k][i]) * data->qvel[i];
    }
    const mjtNum determinant = J[0][0] * J[1][1] - J[0][1] * J[1][0];
    acceleration[0] = (J[1][1] * a[0] - J[0][1] * a[1]) / determinant;
    acceleration[1] = (J[0][0] * a[1] - J[1][0] * a[0]) / determinant;
    mj_mulM(model, data, data->qfrc_applied, acceleration);
    for (int i = 0; i < N; i++)
        data->qfrc_applied[i] += data->qfrc_bias[i];
}

/* Processor time of a step of 10 ms, s, the mean of a run from the start. */
static double step_cost(const mjModel *model, mjData *data, int steps)
{
    mj_resetData(model, data);
    memcpy(data->qpos, Q_START, sizeof Q_START);
    const clock_t begin = clock();
    for (int k = 0; k < steps * STEPS_OF_MUJOCO; k++)
        mj_step(model, data);
    return (double)(clock() - begin) / CLOCKS_PER_SEC / steps;
}

int main(int count, char *argument[])
{
    char error[1000] = "usage: mujoco_step URDF free|controlled STEPS";
    mjModel *model = count == 4 ? mj_loadXML(argument[1], NULL, error, sizeof error) : NULL;
    if (!model || model->nv != N) {
        fprintf(stderr, "%s\n", error);
        return 1;
    }
    model->opt.integrator = mjINT_RK4;
    model->opt.timestep = TIMESTEP;
    memcpy(model->opt.gravity, (mjtNum[]){0, GRAVITY, 0}, sizeof model->opt.gravity);
    model->opt.disableflags |= mjDSBL_CONSTRAINT;
    mjcb_control = strcmp(argument[2], "controlled") ? NULL : control;
    mjData *data = mj_makeData(model);
    step_cost(model, data, 10); /* into the caches */
    const double cost = step_cost(model, data, atoi(argument[3]));
    printf("%.9f %.17g %.17g\n", cost, data->qpos[0], data->qpos[1]);
    return 0;
}
