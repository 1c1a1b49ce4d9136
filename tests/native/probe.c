/* Hands the engine's inner functions to the tests. */
#include <string.h>

#include "fmu.c"

static const double NO_ARMATURE[N_JOINTS] = {0};
static const double NO_CENTRE[3] = {0};

FMI2_Export void probe_task(const double q[], const double v[], double x[], double J[],
                            double drift[])
{
    JointPosition joint[N_BODIES];
    TaskFrame task;
    place_joints(q, joint);
    task_frame(joint, v, &task);
    memcpy(x, task.x, sizeof task.x);
    memcpy(J, task.J, sizeof task.J);
    memcpy(drift, task.drift, sizeof task.drift);
}

FMI2_Export void probe_turn(const double angle[], double count, double c[], double s[])
{
    for (int i = 0; i < count; i++) {
        const JointPosition position = turn(angle[i]);
        c[i] = position.c;
        s[i] = position.s;
    }
}

FMI2_Export void probe_noise(double seed, double k, double channel, double count, double pairs[])
{
    for (int i = 0; i < count; i++)
        normal_pair(seed, k + i, (int)channel, &pairs[2 * i]);
}

FMI2_Export void probe_effort_of_force(const double q[], const double force[], double tau[])
{
    JointPosition joint[N_BODIES];
    place_joints(q, joint);
    effort_of_force(joint, force, tau);
}

FMI2_Export void probe_inverse_dynamics(const double q[], const double v[], const double a[],
                                        const double gravity[], double tau[])
{
    JointPosition joint[N_BODIES];
    EndBody end_body;
    place_joints(q, joint);
    load_end_body(0.0, NO_CENTRE, &end_body);
    inverse_dynamics(joint, &end_body, NO_ARMATURE, v, a, gravity, tau);
}

FMI2_Export void probe_effort_bounds(const double q[], const double v[], const double a[],
                                     const double gravity[], double bound[])
{
    JointPosition joint[N_BODIES];
    EndBody end_body;
    place_joints(q, joint);
    load_end_body(0.0, NO_CENTRE, &end_body);
    effort_bounds(joint, &end_body, NO_ARMATURE, v, a, gravity, bound);
}

FMI2_Export void probe_acceleration_of_effort(const double q[], const double tau[], double a[])
{
    JointPosition joint[N_BODIES];
    EndBody end_body;
    place_joints(q, joint);
    load_end_body(0.0, NO_CENTRE, &end_body);
    acceleration_of_effort(joint, &end_body, NO_ARMATURE, tau, a);
}

#ifdef HAS_RCOND
FMI2_Export void probe_pseudo_inverse(double J[], double b[], double rcond, double result[])
{
    apply_pseudo_inverse((double(*)[N_JOINTS])J, b, rcond, ANY_RANK, result, NULL);
}
#endif

/* q̈ with stops at a state after an impact, that state, and the joints that rest. */
FMI2_Export void probe_stopped(double value[], const int anti_chatter[], double a[], double held[])
{
    const Plant *plant = (Plant *)value;
    Stops stops;
    double effort[N_JOINTS];
    impact(plant, &value[Q], anti_chatter);
    find_regime(plant, &value[Q], anti_chatter, ANY_RANK, 0.0, &stops, a, effort, NULL);
    for (int i = 0; i < N_JOINTS; i++)
        held[i] = stops.held[i] != FREE;
}

FMI2_Export void probe_acceleration(const double value[], double a[])
{
    Plant plant;
    memcpy(plant.value, value, sizeof plant.value);
    acceleration(&plant, &plant.value[Q], &plant.value[V], NULL, ANY_RANK, a, NULL);
}

static int rank_of(const double value[])
{
    double a[N_JOINTS];
    return acceleration((const Plant *)value, &value[Q], &value[V], NULL, ANY_RANK, a, NULL);
}

static Failure failure;

FMI2_Export int probe_advance(double value[], double h)
{
    Sampling none = {0};
    return advance_sampled(&none, (Plant *)value, 0.0, h, &failure);
}

FMI2_Export void probe_failure(double result[])
{
    result[0] = failure.reason;
    result[1] = failure.joint;
    result[2] = failure.rate;
}

FMI2_Export void probe_outputs(double value[])
{
    compute_position((Plant *)value);
    compute_effort((Plant *)value, ANY_RANK);
}

/* The changes of all computed variables for changes of q, v and inputs. */
FMI2_Export void probe_differentiate(const double value[], const int held[], const int slip[],
                                     const double change[], double derivative[])
{
    differentiate(value, held, slip, rank_of(value), WANTS_X | WANTS_TAU | WANTS_RATES, change, derivative);
    for (int i = 0; i < N_JOINTS; i++) {
        derivative[Q + i] = change[Q + i];
        derivative[V + i] = change[V + i];
    }
}

/* The derivatives of q̈ with respect to states and inputs, a row for each of them. */
FMI2_Export void probe_slopes(double value[], const int held[], const int slip[], double slope[])
{
    Stops stops = {.any_held = 1, .any_slip = 1, .rank = rank_of(value)};
    memcpy(stops.held, held, sizeof stops.held);
    memcpy(stops.slip, slip, sizeof stops.slip);
    compute_rates((Plant *)value, &stops);
    acceleration_slopes((const Plant *)value, &stops, (double(*)[N_JOINTS])slope);
}

/* All computed variables. */
FMI2_Export void probe_compute(double value[], const int held[], const int slip[])
{
    Stops stops = {.any_held = 1, .any_slip = 1, .rank = rank_of(value)};
    memcpy(stops.held, held, sizeof stops.held);
    memcpy(stops.slip, slip, sizeof stops.slip);
    compute_position((Plant *)value);
    compute_effort((Plant *)value, ANY_RANK);
    compute_rates((Plant *)value, &stops);
}
