/* The equations of motion under the control law. This file is compiled twice: with real numbers, and with complex
   numbers for derivatives. Each file uses only files that are included before it. */
#include "turn.c"
#include "mechanism.c"
#ifdef HAS_QUAT
#include "orientation.c"
#endif
#if !COMMANDS_ACCELERATION
#include "effort_control.c"
#elif defined HAS_RCOND
#include "pseudo_inverse.c"
#include "task_control.c"
#ifndef IS_COMPLEX
#include "task_slopes.c"
#endif
#else
#include "joint_control.c"
#endif
#include "plant.c"
#include "contacts.c"
#include "stops.c"
#ifndef IS_COMPLEX
#include "jacobian.c"
#endif
