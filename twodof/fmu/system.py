"""A system of FMUs in an SSP 1.0 file, with the interface of its robot's FMU."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path

from ..bounds import MAX_DESCRIPTIONS, MAX_FILES, MAX_VARIABLES
from ..errors import FmuError, InputError, SspError, choice
from ..export.package import has_member
from ..export.typed_values import Type
from .description import RECORDED, SI, Fmu, load_any_fmu, logged
from .scalar import Scalar
from .ssp_file import IDENTITY, STRUCTURE, Affine, Parameter, read_ssp
from .targets import targets_of
from .wiring import Link, Node, Wiring, conversion, order

MOST_NAMED = 5  # names in a remark
Start = float | bool | str
"""A start value of any type."""


@dataclass(frozen=True, repr=False)
class System(Fmu):
    """A system of co-simulation FMUs, one of which is the robot.

    In ``variables``, connectors of the system, variables of the robot, and inputs with a unique name have their own
    names; other variables are "component.name". A variable that a connection drives has the causality "local".

    Attributes:
        description: description of the robot's FMU, with the system's name and default experiment. Its GUID is the
            SHA-256 of the structure, the parameter sets, and the GUIDs and checksums of the FMUs.
        components: FMUs by full name.
        links: connections of components' variables with their first sources.
        batches: outputs and inputs in the order of evaluation at one instant.
        initial: outputs and inputs in the order of evaluation in initialisation mode.
        recorded: name of the component that is the robot.
        nodes: the component's variable, or the system's connector, for each of ``variables``.
        bound: start values of components' variables from parameter bindings, also of connectors that pass them.
        ignored: names in parameter bindings that no variable or connector has, or only one that its FMU calculates.
    """

    recorded: str = ""
    components: Mapping[str, Fmu] = field(default_factory=dict)
    links: tuple[Link, ...] = ()
    batches: tuple[tuple[Node, ...], ...] = ()
    initial: tuple[tuple[Node, ...], ...] = ()
    nodes: Mapping[str, Node] = field(default_factory=dict)
    bound: Mapping[Node, Start] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"<System '{self.path}': {', '.join(self.components)}; joints {', '.join(self.joints)}>"

    def source_of(self, name: str) -> str:
        """Return the output that is connected to a variable; "" without a connection."""
        return next((f"{link.source}" for link in self.links if link.target == self.nodes[name]), "")

    def remarks(self, asked: Iterable[str] = ()) -> list[str]:
        """Return lines about ignored bindings, partly connected vectors, and settings that another FMU has too."""
        ends, lines = {link.target for link in self.links}, []
        if self.ignored:
            first = ", ".join(f"{name:.80}" for name in self.ignored[:MOST_NAMED])
            more = f" and {len(self.ignored) - MOST_NAMED} more" * (len(self.ignored) > MOST_NAMED)
            lines.append(f"parameter bindings name no variable that can be set, and are ignored: {first}{more}")
        asked = [*asked]
        given = {self.nodes.get(self.aliases.get(name, name)) for name in asked}
        for element, fmu in self.components.items():
            for names in fmu.groups("input").values():
                left = [node for name in names if (node := Node(element, name)) not in ends]
                if len(left) < len(names) and not given.issuperset(left):
                    kept = _kept([f"{node}" for node in left if node not in given])
                    lines.append(f"not all elements of an input are connected: {kept}")
        known = {*self.groups("parameter"), *self.groups("input")}
        groups = {name.partition("[")[0] for name in asked}
        for group in sorted(groups & known):
            others = [full for name in self.components if (full := f"{name}.{group}") in known - groups]
            own = {self.nodes[name].element for name in self.vector(group)[:1]} & self.components.keys()
            lines += [f"{group} is set in '{element}' alone: {_kept(others)}" for element in own if others]
        return lines

    @property
    def connections(self) -> list[str]:
        """Texts of the connections, such as "plant.q -> controller.q", with one text for a vector."""
        groups: dict[tuple[str, str, Affine], int] = {}
        for link in self.links:
            source, target = (str(node).partition("[")[0] for node in link[:2])
            groups[source, target, link.map] = groups.get((source, target, link.map), 0) + 1
        return [
            f"{source} -> {target}"
            + f", {count} values" * (count > 1)
            + f", × {affine.gain:g} + {affine.offset:g}" * (affine != IDENTITY)
            for (source, target, affine), count in groups.items()
        ]


def _kept(names: list[str]) -> str:
    """Return the sentence that variables keep their values."""
    return f"{', '.join(names)} {'keeps its value' if len(names) == 1 else 'keep their values'}"


def load_fmu(path: str | Path, robot: str = "") -> Fmu:
    """Read and check an FMU's description, or a system of FMUs, without unzipping or running it.

    Args:
        path: an FMU, or an SSP 1.0 file.
        robot: component of a system with the robot's outputs q and v; "": the only component with such outputs.

    Raises:
        FmuError: the file is missing, is not a zip archive, is unsafe to unzip, is neither a co-simulation FMU of FMI
            2.0 or 3.0 nor an SSP 1.0 file, or has no outputs q[i] and v[i].
    """
    path = Path(path)
    if has_member(path, STRUCTURE):
        return load_system(path, robot)
    if robot:
        raise FmuError(f"'{path}' is an FMU, which has no components; leave out `robot` '{robot}'")
    return logged(load_any_fmu(path))


def load_system(path: Path, robot: str = "") -> System:
    """Read a system of FMUs.

    Raises:
        FmuError: a feature, component or connection is invalid; the message names it.
    """
    title, top, times, structure = read_ssp(path)
    if unsupported := next((text for element in top.walk() for text in element.unsupported), ""):
        raise FmuError(f"'{path}': {unsupported}")
    fmus: dict[str, Fmu] = {}
    by_source: dict[str, Fmu] = {}
    room, free, files = MAX_DESCRIPTIONS, MAX_VARIABLES, MAX_FILES
    for element in (each for each in top.walk() if each.source):
        if element.source not in by_source:
            by_source[element.source] = load_any_fmu(path, element.source)
            files -= len(by_source[element.source].members)
            if files < 0:
                raise FmuError(f"'{path}': its FMUs have more than {MAX_FILES} files together")
        fmus[element.name] = fmu = by_source[element.source]
        room, free = room - fmu.described, free - len(fmu.variables)
        if room < 0 or free < 0:
            most = f"{MAX_VARIABLES} variables, or descriptions of more than {MAX_DESCRIPTIONS} bytes"
            raise FmuError(f"'{path}': its components have more than {most}")
    wiring = Wiring(path, top, fmus)
    links = wiring.links()
    batches, initial = (tuple(map(tuple, order(path, fmus, links, start))) for start in (False, True))
    chosen = _robot(path, fmus, robot)
    starts, ignored = _bound(path, wiring)
    numbers = {node: value for node, value in starts.items() if not isinstance(value, str)}
    goals, unjudged = targets_of(wiring, fmus, links, chosen)
    measuring = _measuring(fmus, links, chosen)
    variables, nodes = _variables(path, wiring, fmus, links, numbers, chosen, measuring, goals)
    digest = hashlib.sha256(structure)
    for fmu in by_source.values():
        digest.update(f"{fmu.guid} {sorted(fmu.members.items())}\0".encode())
    description = copy(fmus[chosen].description)
    description.modelName, description.guid, description.defaultExperiment = title, digest.hexdigest(), times
    aliases: dict[str, str] = {}
    for name, node in nodes.items():
        if (full := str(node)) != name and node.element:
            aliases |= {full: name, full.rpartition("[")[0] or full: name.rpartition("[")[0] or name}
    own = dict(variables=variables, description=description, control="", aliases=aliases, unjudged=unjudged)
    return System(
        **{**vars(fmus[chosen]), **own},
        recorded=chosen,
        components=fmus,
        links=tuple(links),
        batches=batches,
        initial=initial,
        nodes=nodes,
        bound={node: value for node, value in starts.items() if node.element in fmus},
        ignored=(*ignored, *(name for element in top.walk() for name in element.ignored)),
    )


def _robot(path: Path, fmus: dict[str, Fmu], robot: str) -> str:
    """Return the name of the robot's component, and fill in the joint names of its FMU."""
    if robot and robot not in fmus:
        raise FmuError(f"'{path}' has no component '{robot}'{choice(robot, fmus)}")
    having = [name for name, fmu in fmus.items() if fmu.vector("q") and fmu.vector("v")]
    robots = [name for name in having if fmus[name].variables[fmus[name].vector("q")[0]].causality == "output"]
    if robot and robot not in robots:
        raise FmuError(f"'{path}': '{robot}', the `robot`, has no outputs q[i] and v[i]{choice(robot, robots)}")
    robots = [robot] if robot else robots
    if len(robots) != 1:
        by = "by `robot` of 'twodof run', 'twodof info' or the Python function load_fmu"
        some = f"; choose one {by}: {', '.join(robots)}" if robots else f" among {', '.join(fmus)}"
        raise FmuError(f"'{path}' has {len(robots) or 'no'} components with outputs q[i] and v[i]{some}")
    fmus[robots[0]] = logged(fmus[robots[0]])
    return robots[0]


def _measuring(fmus: Mapping[str, Fmu], links: list[Link], robot: str) -> str:
    """Return the component that measures the robot: a controller with outputs q_meas that reads q, or the robot."""
    q = Node(robot, fmus[robot].vector("q")[0])
    readers = {link.target.element for link in links if link.source == q}
    having = [name for name in readers if name in fmus and fmus[name].vector("q_meas")]
    return having[0] if len(having) == 1 else robot


def _bound(path: Path, wiring: Wiring) -> tuple[dict[Node, Start], list[str]]:
    """Return start values from parameter bindings, and names without effect; outer systems precede inner ones.

    A connector with a value passes it to the connected variables; without one, they keep their own.
    """
    starts: dict[Node, Start] = {}
    ignored = []
    for element in wiring.elements.values():
        for parameter in element.parameters:
            name = f"{element.name}.{parameter.name}" if element.name else parameter.name
            if (node := wiring.find(name)) is None:  # the standard ignores such parameters
                ignored.append(f"{name} (name its elements: {name}[1])" if wiring.find(f"{name}[1]") else name)
            elif (scalar := wiring.scalar(node)) is not None and scalar.is_calculated:
                ignored.append(f"{name} ({scalar.causality})")
            else:
                starts[node] = _value(path, wiring, node, parameter)
    passed = wiring.passed({node: value for node, value in starts.items() if not isinstance(value, str)}).items()
    return starts | {node: _typed(path, node, wiring.scalar(node), value) for node, value in passed}, ignored


def _value(path: Path, wiring: Wiring, node: Node, parameter: Parameter) -> Start:
    """Return the value of a parameter for a variable or connector, in its unit and of its type."""
    value, scalar, total = parameter.value, wiring.scalar(node), parameter.map
    if isinstance(value, str):
        if scalar is None or scalar.type != parameter.type or total != IDENTITY:
            use = "transformed" if scalar is not None and scalar.type == parameter.type else "for another type"
            raise FmuError(
                f"'{path}': the value of '{node}', '{value:.80}', is a {parameter.type} {use}: not supported"
            )
        return _typed(path, node, scalar, value)
    if isinstance(value, bool) and total != IDENTITY:
        raise FmuError(f"'{path}': the value of '{node}' is a Boolean, which is not transformed")
    if parameter.converts:
        given, own = wiring.applied(node, parameter.unit), wiring.unit(node)
        total = total.after(conversion(path, given, own, f"'{node}' and its value"))
    return _typed(path, node, scalar, value if isinstance(value, bool) else total.of(value))


def _typed(path: Path, node: Node, scalar: Scalar | None, value: Start) -> Start:
    """Return a value for a variable, None for a connector, if it has the variable's type."""
    if scalar is None and isinstance(value, bool):
        return value
    try:
        return (Type("Real") if scalar is None else scalar.value_type).value(value, str(node))
    except InputError as error:
        raise FmuError(f"'{path}': {error}") from error


def _variables(
    path: Path,
    wiring: Wiring,
    fmus: Mapping[str, Fmu],
    links: list[Link],
    starts: Mapping[Node, float | bool],
    robot: str,
    measuring: str,
    goals: set[Node],
) -> tuple[dict[str, Scalar], dict[str, Node]]:
    """Return the variables of a system, and the component's variable or the connector for each of them.

    Names without a component are those of the robot, except for measured values, those of the system's connectors, and
    ``goals``, its targets. A connector that could be mistaken for a vector of the robot is "system.connector".
    """
    variables: dict[str, Scalar] = {}
    nodes: dict[str, Node] = {}

    def add(name: str, node: Node, scalar: Scalar, causality: str, start: float | bool | None) -> None:
        if name in variables:
            raise FmuError(f"'{path}' has two variables '{name}', '{node}' and '{nodes[name]}'")
        text = None if start is None else str(start).lower() if isinstance(start, bool) else repr(start)
        variables[name] = replace(scalar, name=name, causality=causality, start=text)
        nodes[name] = node

    driven: dict[Node, list[Link]] = {}
    for link in (link for link in links if link.source.element not in fmus):
        driven.setdefault(link.source, []).append(link)
    for source, targets in driven.items():
        scalars = [scalar for link in targets if (scalar := wiring.scalar(link.target)) is not None]
        first = scalars[0]
        if len(types := sorted({scalar.type for scalar in scalars})) > 1:
            raise SspError(f"'{path}': the connector '{source}' goes to variables of type {' and '.join(types)}")
        causality = "input" if any(scalar.causality == "input" for scalar in scalars) else "parameter"
        values = [starts.get(link.target, scalar.start_value) for link, scalar in zip(targets, scalars)]
        inverted = {value if value is None else link.map.inverse(value) for link, value in zip(targets, values)}
        start = starts.get(source, inverted.pop() if len(inverted) == 1 else None)
        typed = None if start is None else _typed(path, source, first, start)
        assert not isinstance(typed, str)  # connections have numbers and Booleans
        plain = source.element or source in goals or source.connector.partition("[")[0] not in RECORDED
        name = source.connector if source in goals else str(source) if plain else f"system.{source}"
        scalar = replace(first, unit=wiring.unit(source).name or first.unit)
        add(name, source, scalar, causality, typed)
    ends = {link.target for link in links}
    names = Counter(name for fmu in fmus.values() for name in fmu.variables)
    for element in (robot, *(name for name in fmus if name != robot)):
        for scalar in fmus[element].variables.values():
            node = Node(element, scalar.name)
            if scalar.causality in ("input", "output", "parameter"):
                group = scalar.name.partition("[")[0]
                free = scalar.causality == "input" and node not in ends and group not in RECORDED
                of = measuring if group in ("q_meas", "v_meas") else robot
                if group in RECORDED and element == robot and (unit := wiring.unit(node)).is_scaled:
                    raise FmuError(f"'{path}': {node} is in {unit.name}; {SI}")
                alone = node in goals or (free and names[scalar.name] == 1)
                own = (element == of or alone) and scalar.name not in variables
                start = starts.get(node, scalar.start_value)
                causality = "local" if node in ends else scalar.causality
                add(scalar.name if own else str(node), node, scalar, causality, start)
    return variables, nodes
