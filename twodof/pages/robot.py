"""A robot in the 3D scene of a page: the shapes of its links, and where they are."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import PageError
from ..kinematics import Array, Kinematics
from ..plant.urdf import Joint, RobotError, Urdf, read_urdf
from ..plots.scales import COLOURS
from ..ros.scene import floats, origin
from .meshes import Colour, ReadMesh, mesh_parts
from .page import Page

NO_MATERIAL = (0.62, 0.66, 0.70)


class PageRobot:
    """A robot in the scene of a page.

    Args:
        page: the page.
        urdf: XML text.
        joints: names of the joints whose positions q has, in its order.
        frame: the end effector's link.
        read: where the meshes are from.

    Attributes:
        missing: names of meshes that are not at hand; where no mesh is, links are drawn as sticks.

    Raises:
        PageError: the URDF is not sound, or a shape is not described by numbers.
    """

    def __init__(
        self, page: Page, urdf: str, joints: Sequence[str], frame: str, read: ReadMesh
    ) -> None:
        try:
            robot = read_urdf(urdf)
        except RobotError as error:
            raise PageError(str(error)) from error
        self._scene, self._read, self._frame = page.scene, read, frame
        self._kinematics = Kinematics(robot, joints)
        self._moving = [joint for joint in robot.joints.values() if self._kinematics.moves(joint)]
        self.missing: list[str] = []
        numbers = {link: i for i, link in enumerate(robot.links)}
        self._names = {}
        for link in robot.links:
            chain = [robot.root, *(joint.child for joint in robot.chain(link))]
            self._names[link] = "/robot/" + "/".join(f"link{numbers[name]}" for name in chain)
        self._nodes: dict[str, Any] = {
            link: page.scene.add_frame(name, show_axes=False) for link, name in self._names.items()
        }
        drawn = [self._draw(robot.tree, link) for link in robot.tree.findall("link")]
        self._place(robot.joints.values(), [0.0] * len(joints))
        if not any(drawn):
            self._add_sticks(robot)

    def pose(self, q: Sequence[float]) -> None:
        """Show it at joint positions q, rad or m."""
        self._place(self._moving, q)

    def show_axes(self, page: Page, size: float) -> None:
        """Draw the axes of the end effector's frame."""
        page.add_axes(f"{self._names[self._frame]}/axes", size)

    def points(self, q: Sequence[float]) -> Array:
        """Origins of all links in the root frame, L × 3, m."""
        return np.array([place.translation[0] for place in self._kinematics.links([q]).values()])

    def end_effector(self, q: Sequence[float]) -> Array:
        """Position of the end effector in the root frame, m."""
        end: Array = self._kinematics.path(self._frame, [q])[0]
        return end

    def _place(self, joints: Iterable[Joint], q: Sequence[float]) -> None:
        for joint in joints:
            place, node = self._kinematics.in_parent(joint, [q]), self._nodes[joint.child]
            node.position, node.wxyz = place.translation[0], _wxyz(place.rotation)[0]

    def _draw(self, tree: ET.Element, link: ET.Element) -> int:
        """Add the shapes of a link; how many there are."""
        name, count = str(link.get("name")), 0
        for visual in link.findall("visual"):
            geometry = visual.find("geometry")
            if geometry is None or not len(geometry):
                continue
            try:
                place = origin(visual.find("origin"))
                look = {
                    "color": _colour(tree, visual), "side": "double", "cast_shadow": False,
                    "receive_shadow": False, "position": place.translation,
                    "wxyz": _wxyz(place.rotation),
                }  # fmt: skip
                count += self._add_shape(f"{self._names[name]}/visual{count}", geometry[0], look)
            except ValueError as error:
                raise PageError(f"link {name!r} cannot be drawn: {error}") from error
        return count

    def _add_shape(self, name: str, element: ET.Element, look: Mapping[str, Any]) -> bool:
        def number(key: str) -> float:
            return float(element.get(key, 1))

        if element.tag == "box":
            self._scene.add_box(name, dimensions=floats(element, "size", "1 1 1"), **look)
        elif element.tag == "sphere":
            self._scene.add_icosphere(name, number("radius"), **look)
        elif element.tag == "cylinder":
            self._scene.add_cylinder(name, number("radius"), number("length"), **look)
        elif element.tag == "mesh":
            file = element.get("filename", "").removeprefix("package://")
            parts = mesh_parts(file, self._read, floats(element, "scale", "1 1 1"))
            if not parts:
                self.missing.append(file)
                return False
            for i, part in enumerate(parts):
                own = {**look, "color": part.colour or look["color"]}
                self._scene.add_mesh_simple(
                    f"{name}/part{i}", part.vertices, part.triangles, flat_shading=True, **own
                )
        else:
            return False
        return True

    def _add_sticks(self, robot: Urdf) -> None:
        """A ball at each joint, and a stick from each link's origin to those of its children."""
        joints = list(robot.joints.values())
        radius = 0.05 * max(float(np.linalg.norm(joint.xyz)) for joint in joints)
        for i, joint in enumerate(joints):
            name, length = self._names[joint.parent], float(np.linalg.norm(joint.xyz))
            self._scene.add_icosphere(
                f"{name}/joint{i}", 1.4 * radius, color=(70, 78, 88), position=joint.xyz
            )
            if length > radius:
                r, g, b = (int(COLOURS[i % 6][k : k + 2], 16) for k in (1, 3, 5))
                along = Rotation.align_vectors([joint.xyz], [(0.0, 0.0, 1.0)])[0]
                self._scene.add_cylinder(
                    f"{name}/stick{i}", radius, length, color=(r, g, b),
                    position=np.array(joint.xyz) / 2, wxyz=_wxyz(along),
                )  # fmt: skip


def _wxyz(rotation: Rotation) -> Array:
    return np.roll(rotation.as_quat(), 1, axis=-1)


def _colour(tree: ET.Element, visual: ET.Element) -> Colour:
    material = visual.find("material")
    if material is not None:
        named = [m for m in tree.findall("material") if m.get("name") == material.get("name")]
        for found in (material, *named):
            if (colour := found.find("color")) is not None:
                r, g, b = floats(colour, "rgba", "1 1 1 1")[:3].tolist()
                return r, g, b
    return NO_MATERIAL
