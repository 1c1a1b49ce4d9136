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
/* Modes decay before the stages if the cube of damping rate times step exceeds UNSEEN. Later steps do not see their effects
   either, which therefore may only have a share of the tolerances. */
static const double UNSEEN = 10.0, SHARE_UNSEEN = 0.2;

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

/* The larger number; NaN if one of them is NaN, unlike fmax. */
static double larger(double a, double b)
{
    return a > b || isnan(a) ? a : b;
}

/* Weighted sum of the first increments. */
static double weighted(double u[N_INCREMENTS][N_STATES], const double weight[N_INCREMENTS], int count, int i)
{
    double sum = 0.0;
    for (int j = 0; j < count; j++)
        sum += weight[j] * u[j][i];
    return sum;
}

/* Fill K and P with the dense output of a step to y_new, where the derivatives are k. The increments of y are given. */
static void fill_dense_output(Step *step, const double increment[N_STATES], const double k[N_STATES])
{
    const double h = step->size, rtol = step->plant->value[RTOL], atol = step->plant->value[ATOL];
    for (int i = 0; i < N_STATES; i++)
        step->K[2][i] = increment[i] / h; /* a difference of states loses digits in short steps */
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

/* The share of a mode's decay that the stages see; they come after that of a fast mode. */
static double seen(const Modes *modes, int mode, double h)
{
    const double z = modes->rate[mode] * h;
    return UNSEEN / (UNSEEN + z * z * z);
}

/* First acceleration of the exact decay, in the modes. All efforts but those of the damping are as after the decay of the
   fast modes, because that is when the stages see them. */
static void settled(Step *step, const Modes *modes, double a[N_JOINTS])
{
    double y[N_STATES], after[N_JOINTS], effort[N_JOINTS], part[N_JOINTS];
    in_modes(modes, step->K[0] + N_JOINTS, part);
    memcpy(y, step->y, sizeof y);
    for (int m = 0; m < N_JOINTS; m++) {
        const double share = seen(modes, m, step->size);
        a[m] = (1.0 - share) * part[m];
        for (int i = 0; i < N_JOINTS && share < 1.0; i++)
            y[N_JOINTS + i] += modes->V[m][i] * (a[m] / modes->rate[m]);
    }
    evaluate(step, y, after, effort, NULL);
    in_modes(modes, after, part);
    for (int m = 0; m < N_JOINTS; m++)
        a[m] += part[m];
}

/* Norm of the velocity changes that the stages do not see, because they come after a decay during which M⁻¹ D changes. k
   are the derivatives at y_new. The velocities that have decayed are `fast`, and their displacement is `moved`. */
static double unseen(Step *step, const Modes *modes, const double k[N_STATES])
{
    const double *v = step->y + N_JOINTS, *v_new = step->y_new + N_JOINTS;
    double lost[N_JOINTS], part[N_JOINTS], fast[N_JOINTS] = {0}, moved[N_JOINTS] = {0}, fast_2 = 0.0, moved_2 = 0.0;
    double y[N_STATES], a[N_JOINTS], effort[N_JOINTS], change[N_STATES] = {0};
    for (int i = 0; i < N_JOINTS; i++)
        lost[i] = v[i] - v_new[i];
    in_modes(modes, lost, part);
    for (int m = 0; m < N_JOINTS; m++) {
        const double share = seen(modes, m, step->size);
        for (int i = 0; i < N_JOINTS && share < 1.0; i++) {
            fast[i] += modes->V[m][i] * ((1.0 - share) * part[m]);
            moved[i] += modes->V[m][i] * ((1.0 - share) * part[m] / modes->rate[m]);
        }
    }
    for (int i = 0; i < N_JOINTS; i++) {
        fast_2 += fast[i] * fast[i];
        moved_2 += moved[i] * moved[i];
    }
    if (moved_2 == 0.0)
        return 0.0;
    const double rate = sqrt(fast_2 / moved_2);
    memcpy(y, step->y_new, sizeof y);
    for (int i = 0; i < N_JOINTS; i++)
        y[N_JOINTS + i] += rate * moved[i];
    evaluate(step, y, a, effort, NULL);
    for (int i = 0; i < N_JOINTS; i++)
        change[N_JOINTS + i] = (a[i] - k[N_JOINTS + i]) / rate + fast[i]; /* T is −rate in each mode */
    return error_norm(step, change);
}

/* Fill y_new, K and P from y and K[0]; return the norm of the error, or a larger one of the velocity changes that neither
   T nor time explains. A step passes if it is below 1. With modes, the method integrates the difference from their exact
   decay. */
static double rosenbrock(Step *step, const Modes *modes)
{
    const double h = step->size, *damping = &step->plant->value[DAMPING], *v = step->y + N_JOINTS;
    double u[N_INCREMENTS][N_STATES], Tu[N_INCREMENTS][N_STATES], k[N_STATES], error[N_STATES], *y_new = step->y_new;
    double by_T[N_STATES], rest[N_INCREMENTS + 1][N_STATES], unexplained[N_STATES] = {0}, increment[N_STATES];
    double a[N_JOINTS], change[N_STATES] = {0}, rates[N_STATES] = {0}, rates_before[N_STATES] = {0};
    DampedSystem system;
    damped_system(step, h * GAMMA, &system);
    memcpy(k, step->K[0], sizeof k);
    if (modes) {
        settled(step, modes, a);
        memset(k, 0, sizeof k);
        memcpy(rates_before, step->K[0], sizeof rates_before);
    }
    for (int stage = 0; stage < N_INCREMENTS; stage++) {
        for (int i = 0; i < N_STATES; i++)
            Tu[stage][i] = u[stage][i] = GAMMA * (h * k[i] + weighted(u, COUPLING[stage], stage, i));
        solve(&system, h * GAMMA, damping, u[stage]);
        for (int i = 0; i < N_STATES; i++)
            Tu[stage][i] = (u[stage][i] - Tu[stage][i]) / (h * GAMMA);
        const int next = stage + 1, last = next == N_INCREMENTS;
        if (modes)
            decay(modes, v, a, last ? h : NODE[next] * h, change, rates);
        for (int i = 0; i < N_STATES; i++) {
            increment[i] = last ? weighted(u, WEIGHT[stage], stage, i) + u[stage][i] : weighted(u, WEIGHT[next], next, i);
            increment[i] += change[i];
            y_new[i] = step->y[i] + increment[i];
            by_T[i] = last ? by_T[i] + Tu[stage][i] : weighted(Tu, WEIGHT[next], next, i);
        }
        memcpy(k, y_new + N_JOINTS, N_JOINTS * sizeof *k);
        evaluate(step, y_new, k + N_JOINTS, step->effort[next], last ? &step->margin_new : NULL);
        for (int i = 0; i < N_STATES; i++)
            rest[next][i] = h * (k[i] - rates[i] - (step->K[0][i] - rates_before[i]) - by_T[i]);
        for (int i = 0; !last && i < N_STATES; i++)
            k[i] -= rates[i];
    }
    fill_dense_output(step, increment, k);
    for (int i = 0; i < N_STATES; i++)
        error[i] = weighted(u, ESTIMATE, N_INCREMENTS, i);
    for (int stage = 1; stage < N_INCREMENTS; stage++)
        for (int i = N_JOINTS; i < N_STATES; i++)
            unexplained[i] = larger(unexplained[i], fabs(rest[stage][i] - NODE[stage] * rest[N_INCREMENTS][i]));
    step->inside = modes ? HUGE_VAL : error_norm(step, error);
    solve(&system, h * GAMMA, damping, error); /* it damps stiff modes as the method does */
    solve(&system, h * GAMMA, damping, unexplained);
    memset(unexplained, 0, N_JOINTS * sizeof *unexplained);
    const double other = error_norm(step, unexplained); /* it falls with h², the error with h³ */
    const double norm = larger(error_norm(step, error), other * sqrt(other));
    return modes ? larger(norm, unseen(step, modes, k) / SHARE_UNSEEN) : norm;
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
