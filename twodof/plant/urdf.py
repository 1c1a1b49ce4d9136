"""A URDF as a checked tree of links and joints.

Masses and inertias, which only a simulation needs, are checked in ``robot``. This module imports the standard library
only.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, replace

from .numerals import number

UNBOUNDED = 1.7976931348623157e308  # magnitude of q_min and q_max that stands for "no limit" (the largest double)

NUMERIC_TAGS = ("origin", "axis", "limit", "dynamics", "mass", "inertia")
MOVING_TYPES = ("revolute", "continuous", "prismatic")
INERTIA = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
"""Attributes of <inertia>, and their indices in the matrix."""
SHAPES = ("visual", "collision")
MAX_URDF = 8 * 1024**2  # bytes of a file, or characters of a text
MAX_LINKS = 1000
MAX_JOINTS = 128  # moving joints; Pinocchio's memory grows with the cube of their number
MAX_SHAPES = 5000  # visuals and collisions, all of which a page contains
MAX_ELEMENTS = 100_000
DEGREES = 25.0, 1e4  # rad: limits between these are probably in degrees; larger ones mean no limit
MAX_DEPTH = 100  # nested elements
MAX_NAME = 1000  # characters; a string literal of C holds 4095 bytes
LARGEST = 1e9  # metres, radians, kilograms: beyond it a URDF is a mistake, not a robot

Vector = tuple[float, float, float]


class RobotError(ValueError):
    """A robot description is unusable; the message names the culprit."""


@dataclass(frozen=True)
class Joint:
    """A joint of a URDF."""

    name: str
    type: str  # "fixed", "revolute", "continuous" or "prismatic"
    parent: str
    child: str
    xyz: Vector  # xyz, rpy: pose of its frame in the parent's frame at q = 0, m, and rad about the fixed axes x, y, z
    rpy: Vector
    axis: Vector  # unit vector in the joint's frame
    low: float  # low, high: position limits, rad or m; ∓UNBOUNDED without limits
    high: float
    effort: float  # effort, velocity: limits, N·m or N, rad/s or m/s; infinite if the URDF has 0 or none
    velocity: float
    damping: float  # damping, friction: viscous, N·m·s/rad or N·s/m, and Coulomb friction, N·m or N
    friction: float
    leader: str  # the independent joint that it follows: q = ratio·q_leader + offset; its own name if it is independent
    ratio: float = 1.0  # ratio, offset: constants of this equation
    offset: float = 0.0

    @property
    def moves(self) -> bool:
        """True for a joint that is not fixed."""
        return self.type != "fixed"

    @property
    def prismatic(self) -> bool:
        """True for a joint whose coordinate is a length."""
        return self.type == "prismatic"


@dataclass(frozen=True)
class Urdf:
    """A robot as described by its URDF."""

    name: str
    root: str  # the link without a parent
    links: tuple[str, ...]  # link names, in the order of the file
    joints: dict[str, Joint]  # joints by name, in the order of the file
    tree: ET.Element  # the XML, for all other facts
    warnings: tuple[str, ...]  # elements without effect, one line each

    def chain(self, link: str) -> list[Joint]:
        """Return the joints from the root to a link."""
        above = {joint.child: joint for joint in self.joints.values()}
        chain = []
        while link in above:
            chain.append(above[link])
            link = above[link].parent
        return chain[::-1]


def check_axes(axes: str) -> None:
    """Refuse task axes that are not one to three different letters of "xyz"."""
    if not axes or len(set(axes)) != len(axes) or set(axes) - set("xyz"):
        raise RobotError(f"axes '{axes}': expected one to three different letters of x, y, z")


def read_urdf(text: str) -> Urdf:
    """Read a robot from the text of a URDF.

    Raises:
        RobotError: an element is not supported; the message names the joint, link or attribute.
    """
    tree = parse_robot(text)
    links = _by_name(tree, "link")
    elements = _by_name(tree, "joint")
    moving = [name for name, joint in elements.items() if joint.get("type") != "fixed"]
    shapes = sum(len(link.findall(kind)) for kind in SHAPES for link in links.values())
    counts = {
        "links": (len(links), MAX_LINKS),
        "moving joints": (len(moving), MAX_JOINTS),
        "visuals and collisions": (shapes, MAX_SHAPES),
    }
    for what, (count, most) in counts.items():
        if count > most:
            raise RobotError(f"the URDF has {count} {what}; at most {most} are supported")
    for tag, named in (("link", links), ("joint", elements)):
        for name, element in named.items():
            _check_numbers(element, f"{tag} '{name}'")
    root = _check_tree(links, elements)
    joints = {name: _joint(name, element) for name, element in elements.items()}
    joints = {name: _following(joint, joints) for name, joint in joints.items()}
    warnings = []
    if frozen := [n for n, joint in joints.items() if joint.leader == n and joint.low == joint.high]:
        warnings.append(
            "equal or missing lower and upper limits do not allow any motion of"
            f" {_listed('joint', frozen)}: give limits, or type 'continuous'"
        )
    turns = {n: max(abs(j.low), abs(j.high)) for n, j in joints.items() if not j.prismatic}
    if wide := [n for n, most in turns.items() if DEGREES[0] < most < DEGREES[1]]:
        warnings.append(f"limits of more than {DEGREES[0]:g} rad may be in degrees: {_listed('joint', wide)}")
    return Urdf(tree.get("name", ""), root, tuple(links), joints, tree, tuple(warnings))


def _listed(what: str, names: Sequence[str]) -> str:
    quoted = ", ".join(f"'{name}'" for name in names)
    return f"{what}{'s' if len(names) > 1 else ''} {quoted}"


def parse_robot(urdf: str, what: str = "URDF") -> ET.Element:
    """Return the root of a URDF or SRDF, an untrusted text of limited size without entities, or raise RobotError."""
    if len(urdf) > MAX_URDF:  # parsed elements take thirty times the memory of the text
        raise RobotError(f"the {what} has {len(urdf)} characters; at most {MAX_URDF} are supported")
    if "<!DOCTYPE" in urdf or "<!ENTITY" in urdf:
        raise RobotError(f"the {what} has a document type declaration; remove it")
    try:
        tree = ET.fromstring(urdf)
    except (ET.ParseError, ValueError) as error:
        raise RobotError(f"the {what} is not XML: {error}") from error
    if tree.tag != "robot":
        raise RobotError(f"the {what}'s root element is <{tree.tag}>, expected <robot>")
    depth, level, count = 1, [tree], 1
    while level := [child for element in level for child in element]:
        depth, count = depth + 1, count + len(level)
        if count > MAX_ELEMENTS:
            raise RobotError(f"the {what} has more than {MAX_ELEMENTS} elements")
        if depth > MAX_DEPTH:  # XML writers descend by recursion
            raise RobotError(f"the {what}'s elements are nested deeper than {MAX_DEPTH}")
    return tree


def _joint(name: str, element: ET.Element) -> Joint:
    kind = str(element.get("type"))
    if kind not in (*MOVING_TYPES, "fixed"):
        raise RobotError(
            f"joint '{name}' is of type '{kind}', which is not supported;"
            f" supported are fixed, {', '.join(MOVING_TYPES)}"
        )
    low, high = -UNBOUNDED, UNBOUNDED
    if kind in ("revolute", "prismatic"):
        if element.find("limit") is None:
            raise RobotError(f"joint '{name}' has no <limit>, which type '{kind}' needs")
        low, high = (attribute(element, "limit", key, 0.0) for key in ("lower", "upper"))
        if low > high:
            raise RobotError(f"joint '{name}': lower limit {low:g} > upper limit {high:g}")
    effort = attribute(element, "limit", "effort", 0.0)
    velocity = attribute(element, "limit", "velocity", 0.0)
    damping, friction = (attribute(element, "dynamics", key, 0.0) for key in ("damping", "friction"))
    for key, value in (("effort", effort), ("damping", damping), ("friction", friction)):
        if kind != "fixed" and value < 0:
            raise RobotError(f"joint '{name}': negative {key}")
    axis = vector(element.find("axis"), "xyz", (1.0, 0.0, 0.0))
    length = math.hypot(*axis)
    if kind == "fixed":
        axis, length = (1.0, 0.0, 0.0), 1.0
    if not length:
        raise RobotError(f"joint '{name}': its axis is zero")
    x, y, z = (component / length for component in axis)
    origin = element.find("origin")
    leader, ratio, offset = _mimicry(name, None if kind == "fixed" else element.find("mimic"))
    return Joint(
        name=name,
        type=kind,
        parent=_link(element, "parent"),
        child=_link(element, "child"),
        xyz=vector(origin, "xyz", (0.0, 0.0, 0.0)),
        rpy=vector(origin, "rpy", (0.0, 0.0, 0.0)),
        axis=(x, y, z),
        low=low,
        high=high,
        effort=effort or math.inf,
        velocity=velocity if velocity > 0.0 else math.inf,
        damping=damping,
        friction=friction,
        leader=leader,
        ratio=ratio,
        offset=offset,
    )


def _mimicry(name: str, mimic: ET.Element | None) -> tuple[str, float, float]:
    """Return leader, ratio and offset by a joint's <mimic>; without one, the joint is its own leader."""
    if mimic is None:
        return name, 1.0, 0.0
    try:
        ratio, offset = (number(mimic.get(*key).strip()) for key in (("multiplier", "1"), ("offset", "0")))
    except ValueError:
        ratio = offset = math.inf
    if not (abs(ratio) <= LARGEST and abs(offset) <= LARGEST):
        raise RobotError(f"joint '{name}': its <mimic> has a factor or offset that is not a number")
    if mimic.get("joint") == name:
        raise RobotError(f"joint '{name}' mimics itself")
    return mimic.get("joint", ""), ratio, offset


def _following(joint: Joint, joints: dict[str, Joint]) -> Joint:
    """Return the joint with the leader at the end of its chain of <mimic> elements, which is independent."""
    seen = [joint.name]
    while joint.leader != seen[-1]:
        leader = joints.get(joint.leader)
        if leader is None or not leader.moves or leader.name in seen:
            reason = (
                "does not exist"
                if leader is None
                else f"is fixed: make '{seen[-1]}' fixed too"
                if not leader.moves
                else "follows it"
            )
            raise RobotError(f"joint '{seen[-1]}' mimics '{joint.leader}', which {reason}")
        seen.append(leader.name)
        ratio, offset = joint.ratio * leader.ratio, joint.ratio * leader.offset + joint.offset
        if not abs(ratio) + abs(offset) <= LARGEST:
            raise RobotError(f"joint '{seen[0]}': the factors or offsets of the joints that it mimics are too large")
        joint = replace(joint, leader=leader.leader, ratio=ratio, offset=offset)
    return joint


def _by_name(tree: ET.Element, tag: str) -> dict[str, ET.Element]:
    elements: dict[str, ET.Element] = {}
    for element in tree.findall(tag):
        name = element.get("name")
        if not name:
            raise RobotError(f"the URDF has a <{tag}> without a name")
        if len(name) > MAX_NAME:
            raise RobotError(
                f"the URDF has a <{tag}> whose name has {len(name)} characters; at most {MAX_NAME} are supported"
            )
        if name in elements:
            raise RobotError(f"the URDF has two {tag}s named '{name}'")
        elements[name] = element
    return elements


def _check_numbers(element: ET.Element, owner: str) -> None:
    counts = {"xyz": 3, "rpy": 3}
    for tag in NUMERIC_TAGS:
        for part in element.iter(tag):
            for key, text in part.attrib.items():
                try:
                    numbers = [number(word) for word in text.split()]
                except ValueError:
                    numbers = []
                if len(numbers) != counts.get(key, 1):
                    raise RobotError(f"{owner}: <{tag} {key}='{text}'> is not a number or vector")
                if not all(abs(number) <= LARGEST for number in numbers):
                    if tag == "limit" and not any(map(math.isnan, numbers)):
                        continue  # a huge value is a common way to write "no limit"
                    raise RobotError(f"{owner}: <{tag} {key}='{text}'> is not finite or too large")


def _check_tree(links: dict[str, ET.Element], joints: dict[str, ET.Element]) -> str:
    parent: dict[str, str] = {}
    for name, joint in joints.items():
        for side in ("parent", "child"):
            if _link(joint, side) not in links:
                raise RobotError(f"joint '{name}': its {side} link '{_link(joint, side)}' does not exist")
        child = _link(joint, "child")
        if child in parent:
            raise RobotError(f"link '{child}' has two parents: closed loops are not supported")
        parent[child] = _link(joint, "parent")
    if not links:
        raise RobotError("the URDF has no links")
    roots = [link for link in links if link not in parent]
    reached = set(roots)
    for link in links:
        path = [link]
        while path[-1] not in reached:
            path.append(parent[path[-1]])
            if len(path) > len(links):
                raise RobotError(f"link '{link}' is its own ancestor: loops are not supported")
        reached.update(path)
    if len(roots) != 1:
        raise RobotError(f"the URDF needs one root link, it has {len(roots)}: {', '.join(roots)}")
    return roots[0]


def _link(joint: ET.Element, side: str) -> str:
    element = joint.find(side)
    return "" if element is None else element.get("link", "")


def attribute(element: ET.Element, tag: str, key: str, default: float) -> float:
    """Return a number of an element's first child with a tag, at most the largest double."""
    child = element.find(tag)
    value = default if child is None else float(child.get(key, default))
    return max(-UNBOUNDED, min(UNBOUNDED, value))


def vector(element: ET.Element | None, key: str, default: Vector) -> Vector:
    """Return three numbers of an attribute."""
    if element is None or element.get(key) is None:
        return default
    x, y, z = (float(word) for word in str(element.get(key)).split())
    return x, y, z
