/* Hands the engine's inner functions to the tests. */
#include <string.h>

#include "dynamics.h"
#include "fmi2Functions.h"
#include "integrator.h"
#include "pseudo_inverse.h"

FMI2_Export void probe_task(const double q[], const double v[], double x[], double J[],
                            double drift[])
{
    Placement joint[N_JOINTS];
    TaskFrame task;
    place_joints(q, joint);
    task_frame(joint, v, &task);
    memcpy(x, task.x, sizeof task.x);
    memcpy(J, task.J, sizeof task.J);
    memcpy(drift, task.drift, sizeof task.drift);
}

FMI2_Export void probe_inverse_dynamics(const double q[], const double v[], const double a[],
                                        const double gravity[], double tau[])
{
    Placement joint[N_JOINTS];
    place_joints(q, joint);
    inverse_dynamics(joint, v, a, gravity, tau);
}

FMI2_Export void probe_acceleration_of_effort(const double q[], const double tau[], double a[])
{
    Placement joint[N_JOINTS];
    place_joints(q, joint);
    acceleration_of_effort(joint, tau, a);
}

FMI2_Export void probe_pseudo_inverse(double J[], double b[], double rcond, double result[])
{
    apply_pseudo_inverse((double(*)[N_JOINTS])J, b, rcond, result);
}

FMI2_Export void probe_acceleration(const double value[], double a[])
{
    Plant plant;
    memcpy(plant.value, value, sizeof plant.value);
    acceleration(&plant, &plant.value[Q], &plant.value[V], a);
}

static Obstacle obstacle;

FMI2_Export int probe_advance(double value[], double h)
{
    return advance_plant((Plant *)value, h, &obstacle);
}

FMI2_Export void probe_obstacle(double result[])
{
    result[0] = obstacle.reason;
    result[1] = obstacle.joint;
    result[2] = obstacle.rate;
}

FMI2_Export void probe_outputs(double value[])
{
    compute_position((Plant *)value);
    compute_effort((Plant *)value);
}
