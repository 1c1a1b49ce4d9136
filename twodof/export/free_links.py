"""Masses, centres of mass and inertias of links as inputs of a native FMU."""

import fnmatch
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..errors import BuildError, choice
from ..plant.robot import Robot, moving_links
from ..plant.urdf import INERTIA, Urdf
from ..plant.variables import OF_LINKS, Variable, name_of_link
from .bodies import FreeLink, Inertial
from .straight_line import Expression

ROWS, COLUMNS = zip(*INERTIA.values())
ELEMENTS: dict[str, tuple[str, str, Sequence[str]]] = {
    "mass": ("mass", "kg", ()),
    "com": ("centre of mass", "m", ("axis x", "axis y", "axis z")),
    "inertia": ("inertia about the centre of mass", "kg.m2", tuple(INERTIA)),
}
"""Description, unit and elements of each group of OF_LINKS."""


def free_links(urdf: Urdf, robot: Robot, patterns: Sequence[str]) -> tuple[list[FreeLink], list[Variable]]:
    """Return the links with values that match patterns, and these values as inputs, group by group.

    In C, the values are the elements of an array ``link``.
    """
    links: dict[str, FreeLink] = {}
    for name, body, pose, inertia in zip(*moving_links(urdf, robot.model)):
        given = Inertial(inertia.mass, inertia.lever, inertia.inertia)
        links[name] = FreeLink(body, pose.rotation, pose.translation, given, given)
    chosen = _chosen(urdf, [f"{group}:{name}" for group in OF_LINKS for name in links], patterns)
    table: list[Variable] = []
    for group in OF_LINKS:
        for name, link in links.items():
            if f"{group}:{name}" not in chosen:
                continue
            inputs = _inputs(group, name, link.given)
            if any(variable.called == inputs[0].called for variable in table):
                other = f"another link has the same name in the FMU, '{inputs[0].called}'"
                raise BuildError(f"`free` '{group}:{name}': {other}")
            values = [Expression(f"link[{len(table) + i}]") for i in range(len(inputs))]
            links[name] = replace(link, free=_varied(link.free, group, values))
            table += inputs
    return [link for link in links.values() if link.free is not link.given], table


def _inputs(group: str, link: str, given: Inertial) -> list[Variable]:
    """Return the values of a group of a link as inputs."""
    text, unit, elements = ELEMENTS[group]
    called = name_of_link(group, link)
    if group == "mass":
        mass = float(given.mass)
        return [Variable(group, None, "input", unit, mass, f"{text} of link {link}", called, known=mass)]
    values = (given.com if group == "com" else given.inertia[ROWS, COLUMNS]).tolist()
    return [
        Variable(group, i, "input", unit, value, f"{text} of link {link}, {element}", called, known=value)
        for i, (value, element) in enumerate(zip(values, elements))
    ]


def _varied(inertial: Inertial, group: str, values: list[Expression]) -> Inertial:
    """Return the inertia with the values of a group instead of its own."""
    if group == "mass":
        return inertial._replace(mass=values[0])
    if group == "com":
        return inertial._replace(com=np.array(values, dtype=object))
    tensor = np.empty((3, 3), dtype=object)
    tensor[ROWS, COLUMNS] = tensor[COLUMNS, ROWS] = values
    return inertial._replace(inertia=tensor)


def _chosen(urdf: Urdf, known: Sequence[str], patterns: Sequence[str]) -> set[str]:
    """Return the known names that match patterns; raise BuildError for a pattern that matches none."""
    chosen: set[str] = set()
    for pattern in patterns:
        matches = fnmatch.filter(known, pattern.replace("[", "[[]"))  # brackets are part of names, not of patterns
        if not matches:
            link = pattern.partition(":")[2]
            if link not in urdf.links:
                raise BuildError(f"`free` '{pattern}' matches no link that moves and has mass{choice(pattern, known)}")
            moves = any(joint.moves for joint in urdf.chain(link))
            raise BuildError(f"`free` '{pattern}': {'the link has no mass' if moves else 'no joint moves the link'}")
        chosen.update(matches)
    return chosen
