/* Three FMUs of one program, as sources with prefixes: A_ and B_ of FMI 3.0, C_ of FMI 2.0. Their steps
   are interleaved.

   embedded TOKEN REFERENCE TOKEN REFERENCE GUID REFERENCE
   prints q of all, of two joints each, every 10 of 500 steps of 10 ms; a reference is that of q. */
#include <stdio.h>
#include <stdlib.h>

#include "fmi2FunctionTypes.h"
#include "fmi3FunctionTypes.h"

#define DECLARE(P, V)                                                                             \
    V##DoStepTYPE P##V##DoStep;                                                                   \
    V##ExitInitializationModeTYPE P##V##ExitInitializationMode;                                   \
    V##EnterInitializationModeTYPE P##V##EnterInitializationMode;                                 \
    V##FreeInstanceTYPE P##V##FreeInstance;
DECLARE(A_, fmi3)
DECLARE(B_, fmi3)
DECLARE(C_, fmi2)
fmi3InstantiateCoSimulationTYPE A_fmi3InstantiateCoSimulation, B_fmi3InstantiateCoSimulation;
fmi3GetFloat64TYPE A_fmi3GetFloat64, B_fmi3GetFloat64;
fmi2InstantiateTYPE C_fmi2Instantiate;
fmi2GetRealTYPE C_fmi2GetReal;
fmi2SetupExperimentTYPE C_fmi2SetupExperiment;

static void say(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                fmi3String message)
{
    (void)environment, (void)status;
    fprintf(stderr, "%s: %s\n", category, message);
}

int main(int count, char *argument[])
{
    static const fmi2CallbackFunctions callbacks = {NULL, calloc, free, NULL, NULL};
    const unsigned *no = NULL;
    fmi3Boolean event, end, early;
    double q[6], last;
    if (count != 7)
        return 1;
    const fmi3ValueReference a_q = (unsigned)atoi(argument[2]), b_q = (unsigned)atoi(argument[4]);
    const fmi2ValueReference c_q[2] = {(unsigned)atoi(argument[6]), (unsigned)atoi(argument[6]) + 1};
    void *a = A_fmi3InstantiateCoSimulation("a", argument[1], "", 0, 0, 0, 0, no, 0, NULL, say, NULL);
    void *b = B_fmi3InstantiateCoSimulation("b", argument[3], "", 0, 0, 0, 0, no, 0, NULL, say, NULL);
    void *c = C_fmi2Instantiate("c", fmi2CoSimulation, argument[5], "", &callbacks, 0, 0);
    if (!a || !b || !c)
        return 2;
    int bad = C_fmi2SetupExperiment(c, 0, 0.0, 0.0, 0, 0.0);
    bad |= A_fmi3EnterInitializationMode(a, 0, 0.0, 0.0, 0, 0.0) | A_fmi3ExitInitializationMode(a);
    bad |= C_fmi2EnterInitializationMode(c) | C_fmi2ExitInitializationMode(c);
    bad |= B_fmi3EnterInitializationMode(b, 0, 0.0, 0.0, 0, 0.0) | B_fmi3ExitInitializationMode(b);
    for (int k = 0; k < 500 && !bad; k++) {
        bad |= B_fmi3DoStep(b, k * 0.01, 0.01, true, &event, &end, &early, &last);
        bad |= A_fmi3DoStep(a, k * 0.01, 0.01, true, &event, &end, &early, &last);
        bad |= C_fmi2DoStep(c, k * 0.01, 0.01, 1);
        bad |= A_fmi3GetFloat64(a, &a_q, 1, q, 2) | B_fmi3GetFloat64(b, &b_q, 1, q + 2, 2);
        bad |= C_fmi2GetReal(c, c_q, 2, q + 4);
        if (k % 10 == 9)
            printf("%.17g %.17g %.17g %.17g %.17g %.17g\n", q[0], q[1], q[2], q[3], q[4], q[5]);
    }
    A_fmi3FreeInstance(a), B_fmi3FreeInstance(b), C_fmi2FreeInstance(c);
    return bad ? 3 : 0;
}
