/* Cost of one communication step of a plant and its controller, two FMUs that a program in C loads and connects: the
   time of the two engines, without a master, a bag or anything else. */
#include <dlfcn.h>
#include <math.h>
#include <stdio.h>
#include <time.h>

#include "fmi2Functions.h"

typedef struct {
    fmi2Component instance;
    fmi2SetRealTYPE *set;
    fmi2GetRealTYPE *get;
    fmi2DoStepTYPE *step;
} Engine;

static int begin(Engine *engine, const char *library, const char *guid)
{
    static const fmi2CallbackFunctions callbacks = {NULL, NULL, NULL, NULL, NULL};
    void *of = dlopen(library, RTLD_NOW | RTLD_LOCAL);
    if (!of)
        return fmi2Fatal;
    engine->set = (fmi2SetRealTYPE *)dlsym(of, "fmi2SetReal");
    engine->get = (fmi2GetRealTYPE *)dlsym(of, "fmi2GetReal");
    engine->step = (fmi2DoStepTYPE *)dlsym(of, "fmi2DoStep");
    fmi2InstantiateTYPE *instantiate = (fmi2InstantiateTYPE *)dlsym(of, "fmi2Instantiate");
    engine->instance = instantiate("part", fmi2CoSimulation, guid, "", &callbacks, 0, 0);
    if (!engine->instance)
        return fmi2Fatal;
    int status = ((fmi2SetupExperimentTYPE *)dlsym(of, "fmi2SetupExperiment"))(engine->instance, 0, 0.0, 0.0, 0, 0.0);
    status |= ((fmi2EnterInitializationModeTYPE *)dlsym(of, "fmi2EnterInitializationMode"))(engine->instance);
    return status | ((fmi2ExitInitializationModeTYPE *)dlsym(of, "fmi2ExitInitializationMode"))(engine->instance);
}

/* Processor time of a step, s, the mean of a run from the start; NaN where a call fails. References are those of q and
   v of the plant, of its tau_cmd, of q and v of the controller and of its tau_cmd; last has the last q and v. */
double system_cost(const char *const *libraries, const char *const *guids, const unsigned *const *references, int n,
                   double h, int steps, double *last)
{
    Engine plant, controller;
    double effort[64];
    int status = begin(&plant, libraries[0], guids[0]) | begin(&controller, libraries[1], guids[1]);
    if (status || n > 64)
        return NAN;
    const clock_t start = clock();
    for (int k = 0; k < steps; k++) {
        status |= plant.get(plant.instance, references[0], 2 * n, last);
        status |= controller.set(controller.instance, references[2], 2 * n, last);
        status |= controller.get(controller.instance, references[3], n, effort);
        status |= plant.set(plant.instance, references[1], n, effort);
        status |= plant.step(plant.instance, k * h, h, fmi2True);
        status |= controller.step(controller.instance, k * h, h, fmi2True);
    }
    const double cost = (double)(clock() - start) / CLOCKS_PER_SEC / steps;
    status |= plant.get(plant.instance, references[0], 2 * n, last);
    return status ? NAN : cost;
}
