"""The robot: a URDF, checked, as a Pinocchio model with one coordinate per joint.

Pinocchio loads several things silently that this plant cannot simulate, so the XML is
checked before Pinocchio sees it, and every refusal names the joint or the link.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

UNBOUNDED = 1.7976931348623157e308
"""Magnitude of q_min and q_max that stands for "no limit" (the largest double)."""

NUMERIC_TAGS = ("origin", "axis", "limit", "dynamics", "mass", "inertia")
MOVING_TYPES = ("revolute", "continuous", "prismatic")
MAX_LINKS = 1000
MAX_JOINTS = 128  # that move; Pinocchio's memory grows with their third power
MAX_DEPTH = 100  # of elements in elements
MAX_NAME = 1000  # characters; a string literal of C holds 4095 bytes
LARGEST = 1e9  # metres, radians, kilograms: beyond it a URDF is a mistake, not a robot


class RobotError(ValueError):
    """A robot description that cannot be simulated; the message names the culprit."""


@dataclass(frozen=True)
class Robot:
    """A fixed-base robot whose n joints each have one coordinate, and its task frame.

    Attributes:
        name: the URDF's robot name.
        model: Pinocchio model, nq = nv = n; its gravity is not used (see ``Plant``).
        joints: joint names in the model's order, Pinocchio's joint 1 first.
        prismatic: per joint, True where the coordinate is a length (m), else an angle (rad).
        q_min, q_max: position limits, rad or m; ∓UNBOUNDED where there is none.
        effort: effort limits, N·m or N; infinite where the URDF has 0 or none.
        damping: viscous joint damping D, N·m·s/rad or N·s/m.
        frame: name of the task frame, and its Pinocchio index ``frame_id``.
        axes: task axes, a subset of "xyz" in the root frame, e.g. "xy"; m = len(axes).
        root: name of the URDF's root link, the frame in which positions are expressed.
        warnings: what was read but has no effect, one line each.
    """

    name: str
    model: pin.Model
    joints: tuple[str, ...]
    prismatic: tuple[bool, ...]
    q_min: tuple[float, ...]
    q_max: tuple[float, ...]
    effort: tuple[float, ...]
    damping: tuple[float, ...]
    frame: str
    frame_id: int
    axes: str
    root: str
    warnings: tuple[str, ...]

    def moves_frame(self) -> tuple[bool, ...]:
        """Per joint, whether it lies between the root and the task frame."""
        supports = set(self.model.supports[self.model.frames[self.frame_id].parentJoint])
        return tuple(i + 1 in supports for i in range(len(self.joints)))


def load_robot(urdf: str, frame: str, axes: str) -> Robot:
    """Robot from the text of a URDF.

    Args:
        urdf: XML text.
        frame: name of the link whose origin is the end effector.
        axes: one to three different letters of "xyz", the task's axes in the root frame.

    Raises:
        RobotError: anything that is not supported, naming the joint, link or attribute.
    """
    if not axes or len(set(axes)) != len(axes) or set(axes) - set("xyz"):
        raise RobotError(f"axes '{axes}': expected one to three different letters of x, y, z")
    tree = _parse(urdf)
    root, warnings = _check(tree)
    links = [str(link.get("name")) for link in tree.findall("link")]
    if frame not in links:
        raise RobotError(f"no frame '{frame}' in the URDF; there are: {', '.join(links)}")
    try:
        model = pin.buildModelFromXML(ET.tostring(_mechanism(tree), encoding="unicode"))
    except (ValueError, RuntimeError) as error:
        raise RobotError(f"Pinocchio cannot read the URDF: {error}") from error
    xml = {str(joint.get("name")): joint for joint in tree.findall("joint")}
    joints = tuple(model.names)[1:]
    _check_mass_matrix(model, joints)
    robot = Robot(
        name=tree.get("name", ""),
        model=model,
        joints=joints,
        prismatic=tuple(xml[j].get("type") == "prismatic" for j in joints),
        q_min=tuple(_limits(xml[j])[0] for j in joints),
        q_max=tuple(_limits(xml[j])[1] for j in joints),
        effort=tuple(_attribute(xml[j], "limit", "effort", 0.0) or math.inf for j in joints),
        damping=tuple(_attribute(xml[j], "dynamics", "damping", 0.0) for j in joints),
        frame=frame,
        frame_id=model.getFrameId(frame, pin.FrameType.BODY),
        axes=axes,
        root=root,
        warnings=tuple(warnings),
    )
    if not any(robot.moves_frame()):
        raise RobotError(f"no joint moves the frame '{frame}'")
    return robot


def _parse(urdf: str) -> ET.Element:
    if "<!DOCTYPE" in urdf or "<!ENTITY" in urdf:
        raise RobotError("the URDF has a document type declaration; remove it")
    try:
        tree = ET.fromstring(urdf)
    except (ET.ParseError, ValueError) as error:
        raise RobotError(f"the URDF is not XML: {error}") from error
    if tree.tag != "robot":
        raise RobotError(f"the URDF's root element is <{tree.tag}>, expected <robot>")
    depth, level = 1, [tree]
    while level := [child for element in level for child in element]:
        depth += 1
        if depth > MAX_DEPTH:  # what writes XML goes down by recursion
            raise RobotError(f"the URDF's elements are nested deeper than {MAX_DEPTH}")
    return tree


def _check(tree: ET.Element) -> tuple[str, list[str]]:
    """Refuse what is not supported; the root link's name and the warnings."""
    links = _by_name(tree, "link")
    joints = _by_name(tree, "joint")
    moving = [name for name, joint in joints.items() if joint.get("type") != "fixed"]
    for what, names, most in (("links", links, MAX_LINKS), ("moving joints", moving, MAX_JOINTS)):
        if len(names) > most:
            raise RobotError(f"the URDF has {len(names)} {what}; at most {most} are supported")
    for tag, elements in (("link", links), ("joint", joints)):
        for name, element in elements.items():
            _check_numbers(element, f"{tag} '{name}'")
    root = _check_tree(links, joints)
    warnings = []
    for name, joint in joints.items():
        kind = joint.get("type")
        if kind not in (*MOVING_TYPES, "fixed"):
            raise RobotError(
                f"joint '{name}' is of type '{kind}', which is not supported;"
                f" supported are fixed, {', '.join(MOVING_TYPES)}"
            )
        if joint.find("mimic") is not None:
            raise RobotError(
                f"joint '{name}' mimics another joint, which is not supported;"
                " make it fixed, or leave out its <mimic> to move it on its own"
            )
        if kind == "fixed":
            continue
        if kind != "continuous":
            if joint.find("limit") is None:
                raise RobotError(f"joint '{name}' has no <limit>, which type '{kind}' needs")
            lower, upper = _limits(joint)
            if lower > upper:
                raise RobotError(f"joint '{name}': lower limit {lower:g} > upper limit {upper:g}")
        for tag, key in (("limit", "effort"), ("dynamics", "damping")):
            if _attribute(joint, tag, key, 0.0) < 0:
                raise RobotError(f"joint '{name}': negative {key}")
        if _attribute(joint, "dynamics", "friction", 0.0):
            warnings.append(f"joint '{name}': friction is not modelled and is ignored")
        if not any(_vector(joint.find("axis"), "xyz", (1.0, 0.0, 0.0))):
            raise RobotError(f"joint '{name}': its axis is zero")
        _check_body(joint, links, joints)
    if not moving:
        raise RobotError("the URDF has no moving joint")
    return root, warnings


def _by_name(tree: ET.Element, tag: str) -> dict[str, ET.Element]:
    found: dict[str, ET.Element] = {}
    for element in tree.findall(tag):
        name = element.get("name")
        if not name:
            raise RobotError(f"the URDF has a <{tag}> without a name")
        if len(name) > MAX_NAME:
            raise RobotError(
                f"the URDF has a <{tag}> whose name has {len(name)} characters;"
                f" at most {MAX_NAME} are supported"
            )
        if name in found:
            raise RobotError(f"the URDF has two {tag}s named '{name}'")
        found[name] = element
    return found


def _check_numbers(element: ET.Element, owner: str) -> None:
    counts = {"xyz": 3, "rpy": 3}
    for tag in NUMERIC_TAGS:
        for found in element.iter(tag):
            for key, text in found.attrib.items():
                try:
                    numbers = [_number(word) for word in text.split()]
                except ValueError:
                    numbers = []
                if len(numbers) != counts.get(key, 1):
                    raise RobotError(f"{owner}: <{tag} {key}='{text}'> is not a number or vector")
                if not all(abs(number) <= LARGEST for number in numbers):
                    if tag == "limit" and not any(map(math.isnan, numbers)):
                        continue  # a huge limit is a common way to write "none"
                    raise RobotError(f"{owner}: <{tag} {key}='{text}'> is not finite or too large")


def _number(word: str) -> float:
    """A number that other readers read as Python does: without underscores and other digits."""
    if not word.isascii() or "_" in word:
        raise ValueError(word)
    return float(word)


def _check_tree(links: dict[str, ET.Element], joints: dict[str, ET.Element]) -> str:
    parent: dict[str, str] = {}
    for name, joint in joints.items():
        for side in ("parent", "child"):
            if _link(joint, side) not in links:
                raise RobotError(
                    f"joint '{name}': its {side} link '{_link(joint, side)}' does not exist"
                )
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


def _check_body(
    joint: ET.Element, links: dict[str, ET.Element], joints: dict[str, ET.Element]
) -> None:
    """A moving body, that is a link with all that is fixed to it, needs physical inertia."""
    first = _link(joint, "child")
    children: dict[str, list[str]] = {}
    for other in joints.values():
        if other.get("type") == "fixed":
            children.setdefault(_link(other, "parent"), []).append(_link(other, "child"))
    body = [first]
    for name in body:
        body.extend(children.get(name, ()))
    mass = 0.0
    for name in body:
        inertial = links[name].find("inertial")
        if inertial is not None:
            mass += _check_inertia(name, inertial)
    if mass == 0.0:
        raise RobotError(
            f"link '{first}' moves (joint '{joint.get('name')}') but has no mass;"
            " give it an <inertial> with the mass and inertia of the part"
        )


def _check_inertia(link: str, inertial: ET.Element) -> float:
    """The link's mass, after the checks."""
    if missing := _missing(inertial):
        raise RobotError(f"link '{link}': its <inertial> has no {missing}")
    mass = _attribute(inertial, "mass", "value", 0.0)
    if mass < 0.0:
        raise RobotError(f"link '{link}': negative mass {mass:g} kg")
    xx, xy, xz, yy, yz, zz = (_attribute(inertial, "inertia", key, 0.0) for key in _INERTIA_KEYS)
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    slack = 1e-6 * float(np.abs(moments).sum()) + 1e-15  # URDFs are written with few digits
    if moments[0] < -slack or moments[2] > moments[0] + moments[1] + slack:
        text = ", ".join(f"{moment:.3g}" for moment in moments)
        raise RobotError(
            f"link '{link}': its inertia is not physical, principal moments {text} kg·m2"
            " must be positive and none larger than the sum of the other two"
        )
    return mass


_INERTIA_KEYS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def _missing(inertial: ET.Element) -> str:
    """The first element and those of its attributes that are not there; "" where all are."""
    for tag, keys in (("mass", ("value",)), ("inertia", _INERTIA_KEYS)):
        element = inertial.find(tag)
        missing = [key for key in keys if element is None or element.get(key) is None]
        if missing:
            return f"<{tag} {' '.join(missing)}>"
    return ""


def _mechanism(tree: ET.Element) -> ET.Element:
    """The URDF of the bare mechanism: inertias, joints, limits, and nothing else.

    urdfdom drops or refuses a whole link or joint for flaws in parts that do not matter here, and
    takes a number with a space behind it for 0. Continuous joints become revolute without limits,
    so that Pinocchio's state is the angle.
    """
    bare = ET.Element("robot", name=tree.get("name") or "robot")
    for link in tree.findall("link"):
        copy = ET.SubElement(bare, "link", name=str(link.get("name")))
        copy.extend(e for e in link.findall("inertial") if not _missing(e))
    for joint in tree.findall("joint"):
        kind = str(joint.get("type"))
        copy = ET.SubElement(bare, "joint", name=str(joint.get("name")), type=kind)
        copy.extend(e for e in joint if e.tag in ("parent", "child", "origin"))
        if kind == "fixed":
            continue
        copy.extend(joint.findall("axis"))
        low, high = _limits(joint)
        ET.SubElement(copy, "limit", lower=repr(low), upper=repr(high), effort="0", velocity="0")
        if kind == "continuous":
            copy.set("type", "revolute")
    for tag in NUMERIC_TAGS:
        for element in bare.iter(tag):
            for key, text in element.attrib.items():
                element.set(key, " ".join(repr(_number(word)) for word in text.split()))
    return bare


def _limits(joint: ET.Element) -> tuple[float, float]:
    if joint.get("type") == "continuous":
        return -UNBOUNDED, UNBOUNDED
    return _attribute(joint, "limit", "lower", 0.0), _attribute(joint, "limit", "upper", 0.0)


def _check_mass_matrix(model: pin.Model, joints: tuple[str, ...]) -> None:
    """Every joint, the outermost first, must have something to move."""
    mass_matrix = pin.crba(model, model.createData(), np.zeros(model.nq))
    mass_matrix = np.triu(mass_matrix) + np.triu(mass_matrix, 1).T
    for i in reversed(range(len(joints))):
        block = mass_matrix[i:, i:]
        if not np.linalg.eigvalsh(block)[0] > 1e-12 * np.trace(block):
            raise RobotError(
                f"joint '{joints[i]}': the links behind it have no inertia about its axis,"
                " so its acceleration is not defined"
            )


def _link(joint: ET.Element, side: str) -> str:
    element = joint.find(side)
    return "" if element is None else element.get("link", "")


def _attribute(element: ET.Element, tag: str, key: str, default: float) -> float:
    child = element.find(tag)
    value = default if child is None else float(child.get(key, default))
    return max(-UNBOUNDED, min(UNBOUNDED, value))


def _vector(element: ET.Element | None, key: str, default: tuple[float, ...]) -> tuple[float, ...]:
    if element is None or element.get(key) is None:
        return default
    return tuple(float(word) for word in str(element.get(key)).split())
