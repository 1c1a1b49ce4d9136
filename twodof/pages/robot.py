"""A robot in the 3D scene of a page: the shapes of its links, and where they are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ..errors import PageError
from ..geometry.kinematics import Array, Kinematics
from ..geometry.meshes import ReadMesh
from ..geometry.shapes import link_shapes
from ..plant.urdf import Joint, RobotError, read_urdf
from .page import Page


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
            shapes, self.missing = link_shapes(robot, read)
        except RobotError as error:
            raise PageError(str(error)) from error
        self._frame = frame
        self._kinematics = Kinematics(robot, joints)
        self._moving = [joint for joint in robot.joints.values() if self._kinematics.moves(joint)]
        numbers = {link: i for i, link in enumerate(robot.links)}
        self._names = {}
        for link in robot.links:
            chain = [robot.root, *(joint.child for joint in robot.chain(link))]
            self._names[link] = "/robot/" + "/".join(f"link{numbers[name]}" for name in chain)
        self._nodes: dict[str, Any] = {
            link: page.scene.add_frame(name, show_axes=False) for link, name in self._names.items()
        }
        for i, shape in enumerate(shapes):
            page.scene.add_mesh_simple(
                f"{self._names[shape.link]}/shape{i}", shape.vertices, shape.triangles,
                color=shape.colour, position=shape.place.translation,
                wxyz=_wxyz(shape.place.quat), flat_shading=True, side="double",
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        self._place(robot.joints.values(), [0.0] * len(joints))

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
            node.position, node.wxyz = place.translation[0], _wxyz(place.quat[0])


def _wxyz(xyzw: Array) -> Array:
    return np.roll(xyzw, 1)
