"""Robot description and transforms with which RViz, Foxglove and rerun show a robot.

There is one transform for each joint, from parent to child link, as in robot_state_publisher.
"""

import logging
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence

import numpy as np

from ..geometry.kinematics import Array, Kinematics, Placement
from ..geometry.meshes import Meshes, ReadMesh
from ..geometry.shapes import floats, origin
from ..plant.urdf import Joint, RobotError, read_urdf

LARGEST = 1e6  # m
logger = logging.getLogger(__name__)


class Scene:
    """The geometry of a robot for ROS 2 viewers.

    Args:
        urdf: XML text whose meshes are named ``package://meshes/…``.
        joints: names of the joints, in the order of q.
        read: returns the bytes of a mesh by its name ``meshes/…``, or None if it is missing.
        meshes_in: URI of the folder with meshes of these names, with a trailing slash; "": there is none.

    Attributes:
        description: the URDF, in which the best-fitting box or cylinder replaces each mesh, so that it renders
            without mesh files; with ``meshes_in``, the URIs of the meshes instead.
        fixed, moving: joints with constant transforms, and the other joints.
    """

    def __init__(self, urdf: str, joints: Sequence[str], frame: str, read: ReadMesh, meshes_in: str = "") -> None:
        robot = read_urdf(urdf)
        if frame not in robot.links:
            raise RobotError(f"it has no link '{frame}'")
        self._kinematics, self._frame = Kinematics(robot, joints), frame
        every = robot.joints.values()
        self.moving = [joint for joint in every if self._kinematics.moves(joint)]
        self.fixed = [joint for joint in every if not self._kinematics.moves(joint)]
        try:
            if meshes_in:
                for mesh in robot.tree.iter("mesh"):
                    mesh.set("filename", meshes_in + mesh.get("filename", "").removeprefix("package://"))
            else:
                with Meshes(read) as meshes:
                    _replace_meshes(robot.tree, meshes)
        except ValueError as error:
            raise RobotError(f"its meshes cannot be placed: {error}") from error
        self.description = ET.tostring(robot.tree, encoding="unicode")

    def transforms(self, joints: Iterable[Joint], q: Array) -> list[Array]:
        """Return the transforms of the joints' child links in their parent links, at N positions q, rad or m.

        Each is an N × 7 array, or 1 × 7 if it is constant: position in m, and a unit quaternion x, y, z, w.
        """
        return [self._kinematics.pose(joint, q) for joint in joints]

    def end_effector(self, q: Array) -> Array:
        """Return positions of the end effector in the root frame, N × 3, m."""
        return self._kinematics.path(self._frame, q)


def _replace_meshes(tree: ET.Element, meshes: Meshes) -> None:
    fitted: dict[tuple[str, str], tuple[ET.Element, Placement] | None] = {}
    for link in tree.findall("link"):
        for part in [*link.findall("visual"), *link.findall("collision")]:
            geometry = part.find("geometry")
            mesh = None if geometry is None else geometry.find("mesh")
            if geometry is None or mesh is None:
                continue
            key = (mesh.get("filename", ""), mesh.get("scale", "1 1 1"))
            if key not in fitted:
                fitted[key] = _fit(key[0], floats(mesh, "scale", "1 1 1"), meshes)
            fit = fitted[key]
            if fit is None:
                link.remove(part)
                continue
            shape, placement = fit
            geometry.remove(mesh)
            geometry.append(shape)
            _place(part, origin(part.find("origin")) * placement)


def _fit(uri: str, scale: Array, meshes: Meshes) -> tuple[ET.Element, Placement] | None:
    """Return the smallest box or cylinder along the mesh's principal axes or its own axes, and its pose."""
    vertices = _vertices(uri, scale, meshes)
    if vertices is None:
        return None
    candidates = []
    _, axes = np.linalg.eigh(np.cov(vertices.T))
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])  # right-handed
    for rotation in (np.eye(3), axes):
        local = vertices @ rotation
        low, high = local.min(axis=0), local.max(axis=0)
        size, centre = high - low, (low + high) / 2
        candidates.append((float(np.prod(size)), "box", size, rotation, centre))
        for k in range(3):
            rotated = rotation[:, [(k + 1) % 3, (k + 2) % 3, k]]  # the cylinder's axis is z
            local_rotated = vertices @ rotated
            middle = (local_rotated.min(axis=0) + local_rotated.max(axis=0)) / 2
            r = float(np.linalg.norm(local_rotated[:, :2] - middle[:2], axis=1).max())
            height = float(np.ptp(local_rotated[:, 2]))
            round_size = np.array([r, height])
            candidates.append((math.pi * r * r * height, "cylinder", round_size, rotated, middle))
    _, kind, size, rotation, centre = min(candidates, key=lambda candidate: candidate[0])
    placement = Placement(rotation @ centre, rotation)
    if kind == "box":
        return ET.Element("box", size=_text(size)), placement
    radius, length = (repr(float(value)) for value in size)
    return ET.Element("cylinder", radius=radius, length=length), placement


def _vertices(uri: str, scale: Array, meshes: Meshes) -> Array | None:
    try:
        surfaces = meshes.surfaces(uri.removeprefix("package://"), coloured=False)
        if not surfaces:
            raise ValueError("the FMU does not contain it")
        vertices = np.concatenate([surface.vertices for surface in surfaces]) * scale
        if np.abs(vertices).max(initial=0.0) < LARGEST:  # false also for NaN
            return vertices
        raise ValueError("its size is not valid")
    except ValueError as error:
        logger.warning("mesh '%s' is left out of the scene: %s", uri, error)
        return None


def _place(part: ET.Element, transform: Placement) -> None:
    origin = part.find("origin")
    if origin is None:
        origin = ET.SubElement(part, "origin")
    r = transform.rotation
    # roll after removal of yaw, which is exact also in gimbal lock, unlike SciPy's
    yaw = math.atan2(r[1, 0], r[0, 0])
    sin, cos = math.sin(yaw), math.cos(yaw)
    pitch = math.atan2(-r[2, 0], cos * r[0, 0] + sin * r[1, 0])
    roll = math.atan2(sin * r[0, 2] - cos * r[1, 2], cos * r[1, 1] - sin * r[0, 1])
    origin.set("xyz", _text(transform.translation))
    origin.set("rpy", _text((roll, pitch, yaw)))


def _text(values: Sequence[float] | Array) -> str:
    return " ".join(repr(float(value)) for value in values)
