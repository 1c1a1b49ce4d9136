"""A robot in the 3D scene of a page: the shapes of its links, and where they are."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import pi
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import PageError
from .page import COLOURS, Page
from .scene import Scene, Transform, floats, load_mesh, origin, quaternion

Array = NDArray[np.float64]
ReadMesh = Callable[[str], bytes | None]
"""The bytes of a mesh by its name ``meshes/…``, None where it is missing."""

NO_MATERIAL = (0.62, 0.66, 0.70)


class _Shape(NamedTuple):
    """Triangles: vertices V × 3 in m, indices T × 3."""

    vertices: Array
    triangles: NDArray[np.uint32]


class PageRobot:
    """A robot in the scene of a page.

    Args:
        page: the page.
        urdf: XML text.
        joints: names of the moving joints in the order of q.
        frame: the end effector's link.
        read: where the meshes are from.

    Attributes:
        missing: names of meshes that are not at hand; where no mesh is, links are drawn as sticks.

    Raises:
        PageError: a shape is not described by numbers.
    """

    def __init__(
        self, page: Page, urdf: str, joints: Sequence[str], frame: str, read: ReadMesh
    ) -> None:
        tree = ET.fromstring(urdf)
        self.missing: list[str] = []
        visuals = {}
        for link in tree.findall("link"):
            name = link.get("name", "")
            try:
                visuals[name] = list(self._visuals(tree, link, read))
            except ValueError as error:
                raise PageError(f"link {name!r} cannot be drawn: {error}") from error
            for part in list(link):
                link.remove(part)
        self._kinematics = Scene(
            ET.tostring(tree, encoding="unicode"), joints, frame, lambda name: None
        )
        self._transforms = {
            transform.child: transform
            for transform in (*self._kinematics.fixed, *self._at([0.0] * len(joints)))
        }
        self._nodes: dict[str, Any] = {}
        names = {link: f"link{i}" for i, link in enumerate(visuals)}
        for name, shapes in visuals.items():
            path = "/".join(names[ancestor] for ancestor in self._chain(name))
            self._nodes[name] = page.scene.add_frame(f"/robot/{path}", show_axes=False)
            for i, (shape, pose, colour) in enumerate(shapes):
                page.scene.add_mesh_simple(
                    f"/robot/{path}/visual{i}", shape.vertices, shape.triangles,
                    color=colour, flat_shading=True, side="double", cast_shadow=False,
                    receive_shadow=False,
                    position=pose[:3, 3], wxyz=_wxyz(quaternion(pose[:3, :3])),
                )  # fmt: skip
        if not any(visuals.values()):
            self._add_sticks(page, names)
        for transform in self._kinematics.fixed:
            _place(self._nodes[transform.child], transform)

    def pose(self, q: Sequence[float]) -> None:
        """Show it at joint positions q, rad or m."""
        for transform in self._at(q):
            _place(self._nodes[transform.child], transform)

    def points(self, q: Sequence[float]) -> Array:
        """Origins of all links in the root frame, L × 3, m."""
        transforms = {**self._transforms, **{t.child: t for t in self._at(q)}}
        places: dict[str, Array] = {}

        def place(link: str) -> Array:
            if link not in places:
                transform = transforms.get(link)
                own = np.eye(4) if transform is None else _matrix(transform)
                places[link] = own if transform is None else place(transform.parent) @ own
            return places[link]

        return np.array([place(link)[:3, 3] for link in self._nodes])

    def end_effector(self, q: Sequence[float]) -> Array:
        """Position of the end effector in the root frame, m."""
        return np.array(self._kinematics.end_effector(q))

    def _at(self, q: Sequence[float]) -> list[Transform]:
        return self._kinematics.moving(q)

    def _chain(self, link: str) -> list[str]:
        """The links from the root to this one."""
        chain = [link]
        while (transform := self._transforms.get(chain[-1])) is not None:
            chain.append(transform.parent)
        return chain[::-1]

    def _visuals(
        self, tree: ET.Element, link: ET.Element, read: ReadMesh
    ) -> Iterator[tuple[_Shape, Array, tuple[float, float, float]]]:
        """Shapes of a link, their poses in its frame, 4 × 4, and their colours."""
        for visual in link.findall("visual"):
            shape = self._shape(visual.find("geometry"), read)
            if shape is not None:
                yield shape, origin(visual.find("origin")), _colour(tree, visual)

    def _shape(self, geometry: ET.Element | None, read: ReadMesh) -> _Shape | None:
        element = None if geometry is None or not len(geometry) else geometry[0]
        if element is None:
            return None
        if element.tag == "box":
            return _box(floats(element, "size", "1 1 1"))
        if element.tag == "sphere":
            return _sphere(float(element.get("radius", 1)))
        if element.tag == "cylinder":
            return _cylinder(float(element.get("radius", 1)), float(element.get("length", 1)))
        if element.tag != "mesh":
            return None
        name = element.get("filename", "").removeprefix("package://")
        shape = _mesh(name, read(name), floats(element, "scale", "1 1 1"))
        if shape is None:
            self.missing.append(name)
        return shape

    def _add_sticks(self, page: Page, names: Mapping[str, str]) -> None:
        """A stick from each link's origin to those of its children."""
        lengths = [float(np.linalg.norm(t.translation)) for t in self._transforms.values()]
        radius = 0.05 * max(lengths, default=1.0)
        for i, transform in enumerate(self._transforms.values()):
            length = float(np.linalg.norm(transform.translation))
            path = "/".join(names[ancestor] for ancestor in self._chain(transform.parent))
            r, g, b = (int(COLOURS[i % 6][k : k + 2], 16) for k in (1, 3, 5))
            ball = _sphere(1.4 * radius)
            page.scene.add_mesh_simple(
                f"/robot/{path}/joint{i}", *ball, color=(70, 78, 88), position=transform.translation
            )
            if length > radius:
                direction = np.array(transform.translation) / length
                pose = np.eye(3)
                pose[:, 2] = direction
                pose[:, 0] = np.cross(np.eye(3)[int(np.argmin(np.abs(direction)))], direction)
                pose[:, 0] /= np.linalg.norm(pose[:, 0])
                pose[:, 1] = np.cross(direction, pose[:, 0])
                page.scene.add_mesh_simple(
                    f"/robot/{path}/stick{i}", *_cylinder(radius, length), color=(r, g, b),
                    position=np.array(transform.translation) / 2, wxyz=_wxyz(quaternion(pose)),
                )  # fmt: skip


def _place(node: Any, transform: Transform) -> None:
    node.position = transform.translation
    node.wxyz = _wxyz(transform.rotation)


def _wxyz(xyzw: Sequence[float]) -> tuple[float, float, float, float]:
    x, y, z, w = xyzw
    return w, x, y, z


def _matrix(transform: Transform) -> Array:
    x, y, z, w = transform.rotation
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = transform.translation
    return pose


def _colour(tree: ET.Element, visual: ET.Element) -> tuple[float, float, float]:
    material = visual.find("material")
    if material is not None:
        named = [m for m in tree.findall("material") if m.get("name") == material.get("name")]
        for found in (material, *named):
            if (colour := found.find("color")) is not None:
                r, g, b = floats(colour, "rgba", "1 1 1 1")[:3].tolist()
                return r, g, b
    return NO_MATERIAL


def _mesh(name: str, content: bytes | None, scale: Array) -> _Shape | None:
    if content is None:
        return None
    try:
        mesh = load_mesh(name, content, scale)
    except ValueError:
        return None
    corners = (mesh.tri_indices(i) for i in range(mesh.num_tris))
    triangles = [(corner[0], corner[1], corner[2]) for corner in corners]
    return _Shape(np.array(mesh.vertices()), np.array(triangles, dtype=np.uint32))


def _box(size: Array) -> _Shape:
    corners = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)]) - 0.5
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
    return _Shape(corners * size, np.array(triangles, dtype=np.uint32))


def _cylinder(radius: float, length: float) -> _Shape:
    """About z, its centre at the origin."""
    return _turned(
        [(0.0, -length / 2), (radius, -length / 2), (radius, length / 2), (0, length / 2)]
    )


def _sphere(radius: float) -> _Shape:
    angles = np.linspace(-pi / 2, pi / 2, 17)
    return _turned([(radius * float(np.cos(a)), radius * float(np.sin(a))) for a in angles])


def _turned(profile: Sequence[tuple[float, float]], sides: int = 32) -> _Shape:
    """A body of revolution about z from its radii and heights."""
    angles = np.linspace(0.0, 2 * pi, sides, endpoint=False)
    rings = [
        np.column_stack([r * np.cos(angles), r * np.sin(angles), np.full(sides, z)])
        for r, z in profile
    ]
    triangles = []
    for ring in range(len(profile) - 1):
        for i in range(sides):
            a, b = ring * sides + i, ring * sides + (i + 1) % sides
            triangles += [(a, b, b + sides), (a, b + sides, a + sides)]
    return _Shape(np.vstack(rings), np.array(triangles, dtype=np.uint32))
