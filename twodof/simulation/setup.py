"""Constants for judging a run's samples: robot, limits, step and settings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from math import inf
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..fmu import Fmu, System
from ..fmu.description import RECORDED
from ..fmu.wiring import Node
from ..plant.urdf import INERTIA, UNBOUNDED, RobotError, Urdf, read_urdf
from ..plant.variables import EXACT, OF_LINKS, name_of_link

if TYPE_CHECKING:
    from ..geometry.kinematics import Kinematics

Array = NDArray[np.float64]
OF_THE_CONTROLLER = (
    "control_period", "control_delay", "q_resolution", "q_noise", "v_noise", "v_from_q", "seed"
)  # fmt: skip
"""Parameters that plant and controller of a system both have, but that act in the controller."""


class Limits(NamedTuple):
    """Effort (N·m, N) and velocity limits of joints, infinite without a limit."""

    effort: tuple[float, ...]
    velocity: tuple[float, ...]


class Setup(NamedTuple):
    """Robot and settings of a run.

    Attributes:
        joints: names of the n joints.
        units: "rad" or "m" for each joint; "" if unknown.
        low, high: position limits of the run, or else of the URDF, n values; infinite without a limit.
        limits: effort and velocity limits of the URDF.
        robot: the robot; None if unknown.
        frame, axes: the end effector's link, and the task axes, letters of "xyz"; "" if unknown.
        step: communication step, s.
        starts: start values of all inputs and parameters; those of a system's controller also without its name.
        controller: prefix of the variables of a system's controller, such as "controller."; "" without one.
        own: names without this prefix, by full name, of variables that only the controller has.
        links: inertial values of links that are inputs, as the controller's model has them.
        unjudged: reasons for which targets are not judged, a line each.
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    low: Array
    high: Array
    limits: Limits
    robot: Urdf | None
    frame: str
    axes: str
    step: float
    starts: Mapping[str, float]
    controller: str = ""
    own: Mapping[str, str] = MappingProxyType({})
    links: Mapping[str, float] = MappingProxyType({})
    unjudged: tuple[str, ...] = ()

    def given(self, group: str, values: Mapping[str, float] | None = None) -> Array:
        """Return the elements of a vector of inputs or parameters, from start values or ``values``; empty if none."""
        values = self.starts if values is None else values
        found: list[float] = []
        while (name := f"{group}[{len(found) + 1}]") in values:
            found.append(float(values[name]))
        return np.array(found)

    @property
    def kinematics(self) -> Kinematics:
        """Forward kinematics of the robot, which must be known."""
        from ..geometry.kinematics import Kinematics  # SciPy takes half a second to import

        assert self.robot is not None
        return Kinematics(self.robot, self.joints)

    @property
    def rows(self) -> list[int]:
        """Indices of the task axes."""
        return ["xyz".index(axis) for axis in self.axes]

    def positions(self, q: Array) -> Array:
        """Return positions of the end effector along the task axes at N samples, N × m."""
        return self.kinematics.path(self.frame, q)[:, self.rows]

    def orientations(self, q: Array) -> Array:
        """Return orientations of the end effector at N samples, quaternions x, y, z, w, N × 4."""
        from ..geometry.kinematics import BLOCK, quaternions

        kinematics, blocks = self.kinematics, (q[k : k + BLOCK] for k in range(0, len(q), BLOCK))
        return np.concatenate([quaternions(kinematics.end(self.frame, block).rotation) for block in blocks])


def limits_of(robot: Urdf | None, names: Sequence[str]) -> Limits:
    """Return the limits of joints; the velocity limit of a joint that mimics another also limits its leader."""
    joints = robot.joints if robot is not None else {}
    if not {*names} <= joints.keys():
        return Limits((inf,) * len(names), (inf,) * len(names))
    speeds = dict.fromkeys(joints, inf)
    for joint in joints.values():
        if joint.ratio:
            speeds[joint.leader] = min(speeds[joint.leader], joint.velocity / abs(joint.ratio))
    return Limits(tuple(joints[n].effort for n in names), tuple(speeds[n] for n in names))


def robot_of(text: str | None) -> Urdf | None:
    """Return the robot of a URDF's text; None if there is no valid one."""
    try:
        return None if text is None else read_urdf(text)
    except RobotError:
        return None


def setup(
    *,
    joints: Sequence[str],
    robot: Urdf | None,
    frame: str,
    axes: str,
    step: float,
    starts: Mapping[str, float],
    controller: str = "",
) -> Setup:
    """Return the setup of a run from the facts in its FMU or in its bag's provenance."""
    known = robot.joints if robot is not None else {}
    own = [known.get(name) for name in joints]
    ends = []
    for group, sign in (("q_min", -1.0), ("q_max", 1.0)):
        values = [starts.get(f"{group}[{i + 1}]") for i in range(len(joints))]
        limits = [None if j is None else j.low if sign < 0.0 else j.high for j in own]
        held = [limit if value is None else value for value, limit in zip(values, limits)]
        ends.append(np.array([sign * inf if x is None or abs(x) >= UNBOUNDED else float(x) for x in held]))
    units = tuple("" if joint is None else "m" if joint.prismatic else "rad" for joint in own)
    names = tuple(joints)
    prefix = f"{controller}." if controller else ""
    alone = {name: short for name in starts if (short := _short(name, prefix)) and short not in starts}
    starts, bounds = _whole(starts, prefix, alone), limits_of(robot, names)
    return Setup(names, units, ends[0], ends[1], bounds, robot, frame, axes, step, starts, prefix, alone)


def controller_of(system: System) -> str:
    """Return the component that computes the efforts of a system's robot by a control law of this package, or "".

    Other components may be between the controller and the robot.
    """
    robot = system.recorded
    found, seen = {link.source.element for link in system.links if _is_effort(link.target, robot)}, {robot}
    while found := found & system.components.keys() - seen:
        if laws := [
            name for name in found if {"payload_known", "tau_cmd[1]"} <= system.components[name].variables.keys()
        ]:
            return laws[0] if len(laws) == 1 else ""
        seen |= found
        found = {link.source.element for link in system.links if link.target.element in found}
    return ""


def unconnected(system: System, given: Iterable[str] = ()) -> list[str]:
    """Return a line for each input vector between plants and controllers of which no element is connected or given.

    Controllers have inputs q and v and an output tau_cmd; in a system with one, each input tau_cmd is of a plant.
    """
    known = {link.target for link in system.links} | {system.nodes[name] for name in given}
    laws = [name for name, fmu in system.components.items() if "tau_cmd" in fmu.groups("output")]
    having = [(name, group) for name in laws for group in "qv"]
    having += [(name, "tau_cmd") for name in system.components if laws]
    lines = []
    for name, group in having:
        nodes = {Node(name, own) for own in system.components[name].groups("input").get(group, ())}
        if nodes and nodes.isdisjoint(known):
            lines.append(f"the input {name}.{group} is not connected, and keeps its value")
    return lines


def _is_effort(node: Node, robot: str) -> bool:
    return node.element == robot and node.connector.partition("[")[0] == "tau_cmd"


def _short(name: str, prefix: str) -> str:
    """Return the name without a prefix of a variable that can describe a controller; "" for other variables."""
    short = name.removeprefix(prefix)
    return short if prefix and short != name and short.partition("[")[0] not in RECORDED else ""


def _whole(starts: Mapping[str, float], prefix: str, own: Mapping[str, str]) -> Mapping[str, float]:
    """Return a system's start values, with its controller's values of parameters that act in the controller."""
    if not prefix:
        return starts
    acting = {name.removeprefix(prefix): value for name, value in starts.items() if name.startswith(prefix)}
    acting = {name: value for name, value in acting.items() if name.partition("[")[0] in OF_THE_CONTROLLER}
    period = max(each.get("control_period", 0.0) for each in (starts, acting))  # the plant may sample its effort, too
    return {**starts, **acting, **{own[name]: starts[name] for name in own}, "control_period": period}


def setup_of(fmu: Fmu, robot: Urdf | None, step: float, starts: Mapping[str, float]) -> Setup:
    """Return the setup of a run of an FMU with a robot."""
    controller, axes = controller_of(fmu) if isinstance(fmu, System) else "", "".join(fmu.axes)
    found = setup(
        joints=fmu.joints, robot=robot, frame=fmu.frame, axes=axes, step=step, starts=starts, controller=controller
    )
    units = tuple(own or fmu.variables[name].unit or "" for own, name in zip(found.units, fmu.vector("q")))
    return found._replace(units=units, links=_inertials(fmu, robot), unjudged=fmu.unjudged)


def _inertials(fmu: Fmu, robot: Urdf | None) -> dict[str, float]:
    """Return the URDF's values for links that are inputs; start values that differ by rounding alone are the URDF's."""
    inputs = (name for name, v in fmu.variables.items() if fmu.control and v.causality == "input")
    starts = fmu.start_values
    found = {name: float(starts[name]) for name in inputs if name.partition("_")[0] in OF_LINKS}
    if not found or robot is None:
        return found
    from ..geometry.kinematics import Kinematics  # as above

    kinematics, names = Kinematics(robot, fmu.joints), Counter(name_of_link("", link) for link in robot.links)
    for link in (link for link in robot.links if names[name_of_link("", link)] == 1):
        mass, com, inertia = kinematics.body(link)
        tensor = [inertia[3 * row + column] for row, column in INERTIA.values()]
        for group, values in {"mass": [mass], "com": com, "inertia": tensor}.items():
            rounding = EXACT * max(map(abs, values))
            for name, value in zip(fmu.vector(name_of_link(group, link)), values):
                if name in found and abs(found[name] - value) > rounding:
                    found[name] = value
    return found
