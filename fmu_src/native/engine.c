/* The equations of motion under the control law. Compiled twice: with real numbers, and with complex ones
   for derivatives. A file uses those before it. */
#include "turn.c"
#include "mechanism.c"
#if N_ROWS > N_AXES
#include "orientation.c"
#endif
#if !COMMANDS_ACCELERATION
#include "effort_control.c"
#elif defined HAS_RCOND
#include "pseudo_inverse.c"
#include "task_control.c"
#else
#include "joint_control.c"
#endif
#include "plant.c"
#include "stops.c"
