"""A checked URDF as a Pinocchio model and its independent joints.

Pinocchio silently loads some features that this plant cannot simulate. Therefore the XML is checked first, and every
refusal names the joint or the link.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from .numerals import number
from .urdf import INERTIA, NUMERIC_TAGS, UNBOUNDED, Joint, RobotError, Urdf, attribute, check_axes, read_urdf


@dataclass(frozen=True)
class Robot:
    """A fixed-base robot with n independent joints, and its task frame."""

    name: str
    # Pinocchio model of all joints that move, one coordinate each; its gravity is not used (see ``Mechanism``)
    model: pin.Model
    # coupling, offset: positions of the model's joints are ``coupling @ q + offset``; coupling is None, and the
    # positions are q, if no joint mimics another
    coupling: NDArray[np.float64] | None
    offset: NDArray[np.float64]
    joints: tuple[str, ...]  # names of the n joints in the model's order
    prismatic: tuple[bool, ...]  # for each joint, True if its coordinate is a length (m), False for an angle (rad)
    # q_min, q_max: position limits, rad or m, including limits of joints that mimic it; ∓UNBOUNDED without one
    q_min: tuple[float, ...]
    q_max: tuple[float, ...]
    effort: tuple[float, ...]  # effort limits, N·m or N; infinite if the URDF has 0 or none
    damping: tuple[float, ...]  # viscous joint damping D, N·m·s/rad or N·s/m, including that of joints that mimic it
    friction: tuple[float, ...]  # Coulomb friction, N·m or N, including that of joints that mimic it
    frame: str  # name of the task frame, and its Pinocchio index ``frame_id``
    frame_id: int
    axes: str  # task axes, a subset of "xyz" in the root frame, e.g. "xy"; m = len(axes)
    root: str  # name of the URDF's root link, the frame in which positions are expressed
    warnings: tuple[str, ...]  # URDF elements without effect, one line each

    def moves_frame(self) -> tuple[bool, ...]:
        """Return the mask of the joints between the root and the task frame."""
        return tuple(bool(column.any()) for column in self._path().T)

    def origins(self, q: Sequence[float]) -> dict[str, NDArray[np.float64]]:
        """Return the origins of all links in the root frame at joint positions q, m, by name."""
        data = self.model.createData()
        positions = np.array(q) if self.coupling is None else self.coupling @ q + self.offset
        pin.framesForwardKinematics(self.model, data, positions)
        frames = enumerate(self.model.frames)
        return {f.name: data.oMf[i].translation.copy() for i, f in frames if f.type == pin.FrameType.BODY}

    def swing(self) -> tuple[float, ...]:
        """Bound on how fast each joint changes σ/σ_max of the task Jacobian, 1/rad or 1/m.

        A joint i of a chain changes column j of the Jacobian by the cross product of an axis with
        column max(i, j), so that ‖∂J/∂q_i‖ ≤ √n σ_max for n joints. By Weyl's inequality no singular value changes
        faster, and no ratio σ/σ_max changes by more than 2 √n per unit. With fewer than three task axes, the columns
        are projections, and the bound is an estimate. A first joint that moves the task as a rigid body, within its
        axes, changes no singular value.
        """
        path = self._path()
        bound = 2.0 * math.sqrt(len(path)) * np.abs(path).sum(axis=0)
        first = np.flatnonzero(path[:1].any(axis=0))
        if len(first) == 1 and not path[1:, first].any():
            J = pin.computeJointJacobians(self.model, self.model.createData(), pin.neutral(self.model))
            axis = J.reshape(6, -1)[3:, self._support()[0] - 1]  # with one joint, Pinocchio returns a vector
            rotation, task = pin.skew(axis), np.diag([float(a in self.axes) for a in "xyz"])
            bound[first] *= not np.allclose(task @ rotation, rotation @ task, atol=1e-12)
        return tuple(bound.tolist())

    def _path(self) -> NDArray[np.float64]:
        """Return the coupling's rows for the joints between the root and the task frame."""
        coupling = np.eye(len(self.joints)) if self.coupling is None else self.coupling
        return coupling[[i - 1 for i in self._support()]]

    def _support(self) -> list[int]:
        """Return Pinocchio's indices of the joints between the root and the task frame."""
        return list(self.model.supports[self.model.frames[self.frame_id].parentJoint])[1:]


def load_robot(text: str, frame: str, axes: str) -> Robot:
    """Load a robot from the text of a URDF.

    Args:
        frame: name of the link whose origin is the end effector.
        axes: one to three different letters of "xyz", the task's axes in the root frame.

    Raises:
        RobotError: anything that is not supported, naming the joint, link or attribute.
    """
    check_axes(axes)
    urdf = read_urdf(text)
    odd: list[str] = []
    bodies = {joint.child: _mass(urdf, joint, odd) for joint in urdf.joints.values() if joint.moves}
    warnings = list(urdf.warnings)
    if empty := ", ".join(f"'{link}'" for link, mass in bodies.items() if not mass):
        warnings.append(f"these moving links have no mass: {empty}")
    if odd:
        links = ", ".join(f"'{link}'" for link in dict.fromkeys(odd))
        warnings.append(
            "no body can have these inertias: one principal moment is larger than the sum of the"
            f" other two; they are used unchanged: {links}"
        )
    if not bodies:
        raise RobotError("no joint moves a link; a robot needs a revolute, continuous or prismatic joint, not locked")
    if frame not in urdf.links:
        raise RobotError(f"no frame '{frame}' in the URDF; there are: {', '.join(urdf.links)}")
    try:
        model = pin.buildModelFromXML(ET.tostring(_mechanism(urdf), encoding="unicode"))
    except (ValueError, RuntimeError) as error:
        raise RobotError(f"Pinocchio cannot read the URDF: {error}") from error
    moving = [urdf.joints[name] for name in list(model.names)[1:]]
    joints = [joint for joint in moving if joint.leader == joint.name]
    coupling, offset = _coupling(moving, joints)
    limits = [_limits(joint, moving) for joint in joints]
    robot = Robot(
        name=urdf.name,
        model=model,
        coupling=coupling,
        offset=offset,
        joints=tuple(joint.name for joint in joints),
        prismatic=tuple(joint.prismatic for joint in joints),
        q_min=tuple(low for low, _ in limits),
        q_max=tuple(high for _, high in limits),
        effort=tuple(joint.effort for joint in joints),
        damping=tuple(sum(j.ratio**2 * j.damping for j in moving if j.leader == joint.name) for joint in joints),
        friction=tuple(sum(abs(j.ratio) * j.friction for j in moving if j.leader == joint.name) for joint in joints),
        frame=frame,
        frame_id=model.getFrameId(frame, pin.FrameType.BODY),
        axes=axes,
        root=urdf.root,
        warnings=tuple(warnings),
    )
    _check_mass_matrix(robot)
    if not any(robot.moves_frame()):
        raise RobotError(f"no joint moves the frame '{frame}'")
    return robot


def moving_links(urdf: Urdf, model: pin.Model) -> tuple[list[str], list[int], list[pin.SE3], list[pin.Inertia]]:
    """Return the moving links with mass: names, bodies, poses in these, and inertias in the links' frames."""
    names, bodies, poses, inertias = [], [], [], []
    for element in urdf.tree.findall("link"):
        name = str(element.get("name"))
        frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
        inertial = element.find("inertial")
        if not frame.parentJoint or inertial is None:
            continue
        mass = inertial.find("mass")
        tensor = inertial.find("inertia")
        if mass is None or tensor is None or not float(mass.get("value", 0.0)):
            continue
        about = np.empty((3, 3))
        for key, (row, column) in INERTIA.items():
            about[row, column] = about[column, row] = float(tensor.get(key, 0.0))
        pose = inertial_pose(inertial)
        names.append(name)
        bodies.append(frame.parentJoint - 1)
        poses.append(frame.placement)
        inertias.append(pose.act(pin.Inertia(float(mass.get("value", 0.0)), np.zeros(3), about)))
    return names, bodies, poses, inertias


def inertial_pose(inertial: ET.Element) -> pin.SE3:
    """Return the pose of an <inertial> element's frame in its link's frame."""
    origin = inertial.find("origin")
    xyz, rpy = ("0 0 0" if origin is None else origin.get(key, "0 0 0") for key in ("xyz", "rpy"))
    x, r = (np.array([float(word) for word in text.split()]) for text in (xyz, rpy))
    return pin.SE3(pin.rpy.rpyToMatrix(*r), x)


def _coupling(
    moving: Sequence[Joint], joints: Sequence[Joint]
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64]]:
    """Return G and c, with which all joint positions are G q + c; G is None if they equal q."""
    offset = np.array([joint.offset for joint in moving])
    if len(moving) == len(joints):
        return None, offset
    columns = {joint.name: i for i, joint in enumerate(joints)}
    G = np.zeros((len(moving), len(joints)))
    for row, joint in zip(G, moving):
        row[columns[joint.leader]] = joint.ratio
    return G, offset


def _limits(leader: Joint, moving: Sequence[Joint]) -> tuple[float, float]:
    """Return the range in which a joint and all joints that mimic it are within their limits."""
    low, high = leader.low, leader.high
    for joint in moving:
        if joint.leader != leader.name or joint is leader or not joint.ratio:
            continue
        ends = [
            math.copysign(UNBOUNDED, limit * joint.ratio)
            if abs(limit) >= UNBOUNDED
            else (limit - joint.offset) / joint.ratio
            for limit in (joint.low, joint.high)
        ]
        low, high = max(low, min(ends)), min(high, max(ends))
        if low > high:
            raise RobotError(
                f"joint '{joint.name}' mimics '{leader.name}', but no position of '{leader.name}' is"
                " within the limits of both"
            )
    return low, high


def _mass(urdf: Urdf, joint: Joint, odd: list[str]) -> float:
    """Return the mass of a moving body, a link with all links fixed to it, after checking its inertia."""
    fixed = [other for other in urdf.joints.values() if not other.moves]
    body = [joint.child]
    for name in body:
        body.extend(other.child for other in fixed if other.parent == name)
    links = {str(link.get("name")): link for link in urdf.tree.findall("link")}
    inertials = ((name, links[name].find("inertial")) for name in body)
    return sum(_check_inertia(name, inertial, odd) for name, inertial in inertials if inertial is not None)


def _check_inertia(link: str, inertial: ET.Element, odd: list[str]) -> float:
    """Check a link and return its mass; append it to ``odd`` if its inertia is slightly off."""
    if missing := _missing(inertial):
        raise RobotError(f"link '{link}': its <inertial> has no {missing}")
    mass = attribute(inertial, "mass", "value", 0.0)
    if mass < 0.0:
        raise RobotError(f"link '{link}': negative mass {mass:g} kg")
    xx, xy, xz, yy, yz, zz = (attribute(inertial, "inertia", key, 0.0) for key in INERTIA)
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    slack = 1e-6 * float(np.abs(moments).sum()) + 1e-15  # URDFs are written with few digits
    if moments[2] > moments[0] + moments[1] + slack:
        odd.append(link)
    if moments[0] < -slack:
        text = ", ".join(f"{moment:.3g}" for moment in moments)
        raise RobotError(f"link '{link}': its inertia is not physical, principal moments {text} kg·m2 must be positive")
    return mass


def _missing(inertial: ET.Element) -> str:
    """Return the first element with missing attributes, and these attributes; "" if there is none."""
    for tag, keys in (("mass", ("value",)), ("inertia", INERTIA)):
        element = inertial.find(tag)
        missing = [key for key in keys if element is None or element.get(key) is None]
        if missing:
            return f"<{tag} {' '.join(missing)}>"
    return ""


def _mechanism(urdf: Urdf) -> ET.Element:
    """Return a URDF reduced to inertias, joints and limits.

    urdfdom drops or refuses a whole link or joint because of flaws in parts that have no effect here, and reads a
    number with a trailing space as 0. Continuous joints become revolute without limits, so that Pinocchio's state is
    the angle.
    """
    bare = ET.Element("robot", name=urdf.name or "robot")
    for link in urdf.tree.findall("link"):
        copy = ET.SubElement(bare, "link", name=str(link.get("name")))
        copy.extend(e for e in link.findall("inertial") if not _missing(e))
    for element in urdf.tree.findall("joint"):
        joint = urdf.joints[str(element.get("name"))]
        copy = ET.SubElement(bare, "joint", name=joint.name, type=joint.type)
        copy.extend(e for e in element if e.tag in ("parent", "child", "origin"))
        if not joint.moves:
            continue
        copy.extend(element.findall("axis"))
        low, high = repr(joint.low), repr(joint.high)
        ET.SubElement(copy, "limit", lower=low, upper=high, effort="0", velocity="0")
        if joint.type == "continuous":
            copy.set("type", "revolute")
    for tag in NUMERIC_TAGS:
        for element in bare.iter(tag):
            for key, text in element.attrib.items():
                element.set(key, " ".join(repr(number(word)) for word in text.split()))
    return bare


def _check_mass_matrix(robot: Robot) -> None:
    """Refuse a joint that moves no mass, the outermost first."""
    model, n = robot.model, len(robot.joints)
    G = np.eye(n) if robot.coupling is None else robot.coupling
    M = pin.crba(model, model.createData(), np.zeros(model.nq))
    M = G.T @ (np.triu(M) + np.triu(M, 1).T) @ G
    for i in reversed(range(n)):
        block = M[i:, i:]
        if not np.linalg.eigvalsh(block)[0] > 1e-12 * np.trace(block):
            raise RobotError(
                f"joint '{robot.joints[i]}': the links behind it have no mass or no inertia about"
                " its axis, so its acceleration is not defined; give them the <inertial> of"
                " the real part, or lock the joint with `lock`"
            )
