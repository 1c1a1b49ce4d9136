"""Targets of a system's robot: inputs of its controllers, and connectors of the system, in the robot's coordinates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from .description import RECORDED, Fmu
from .ssp_file import IDENTITY
from .wiring import Link, Node, Wiring

TARGETS = tuple(group for group in RECORDED if group.endswith("_des"))


def targets_of(wiring: Wiring, fmus: Mapping[str, Fmu], links: Sequence[Link], robot: str) -> set[Node]:
    """Return the inputs and connectors that are targets of the robot: whole vectors of real numbers in SI units.

    The robot's inputs depend on the outputs of their component, which reads the robot's positions in elements with
    the same indices. Targets and positions arrive without transformation, or with the same one.
    """
    driving, incoming, found = _driving(links, robot), {link.target: link for link in links}, set[Node]()
    for group in TARGETS:
        position = fmus[robot].vector(group.removesuffix("_des"))
        having = [name for name in fmus if name in driving and group in fmus[name].groups("input")]
        for name in having:
            nodes = [Node(name, own) for own in fmus[name].vector(group)]
            given = [incoming.get(node, Link(node, node, IDENTITY)) for node in nodes]
            free = len(having) == 1 and all(link.source == link.target for link in given)
            passed = all(link.source == Node("", link.target.connector) for link in given)
            read = [] if name == robot else _positions(fmus[robot], links, robot, name, group)
            measured = bool(read) or name == robot
            if (free or passed) and measured and len(nodes) == len(position) and _are_alike(wiring, [*given, *read]):
                found |= {link.source for link in given}
    return found


def _driving(links: Sequence[Link], robot: str) -> set[str]:
    """Return the robot, and the components on whose outputs its inputs depend."""
    driving = found = {robot}
    while found:
        found = {link.source.element for link in links if link.target.element in found} - driving
        driving = driving | found
    return driving


def _positions(plant: Fmu, links: Iterable[Link], robot: str, controller: str, group: str) -> list[Link]:
    """Return the connections from the robot's positions to a controller; none if a whole vector has other indices."""
    vectors = [plant.vector(name) for name in ("q", "q_meas", group.removesuffix("_des"))]
    known = {Node(robot, name) for names in vectors for name in names}
    read = [link for link in links if link.source in known and link.target.element == controller]
    read = [link for link in read if _split(link.target)[0] not in TARGETS]
    same = all(_split(link.source)[1] == _split(link.target)[1] for link in read)
    whole = any(names and {Node(robot, name) for name in names} <= {link.source for link in read} for names in vectors)
    return read if same and whole else []


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
