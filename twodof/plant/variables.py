"""The table of FMI variables, from which native and Python FMUs have their variables and descriptions.

Names are FMI structured names with 1-based indices. The value reference of a variable is its 1-based index in the
table.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .robot import Robot

Value = float | bool
EXACT = 1e-9  # relative tolerance within which an effort is at its limit, not beyond it


@dataclass(frozen=True)
class Range:
    """Closed range of valid values of a variable, and its description."""

    low: float
    high: float
    words: str


NO_RANGE = Range(-math.inf, math.inf, "")
NOT_NEGATIVE = Range(0.0, math.inf, ">= 0")
POSITIVE = Range(sys.float_info.min, math.inf, "> 0")
"""The smallest normal number is the minimum: C++ cannot read smaller ones, and processors may flush them to 0."""
GAINS = ("Kp", "Kd", "Kn", "Kp_rot", "Kd_rot")
RANGES = {
    **dict.fromkeys((*GAINS, "payload", "friction", "damping", "armature"), NOT_NEGATIVE),
    **dict.fromkeys(("rtol", "atol", "max_step", "mass"), POSITIVE),
    "rcond": Range(0.0, math.nextafter(1.0, 0.0), "in [0, 1)"),
    **dict.fromkeys(("control_period", "control_delay", "q_resolution", "q_noise", "v_noise"), NOT_NEGATIVE),
    "seed": Range(0, 2**31 - 1, "in [0, 2147483647]"),
    "integrator": Range(0, 2, "0 (automatic), 1 (Dormand-Prince) or 2 (stiff joints)"),
}
"""Valid ranges by group; the FMU refuses values outside them. Other variables have no range."""


@dataclass(frozen=True)
class Variable:
    """A scalar variable of the FMU."""

    # the vector's name and the plant's attribute, e.g. "x_des"; ``index`` its 0-based element, None for a scalar.
    # "der_q" is the derivative of "q"
    group: str
    index: int | None
    # "input", "output", "local" (the derivatives of the states q and v) or "parameter" (all parameters are fixed)
    causality: str
    unit: str  # FMI unit name, or ""
    start: Value | None  # start value; None for computed variables
    description: str
    called: str = ""  # name of the vector in the FMU if it differs from the group; else ""
    shown: bool = True  # whether the FMU declares it; otherwise only the engine uses it
    columns: int = 0  # number of columns of a matrix, whose elements ``index`` counts row by row; 0 for other variables
    # the URDF's value of a link's mass, centre or inertia, for the controller's model; else None
    known: float | None = None

    @property
    def name(self) -> str:
        """FMI name, e.g. "x_des[1]" or "M[1,2]"."""
        group = self.called or self.derivative_of or self.group
        if self.columns and self.index is not None:
            return f"{group}[{self.index // self.columns + 1},{self.index % self.columns + 1}]"
        name = group if self.index is None else f"{group}[{self.index + 1}]"
        return f"der({name})" if self.derivative_of else name

    @property
    def is_free(self) -> bool:
        """True for an input that would be a parameter or a constant if it were not free."""
        return self.causality == "input" and self.group in (*FREE, *OF_LINKS)

    @property
    def derivative_of(self) -> str:
        """Group of the state whose derivative this is; "" for other variables."""
        return self.group.removeprefix("der_") if self.group.startswith("der_") else ""

    @property
    def type(self) -> str:
        """FMI type of the variable."""
        return "Boolean" if isinstance(self.start, bool) else "Integer" if isinstance(self.start, int) else "Real"

    def refusal(self, value: Value) -> str:
        """Return why a value is invalid, or "" if it is valid."""
        within = RANGES.get(self.group, NO_RANGE)
        fits = within.low <= value <= within.high
        return "" if fits else f"{self.name} = {value:g} must be {within.words}"


@dataclass(frozen=True)
class Control:
    """A control law: the source of joint accelerations or efforts."""

    title: str  # description in words, with "{frame}" for the frame
    inputs: tuple[str, ...]  # groups of inputs, in the table's order; τ depends on them directly
    parameters: tuple[str, ...]  # groups of parameters
    commands: str  # result of the law, "acceleration" (q̈_cmd, then inverse dynamics) or "effort" (τ)
    rigid_stops: bool  # default of the parameter ``rigid_stops``
    outputs: tuple[str, ...] = ()  # groups of outputs that only this law has


CONTROLS = {
    "task": Control(
        "operational-space control of {frame}",
        ("x_des", "xd_des", "xdd_des", "Kp", "Kd", "Kn"),
        ("rcond", "payload_known"),
        "acceleration",
        False,
    ),
    "pose": Control(
        "operational-space control of {frame}, with its orientation",
        ("x_des", "xd_des", "xdd_des", "quat_des", "omega_des", "alpha_des", "Kp", "Kd", "Kp_rot", "Kd_rot", "Kn"),
        ("rcond", "payload_known"),
        "acceleration",
        False,
        ("quat", "omega"),
    ),
    "joint": Control(
        "joint-space control", ("q_des", "v_des", "a_des", "Kp", "Kd"), ("payload_known",), "acceleration", True
    ),
    "effort": Control("effort control, the bare plant", ("tau_cmd",), (), "effort", True),
}
"""Control laws by name. The module <name>_control here, and the C file of that name in the native engine, have the law.
"pose" is "task" with three more rows.
"""

ON_REQUEST = ("M", "h", "J", "drift", "quat", "omega")
"""Groups of outputs that only ``FmuOptions.outputs`` or the control law adds."""
OF_ORIENTATION = {"quat", "omega"}  # groups of outputs with which J and drift have rows of rotations too
DISTURBANCES = ("tau_ext", "f_ext")
FREE = ("gravity", "payload", "payload_com", "friction", "damping", "armature")
"""Groups of parameters that may be inputs, which can change during a run and have derivatives."""
OF_LINKS = ("mass", "com", "inertia")  # groups of values of links, which are constants unless they are inputs
OF_THE_PLANT = {
    *DISTURBANCES,
    *("x", "xd", "quat", "omega", "q_start", "v_start", "q_min", "q_max", "rtol", "atol", "max_step"),
    *("friction", "damping", "integrator", "rigid_stops"),
}
"""Groups that a controller alone does not have."""
OF_A_LAW = {group for law in CONTROLS.values() for group in law.parameters}

ROWS: tuple[tuple[str, str, str, str, Value | tuple[float, ...] | None, str], ...] = (
    ("x_des", "input", "axis", "m", None, "target position"),
    ("xd_des", "input", "axis", "m/s", 0.0, "target velocity"),
    ("xdd_des", "input", "axis", "m/s2", 0.0, "target acceleration"),
    ("quat_des", "input", "quaternion", "", None, "target orientation of {frame}"),
    ("omega_des", "input", "turn", "rad/s", 0.0, "target angular velocity"),
    ("alpha_des", "input", "turn", "rad/s2", 0.0, "target angular acceleration"),
    ("q_des", "input", "joint", "m|rad", None, "target position"),
    ("v_des", "input", "joint", "m/s|rad/s", 0.0, "target velocity"),
    ("a_des", "input", "joint", "m/s2|rad/s2", 0.0, "target acceleration"),
    ("Kp", "input", "controlled", "1/s2", 50.0, "proportional gain"),
    ("Kd", "input", "controlled", "1/s", 40.0, "derivative gain"),
    ("Kp_rot", "input", "turn", "1/s2", 50.0, "proportional gain of the orientation"),
    ("Kd_rot", "input", "turn", "1/s", 40.0, "derivative gain of the orientation"),
    ("tau_cmd", "input", "joint", "N|N.m", 0.0, "commanded torque or force"),
    ("tau_ext", "input", "joint", "N|N.m", 0.0, "external torque or force"),
    ("f_ext", "input", "root", "N", 0.0, "external force at {frame}"),
    ("Kn", "input", "", "1/s", None, "damping of the null-space motion, which does not move {frame}"),
    ("q", "output", "joint", "m|rad", None, "position"),
    ("v", "output", "joint", "m/s|rad/s", None, "velocity"),
    ("x", "output", "axis", "m", None, "position"),
    ("xd", "output", "axis", "m/s", None, "velocity"),
    ("quat", "output", "quaternion", "", None, "orientation of {frame}"),
    ("omega", "output", "turn", "rad/s", None, "angular velocity of {frame}"),
    ("M", "output", "joint pair", "", None, "mass matrix with payload and armature, in SI units"),
    ("h", "output", "joint", "N|N.m", None, "torque or force of gravity, Coriolis and centrifugal effects"),
    ("J", "output", "task joint", "", None, "Jacobian of {frame}: one row for each target, one column for each joint"),
    ("drift", "output", "task", "m/s2|rad/s2", None, "acceleration of {frame} at zero joint accelerations, dJ/dt v"),
    ("tau", "output", "joint", "N|N.m", None, "applied control torque or force"),
    ("q_meas", "output", "joint", "m|rad", None, "position that the controller measured"),
    ("v_meas", "output", "joint", "m/s|rad/s", None, "velocity that the controller measured"),
    ("der_q", "local", "joint", "m/s|rad/s", None, "velocity"),
    ("der_v", "local", "joint", "m/s2|rad/s2", None, "acceleration"),
    ("q_start", "parameter", "joint", "m|rad", None, "initial position"),
    ("v_start", "parameter", "joint", "m/s|rad/s", 0.0, "initial velocity"),
    ("q_min", "parameter", "joint", "m|rad", None, "lower position limit"),
    ("q_max", "parameter", "joint", "m|rad", None, "upper position limit"),
    ("gravity", "parameter", "root", "m/s2", (0.0, 0.0, -9.81), "gravity"),
    ("payload", "parameter", "", "kg", 0.0, "point mass at {frame}"),
    ("payload_com", "parameter", "frame", "m", 0.0, "position of the payload"),
    ("rcond", "parameter", "", "", 0.01, "the pseudo-inverse of J drops singular values up to rcond times the largest"),
    ("rtol", "parameter", "", "", 1e-3, "relative tolerance of the integrator"),
    ("atol", "parameter", "", "", 1e-6, "absolute tolerance of the integrator"),
    ("max_step", "parameter", "", "s", 1e-3, "largest step of the integrator"),
    ("friction", "parameter", "joint", "N|N.m", None, "Coulomb and static friction"),
    ("damping", "parameter", "joint", "N.s/m|N.m.s/rad", None, "viscous friction"),
    ("armature", "parameter", "joint", "kg|kg.m2", 0.0, "rotor inertia times gear ratio squared"),
    ("control_period", "parameter", "", "s", 0.0, "sampling period of the controller, 0 for a continuous one"),
    ("control_delay", "parameter", "", "s", 0.0, "delay from a sample to the effect of its command"),
    ("q_resolution", "parameter", "joint", "m|rad", 0.0, "resolution of the position sensor"),
    ("q_noise", "parameter", "joint", "m|rad", 0.0, "standard deviation of the position sensor's noise"),
    ("v_noise", "parameter", "joint", "m/s|rad/s", 0.0, "standard deviation of the velocity sensor's noise"),
    ("seed", "parameter", "", "", 0, "seed of the sensors' noise"),
    ("integrator", "parameter", "", "", 0, "integrator: 0 automatic, 1 Dormand-Prince, 2 ROS34PW2 for stiff joints"),
    ("v_from_q", "parameter", "", "", False, "compute measured velocities as differences of measured positions"),
    ("limit_effort", "parameter", "", "", False, "limit control torques and forces to the URDF's effort limits"),
    ("rigid_stops", "parameter", "", "", None, "a joint stop reacts on all joints; otherwise it clamps its own joint"),
    ("payload_known", "parameter", "", "", False, "the controller's model includes the payload"),
)
"""Group; causality; owners of the elements ("" for a scalar); unit, or units for a prismatic | a revolute joint; start
value (None if it is computed, given by the robot or the control law, or a target); and description.
"""

Starts = Mapping[str, Value | tuple[float, ...]]


def variable_table(
    robot: Robot, starts: Starts, control: str = "task", outputs: Collection[str] = ()
) -> list[Variable]:
    """Return the variables of a robot's FMU, in the order of their value references.

    Args:
        robot: the robot; n joints and m task axes give the vectors' lengths.
        starts: start values that differ from the defaults, by group. "q_start" (n values) is required. "x_des" (m
            values) and "quat_des" (4 values) are required if the control law has them.
        outputs: groups of ``ON_REQUEST`` that the FMU has.
    """
    law = CONTROLS[control]
    of_robot = {group: getattr(robot, group) for group in ("q_min", "q_max", "friction", "damping")}
    redundant = len(robot.joints) > _count_task_rows(robot, law)
    starts = {**of_robot, "Kn": 10.0 if redundant else 0.0, "rigid_stops": law.rigid_stops, **starts}
    if "q_des" in law.inputs:
        starts.setdefault("q_des", starts["q_start"])
    requested = {*law.outputs, *outputs}
    owners = _owners(robot, law, bool(OF_ORIENTATION & requested))
    table: list[Variable] = []
    for group, causality, owner, unit, default, text in ROWS:
        own = group in (*law.inputs, *law.parameters)
        if group in ON_REQUEST and group not in requested:
            continue
        if not (own or (causality != "input" and group not in OF_A_LAW) or group in DISTURBANCES):
            continue
        start = starts.get(group, default) if causality in ("input", "parameter") else None
        text, (sliding, _, turning) = text.format(frame=robot.frame), unit.partition("|")
        slides = [True] * len(robot.axes) + [False] * 3 if owner == "task" else robot.prismatic
        columns = len(robot.joints) if owner in ("joint pair", "task joint") else 0
        for i, element in enumerate(owners[owner]):
            own_unit = turning if turning and not slides[i] else sliding
            value = start[i] if isinstance(start, tuple) else start
            described = f"{text}, {element}" if element else text
            table.append(Variable(group, i, causality, own_unit, value, described, columns=columns))
        if not owner:
            assert not isinstance(start, tuple)
            table.append(Variable(group, None, causality, unit, start, text))
    return table


def free_table(table: Sequence[Variable], free: Collection[str], links: Sequence[Variable] = ()) -> list[Variable]:
    """Return the table with groups of parameters, and then values of links, as further inputs after the others."""
    rest = [variable for variable in table if variable.group not in free]
    first = next(i for i, variable in enumerate(rest) if variable.causality == "output")
    inputs = [replace(variable, causality="input") for variable in table if variable.group in free]
    return [*rest[:first], *inputs, *links, *rest[first:]]


def name_of_link(group: str, link: str) -> str:
    """Return the name in the FMU of a group of values of a link."""
    return f"{group}_{re.sub('[^0-9A-Za-z_]', '_', link)}"


def controller_table(table: Sequence[Variable]) -> list[Variable]:
    """Return the table of the controller alone: q and v are inputs, tau is its output tau_cmd."""
    starts = {(v.group, v.index): v.start for v in table}
    rows = []
    for variable in table:
        shown = variable.group not in OF_THE_PLANT and variable.causality != "local"
        variable = replace(variable, shown=shown)
        if variable.group in ("q", "v"):
            start = starts[f"{variable.group}_start", variable.index]
            variable = replace(variable, causality="input", start=start)
        elif variable.group == "tau":
            text = variable.description.replace("applied control", "commanded")
            variable = replace(variable, called="tau_cmd", description=text)
        rows.append(variable)
    return rows


def _owners(robot: Robot, law: Control, rotates: bool) -> dict[str, list[str]]:
    """Return, for each kind of owner, a phrase for the description of each element.

    Args:
        rotates: whether the task contains rotations.
    """
    joint = [f"joint {name}" for name in robot.joints]
    axis = [f"{robot.frame}, axis {letter}" for letter in robot.axes]
    turn = [f"about axis {letter} of {robot.root}" for letter in "xyz"]
    task = [*axis, *turn] if rotates else axis
    return {
        "": [],
        "joint": joint,
        "axis": axis,
        "controlled": axis if "x_des" in law.inputs else joint,
        "root": [f"axis {letter} of {robot.root}" for letter in "xyz"],
        "frame": [f"axis {letter} of {robot.frame}" for letter in "xyz"],
        "turn": turn,
        "task": task,
        "task joint": [""] * (len(task) * len(joint)),
        "joint pair": [""] * len(joint) ** 2,
        "quaternion": list("xyzw"),
    }


def _count_task_rows(robot: Robot, law: Control) -> int:
    return len(robot.axes) + 3 * ("quat_des" in law.inputs)


def count_event_indicators(robot: Robot, control: str) -> int:
    """Count the event indicators of Model Exchange: three per joint, and one per singular value that J⁺ may drop."""
    law = CONTROLS[control]
    rows = _count_task_rows(robot, law) if "rcond" in law.parameters else 1
    return 3 * len(robot.joints) + rows - 1
