/* Derivatives along a direction, exact to rounding, by the complex step:

       f(x + i h d) = f(x) + i h f'(x) d,   h = 1e-100

   The engine's files are compiled a second time with complex numbers. Compilers without complex numbers use central
   differences.
   Source: Squire & Trapp, SIAM Review 40(1), 1998. */
#include <float.h>
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "directional.h"

typedef double Real;

/* Scale of the changes, at least the smallest safe divisor. */
static Real largest_of(const Real change[], int count)
{
    Real largest = DBL_MIN;
    for (int i = 0; i < count; i++)
        largest = fabs(change[i]) > largest ? fabs(change[i]) : largest;
    return largest;
}

#if defined _MSC_VER || defined __STDC_NO_COMPLEX__ || defined NO_COMPLEX
#define COMPLEX 0
#else
#define COMPLEX 1
#include <complex.h>
#undef I     /* the engine uses this name */
#undef creal /* musl's macros cast to double, which is redefined below */
#undef cimag
#ifdef __clang__ /* a robot may not need all functions, and a keyword becomes a macro */
#pragma clang diagnostic ignored "-Wunused-function"
#pragma clang diagnostic ignored "-Wkeyword-macro"
#endif

static const Real STEP = 1e-100;
static const double _Complex UNIT = (double _Complex)_Complex_I;

/* x = a + i b, by C99's representation (6.2.5, paragraph 13): the expression would compute the product i b. */
static inline void assign(double _Complex *x, Real a, Real b)
{
    ((Real *)x)[0] = a;
    ((Real *)x)[1] = b;
}

static inline double _Complex complex_atan2(double _Complex y, double _Complex x)
{
    const Real a = creal(x), b = creal(y), square = a * a + b * b;
    return atan2(b, a) + UNIT * ((a * cimag(y) - b * cimag(x)) / square);
}

static inline double _Complex complex_fabs(double _Complex x)
{
    return creal(x) < 0.0 ? -x : x;
}

static inline double _Complex complex_sqrt(double _Complex x)
{
    const Real root = sqrt(creal(x));
    return root + UNIT * ((root > 0.0 ? 0.5 / root : 0.0) * cimag(x));
}

static inline double _Complex complex_fmax(double _Complex a, double _Complex b)
{
    return creal(a) < creal(b) ? b : a;
}

/* From here on, the engine has complex numbers. The standard headers that it includes are included above. */
#define double double _Complex
#define sqrt complex_sqrt
#define atan2 complex_atan2
#define fabs complex_fabs
#define fmax complex_fmax
#undef RE
#define RE(x) creal(x)
#define IS_COMPLEX
#endif

#undef INTERNAL
#define INTERNAL static inline /* derivatives do not need all functions */
#include "engine.c"

/* Compute the requested variables. */
static void evaluate(Plant *plant, const int held[N_JOINTS], const int slip[N_JOINTS], int rank,
                     int wanted)
{
    if (wanted & WANTS_X)
        compute_position(plant);
    if (wanted & WANTS_TAU)
        compute_effort(plant, rank);
    for (int i = 0; i < N_JOINTS && wanted & WANTS_SAMPLE && plant->value[CONTROL_PERIOD] == 0.0; i++) {
        if (plant->value[Q_RESOLUTION + i] == 0.0) /* noise does not depend on the state */
            plant->value[Q_MEAS + i] = plant->value[Q + i];
        if (plant->value[V_FROM_Q] == 0.0)
            plant->value[V_MEAS + i] = plant->value[V + i];
    }
    if (wanted & WANTS_RATES) {
        Stops stops = {.rank = rank};
        for (int i = 0; i < N_JOINTS; i++) {
            stops.any_held |= stops.held[i] = held[i];
            stops.any_slip |= stops.slip[i] = slip[i];
        }
        compute_rates(plant, &stops);
    }
    if (wanted & WANTS_LAW) {
        JointPosition joint[N_BODIES];
        place_joints(&plant->value[Q], joint);
        command(plant->value, joint, &plant->value[Q], &plant->value[V], rank, &plant->value[DER_V], NULL);
    }
}

#if COMPLEX
void differentiate(const Real value[], const int held[], const int slip[], int rank, int wanted,
                   const Real change[], Real derivative[])
{
    const Real largest = largest_of(change, X); /* scales the direction, so that every step is small */
    const Real inverse = 1.0 / largest, up = 1.0 / STEP;
    Plant plant;
    for (int i = 0; i < N_VARIABLES; i++)
        plant.value[i] = value[i];
    for (int i = 0; i < X; i++)
        plant.value[i] += UNIT * (change[i] * inverse * STEP);
    evaluate(&plant, held, slip, rank, wanted);
    for (int i = 0; i < FIRST_PARAMETER; i++)
        derivative[i] = cimag(plant.value[i]) * up * largest;
}
#else
/* ∛ε, for which truncation and rounding errors are of equal size. */
static const Real NUDGE = 6e-6;

void differentiate(const Real value[], const int held[], const int slip[], int rank, int wanted,
                   const Real change[], Real derivative[])
{
    const Real largest = largest_of(change, X);
    Plant after, before;
    for (int i = 0; i < N_VARIABLES; i++) {
        const Real nudge = i < X ? NUDGE * (change[i] / largest) : 0.0;
        after.value[i] = value[i] + nudge;
        before.value[i] = value[i] - nudge;
    }
    evaluate(&after, held, slip, rank, wanted);
    evaluate(&before, held, slip, rank, wanted);
    for (int i = 0; i < FIRST_PARAMETER; i++)
        derivative[i] = (after.value[i] - before.value[i]) / (2.0 * NUDGE) * largest;
}
#endif
