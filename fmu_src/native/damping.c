/* The damped motion M v̇ = −D v at fixed positions: the linear system of an implicit step, and the exact solution by
   modes. The equations are those of plant/damping.py. */
#include <math.h>
#include <string.h>

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

/* Velocities V, one mode a row, with V M Vᵀ = 1 and V D Vᵀ = diag(rate), in which velocities decay at these rates, 1/s;
   and the factors of M. age is the number of steps since then, or NONE. */
typedef struct {
    double rate[N_JOINTS], V[N_JOINTS][N_JOINTS];
    DampedSystem mass;
    int age;
} Modes;

enum { NONE = -1, MAX_ROTATIONS = 20 /* of each pair of modes */ };
/* Two modes count as orthogonal if the cosine of their angle, or the ratio of their rates, is below 2⁻⁴⁰. */
static const double ORTHOGONAL_MODES = 1.0 / 1099511627776.0;

static double damped_product(const double *damping, const double a[N_JOINTS], const double b[N_JOINTS])
{
    double sum = 0.0;
    for (int i = 0; i < N_JOINTS; i++)
        sum += damping[i] * a[i] * b[i];
    return sum;
}

/* Rotate two modes so that D couples them no more; false if it does not couple them. */
static int decouple(const double *damping, double a[N_JOINTS], double b[N_JOINTS], double *rate_a, double *rate_b)
{
    const double coupling = damped_product(damping, a, b), small = ORTHOGONAL_MODES;
    if (!(coupling * coupling > small * small * (*rate_a * *rate_b)) || !(*rate_a > small * small * *rate_b)
        || !(*rate_b > small * small * *rate_a))
        return 0;
    const double zeta = 0.5 * (*rate_b - *rate_a) / coupling;
    const double t = (zeta >= 0.0 ? 1.0 : -1.0) / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
    const double c = 1.0 / sqrt(1.0 + t * t), s = c * t;
    for (int i = 0; i < N_JOINTS; i++) {
        const double x = a[i], y = b[i];
        a[i] = c * x - s * y;
        b[i] = s * x + c * y;
    }
    *rate_a -= t * coupling;
    *rate_b += t * coupling;
    return 1;
}

/* Find the modes at y, where no joint is held; false if the rotations do not converge. M = Lᵀ Δ L gives velocities with
   V M Vᵀ = 1. One-sided Jacobi rotations make them orthogonal by D too. Source: Hestenes, J. SIAM 6(1), 1958. */
static int find_modes(const Step *step, Modes *modes)
{
    const double *damping = &step->plant->value[DAMPING];
    double (*const V)[N_JOINTS] = modes->V;
    damped_system(step, 0.0, &modes->mass);
    for (int k = 0; k < N_JOINTS; k++)
        for (int i = 0; i < N_JOINTS; i++) {
            V[k][i] = i == k ? sqrt(modes->mass.L[k][k]) : 0.0;
            for (int j = k; j < i; j++)
                V[k][i] -= modes->mass.L[i][j] * V[k][j];
        }
    int rotated = 1;
    for (int sweep = 0; sweep < MAX_ROTATIONS && rotated; sweep++) {
        rotated = 0;
        for (int k = 0; k < N_JOINTS; k++)
            modes->rate[k] = damped_product(damping, V[k], V[k]);
        for (int i = 0; i < N_JOINTS; i++)
            for (int j = i + 1; j < N_JOINTS; j++)
                rotated |= decouple(damping, V[i], V[j], &modes->rate[i], &modes->rate[j]);
    }
    modes->age = rotated ? NONE : 0;
    return !rotated;
}

/* Coordinates of a velocity in the modes, V M v. */
static void in_modes(const Modes *modes, const double v[N_JOINTS], double coordinate[N_JOINTS])
{
    double momentum[N_JOINTS];
    for (int k = 0; k < N_JOINTS; k++) {
        momentum[k] = v[k];
        for (int i = 0; i < k; i++)
            momentum[k] += modes->mass.L[k][i] * v[i];
        momentum[k] /= modes->mass.L[k][k];
        for (int i = 0; i < k; i++)
            momentum[i] += modes->mass.L[k][i] * momentum[k];
    }
    for (int k = 0; k < N_JOINTS; k++) {
        coordinate[k] = 0.0;
        for (int i = 0; i < N_JOINTS; i++)
            coordinate[k] += modes->V[k][i] * momentum[i];
    }
}

/* φ₁(z) = (1 − exp(−z))/z and φ₂(z) = (1 − φ₁(z))/z. */
static void phi(double z, double *first, double *second)
{
    *first = z > 0.0 ? -expm1(-z) / z : 1.0;
    *second = z > 1e-3 ? (1.0 - *first) / z : 0.5 - z * (1.0 / 6 - z * (1.0 / 24 - z / 120));
}

/* The motion with v̇ = a at first, if only the damping changes v̇: the change of y after t, and the derivative there. a is
   in the coordinates of the modes. */
static void decay(const Modes *modes, const double v[N_JOINTS], const double a[N_JOINTS], double t,
                  double change[N_STATES], double rates[N_STATES])
{
    memset(change, 0, N_STATES * sizeof *change);
    memset(rates, 0, N_STATES * sizeof *rates);
    for (int k = 0; k < N_JOINTS; k++) {
        const double z = modes->rate[k] * t;
        double first, second;
        phi(z, &first, &second);
        for (int i = 0; i < N_JOINTS; i++) {
            change[i] += modes->V[k][i] * (t * t * second * a[k]);
            change[N_JOINTS + i] += modes->V[k][i] * (t * first * a[k]);
            rates[N_JOINTS + i] += modes->V[k][i] * ((1.0 - z * first) * a[k]);
        }
    }
    for (int i = 0; i < N_JOINTS; i++) {
        change[i] += t * v[i];
        rates[i] = v[i] + change[N_JOINTS + i];
    }
}

/* Bounds on the distances that the joints move within t in this motion. Each mode decays, and is accelerated by the
   efforts of other causes. a are the accelerations of the joints. */
static void excursions(const Modes *modes, const double v[N_JOINTS], const double a[N_JOINTS], double t,
                       double distance[N_JOINTS])
{
    double speed[N_JOINTS], acceleration[N_JOINTS], first, second;
    in_modes(modes, v, speed);
    in_modes(modes, a, acceleration);
    memset(distance, 0, N_JOINTS * sizeof *distance);
    for (int k = 0; k < N_JOINTS; k++) {
        phi(modes->rate[k] * t, &first, &second);
        const double other = acceleration[k] + modes->rate[k] * speed[k];
        const double most = t * first * fabs(speed[k]) + t * t * second * fabs(other);
        for (int i = 0; i < N_JOINTS; i++)
            distance[i] += fabs(modes->V[k][i]) * most;
    }
}
