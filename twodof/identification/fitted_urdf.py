"""Write fitted numbers into a URDF, and keep its comments, order and all other text."""

import io
import re

import lxml.etree
import numpy as np

from ..errors import InputError
from ..plant.robot import inertial_pose
from ..plant.urdf import INERTIA, Urdf
from .inertials import inertia_of
from .parameters import Parameters, Values

OF_DYNAMICS = ("friction", "damping")
DIGITS = 9


def fitted_urdf(text: str, urdf: Urdf, parameters: Parameters, values: Values) -> bytes:
    """Return the text of a URDF with the fitted values that a URDF can store.

    These are friction and damping of joints, and masses, centres and inertias of links. Joints that mimic each other
    share friction and damping in their original proportions.
    """
    tree = parsed(text)
    root = tree.getroot()
    links = {link.get("name"): link for link in root.findall("link")}
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    for free in parameters.free:
        if free.group in OF_DYNAMICS:
            leader = parameters.robot.joints[free.number]
            before, after = (float(getattr(v, free.group)[free.number]) for v in (parameters.start, values))
            for joint in (joint for joint in urdf.joints.values() if joint.leader == leader):
                own = getattr(joint, free.group)
                share = own * after / before if before else after * (joint.name == leader)
                if joint.moves and (share or own):
                    _child(joints[joint.name], "dynamics").set(free.group, _number(share))
        elif free.group in ("mass", "com", "inertia"):
            _write_link(links[parameters.links[free.number]].find("inertial"), free.group, free.number, values)
    declaration = re.match(r"\ufeff?<\?xml.*?\?>\s*", text, re.DOTALL)
    written = lxml.etree.tostring(tree, encoding="unicode")
    return f"{declaration[0] if declaration else ''}{written.rstrip()}\n".encode()


def parsed(text: str) -> lxml.etree.ElementTree:
    """Return the tree of a URDF, in which numbers can be replaced.

    Raises:
        InputError: libxml2 refuses the text; expat, which reads robots, accepts a little more.
    """
    parser = lxml.etree.XMLParser(encoding="utf-8", resolve_entities=False, no_network=True, huge_tree=False)
    try:
        return lxml.etree.parse(io.BytesIO(text.encode()), parser)
    except lxml.etree.XMLSyntaxError as error:
        raise InputError(f"the URDF cannot be written with fitted values: {error.msg}") from error


def _write_link(inertial: lxml.etree.Element, group: str, link: int, values: Values) -> None:
    place = inertial_pose(inertial)
    if group == "mass":
        inertial.find("mass").set("value", _number(values.mass[link]))
    elif group == "com":
        _child(inertial, "origin", first=True).set("xyz", " ".join(map(_number, values.com[link])))
    else:
        R = place.rotation
        tensor = R.T @ inertia_of(values.second[link]) @ R
        for key, index in INERTIA.items():
            inertial.find("inertia").set(key, _number(tensor[index]))


def _child(element: lxml.etree.Element, tag: str, *, first: bool = False) -> lxml.etree.Element:
    """Return an element's child with a tag; if it is missing, make it with the indentation of the others."""
    found = element.find(tag)
    if found is None:
        found = lxml.etree.Element(tag)
        if len(element):
            found.tail = element.text if first else element[-1].tail
            if not first:
                element[-1].tail = element.text
        element.insert(0 if first else len(element), found)
    return found


def _number(value: float) -> str:
    return repr(float(np.format_float_positional(value, DIGITS, fractional=False)) if value else 0.0)
