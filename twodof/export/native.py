"""The native flavour: the header of a robot's constants, and compiling the C engine with it.

The engine in ``fmu_src/native/`` is generic. Its constants are a C header, ``model.h``, in which
each joint turns about, or slides along, the z axis of its own frame: frames are rotated here, once,
so that the engine has one kind of axis. Pinocchio has read the URDF.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from ..errors import BuildError
from ..plant.robot import Robot
from ..plant.variables import CONTROLS, Variable, count_event_indicators
from .recursions import (
    Array,
    Body,
    Mechanism,
    inverse_dynamics,
    mass_matrix,
    mechanism,
    solve_by_factors,
    solve_by_recursion,
    task_frame,
)
from .straight_line import Expression, Value, c_function, cosine, operations, sine

MAX_JOINTS = 128
"""The engine's working memory is on the stack: 0.2 MB at this number."""
FIRST = {"FIRST_OUTPUT": "q", "FIRST_PARAMETER": "q_start", "FIRST_BOOLEAN": "limit_effort"}
"""Where the table's parts begin: inputs, outputs, parameters, truth values among these."""


def model_header(robot: Robot, table: Sequence[Variable], control: str, guid: str) -> str:
    """The text of ``model.h``: all constants of a robot and its variables, exact to the bit.

    Names from the URDF, which may be anybody's, are string literals and nothing else.

    Args:
        robot: the robot, n joints in Pinocchio's order.
        table: its variables; a variable's place is its value reference.
        control: what drives it, a key of ``CONTROLS``.
        guid: as the modelDescription has it.

    Raises:
        BuildError: more joints than the engine's working memory has room for.
    """
    n, m = len(robot.joints), len(robot.axes)
    if n > MAX_JOINTS:
        raise BuildError(f"the robot has {n} joints; the native flavour has room for {MAX_JOINTS}")
    groups = [variable.group for variable in table]
    sections = [
        "/* Constants of a robot, generated from its URDF. SI units. */\n"
        "#ifndef MODEL_H\n#define MODEL_H\n\n#include <math.h>\n",
        f"#define MODEL_GUID {_quoted(guid)}\n"
        f"#define N_JOINTS {n} /* that move on their own */\n"
        f"#define N_BODIES {robot.model.njoints - 1} /* of which some may follow others */\n"
        f"#define N_AXES {m}\n#define N_ROWS {m + 3 * ('quat_des' in groups)}\n",
        f"#define N_INDICATORS {count_event_indicators(robot, control)} /* of events */\n"
        f"#define COMMANDS_ACCELERATION {int(CONTROLS[control].commands == 'acceleration')}\n"
        + ("#define HAS_RCOND\n" if "rcond" in groups else ""),
        _value_references(groups),
        _table("char *const VARIABLE_NAME", (variable.name for variable in table)),
        _table("double START", (0.0 if v.start is None else float(v.start) for v in table)),
        _table("char *const JOINT_NAME", robot.joints),
        "/* Effort limits, HUGE_VAL where there is none, and viscous damping of the joints. */\n"
        + _table("double EFFORT", robot.effort),
        _table("double DAMPING", robot.damping),
        "#endif\n",
    ]
    return "\n".join(sections)


def mechanism_source(robot: Robot, table: Sequence[Variable]) -> str:
    """The text of ``mechanism.c``: the robot's kinematics and dynamics, without loops."""
    n, constants = len(robot.joints), mechanism(robot)
    joint = np.array(
        [
            (Expression(f"joint[{i}].c"), 0.0 if slides else Expression(f"joint[{i}].s"))
            for i, slides in enumerate(constants.prismatic)
        ]
    )
    a, tau, force = _variables("a", n), _variables("tau", n), _variables("force", 3)
    x, R, J, drift = task_frame(constants, joint, _variables("v", n))
    rows = ["xyz".index(axis) for axis in robot.axes]
    frame = _elements("task->x", x[rows])
    if any(variable.group == "quat_des" for variable in table):
        rows += [3, 4, 5]
        frame |= _elements("task->R", R)
    frame |= _elements("task->J", J[rows]) | _elements("task->drift", drift[rows])
    bodies, load = _loaded(constants)
    effort = inverse_dynamics(
        constants, bodies, joint, _variables("v", n), a, _variables("gravity", 3)
    )
    ways = [solve_by_factors(mass_matrix(constants, bodies, joint), tau)]
    if robot.coupling is None:
        ways.append(solve_by_recursion(constants, bodies, joint, tau))
    in_all = "const JointPosition joint[N_BODIES]"
    functions = {
        f"place_joints(const double q[N_JOINTS], {in_all[6:]})": _places(constants),
        f"task_frame({in_all}, const double v[N_JOINTS], TaskFrame *task)": frame,
        f"effort_of_force({in_all}, const double force[3], double tau[N_JOINTS])": _elements(
            "tau", J[:3].T.dot(force)
        ),
        "load_carrier(double payload, const double place[3], Carrier *carrier)": load,
        f"inverse_dynamics({in_all}, const Carrier *carrier, const double v[N_JOINTS],"
        " const double a[N_JOINTS], const double gravity[3], double tau[N_JOINTS])": _elements(
            "tau", effort
        ),
        f"acceleration_of_effort({in_all}, const Carrier *carrier, const double tau[N_JOINTS],"
        " double a[N_JOINTS])": _elements("a", min(ways, key=operations)),
    }
    return MECHANISM + "".join(
        "\n" + c_function(f"void {head}", results) for head, results in functions.items()
    )


MECHANISM = """\
/* The robot's kinematics and dynamics, generated from its URDF: recursions over its joints,
   done with expressions, so that what its constants make 0 or 1 costs nothing. */
#include "mechanism.h"

#include <math.h>
"""
LOWER = np.tril_indices(3)


def _places(robot: Mechanism) -> dict[str, Value]:
    angles = robot.G.dot(_variables("q", robot.G.shape[1])) + robot.c
    places: dict[str, Value] = {}
    for i, (angle, slides) in enumerate(zip(angles, robot.prismatic)):
        places[f"joint[{i}].c"] = angle if slides else cosine(angle)
        places[f"joint[{i}].s"] = 0.0 if slides else sine(angle)
    return places


def _loaded(robot: Mechanism) -> tuple[list[Body], dict[str, Value]]:
    """The bodies, that with the payload as variables; and what these are."""
    carrier, place = robot.path[-1], _variables("place", 3)
    loaded = robot.body[carrier].with_point(
        Expression("payload"), robot.frame_p + robot.frame_R.dot(place)
    )
    load = {"carrier->mass": loaded.mass}
    load |= _elements("carrier->moment", loaded.moment)
    load |= _elements("carrier->inertia", loaded.inertia[LOWER])
    inertia = np.zeros((3, 3), dtype=object)
    inertia[LOWER] = inertia.T[LOWER] = _variables("carrier->inertia", 6)
    bodies = list(robot.body)
    bodies[carrier] = Body(Expression("carrier->mass"), _variables("carrier->moment", 3), inertia)
    return bodies, load


def _variables(name: str, count: int) -> Array:
    return np.array([Expression(f"{name}[{i}]") for i in range(count)], dtype=object)


def _elements(name: str, values: Array) -> dict[str, Value]:
    """Each element of an array by its name in C."""
    return {
        name + "".join(f"[{i}]" for i in place): value for place, value in np.ndenumerate(values)
    }


def _value_references(groups: Sequence[str]) -> str:
    lines = [f"    {group.upper()} = {groups.index(group)}," for group in dict.fromkeys(groups)]
    lines.append(f"    N_VARIABLES = {len(groups)},")
    lines += [f"    {constant} = {group.upper()}," for constant, group in FIRST.items()]
    body = "\n".join(lines)
    return f"/* Value references: the first of each vector. */\nenum {{\n{body}\n}};\n"


def _table(declaration: str, values: Iterable[object]) -> str:
    rows = list(values)
    shape = "".join(f"[{size}]" for size in (len(rows), *np.asarray(rows[0]).shape))
    body = "".join(f"\n    {_literal(row)}," for row in rows)
    return f"static const {declaration}{shape} = {{{body}\n}};\n"


def _literal(value: object) -> str:
    if isinstance(value, np.ndarray):
        return "{" + ", ".join(_literal(element) for element in value) + "}"
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, int):
        return str(value)
    number = float(value)  # type: ignore[arg-type]
    return "HUGE_VAL" if np.isinf(number) else repr(number)


def _quoted(text: str) -> str:
    """A C string literal; what is not printable ASCII as octal escapes of its UTF-8."""
    escaped = "".join(
        chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\?' else f"\\{byte:03o}"
        for byte in text.encode()
    )
    return f'"{escaped}"'
