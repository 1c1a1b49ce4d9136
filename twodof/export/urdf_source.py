"""Read the URDF of a build, lock its joints, and find its end effector."""

import fnmatch
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..errors import BuildError, choice, kind_of, no_such
from ..files import read_file, refusing
from ..plant.urdf import MAX_URDF, RobotError, Urdf, read_urdf
from .mesh_files import mesh_folders
from .xacro_file import expand

DEFAULT_FRAME = "EndEffector"


def read_text(path: Path, mesh_dir: Path | None) -> str:
    """Return the text of a URDF or of an expanded xacro file; raise BuildError if the file cannot be read."""
    if path.suffix == ".xacro":
        return expand(path, mesh_folders(path.parent, mesh_dir), MAX_URDF)
    if path.is_dir() or not path.exists():
        raise BuildError(no_such("URDF", path))
    with refusing(BuildError, f"read the URDF '{path}'"):
        content = read_file(path, MAX_URDF)
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        other = kind_of(path) not in ("", "URDF")
        raise BuildError(no_such("URDF", path) if other else f"the URDF '{path}' is not UTF-8 text") from error


def last_links(urdf: Urdf) -> list[str]:
    """Return the links without child links that at least one joint moves."""
    parents = {joint.parent for joint in urdf.joints.values()}
    ends = [link for link in urdf.links if link not in parents]
    return [link for link in ends if any(joint.moves for joint in urdf.chain(link))]


def end_effector(urdf: Urdf, frame: str | None) -> str:
    """Return the controlled link: the given one, or the default."""
    if frame in urdf.joints and frame not in urdf.links:
        raise RobotError(f"frame '{frame}' is a joint in the URDF; did you mean its link '{urdf.joints[frame].child}'?")
    if frame is not None and frame not in urdf.links:
        raise RobotError(f"no frame '{frame}' in the URDF{choice(frame, urdf.links)}")
    if frame is not None:
        return frame
    leaves = last_links(urdf)
    if DEFAULT_FRAME in urdf.links:
        return DEFAULT_FRAME
    if len(leaves) == 1:
        return leaves[0]
    if not leaves:
        raise RobotError("no joint moves a link; a robot needs a revolute, continuous or prismatic joint, not locked")
    others = [link for link in urdf.links if link not in leaves]
    raise RobotError(
        f"name the controlled link with `frame`; last links are: {', '.join(leaves)};"
        f" other links are: {', '.join(others)}"
    )


def without_meshes(text: str) -> str:
    """Return a URDF without the visuals and collisions that are meshes."""
    tree = ET.fromstring(text)
    for link in tree.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            if shape.find("geometry/mesh") is not None:
                link.remove(shape)
    return ET.tostring(tree, encoding="unicode")


def locked_positions(urdf: Urdf, locks: Mapping[str, float]) -> dict[str, float]:
    """Return the positions, rad or m, at which joints are locked, by name or shell pattern, and those that mimic them.

    Raises:
        RobotError: no joint has such a name, or a position is outside its joint's limits.
    """
    moving = {name: joint for name, joint in urdf.joints.items() if joint.moves}
    positions: dict[str, float] = {}
    for pattern, value in locks.items():
        matches = fnmatch.filter(moving, pattern)
        if not matches:
            raise RobotError(f"no joint '{pattern}' to lock{choice(pattern, moving)}")
        positions |= dict.fromkeys(matches, value)
    for name, joint in moving.items():
        if joint.leader in positions:
            positions.setdefault(name, joint.ratio * positions[joint.leader] + joint.offset)
        elif name in positions:
            raise RobotError(f"joint '{name}' mimics '{joint.leader}', which moves: lock '{joint.leader}'")
    for name, value in positions.items():
        low, high = moving[name].low, moving[name].high
        if not low <= value <= high:
            raise RobotError(f"joint '{name}' cannot be locked at {value:g}: its limits are {low:g} and {high:g}")
    return positions


def lock_joints(text: str, locks: Mapping[str, float]) -> str:
    """Return a URDF in which joints are fixed at the positions of ``locked_positions``, which raises its errors."""
    from scipy.spatial.transform import Rotation  # SciPy takes half a second to import

    urdf = read_urdf(text)
    elements = {str(e.get("name")): e for e in urdf.tree.findall("joint")}
    for name, value in locked_positions(urdf, locks).items():
        joint, element = urdf.joints[name], elements[name]
        rotated = Rotation.from_euler("xyz", joint.rpy)
        xyz = np.array(joint.xyz)
        if joint.prismatic:
            xyz = xyz + rotated.apply(np.array(joint.axis) * value)
        else:
            rotated = rotated * Rotation.from_rotvec(np.array(joint.axis) * value)
        for tag in ("origin", "mimic", "limit", "dynamics"):
            for child in element.findall(tag):
                element.remove(child)
        element.set("type", "fixed")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # in gimbal lock, any pair of roll and yaw is correct
            rpy = rotated.as_euler("xyz")
        ET.SubElement(element, "origin", xyz=" ".join(map(repr, xyz.tolist())), rpy=" ".join(map(repr, rpy.tolist())))
    return ET.tostring(urdf.tree, encoding="unicode")
