/* FMI 2.0 functions that this FMU's modelDescription says it does not have. Some importers bind
   every name of the standard, those of Model Exchange among them: here they are refused. */
#include "instance.h"

static fmi2Status refuse(fmi2Component component, const char *function)
{
    return component ? report(component, fmi2Error, "%s is not supported by this FMU", function)
                     : fmi2Error;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component component, const fmi2ValueReference unknown[],
                                        size_t n_unknown, const fmi2ValueReference given[],
                                        size_t n_given, const fmi2Real seed[], fmi2Real result[])
{
    (void)unknown, (void)n_unknown, (void)given, (void)n_given, (void)seed, (void)result;
    return refuse(component, "fmi2GetDirectionalDerivative");
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

fmi2Status fmi2EnterEventMode(fmi2Component component)
{
    return refuse(component, "fmi2EnterEventMode");
}

fmi2Status fmi2NewDiscreteStates(fmi2Component component, fmi2EventInfo *info)
{
    (void)info;
    return refuse(component, "fmi2NewDiscreteStates");
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component component)
{
    return refuse(component, "fmi2EnterContinuousTimeMode");
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component component, fmi2Boolean no_set_state_prior,
                                       fmi2Boolean *enter_event_mode, fmi2Boolean *terminate)
{
    (void)no_set_state_prior, (void)enter_event_mode, (void)terminate;
    return refuse(component, "fmi2CompletedIntegratorStep");
}

fmi2Status fmi2SetTime(fmi2Component component, fmi2Real time)
{
    (void)time;
    return refuse(component, "fmi2SetTime");
}

fmi2Status fmi2SetContinuousStates(fmi2Component component, const fmi2Real x[], size_t count)
{
    (void)x, (void)count;
    return refuse(component, "fmi2SetContinuousStates");
}

fmi2Status fmi2GetDerivatives(fmi2Component component, fmi2Real derivatives[], size_t count)
{
    (void)derivatives, (void)count;
    return refuse(component, "fmi2GetDerivatives");
}

fmi2Status fmi2GetEventIndicators(fmi2Component component, fmi2Real indicators[], size_t count)
{
    (void)indicators, (void)count;
    return refuse(component, "fmi2GetEventIndicators");
}

fmi2Status fmi2GetContinuousStates(fmi2Component component, fmi2Real x[], size_t count)
{
    (void)x, (void)count;
    return refuse(component, "fmi2GetContinuousStates");
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component component, fmi2Real nominals[],
                                             size_t count)
{
    (void)nominals, (void)count;
    return refuse(component, "fmi2GetNominalsOfContinuousStates");
}
