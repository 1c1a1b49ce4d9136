/* FMI 2.0 functions that this FMU's modelDescription says it does not have. Some importers bind
   every name of the standard: here they are refused. */
#include "instance.h"

static fmi2Status refuse(fmi2Component component, const char *function)
{
    return component ? report(component, fmi2Error, "%s is not supported by this FMU", function)
                     : fmi2Error;
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component component, const fmi2ValueReference vr[],
                                       size_t count, const fmi2Integer order[],
                                       const fmi2Real value[])
{
    (void)vr, (void)count, (void)order, (void)value;
    return refuse(component, "fmi2SetRealInputDerivatives");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component component, const fmi2ValueReference vr[],
                                        size_t count, const fmi2Integer order[], fmi2Real value[])
{
    (void)vr, (void)count, (void)order, (void)value;
    return refuse(component, "fmi2GetRealOutputDerivatives");
}
