"""Generate ``mechanism.c`` of the native flavour: the robot's kinematics and dynamics as C."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from ..plant.robot import Robot
from ..plant.variables import OF_LINKS, OF_ORIENTATION, Variable
from .bodies import Array, Body, FreeLink, JointTree, joint_tree
from .derivatives import ROOT, joint_force, joint_frame, joint_motion, joint_motions, joint_positions, joint_ratios
from .recursions import (
    effort_bounds,
    hybrid_by_factors,
    hybrid_by_recursion,
    inverse_dynamics,
    mass_matrix,
    operations_of_factors,
    task_frame,
)
from .straight_line import Expression, Value, Varied, c_function, operations, varied


def mechanism_source(robot: Robot, table: Sequence[Variable], links: Sequence[FreeLink] = ()) -> str:
    """Return the text of ``mechanism.c``: the robot's kinematics and dynamics as straight-line code."""
    n, constants = len(robot.joints), joint_tree(robot, links)
    joint = np.array(
        [
            (Expression(f"joint[{i}].c"), 0.0 if slides else Expression(f"joint[{i}].s"))
            for i, slides in enumerate(constants.prismatic)
        ]
    )
    v, a, force = _variables("v", n), _variables("a", n), _variables("force", 3)
    armature, gravity = _variables("armature", n), _variables("gravity", 3)
    free = {name for v in table if v.causality == "input" for name in OF_PARAMETER.get(v.group, ())}
    held = sorted({name for names in OF_PARAMETER.values() for name in names} - free)
    x, R, J, drift = task_frame(constants, joint, v)
    rows = ["xyz".index(axis) for axis in robot.axes]
    frame = _elements("task->x", x[rows])
    if any(variable.group in OF_ORIENTATION for variable in table):
        rows += [3, 4, 5]
        frame |= _elements("task->R", R)
    frame |= _elements("task->J", J[rows]) | _elements("task->drift", drift[rows])
    frame |= _elements("task->xd", J[rows].dot(v))
    bodies, load = _loaded(constants)
    effort = inverse_dynamics(constants, bodies, joint, armature, v, a, gravity)
    bounds = np.abs(effort), effort_bounds(constants, bodies, joint, armature, v, a, gravity)
    in_all = "const JointPosition joint[N_BODIES]"
    moved = "const double v[N_JOINTS], const double a[N_JOINTS], const double gravity[3]"
    motion = f"{in_all}, {INERTIAS}, {moved}"
    functions = {
        f"task_frame({in_all}, const double v[N_JOINTS], TaskFrame *task)": frame,
        f"effort_of_force({in_all}, const double force[3], double tau[N_JOINTS])": _elements("tau", J[:3].T.dot(force)),
        f"{LOAD_BODIES if links else LOAD_END_BODY}, EndBody *end_body)": load,
        f"inverse_dynamics({motion}, double tau[N_JOINTS])": _elements("tau", effort),
    }
    alike = {
        f"place_joints(const double q[N_JOINTS], {in_all[6:]})": _places(constants),
        f"effort_bounds({motion}, double bound[N_JOINTS])": _elements("bound", min(bounds, key=operations)),
    }
    texts = [c_function(f"void {head}", results) for head, results in alike.items()]
    texts += [
        c_function(f"void {head}", results, varied(results.values(), held=held)) for head, results in functions.items()
    ]
    texts += _forward_dynamics(constants, bodies, joint, armature, in_all, held)
    texts += ["#ifndef IS_COMPLEX", _tree(constants, rows[: len(robot.axes)])]
    motions = joint_motions(constants, joint, v, a, gravity)
    s, psi, chi, velocity, *others = motions
    at_rest = [s, np.zeros(psi.shape), chi, np.zeros(velocity.shape), *others]
    derived = {
        f"joint_frame(const JointFrame *frame, const double position[3], {MOTIONS})": (
            _joint_frame(constants, joint, motions)
        ),
        f"joint_motion(const JointFrame *frame, const double rate[2], {MOTIONS})": _joint_motion(constants, motions),
        f"joint_force({ONE_JOINT})": _joint_force(bodies, motions),
        f"joint_force_at_rest({ONE_JOINT})": _joint_force(bodies, at_rest),
        f"mass_matrix({in_all}, {INERTIAS}, double M[N_JOINTS][N_JOINTS])": _elements(
            "M", mass_matrix(constants, bodies, joint, armature)
        ),
    }
    texts += [c_function(f"void {head}", results) for head, results in derived.items()]
    return "\n".join([MECHANISM, *texts, "#endif\n"])


def _tree(robot: JointTree, axes: Sequence[int]) -> str:
    """Return C constants: the parent and the leader of each joint, the bodies, the frames, and the task's axes."""
    rows = {"PARENT": robot.parent, "LEADER": np.abs(robot.G).argmax(axis=1), "LOADED": _indices(robot)}
    lines = [f"static const int {name}[N_BODIES] = {{{', '.join(map(str, row))}}};" for name, row in rows.items()]
    parts = [[", ".join(map(_constant, part.flat)) for part in _parts(body)] for body in robot.body]
    constants = ", ".join(f"{{{mass}, {{{moment}}}, {{{inertia}}}}}" for mass, moment, inertia in parts)
    lines.append(f"static const EndBody BODY[N_BODIES] = {{{constants}}};")
    frames = [*zip(robot.R.tolist(), robot.p.tolist(), joint_ratios(robot).tolist())]
    lines.append(f"static const JointFrame FRAME[N_BODIES] = {_braces(frames)};")
    lines.append(f"static const double END_P[3] = {_braces(robot.frame_p.tolist())};")
    lines.append(f"static const int AXIS[N_AXES] = {{{', '.join(map(str, axes))}}};")
    return "\n".join([*lines, f"enum {{ END_BODY = {robot.path[-1]} }};"])


def _braces(values: object) -> str:
    """Return nested sequences of numbers in C."""
    return f"{{{', '.join(map(_braces, values))}}}" if isinstance(values, (list, tuple)) else repr(values)


def _constant(value: Value) -> str:
    """Return a constant in C; the values of a body that varies are not read."""
    return "0.0" if isinstance(value, Expression) else repr(float(value))


def _joint_frame(robot: JointTree, joint: Array, motions: Sequence[Array]) -> dict[str, Value]:
    """Return the frame of any joint by its names in C; constants that all joints have are folded."""
    constant = _common("frame->R", [*robot.R]), _common("frame->p", [*robot.p])
    position = _common("position", [*joint_positions(robot, joint)])
    before = _common("before->R", _before(robot, motions[-2], ROOT[0])), _variables("before->origin", 3)
    return _named(["motion->R", "motion->origin"], joint_frame(constant, position, before))


def _joint_motion(robot: JointTree, motions: Sequence[Array]) -> dict[str, Value]:
    """Return the motion of any joint by its names in C; constants that all joints have are folded."""
    frame = _common("motion->R", [*motions[-2]]), _common("motion->origin", [*motions[-1]])
    ratio = _common("frame->ratio", [*joint_ratios(robot)])
    roots = np.zeros(6), np.array([0.0, 0.0, 0.0, *_variables("gravity", 3)])
    before = [
        _common(f"before->{field}", _before(robot, rows, root))
        for field, rows, root in zip(("velocity", "acceleration"), motions[3:5], roots)
    ]
    motion = joint_motion(frame, ratio, [*_variables("rate", 2)], before)
    return _named([f"motion->{field}" for field in MOTION], motion)


def _before(robot: JointTree, rows: Array, root: Array) -> list[Array]:
    """Return for each joint the row of its parent, which is a joint or the root."""
    return [rows[parent] if parent >= 0 else root for parent in robot.parent]


def _joint_force(bodies: Sequence[Body], motions: Sequence[Array]) -> dict[str, Value]:
    """Return the load and the terms of any joint by their names in C; constants that all joints have are folded."""
    body = _body_of(*(_common(f"body->{part}", rows) for part, rows in zip(BODY, zip(*map(_parts, bodies)))))
    motion = [_common(f"motion->{field}", [*rows]) for field, rows in zip(MOTION, motions)]
    nothing = Body(0.0, np.zeros(3), np.zeros((3, 3))), np.zeros(3), np.zeros((3, 3)), np.zeros(6)
    loads = [_parts(*load) for load in (nothing, joint_force(body, motion, nothing)[0])]
    *inertial, p, B, f = (_common(f"beyond->{part}", rows) for part, rows in zip(LOAD, zip(*loads)))
    load, terms = joint_force(body, motion, (_body_of(*inertial), p, B, f))
    names = [*(f"load->{part}" for part in LOAD), *(f"force->{term}" for term in FORCE)]
    return _named(names, [*_parts(*load), *terms])


def _common(name: str, rows: Sequence[Array]) -> Array:
    """Return the constants that several arrays have in common, and variables for their other elements."""
    common = np.array(rows[0], dtype=object)
    for variable, index in zip(_elements(name, common), np.ndindex(common.shape)):
        if any(isinstance(row[index], Expression) or row[index] != common[index] for row in rows):
            common[index] = Expression(variable)
    return common


def _forward_dynamics(
    robot: JointTree, bodies: Sequence[Body], joint: Array, armature: Array, in_all: str, held: Sequence[str]
) -> list[str]:
    """Return forward dynamics with free and with held joints.

    They use factors of M or articulated bodies, whichever takes fewer operations.
    """
    n = robot.G.shape[1]
    a, tau, free, given = (_variables(name, n) for name in ("a", "tau", "free", "given"))
    all_free, split = (tau, np.ones(n), np.zeros(n)), (free * given, free, given - free * given)
    solvers = [partial(hybrid_by_recursion, robot, bodies, joint, armature)] if n == len(robot.parent) else []
    ways = [solve(*all_free)[0] for solve in solvers]
    if not ways or operations_of_factors(robot.parent) < operations(ways[0]):
        solvers.insert(0, partial(hybrid_by_factors, mass_matrix(robot, bodies, joint, armature)))
        ways.insert(0, solvers[0](*all_free)[0])
    solution = min(ways, key=operations)
    inertial = inverse_dynamics(robot, bodies, joint, armature, np.zeros(n), a, np.zeros(3))
    hybrid = min((solve(*split) for solve in solvers), key=lambda both: operations([*both[0], *both[1]]))
    solve = f"void acceleration_of_effort({in_all}, {INERTIAS}, const double tau[N_JOINTS], double a[N_JOINTS])"
    hold = (
        f"void hybrid_dynamics({in_all}, {INERTIAS}, const double free[N_JOINTS],"
        " const double given[N_JOINTS], double a[N_JOINTS], double reaction[N_JOINTS])"
    )
    holding = c_function(hold, _elements("a", hybrid[0]) | _elements("reaction", hybrid[1]))
    return [
        c_function(solve, _elements("a", solution), _solution(solution, inertial, held)),
        f"#ifndef IS_COMPLEX\n{holding}#endif\n",
    ]


MECHANISM = """\
/* The robot's kinematics and dynamics, generated from its URDF: recursions over its joints,
   done with expressions, so that what its constants make 0 or 1 costs nothing. */
#include "mechanism.h"

#include <math.h>
"""
INERTIAS = "const EndBody *end_body, const double armature[N_JOINTS]"
LOAD_END_BODY = "load_end_body(double payload, const double offset[3]"
LOAD_BODIES = "load_bodies(double payload, const double offset[3], const double link[N_LINK_VALUES]"
MOTIONS = "const JointMotion *before, JointMotion *motion"
ONE_JOINT = "const EndBody *body, const JointMotion *motion, const Load *beyond, Load *load, JointForce *force"
END_BODY = ("end_body->", "payload", "offset[")
OF_PARAMETER = {
    **{"armature": ("armature[",), "gravity": ("gravity[",), "payload": END_BODY, "payload_com": END_BODY},
    **dict.fromkeys(OF_LINKS, ("end_body->",)),
}
"""The C variables of parameters, with respect to which there are derivatives only if they are inputs."""
LOWER = np.tril_indices(3)
MOTION, FORCE = ("s", "psi", "chi", "velocity", "acceleration", "R", "origin"), ("coriolis", "inertial", "by_q", "by_v")
BODY = ("mass", "moment", "inertia")
LOAD = (*BODY, "p", "B", "f")  # fields of structs in C


def _solution(solution: Array, inertial: Array, held: Sequence[str]) -> list[Varied]:
    """Return a = M⁻¹τ and its derivative δa, with M δa = δτ − δM a; ``inertial`` is M a for variables a."""
    names = [(f"a[{i}]", f"tau[{i}]") for i in range(len(solution))]
    value = [a for a, _ in varied(solution, held=held)]
    along = {name: (a, 0.0) for (name, _), a in zip(names, value)}
    rest = {
        name: (Expression(f"cimag({name})") - force, 0.0)
        for (_, name), (_, force) in zip(names, varied(inertial, along, held))
    }
    return [(a, change) for a, (change, _) in zip(value, varied(solution, rest, held))]


def _places(robot: JointTree) -> dict[str, Value]:
    angles = robot.G.dot(_variables("q", robot.G.shape[1])) + robot.c
    variables: dict[str, Value] = {}
    for i, (angle, slides) in enumerate(zip(angles, robot.prismatic)):
        if slides:
            variables[f"joint[{i}].c"] = angle
        else:
            variables[f"joint[{i}]"] = Expression("turn", (angle,))
    return variables


def _loaded(robot: JointTree) -> tuple[list[Body], dict[str, Value]]:
    """Return the bodies, with variables for what varies, and the values of these variables by name.

    They are all values of the end body, which carries the payload, and those of other bodies that depend on free links.
    """
    end_body, offset = robot.path[-1], _variables("offset", 3)
    bodies, load, indices = list(robot.body), dict[str, Value](), _indices(robot)
    loaded = bodies[end_body].with_point(Expression("payload"), robot.frame_p + robot.frame_R.dot(offset))
    for i, body in enumerate(bodies):
        name = "end_body->" if i == end_body else f"end_body[{indices[i]}]."
        body = loaded if i == end_body else body
        values: dict[str, Value] = {f"{name}mass": body.mass}
        values |= _elements(f"{name}moment", body.moment) | _elements(f"{name}inertia", body.inertia[LOWER])
        if indices[i] < 0:
            continue
        ten = [Expression(k) if i == end_body or isinstance(v, Expression) else v for k, v in values.items()]
        bodies[i] = _body_of(np.array(ten[0]), np.array(ten[1:4], dtype=object), np.array(ten[4:], dtype=object))
        load |= values
    return bodies, load


def _indices(robot: JointTree) -> list[int]:
    """Return the index of each body in the array ``end_body``: 0 for the end body, -1 for a constant one."""
    free = [any(isinstance(value, Expression) for part in _parts(body) for value in part.flat) for body in robot.body]
    free[robot.path[-1]] = False
    indices = [sum(free[: i + 1]) if varies else -1 for i, varies in enumerate(free)]
    indices[robot.path[-1]] = 0
    return indices


def _parts(body: Body, *others: Array) -> list[Array]:
    return [np.array(body.mass), body.moment, body.inertia[LOWER], *others]


def _body_of(mass: Array, moment: Array, lower: Array) -> Body:
    inertia = np.zeros((3, 3), dtype=object)
    inertia[LOWER] = inertia.T[LOWER] = lower
    return Body(mass.item(), moment, inertia)


def _variables(name: str, count: int) -> Array:
    return np.array([Expression(f"{name}[{i}]") for i in range(count)], dtype=object)


def _elements(name: str, values: Array) -> dict[str, Value]:
    """Return each element of an array by its name in C."""
    return {name + "".join(f"[{i}]" for i in index): value for index, value in np.ndenumerate(values)}


def _named(names: Sequence[str], arrays: Sequence[Array]) -> dict[str, Value]:
    """Return the elements of several arrays by their names in C."""
    return {name: value for each in map(_elements, names, arrays) for name, value in each.items()}
