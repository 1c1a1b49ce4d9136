/* Coefficients, error norm and dense output are those of SciPy's RK45 and plant/dormand_prince.py.

   Sources: Dormand & Prince, J. Comp. Appl. Math. 6(1), 1980; Shampine, Math. Comp. 46, 1986. */
#include <math.h>
#include <stddef.h>
#include <string.h>

enum { STAGES = 6 }; /* evaluations of the equations of motion in one step */

/* One integration step from y to y_new in one regime (stops.h), by Dormand–Prince, ROS34PW2 or Heun. The first and the
   last of the derivatives K are those at the ends; the last stage is y_new. */
typedef struct {
    const Plant *plant;
    double size;                           /* s */
    double y[N_STATES], y_new[N_STATES];
    int stages;                            /* number of stages, at most STAGES */
    const double (*P)[4];                  /* weights of K in the dense output */
    double K[STAGES + 1][N_STATES];
    double effort[STAGES + 1][N_JOINTS];   /* the efforts that hold joints at rest */
    double effort_rate[N_JOINTS];          /* rates of the holding efforts at the end of the last regime, per s */
    double rounding;                       /* bound on the rounding error of the holding efforts */
    long evaluations;                      /* evaluations of the equations of motion so far */
    double Q[N_STATES][4];                 /* coefficients of the dense output */
    double inside;                         /* norm of its error, if it exceeds that of y_new; else 0 */
    double margin, margin_new;             /* margins of the rank at y and y_new */
    int crossed;                           /* whether the rank has changed in the communication step */
    int alone;                             /* the result of acts_alone in the regime */
    Stops stops;
} Step;

/* Row s has the weights of the derivatives of stages 0…s; the last row is the fifth-order solution. */
static const double A[STAGES][STAGES] = {
    {1.0 / 5, 0, 0, 0, 0, 0},
    {3.0 / 40, 9.0 / 40, 0, 0, 0, 0},
    {44.0 / 45, -56.0 / 15, 32.0 / 9, 0, 0, 0},
    {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729, 0, 0},
    {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656, 0},
    {35.0 / 384, 0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84},
};
static const double E[STAGES + 1] = {
    -71.0 / 57600, 0, 71.0 / 16695, -71.0 / 1920, 17253.0 / 339200, -22.0 / 525, 1.0 / 40};
static const double P[STAGES + 1][4] = {
    {1, -8048581381.0 / 2820520608, 8663915743.0 / 2820520608, -12715105075.0 / 11282082432},
    {0, 0, 0, 0},
    {0, 131558114200.0 / 32700410799, -68118460800.0 / 10900136933, 87487479700.0 / 32700410799},
    {0, -1754552775.0 / 470086768, 14199869525.0 / 1410260304, -10690763975.0 / 1880347072},
    {0, 127303824393.0 / 49829197408, -318862633887.0 / 49829197408, 701980252875.0 / 199316789632},
    {0, -282668133.0 / 205662961, 2019193451.0 / 616988883, -1453857185.0 / 822651844},
    {0, 40617522.0 / 29380423, -110615467.0 / 29380423, 69997945.0 / 29380423},
};
static const double QUADRATIC[2][4] = {{1, -0.5, 0, 0}, {0, 0.5, 0, 0}};

/* q̈ at a state in the regime of the step, the efforts that hold joints at rest, and the margin of the rank,
   which may be NULL. */
static void evaluate(Step *step, const double y[N_STATES], double a[N_JOINTS], double effort[N_JOINTS], double *margin)
{
    const Stops *stops = &step->stops;
    const double *v = y + N_JOINTS;
    step->evaluations++;
    if (stops->any_held && step->plant->value[RIGID_STOPS] != 0.0) { /* no clamps: one recursion has all */
        acceleration_at_rest(step->plant, y, v, slip_of(stops), stops->rank, stops->held, a, effort, margin);
        return;
    }
    acceleration_if(step->plant, step->alone, y, v, slip_of(stops), stops->rank, a, margin);
    if (stops->any_held)
        restrain(step->plant, stops, y, a, effort);
}

/* Root mean square of error/tolerance. */
static double error_norm(const Step *step, const double error[N_STATES])
{
    const double rtol = step->plant->value[RTOL], atol = step->plant->value[ATOL];
    double sum = 0.0;
    for (int i = 0; i < N_STATES; i++) {
        const double size = fabs(step->y[i]), size_new = fabs(step->y_new[i]);
        const double ratio = error[i] / (atol + rtol * (size > size_new ? size : size_new));
        sum += ratio * ratio;
    }
    return sqrt(sum / N_STATES);
}

/* Fill y_new, K[1…6] and P from y and K[0]; return the norm of the error. A step passes if it is below 1. */
static double dormand_prince(Step *step)
{
    double *y_new = step->y_new, error[N_STATES];
    for (int stage = 1; stage <= STAGES; stage++) {
        double weight[STAGES];
        for (int s = 0; s < stage; s++)
            weight[s] = step->size * A[stage - 1][s];
        for (int i = 0; i < N_STATES; i++) {
            double change = 0.0;
            for (int s = 0; s < stage; s++)
                change += weight[s] * step->K[s][i];
            y_new[i] = step->y[i] + change;
        }
        memcpy(step->K[stage], y_new + N_JOINTS, N_JOINTS * sizeof *y_new);
        evaluate(step, y_new, step->K[stage] + N_JOINTS, step->effort[stage],
                 stage == STAGES ? &step->margin_new : NULL);
    }
    for (int i = 0; i < N_STATES; i++) {
        error[i] = 0.0;
        for (int s = 0; s <= STAGES; s++)
            error[i] += E[s] * step->K[s][i];
        error[i] *= step->size;
    }
    step->stages = STAGES;
    step->inside = 0.0;
    step->P = P;
    return error_norm(step, error);
}

/* Fill y_new, K[1] and P by Heun's method, of second order; K[1] is at the state of Euler's method. Return the norm of
   the error of Euler's method. */
static double heun(Step *step)
{
    double error[N_STATES];
    const double *k = step->K[0], *k_new = step->K[1];
    for (int i = 0; i < N_STATES; i++)
        step->y_new[i] = step->y[i] + step->size * k[i];
    memcpy(step->K[1], step->y_new + N_JOINTS, N_JOINTS * sizeof *k);
    evaluate(step, step->y_new, step->K[1] + N_JOINTS, step->effort[1], &step->margin_new);
    for (int i = 0; i < N_STATES; i++) {
        error[i] = 0.5 * step->size * (k_new[i] - k[i]);
        step->y_new[i] += error[i];
    }
    step->stages = 1;
    step->P = QUADRATIC;
    return error_norm(step, error);
}

/* Fill Q, for dense_output. */
static void interpolate(Step *step)
{
    for (int i = 0; i < N_STATES; i++)
        for (int k = 0; k < 4; k++) {
            step->Q[i][k] = 0.0;
            for (int s = 0; s <= step->stages; s++)
                step->Q[i][k] += step->K[s][i] * step->P[s][k];
        }
}

/* A component of the state at a time within the step. */
static double dense_output(const Step *step, double passed, int component)
{
    const double x = passed / step->size, *c = step->Q[component];
    const double slope = c[0] + c[1] * x + c[2] * (x * x) + c[3] * (x * x * x);
    if (passed == step->size)
        return step->y_new[component];
    return step->y[component] + step->size * x * slope;
}
