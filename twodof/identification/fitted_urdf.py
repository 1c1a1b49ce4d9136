"""Write fitted numbers into the text of a URDF, in which nothing else changes."""

import re
import xml.etree.ElementTree as ET

import numpy as np

from ..plant.robot import inertial_pose
from ..plant.urdf import INERTIA, Urdf
from .inertials import inertia_of
from .parameters import Parameters, Values

OF_DYNAMICS = ("friction", "damping")
DIGITS = 9
MARKUP = re.compile(
    r"""<!--.*?-->|<!\[CDATA\[.*?]]>|<\?.*?\?>|</[^>]*>|(?P<start><[^\s/>]+(?:[^"'>]|"[^"]*"|'[^']*')*>)""", re.DOTALL
)
"""Comments, character data, processing instructions, end tags and start tags of a well-formed URDF."""
ATTRIBUTE = re.compile(r"""([^\s=]+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")

Changes = dict[tuple[ET.Element, str], dict[str, str]]
"""New values of attributes of the child with a tag, by its parent and tag."""


def fitted_urdf(text: str, urdf: Urdf, parameters: Parameters, values: Values) -> bytes:
    """Return the text of a URDF with the fitted values that a URDF can store.

    These are friction and damping of joints, and masses, centres and inertias of links. Joints that mimic each other
    share friction and damping in their original proportions.
    """
    inertials = {link.get("name"): link.find("inertial") for link in urdf.tree.findall("link")}
    joints = {joint.get("name"): joint for joint in urdf.tree.findall("joint")}
    changes: Changes = {}
    for free in parameters.free:
        if free.group in OF_DYNAMICS:
            leader = parameters.robot.joints[free.number]
            before, after = (float(getattr(v, free.group)[free.number]) for v in (parameters.start, values))
            for joint in (joint for joint in urdf.joints.values() if joint.leader == leader):
                own = getattr(joint, free.group)
                share = own * after / before if before else after * (joint.name == leader)
                if joint.moves and (share or own):
                    changes.setdefault((joints[joint.name], "dynamics"), {})[free.group] = _number(share)
        elif free.group in ("mass", "com", "inertia"):
            inertial = inertials[parameters.links[free.number]]
            assert inertial is not None  # free links have mass
            changes |= _of_link(inertial, free.group, free.number, values)
    return _edited(text, urdf.tree, changes).encode()


def _of_link(inertial: ET.Element, group: str, link: int, values: Values) -> Changes:
    """Return the changes of a link's mass, centre of mass or inertia."""
    if group == "mass":
        return {(inertial, "mass"): {"value": _number(values.mass[link])}}
    if group == "com":
        return {(inertial, "origin"): {"xyz": " ".join(map(_number, values.com[link]))}}
    R = inertial_pose(inertial).rotation
    tensor = R.T @ inertia_of(values.second[link]) @ R
    return {(inertial, "inertia"): {key: _number(tensor[index]) for key, index in INERTIA.items()}}


def _edited(text: str, tree: ET.Element, changes: Changes) -> str:
    """Return the text of a tree with changed attributes; a missing element becomes the first child of its parent."""
    starts = (match for match in MARKUP.finditer(text) if match["start"])
    tags = dict(zip(tree.iter(), starts, strict=True))
    edits = list[tuple[int, int, str]]()
    for (parent, tag), attributes in changes.items():
        element = parent.find(tag)
        if element is None:
            end = tags[parent].end()
            indentation = text[end : len(text) - len(text[end:].lstrip())]
            words = "".join(f' {name}="{value}"' for name, value in attributes.items())
            edits.append((end, end, f"{indentation}<{tag}{words}/>"))
            continue
        begin, end = tags[element].span()
        known = {match[1]: match.span(match.lastindex or 0) for match in ATTRIBUTE.finditer(text, begin, end)}
        after = begin + 1 + len(tag)
        for name, value in attributes.items():
            edits.append((*known[name], value) if name in known else (after, after, f' {name}="{value}"'))
    parts, last = list[str](), 0
    for begin, end, new in sorted(edits):
        parts += text[last:begin], new
        last = end
    return "".join([*parts, text[last:]])


def _number(value: float) -> str:
    return repr(float(np.format_float_positional(value, DIGITS, fractional=False)) if value else 0.0)
