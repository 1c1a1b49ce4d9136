/* One step of ROS34PW2 for stiff joint damping D, and its dense output, by the equations of plant/rosenbrock.py. Here
   (1 + h γ M⁻¹D) x = r has the solution x = r − (M + h γ D)⁻¹ h γ D r, in which h γ D acts like an armature.

   Source: Rang & Angermann, "New Rosenbrock W-methods of order 3 for partial differential algebraic equations of
   index 1", BIT 45(4), 2005, in the form without products by T of Hairer & Wanner, "Solving ODEs II", IV.7. */
#include <math.h>
#include <stddef.h>
#include <string.h>

enum { N_INCREMENTS = 4 };
static const double GAMMA = 0.435866521508459;
/* Row i has the weights of the increments u of the stages before i; the last row and increment are the solution. */
static const double WEIGHT[N_INCREMENTS][N_INCREMENTS] = {
    {0, 0, 0, 0},
    {2, 0, 0, 0},
    {1.4192173174557647, -0.2592322116729697, 0, 0},
    {4.18476048231916, -0.28519201735549593, 2.294280360279042, 0},
};
static const double COUPLING[N_INCREMENTS][N_INCREMENTS] = {
    {0, 0, 0, 0},
    {-4.588560720558084, 0, 0, 0},
    {-4.18476048231916, 0.28519201735549593, 0, 0},
    {-6.368179200128358, -6.795620944466836, 2.870098604331056, 0},
};
static const double NODE[N_INCREMENTS] = {0, 0.871733043016918, 0.731579957788852, 1}; /* times of the stages */
static const double ESTIMATE[N_INCREMENTS] = {0.2777499476479681, -1.403239895175999, 1.7726301276675507, 0.5};
/* Weights of the derivatives in the dense output, a cubic by the values and derivatives at both ends. */
static const double CUBIC[N_INCREMENTS + 1][4] = {
    {0, 0, 0, 0}, {1, -2, 1, 0}, {0, 3, -2, 0}, {0, -1, 1, 0}, {0, 0, 0, 0}};
/* Damping rate times step: up to STABLE, Dormand–Prince is stable; if the product with the largest step exceeds WORTH,
   this method is cheaper. */
static const double STABLE = 3.3, WORTH = 12.0;

/* The system (M + s D) x = τ at y, with joints at rest held: factors of M + s D = Lᵀ Δ L, with L in the lower triangle,
   whose diagonal is Δ⁻¹. Factorisation from the leaves to the root keeps the zeros between branches.

   Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 6.5. */
typedef struct {
    int held[N_JOINTS];
    double L[N_JOINTS][N_JOINTS];
} DampedSystem;

static void damped_system(const Step *step, double s, DampedSystem *system)
{
    const double *value = step->plant->value;
    double inertia[N_JOINTS], (*const L)[N_JOINTS] = system->L;
    JointPosition joint[N_BODIES];
    EndBody end_body[N_LOADED];
    place_joints(step->y, joint);
    body(value, 0, end_body);
    for (int i = 0; i < N_JOINTS; i++) {
        system->held[i] = step->stops.held[i] != FREE;
        inertia[i] = value[ARMATURE + i] + (system->held[i] ? 0.0 : s * value[DAMPING + i]);
    }
    mass_matrix(joint, end_body, inertia, L);
    for (int i = 0; i < N_JOINTS; i++)
        for (int j = 0; j < i; j++)
            if (reacts(&step->stops, i) || reacts(&step->stops, j)) /* for the others, a clamped joint moves on */
                L[i][j] = 0.0;
    for (int k = N_JOINTS - 1; k >= 0; k--) {
        L[k][k] = 1.0 / L[k][k];
        for (int i = k - 1; i >= 0; i--)
            if (L[k][i] != 0.0) {
                const double factor = L[k][i] * L[k][k];
                for (int j = 0; j <= i; j++)
                    L[i][j] -= factor * L[k][j];
                L[k][i] = factor;
            }
    }
}

/* x of the system for τ. */
static void damped_motion(const DampedSystem *system, const double tau[N_JOINTS], double x[N_JOINTS])
{
    for (int i = 0; i < N_JOINTS; i++)
        x[i] = system->held[i] ? 0.0 : tau[i];
    for (int k = N_JOINTS - 1; k > 0; k--)
        for (int i = 0; i < k; i++)
            x[i] -= system->L[k][i] * x[k];
    for (int k = 0; k < N_JOINTS; k++) {
        x[k] *= system->L[k][k];
        for (int i = 0; i < k; i++)
            x[k] -= system->L[k][i] * x[i];
    }
    for (int k = 0; k < N_JOINTS; k++)
        x[k] = system->held[k] ? 0.0 : x[k];
}

/* Solve (1 − s T) u = r in place, with the system for s = h γ. */
static void solve(const DampedSystem *system, double s, const double damping[N_JOINTS], double u[N_STATES])
{
    double effort[N_JOINTS], change[N_JOINTS];
    for (int i = 0; i < N_JOINTS; i++)
        effort[i] = s * damping[i] * u[N_JOINTS + i];
    damped_motion(system, effort, change);
    for (int i = 0; i < N_JOINTS; i++) {
        u[N_JOINTS + i] -= change[i];
        u[i] += s * u[N_JOINTS + i];
    }
}

/* Weighted sum of the first increments. */
static double weighted(double u[N_INCREMENTS][N_STATES], const double weight[N_INCREMENTS], int count, int i)
{
    double sum = 0.0;
    for (int j = 0; j < count; j++)
        sum += weight[j] * u[j][i];
    return sum;
}

/* Fill K and P with the dense output of a step to y_new, where the derivatives are k. */
static void fill_dense_output(Step *step, double u[N_INCREMENTS][N_STATES], const double k[N_STATES])
{
    const double h = step->size, rtol = step->plant->value[RTOL], atol = step->plant->value[ATOL];
    for (int i = 0; i < N_STATES; i++)
        step->K[2][i] = (weighted(u, WEIGHT[N_INCREMENTS - 1], N_INCREMENTS - 1, i) + u[N_INCREMENTS - 1][i]) / h;
    for (int i = 0; i < N_JOINTS; i++) {
        const double v = step->y[N_JOINTS + i], v_new = step->y_new[N_JOINTS + i], mean = step->K[2][i];
        const double first = (6.0 * mean - 4.0 * v - 2.0 * v_new) / h;
        const double last = (2.0 * v + 4.0 * v_new - 6.0 * mean) / h;
        const double a = step->K[0][N_JOINTS + i], a_new = k[N_JOINTS + i];
        const double tolerance = atol + rtol * fmax(fabs(v), fabs(v_new));
        step->K[1][i] = v;
        step->K[1][N_JOINTS + i] = v == 0.0 || h * fabs(a - first) <= tolerance ? a : first;
        step->K[3][i] = v_new;
        step->K[3][N_JOINTS + i] = h * fabs(a_new - last) <= tolerance ? a_new : last;
    }
    step->stages = N_INCREMENTS;
    step->P = CUBIC;
    memcpy(step->K[N_INCREMENTS], k, sizeof step->K[N_INCREMENTS]);
}

/* Fill y_new, K and P from y and K[0]; return the norm of the error, or a larger one of the velocity changes that neither
   T nor time explains. A step passes if it is below 1. */
static double rosenbrock(Step *step)
{
    const double h = step->size, *damping = &step->plant->value[DAMPING];
    double u[N_INCREMENTS][N_STATES], Tu[N_INCREMENTS][N_STATES], k[N_STATES], error[N_STATES], *y_new = step->y_new;
    double by_T[N_STATES], rest[N_INCREMENTS + 1][N_STATES], unexplained[N_STATES] = {0};
    DampedSystem system;
    damped_system(step, h * GAMMA, &system);
    memcpy(k, step->K[0], sizeof k);
    for (int stage = 0; stage < N_INCREMENTS; stage++) {
        for (int i = 0; i < N_STATES; i++)
            Tu[stage][i] = u[stage][i] = GAMMA * (h * k[i] + weighted(u, COUPLING[stage], stage, i));
        solve(&system, h * GAMMA, damping, u[stage]);
        for (int i = 0; i < N_STATES; i++)
            Tu[stage][i] = (u[stage][i] - Tu[stage][i]) / (h * GAMMA);
        const int next = stage + 1, last = next == N_INCREMENTS;
        for (int i = 0; i < N_STATES; i++) {
            y_new[i] = last ? y_new[i] + u[stage][i] : step->y[i] + weighted(u, WEIGHT[next], next, i);
            by_T[i] = last ? by_T[i] + Tu[stage][i] : weighted(Tu, WEIGHT[next], next, i);
        }
        memcpy(k, y_new + N_JOINTS, N_JOINTS * sizeof *k);
        evaluate(step, y_new, k + N_JOINTS, step->effort[next], last ? &step->margin_new : NULL);
        for (int i = N_JOINTS; i < N_STATES; i++)
            rest[next][i] = h * (k[i] - step->K[0][i] - by_T[i]);
    }
    fill_dense_output(step, u, k);
    for (int i = 0; i < N_STATES; i++)
        error[i] = weighted(u, ESTIMATE, N_INCREMENTS, i);
    for (int stage = 1; stage < N_INCREMENTS; stage++)
        for (int i = N_JOINTS; i < N_STATES; i++)
            unexplained[i] = fmax(unexplained[i], fabs(rest[stage][i] - NODE[stage] * rest[N_INCREMENTS][i]));
    step->inside = error_norm(step, error);
    solve(&system, h * GAMMA, damping, error); /* it damps stiff modes as the method does */
    solve(&system, h * GAMMA, damping, unexplained);
    memset(unexplained, 0, N_JOINTS * sizeof *unexplained);
    const double other = error_norm(step, unexplained);
    return fmax(error_norm(step, error), other * sqrt(other)); /* it falls with h², the error with h³ */
}

/* The rate of damping, 1/s, if a step of Dormand–Prince failed because of it, and this method is cheaper at the largest
   step, s; else 0. */
static double limiting_rate(const Step *step, double largest)
{
    double effort[N_JOINTS], answer[N_JOINTS], power = 0.0, rate = 0.0;
    DampedSystem system;
    for (int i = 0; i < N_JOINTS; i++) {
        const double change = step->K[STAGES][i] - step->K[STAGES - 1][i];
        effort[i] = step->plant->value[DAMPING + i] * change;
        power += effort[i] * change;
    }
    if (!(power > 0.0))
        return 0.0;
    damped_system(step, 0.0, &system);
    damped_motion(&system, effort, answer);
    for (int i = 0; i < N_JOINTS; i++)
        rate += effort[i] * answer[i] / power; /* a Rayleigh quotient of M⁻¹D: the fastest mode dominates */
    return rate * step->size > STABLE && rate * largest > WORTH ? rate : 0.0;
}
