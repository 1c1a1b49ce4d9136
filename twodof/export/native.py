"""The native flavour: the header of a robot's constants, and compiling the C engine with it.

The engine in ``fmu_src/native/`` is generic. Its constants are a C header, ``model.h``, in which
each joint turns about, or slides along, the z axis of its own frame: frames are rotated here, once,
so that the engine has one kind of axis. Pinocchio has read the URDF.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import BuildError
from ..plant.robot import Robot
from ..plant.variables import CONTROLS, RANGES, Variable, count_event_indicators

Array = NDArray[np.float64]

MAX_JOINTS = 128
"""The engine's working memory is on the stack: 0.2 MB at this number."""
FIRST = {"FIRST_OUTPUT": "q", "FIRST_PARAMETER": "q_start", "FIRST_BOOLEAN": "limit_effort"}
"""Where the table's parts begin: inputs, outputs, parameters, truth values among these."""


def model_header(
    robot: Robot, table: Sequence[Variable], control: str, guid: str, fmi: int = 2
) -> str:
    """The text of ``model.h``: all constants of a robot and its variables, exact to the bit.

    Names from the URDF, which may be anybody's, are string literals and nothing else.

    Args:
        robot: the robot, n joints in Pinocchio's order.
        table: its variables; a variable's place is its value reference.
        control: what drives it, a key of ``CONTROLS``.
        guid: as the modelDescription has it.
        fmi: version of FMI; 3 has vectors where 2 has their elements.

    Raises:
        BuildError: more joints than the engine's working memory has room for.
    """
    n, m = len(robot.joints), len(robot.axes)
    if n > MAX_JOINTS:
        raise BuildError(f"the robot has {n} joints; the native flavour has room for {MAX_JOINTS}")
    indicators = count_event_indicators(robot, control)
    if fmi == 3:
        table = _with_indicators(table, indicators)
    groups = [variable.group for variable in table]
    model = robot.model
    subspaces = [_subspace(joint) for joint in list(model.joints)[1:]]
    to_z = [_rotation_to_z(axis[:3] + axis[3:]) for axis in subspaces]
    turned = [np.eye(3), *to_z]  # by Pinocchio's joint index, 0 the root
    parents = [int(parent) for parent in list(model.parents)[1:]]
    placements = list(model.jointPlacements)[1:]
    inertias = list(model.inertias)[1:]
    frame = model.frames[robot.frame_id]
    path = [int(i) - 1 for i in model.supports[frame.parentJoint]][1:]
    sections = [
        "/* Constants of a robot, generated from its URDF. SI units. Each joint turns about, or\n"
        "   slides along, the z axis of its own frame. */\n"
        "#ifndef MODEL_H\n#define MODEL_H\n\n#include <math.h>\n",
        f"#define FMI {fmi}\n#define MODEL_GUID {_quoted(guid)}\n"
        f"#define N_JOINTS {n} /* that move on their own */\n"
        f"#define N_BODIES {len(parents)}\n"
        f"#define N_AXES {m}\n#define N_ROWS {m + 3 * ('quat_des' in groups)}\n"
        f"#define N_PATH {len(path)} /* joints that move the task frame */\n",
        f"#define N_INDICATORS {indicators} /* of events */\n"
        f"#define COMMANDS_ACCELERATION {int(CONTROLS[control].commands == 'acceleration')}\n"
        + ("#define HAS_RCOND\n" if "rcond" in groups else ""),
        _value_references(groups),
        "/* How many values each value reference stands for. */\n"
        + _table("int EXTENT", _extents(table, fmi)),
        _table("char *const VARIABLE_NAME", (variable.name for variable in table)),
        _table("double START", (0.0 if v.start is None else float(v.start) for v in table)),
        _ranges(groups),
        _table("char *const JOINT_NAME", robot.joints),
        "/* The tree: parents are -1 for the root; joints from the root to the task frame. */\n"
        + _table("int PARENT", (parent - 1 for parent in parents)),
        _table("int PRISMATIC", (int(axis[:3].any()) for axis in subspaces)),
        _following(robot),
        _table("int PATH", path or [0]),
        _table("int AXIS", ("xyz".index(axis) for axis in robot.axes)),
        "/* Joint frames in their parents' at q = 0; the task frame in its joint's. */\n"
        + _table(
            "double JOINT_R",
            (turned[p].T @ M.rotation @ R for p, M, R in zip(parents, placements, to_z)),
        ),
        _table(
            "double JOINT_P", (turned[p].T @ M.translation for p, M in zip(parents, placements))
        ),
        f"static const double FRAME_P[3] = "
        f"{_literal(turned[frame.parentJoint].T @ frame.placement.translation)};\n"
        f"static const double FRAME_R[3][3] = "
        f"{_literal(turned[frame.parentJoint].T @ frame.placement.rotation)};\n"
        f"enum {{ CARRIER = {int(frame.parentJoint) - 1} }}; /* the joint that carries it */\n",
        "/* Bodies: mass, centre of mass, inertia about it, in the joint's frame. */\n"
        + _table("double MASS", (inertia.mass for inertia in inertias)),
        _table("double COM", (R.T @ inertia.lever for R, inertia in zip(to_z, inertias))),
        _table("double INERTIA", (R.T @ inertia.inertia @ R for R, inertia in zip(to_z, inertias))),
        "/* Effort limits, HUGE_VAL where there is none, and viscous damping of the joints. */\n"
        + _table("double EFFORT", robot.effort),
        _table("double DAMPING", robot.damping),
        "#endif\n",
    ]
    return "\n".join(sections)


def _subspace(joint: object) -> Array:
    """Velocity of a joint with one coordinate, in its own frame: linear, angular; one is zero."""
    data = joint.createData()  # type: ignore[attr-defined]
    joint.calc(data, np.zeros(1))  # type: ignore[attr-defined]
    return np.asarray(data.S).reshape(6)


def _following(robot: Robot) -> str:
    """Which of the joints that move on their own each body's joint follows, and how."""
    G = np.eye(len(robot.joints)) if robot.coupling is None else robot.coupling
    tables = _table("double OFFSET", robot.offset.tolist())
    if robot.coupling is not None:
        tables += _table("double RATIO", G.sum(axis=1).tolist())
        tables += _table("int LEADER", (int(np.argmax(np.abs(row))) for row in G))
    return "/* A joint's position is RATIO q[LEADER] + OFFSET. */\n" + tables


def _rotation_to_z(axis: Array) -> Array:
    """A rotation R with R e_z = axis; a permutation, so exact, where the axis is x, y or z."""
    k = int(np.argmax(np.abs(axis)))
    x = np.roll(np.eye(3)[0], k + 1)  # the coordinate axis after the largest component
    x -= axis * axis.dot(x)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])


def _value_references(groups: Sequence[str]) -> str:
    lines = [f"    {group.upper()} = {groups.index(group)}," for group in dict.fromkeys(groups)]
    lines.append(f"    N_VARIABLES = {len(groups)},")
    lines += [f"    {constant} = {group.upper()}," for constant, group in FIRST.items()]
    body = "\n".join(lines)
    return f"/* Value references: the first of each vector. */\nenum {{\n{body}\n}};\n"


def _with_indicators(table: Sequence[Variable], count: int) -> list[Variable]:
    """The variables of FMI 3.0: event indicators and the time are among them."""
    first = next(i for i, variable in enumerate(table) if variable.causality == "parameter")
    places = [*(("event_indicators", i) for i in range(count)), ("time", None)]
    added = [Variable(group, i, "local", "", None, "") for group, i in places]
    return [*table[:first], *added, *table[first:]]


def _ranges(groups: Sequence[str]) -> str:
    rows = "".join(
        f"\n    {{{group.upper()}, {groups.count(group)}, {_literal(within.low)},"
        f" {_literal(within.high)}, {_quoted(within.words)}}},"
        for group, within in RANGES.items()
        if group in groups
    )
    return (
        "/* Values that variables may have; others may be any number. */\nstatic const struct {\n"
        "    int first, count;\n    double low, high;\n    const char *words;\n"
        f"}} RANGE[] = {{{rows}\n}};\n"
    )


def _extents(table: Sequence[Variable], fmi: int) -> list[int]:
    """Of each variable 1, or of each vector's first element its length and of the others 0."""
    if fmi == 2:
        return [1] * len(table)
    sizes = Counter(variable.group for variable in table)
    return [0 if variable.index else sizes[variable.group] for variable in table]


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
