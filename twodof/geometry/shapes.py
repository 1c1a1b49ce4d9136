"""Visual shapes of a robot's links, as triangles."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..bounds import MAX_NAME
from ..plant.numerals import number
from ..plant.urdf import RobotError, Urdf
from .kinematics import Array, Placement
from .meshes import Colour, Meshes, ReadMesh, Surface

Indices = NDArray[np.uint32]

NO_MATERIAL = (0.62, 0.66, 0.70)
STICKS = ((0.0, 0.447, 0.698), (0.835, 0.369, 0.0), (0.0, 0.620, 0.451), (0.8, 0.475, 0.655))
BALL = (0.275, 0.306, 0.345)
SIDES = 24  # sides of a round shape


class Shape(NamedTuple):
    """Triangles on a link: vertices V × 3 in m in a frame fixed to the link, and triangles T × 3."""

    link: str
    transform: Placement
    colour: Colour
    vertices: Array
    triangles: Indices


def link_shapes(robot: Urdf, read: ReadMesh) -> tuple[list[Shape], list[str]]:
    """Return the visual shapes of all links, and the names of missing meshes.

    A robot without visual shapes gets balls at its joints and sticks between them.

    Args:
        robot: the robot, whose meshes have names ``package://meshes/…``.

    Raises:
        RobotError: an attribute of a shape is not a number.
    """
    shapes, empty = [], dict[str, None]()
    named = {material.get("name"): material for material in reversed(robot.tree.findall("material"))}
    with Meshes(read) as meshes:
        for link in robot.tree.findall("link"):
            name = str(link.get("name"))
            for visual in link.findall("visual"):
                geometry = visual.find("geometry")
                if geometry is None or not len(geometry):
                    continue
                element = geometry[0]
                try:
                    transform, colour = origin(visual.find("origin")), _colour(visual, named)
                    drawn = _surfaces(element, meshes)
                except ValueError as error:
                    raise RobotError(f"link {name!r} cannot be drawn: {error}") from error
                shapes += [Shape(name, transform, s.colour or colour, *s[:2]) for s in drawn]
                if element.tag == "mesh" and not drawn:
                    empty[_file(element)] = None
    return shapes or _sticks(robot), [file for file in empty if read(file) is None]


def _file(element: ET.Element) -> str:
    return element.get("filename", "").removeprefix("package://")


def _surfaces(element: ET.Element, meshes: Meshes) -> list[Surface]:
    """Return the surfaces of a URDF geometry; none for an unknown kind or an unusable mesh."""

    def size(key: str) -> float:
        (value,) = floats(element, key, "1")
        return float(value)

    if element.tag == "mesh":
        return meshes.scaled(_file(element), floats(element, "scale", "1 1 1"))
    if element.tag == "box":
        corners = np.array(list(np.ndindex(2, 2, 2))) - 0.5
        return [Surface(corners * floats(element, "size", "1 1 1"), BOX, None)]
    if element.tag == "sphere":
        return [Surface(*sphere(size("radius")), None)]
    if element.tag == "cylinder":
        return [Surface(*cylinder(size("radius"), size("length")), None)]
    return []


FACES = (0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)
BOX = np.array([half for a, b, c, d in FACES for half in ((a, b, c), (a, c, d))], dtype=np.uint32)


def sphere(radius: float) -> tuple[Array, Indices]:
    """Return a sphere with its centre at the origin."""
    polar = np.linspace(0.0, math.pi, SIDES // 2 + 1)
    return _revolved(radius * np.sin(polar), -radius * np.cos(polar))


def cylinder(radius: float, length: float) -> tuple[Array, Indices]:
    """Return a cylinder about the origin, along z."""
    return _revolved(np.array([0.0, radius, radius, 0.0]), length / 2 * np.array([-1, -1, 1, 1]))


def _revolved(radii: Array, heights: Array) -> tuple[Array, Indices]:
    """Return the surface of revolution of a polyline about z."""
    angle = np.linspace(0.0, 2 * math.pi, SIDES, endpoint=False)
    x, y = np.outer(radii, np.cos(angle)), np.outer(radii, np.sin(angle))
    vertices = np.stack([x, y, np.repeat(heights[:, None], SIDES, axis=1)], axis=-1)
    here = np.arange(SIDES)
    beside = (here + 1) % SIDES
    rows = np.arange(len(radii) - 1)[:, None] * SIDES
    low, high = rows + SIDES, rows  # the polyline goes upwards, so that triangles are counterclockwise from outside
    quads = [(high + here, high + beside, low + beside), (high + here, low + beside, low + here)]
    triangles = np.concatenate([np.stack(q, axis=-1).reshape(-1, 3) for q in quads])
    return vertices.reshape(-1, 3), triangles.astype(np.uint32)


def _sticks(robot: Urdf) -> list[Shape]:
    """Return a ball at each joint, and a stick from each link's origin to those of its children."""
    joints = list(robot.joints.values())
    radius = 0.05 * max((float(np.linalg.norm(joint.xyz)) for joint in joints), default=0.0)
    still = np.eye(3)
    shapes = []
    for i, joint in enumerate(joints):
        transform = Placement(np.array(joint.xyz), still)
        shapes.append(Shape(joint.parent, transform, BALL, *sphere(1.4 * radius)))
        length = float(np.linalg.norm(joint.xyz))
        if length > radius:
            along = Rotation.align_vectors([joint.xyz], [(0.0, 0.0, 1.0)])[0]
            transform = Placement(np.array(joint.xyz) / 2, along.as_matrix())
            stick = cylinder(radius, length)
            shapes.append(Shape(joint.parent, transform, STICKS[i % len(STICKS)], *stick))
    return shapes


def _colour(visual: ET.Element, named: Mapping[str | None, ET.Element]) -> Colour:
    """Return the colour of a material: its own, or that of the robot's material of the same name."""
    material = visual.find("material")
    if material is not None:
        for candidate in (material, named.get(material.get("name"))):
            if candidate is not None and (colour := candidate.find("color")) is not None:
                r, g, b = floats(colour, "rgba", "1 1 1 1")[:3].tolist()
                return r, g, b
    return NO_MATERIAL


def floats(element: ET.Element | None, key: str, default: str) -> Array:
    """Return the numbers of an attribute; ValueError: it is too long, or has a value that is not a number."""
    text = default if element is None else element.get(key, default)
    if len(text) > MAX_NAME:  # many visuals may share a material
        raise ValueError(f"{key} has more than {MAX_NAME} characters")
    numbers = np.array([number(word) for word in text.split()])
    if not np.isfinite(numbers).all():
        raise ValueError(f"{key}='{text}' is not finite")
    return numbers


def origin(element: ET.Element | None) -> Placement:
    """Return the rotation and position of URDF's xyz and rpy, about the fixed axes x, y and z."""
    rotation = Rotation.from_euler("xyz", floats(element, "rpy", "0 0 0")).as_matrix()
    return Placement(floats(element, "xyz", "0 0 0"), rotation)
