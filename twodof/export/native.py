"""The native flavour: a header with the robot's constants for the C engine.

The engine in ``fmu_src/native/`` is generic. Its constants are a C header, ``model.h``; the robot's
dynamics are ``mechanism.c``. Pinocchio has read the URDF.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from ..plant.regime import BUDGET
from ..plant.robot import Robot
from ..plant.variables import CONTROLS, OF_LINKS, OF_ORIENTATION, ON_REQUEST, RANGES, Variable, count_event_indicators

FIRST = {"FIRST_OUTPUT": "q", "FIRST_PARAMETER": "q_start", "FIRST_INTEGER": "seed", "FIRST_BOOLEAN": "v_from_q"}
"""First group of each part of the table: outputs, parameters, and among these integers and Booleans."""
INDICATORS = "event_indicators"
SIGNS = "change sign where a joint reaches or leaves a stop, or the rank of J⁺ changes"


def model_header(
    robot: Robot,
    table: Sequence[Variable],
    control: str,
    guid: str,
    fmi: int = 2,
    arrays: bool = True,
    clocked: bool = False,
) -> str:
    """Return the text of ``model.h``: constants of a robot and its variables, bit-exact.

    Names from an untrusted URDF appear only in string literals. With the largest number of joints, the engine's working
    memory takes 0.2 MB of the stack.
    """
    m = len(robot.axes)
    table = engine_variables(robot, table, control, fmi)
    groups = [variable.group for variable in table]
    n_free = sum(variable.is_free for variable in table)
    known = [v.known for v in table if v.group in OF_LINKS]
    is_controller = table[groups.index("q")].causality == "input"
    sections = [
        "/* Constants of a robot, generated from its URDF. SI units. */\n"
        "#ifndef MODEL_H\n#define MODEL_H\n\n#include <math.h>\n",
        f"#define FMI {fmi}\n#define MODEL_GUID {_quoted(guid)}\n"
        f"#define N_JOINTS {len(robot.joints)} /* that move on their own */\n"
        f"#define N_BODIES {robot.model.njoints - 1} /* of which some may follow others */\n"
        f"#define N_AXES {m}\n#define N_ROWS {m + 3 * (not OF_ORIENTATION.isdisjoint(groups))}\n",
        f"#define BUDGET {BUDGET} /* evaluations of the equations of motion in one communication step, at most */\n"
        f"#define N_INDICATORS {count_event_indicators(robot, control)} /* of events */\n"
        f"#define COMMANDS_ACCELERATION {int(CONTROLS[control].commands == 'acceleration')}\n"
        f"#define IS_CONTROLLER {int(is_controller)} /* the control law alone: q and v are inputs */\n"
        f"#define IS_CLOCKED {int(clocked)} /* an importer with event mode ticks the samples */\n"
        + "".join(f"#define HAS_{group.upper()}\n" for group in ("rcond", "quat_des", *ON_REQUEST) if group in groups),
        f"enum {{ N_FREE = {n_free} }}; /* parameters that are inputs */\n"
        + (f"#define N_LINK_VALUES {len(known)} /* values of links among them */\n" if known else ""),
        _groups(groups, {**FIRST, "FIRST_OUTPUT": "x"} if is_controller else FIRST),
        _references(table, fmi == 3 and arrays),
        _table("char *const VARIABLE_NAME", (variable.name for variable in table)),
        _table("double START", (0.0 if v.start is None else float(v.start) for v in table)),
        "/* Values of links in the control law's model. */\n" + _table("double LINK_KNOWN", known) if known else "",
        _ranges(groups),
        _table("char *const JOINT_NAME", robot.joints),
        "/* Effort limits of the joints, HUGE_VAL where there is none. */\n" + _table("double EFFORT", robot.effort),
        "/* Bounds on the change of singular values, as parts of the largest, with each joint. */\n"
        + _table("double SWING", robot.swing()),
        "#endif\n",
    ]
    return "\n".join(sections)


def engine_variables(robot: Robot, table: Sequence[Variable], control: str, fmi: int) -> Sequence[Variable]:
    """Return the variables in engine order; in FMI 3.0 with event indicators and the time."""
    if fmi == 2:
        return table
    first = next(i for i, variable in enumerate(table) if variable.causality == "parameter")
    count = count_event_indicators(robot, control)
    shown = all(variable.shown for variable in table)
    indicators = [Variable(INDICATORS, i, "local", "", None, SIGNS, shown=shown) for i in range(count)]
    time = Variable("time", None, "independent", "s", None, "time")
    return [*table[:first], *indicators, time, *table[first:]]


def _groups(groups: Sequence[str], first: Mapping[str, str]) -> str:
    lines = [f"    {group.upper()} = {groups.index(group)}," for group in dict.fromkeys(groups)]
    lines.append(f"    N_VARIABLES = {len(groups)},")
    lines += [f"    {constant} = {group.upper()}," for constant, group in first.items()]
    body = "\n".join(lines)
    return f"/* Places of variables: the first of each vector. */\nenum {{\n{body}\n}};\n"


def _ranges(groups: Sequence[str]) -> str:
    rows = "".join(
        f"\n    {{{group.upper()}, {groups.count(group)},"
        f" {_literal(within.low)}, {_literal(within.high)}, {_quoted(within.words)}}},"
        for group, within in RANGES.items()
        if group in groups
    )
    return (
        "/* Values that variables may have; others may be any number. */\nstatic const struct {\n"
        "    int first, count;\n    double low, high;\n    const char *words;\n"
        f"}} RANGE[] = {{{rows}\n}};\n"
    )


def _references(table: Sequence[Variable], arrays: bool) -> str:
    """Return value references of variables or whole vectors; they begin with 1, as some importers require."""
    indices = [i for i, variable in enumerate(table) if not (arrays and variable.index)]
    return (
        "/* The values of a reference, from 1 on: from INDEX[vr] to before INDEX[vr + 1]. */\n"
        f"enum {{ N_REFERENCES = {len(indices)}, CLOCK = N_REFERENCES + 1 }};\n"
        + _table("int INDEX", [0, *indices, len(table)])
    )


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
    """Return a C string literal; bytes other than printable ASCII become octal escapes."""
    escaped = "".join(
        chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\?' else f"\\{byte:03o}" for byte in text.encode()
    )
    return f'"{escaped}"'
