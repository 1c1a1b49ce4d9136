"""Targets of a system's robot: inputs of its controllers, and connectors of systems, in the robot's coordinates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from .description import RECORDED, Fmu
from .ssp_file import IDENTITY
from .wiring import Link, Node, Wiring

TARGETS = tuple(group for group in RECORDED if group.endswith("_des"))
NO_POSITIONS = ("v", "v_meas", "xd", "omega", "tau")  # inputs that have no positions of the robot
Edges = set[tuple[str, str]]
"""Names of components, the first of which has an output that is connected to the second."""


def targets_of(
    wiring: Wiring, fmus: Mapping[str, Fmu], links: Sequence[Link], robot: str
) -> tuple[set[Node], tuple[str, ...]]:
    """Return the inputs and connectors that are targets of the robot, and why those of other controllers are none.

    Targets are whole vectors of real numbers in SI units. The robot's inputs depend on the outputs of their component,
    which reads the robot's positions in elements with the same indices. Targets and positions arrive without
    transformation, or with the same one.
    """
    edges = {(link.source.element, link.target.element) for link in links}
    driving = _reached({(end, start) for start, end in edges}, robot)
    incoming, found, lines = {link.target: link for link in links}, set[Node](), list[str]()
    for group in TARGETS:
        having = [name for name in fmus if name in driving and group in fmus[name].groups("input")]
        offers, refusals = set[tuple[Node, ...]](), dict[str, str]()
        for name in having:
            nodes = [Node(name, own) for own in fmus[name].vector(group)]
            given = [incoming.get(node, Link(node, node, IDENTITY)) for node in nodes]
            refusal = _refusal(wiring, fmus, given, fmus[robot].vector(group.removesuffix("_des")), having)
            if not refusal and name != robot:
                around = _reached({edge for edge in edges if edge[0] != name}, robot)
                read = [link for link in links if link.target.element == name and link.source.element in around]
                refusal = _misreading(wiring, fmus, robot, read, given)
            if refusal:
                refusals[name] = refusal
            else:
                offers.add(tuple(link.source for link in given))
        if len(offers) == 1:
            found |= {*offers.pop()}
        else:
            refusals |= {name: "there are several such targets" for name in having if offers and name not in refusals}
            lines += [f"{name}.{group} is not judged: {why}" for name, why in refusals.items() if name != robot]
    return found, tuple(lines)


def _reached(edges: Edges, start: str) -> set[str]:
    """Return a component, and those that its outputs reach through others."""
    reached = found = {start}
    while found:
        found = {end for begin, end in edges if begin in found} - reached
        reached = reached | found
    return reached


def _refusal(
    wiring: Wiring, fmus: Mapping[str, Fmu], given: Sequence[Link], position: Sequence[str], having: Sequence[str]
) -> str:
    """Return why an input vector cannot be a target, whatever its controller reads; "" if it can be one."""
    if not given or len(given) != len(position):
        return f"it has {len(given)} elements, and this position of the robot has {len(position)}"
    name = given[0].target.element
    if givers := sorted({link.source.element for link in given} & fmus.keys() - {name}):
        return f"its values come from {', '.join(givers)}"
    if all(link.source == link.target for link in given):
        if others := [other for other in having if other != name]:
            return f"{', '.join(others)} has such a target too"
    elif any(link.source.connector != link.target.connector for link in given) or len({*_elements(given)}) > 1:
        return "not all of its elements come from connectors of one system with the same names"
    return "" if _are_alike(wiring, given) else "it is not of real numbers in SI units with one conversion"


def _elements(links: Iterable[Link]) -> list[str]:
    return [link.source.element for link in links]


def _misreading(
    wiring: Wiring, fmus: Mapping[str, Fmu], robot: str, read: Iterable[Link], given: Sequence[Link]
) -> str:
    """Return why a controller may not read the robot in the coordinates of its target; "" if it does.

    An input vector with the name of the target's position, such as q for q_des, decides. Without one, all vectors do
    that may be positions of the robot.

    Args:
        read: connections from the robot, or from components behind it, to the controller.
    """
    plant, controller = fmus[robot], fmus[given[0].target.element].groups("input")
    named = given[0].target.connector.partition("_des")[0]
    groups: dict[str, list[Link]] = {}
    for link in read:
        groups.setdefault(_split(link.target)[0], []).append(link)
    own = {name: groups[name] for name in (named, f"{named}_meas") if name in groups}
    names = (named, f"{named}_meas") if own else ("q", "q_meas", named)
    vectors = [{Node(robot, name) for name in plant.vector(group)} for group in dict.fromkeys(names)]
    others = {
        group: links
        for group, links in groups.items()
        if group not in (*TARGETS, *NO_POSITIONS)
        and _may_be_positions(wiring, plant, robot, vectors, links, len(given), len(controller.get(group, ())))
    }
    for group, links in (own or others).items():
        if not any(_is_straight(wiring, vector, links, given) for vector in vectors):
            through = sorted({*_elements(links)} - {robot})
            how = (
                f"through {', '.join(through)}" if through else "in another order, with another conversion, or in part"
            )
            return f"{group} reads the robot {how}"
    return "" if own or others else "the controller reads no positions of the robot"


def _is_straight(wiring: Wiring, vector: set[Node], links: Iterable[Link], given: Sequence[Link]) -> bool:
    """Return whether connections pass a whole vector in elements with the same indices, as a target is given."""
    passed = [link for link in links if link.source in vector]
    same = all(_split(link.source)[1] == _split(link.target)[1] for link in passed)
    return (
        bool(vector) and {link.source for link in passed} == vector and same and _are_alike(wiring, [*given, *passed])
    )


def _may_be_positions(
    wiring: Wiring, plant: Fmu, robot: str, vectors: Iterable[set[Node]], links: Iterable[Link], least: int, size: int
) -> bool:
    """Return whether an input vector of a size is as long as positions that it reads, directly or through components.

    Positions through other components have a unit of the robot's positions, or none, and ``least`` elements at least.
    """
    known = {wiring.unit(Node(robot, name)).exponents for group in ("q", "x") for name in plant.vector(group)}
    for source, target, _ in links:
        if source.element == robot and any(source in vector and size >= len(vector) for vector in vectors):
            return True
        may_be = None in known or wiring.unit(target).exponents in (None, *known)
        if source.element != robot and may_be and size >= least:
            return True
    return False


def _split(node: Node) -> tuple[str, str]:
    """Return the name of a vector and the index of its element, that of a scalar is 1."""
    group, _, index = node.connector.partition("[")
    return group, index or "1]"


def _are_alike(wiring: Wiring, links: Sequence[Link]) -> bool:
    """Return whether connections have one map, come from SI units, and go to real inputs in their own units."""
    scalars = [wiring.scalar(link.target) for link in links]
    scaled = [link.source for link in links if wiring.unit(link.source).is_scaled]
    scaled += [link.target for link in links if link.map == IDENTITY and wiring.unit(link.target).is_scaled]
    return (
        len({link.map for link in links}) == 1
        and not scaled
        and all(scalar is not None and (scalar.type, scalar.causality) == ("Real", "input") for scalar in scalars)
    )
