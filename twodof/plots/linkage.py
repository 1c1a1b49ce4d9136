"""Geometry of a robot for pictures: links, reach and singularities."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from math import ceil
from typing import NamedTuple

import numpy as np

from ..errors import choice
from ..export.urdf_source import DEFAULT_FRAME
from ..geometry.kinematics import BLOCK, Array, Kinematics, rotated
from ..plant.urdf import Joint, RobotError, Urdf, check_axes, read_urdf

LOOKS = 2000  # samples that are checked for singularities


@dataclass(frozen=True)
class Reach:
    """Reach circle of a planar arm, m; the normal is the index of the root's x, y or z axis."""

    centre: Array
    radius: float
    normal: int


@dataclass(frozen=True)
class Motion:
    """Motion of the robot's links; points in the root frame, m."""

    robot: str
    frame: str  # frame, root: the end effector's link, and the link in which points are expressed
    root: str
    path: Array  # path of the end effector, N × 3
    start: Array  # start, end: points of the arm at the first and the last sample: root, joints and end effector, × 3
    end: Array
    reach: Reach | None  # reach circle; None unless the arm moves in a plane of two of the root's axes


class Linkage(NamedTuple):
    """Geometry, limits and damping of a robot for pictures, which may have invalid masses."""

    urdf: Urdf
    kinematics: Kinematics
    moving: tuple[Joint, ...]  # independent joints, and joints that mimic them if the bag has these
    frame: str  # the end effector's link
    axes: str  # task axes, letters of "xyz"

    @property
    def chain(self) -> list[Joint]:
        """Joints that move the frame, in order from the root."""
        return [joint for joint in self.urdf.chain(self.frame) if joint.moves]

    def motion(self, q: Array) -> Motion:
        """Return the motion of the links for q, N × ``moving``, rad or m."""
        start, end = self.skeletons(q[[0, -1]])
        path, reach = self.kinematics.path(self.frame, q), self._reach()
        return Motion(self.urdf.name, self.frame, self.urdf.root, path, start, end, reach)

    def skeletons(self, q: Array) -> Array:
        """Return origins of the root, of the frame's joints, and of the frame; N × points × 3."""
        chain = self.urdf.chain(self.frame)
        shown = [0, *(i for i, joint in enumerate(chain, start=1) if joint.moves), len(chain)]
        points = np.empty((len(q), len(shown), 3))
        for k in range(0, len(q), BLOCK):
            along = enumerate(self.kinematics.along(chain, q[k : k + BLOCK]))
            kept = {i: transform.translation for i, transform in along if i in shown}
            points[k : k + BLOCK] = np.stack([kept[i] for i in shown], axis=1)
        return points

    def _reach(self) -> Reach | None:
        """Return the reach circle if all joints rotate about one of the root's axes, else None.

        Distances between neighbouring joints are constant, so no point is farther than their sum. The stretched planar
        arm has this length; for spatial arms the sum would be too large.
        """
        at_zero = np.zeros((1, len(self.moving)))
        chain = self.urdf.chain(self.frame)
        turns = np.abs(
            [
                rotated(transform.rotation, joint.axis)[0] * (not joint.prismatic)
                for joint, transform in zip(chain, islice(self.kinematics.along(chain, at_zero), 1, None))
                if joint.moves
            ]
        )
        normal = int(np.argmax(turns[0]))
        if (turns[:, normal] < 1.0 - 1e-9).any():
            return None
        points = self.skeletons(at_zero)[0, 1:]
        links = np.delete(np.diff(points, axis=0), normal, axis=1)
        return Reach(points[0], float(np.linalg.norm(links, axis=1).sum()), normal)

    def is_singular(self, q: Array, rcond: float, turns: bool) -> bool:
        """Return whether σ_min ≤ rcond·σ_max of the task Jacobian at any sample.

        The Jacobian has the rows of the task axes, and under orientation control three angular rows.
        """
        axes = ["xyz".index(axis) for axis in self.axes] + [3, 4, 5] * turns
        J = self.kinematics.jacobian(self.frame, q[:: ceil(len(q) / LOOKS)])[:, axes]
        sigma = np.linalg.svd(J, compute_uv=False)
        return bool((sigma[:, -1] <= rcond * sigma[:, 0]).any())


def load_linkage(text: str, frame: str, axes: str, names: Sequence[str]) -> Linkage:
    """Load the linkage of a URDF's text; the default frame is "EndEffector" or the deepest link.

    ``names`` are the joints whose positions are known.

    Raises:
        RobotError: the URDF is invalid, or no joint moves the frame.
    """
    check_axes(axes)
    urdf = read_urdf(text)
    moving = tuple(
        joint for joint in urdf.joints.values() if joint.moves and (joint.leader == joint.name or joint.name in names)
    )
    if not frame:
        depths = {link: sum(j.moves for j in urdf.chain(link)) for link in urdf.links}
        last = max(reversed(urdf.links), key=depths.__getitem__)
        frame = DEFAULT_FRAME if DEFAULT_FRAME in urdf.links else last
    if frame not in urdf.links:
        raise RobotError(f"no frame '{frame}' in the URDF{choice(frame, urdf.links)}")
    kinematics = Kinematics(urdf, [joint.name for joint in moving])
    linkage = Linkage(urdf, kinematics, moving, frame, axes)
    if not linkage.chain:
        raise RobotError(f"no joint moves the frame '{frame}'")
    return linkage
