"""Robots of installed packages by name: example-robot-data, and the cache of robot_descriptions."""

from __future__ import annotations

import fnmatch
import importlib.metadata
import os
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from math import tau
from pathlib import Path

from ..errors import BuildError, choice
from ..plant.urdf import RobotError, Urdf, parse_robot, read_urdf
from .fmu_options import FmuOptions
from .urdf_source import last_links, read_text

PACKAGE = "example-robot-data"
SOURCE = f"pip install {PACKAGE}, or load robots with robot_descriptions"
CACHE = "ROBOT_DESCRIPTIONS_CACHE", "~/.cache/robot_descriptions"
"""Environment variable of robot_descriptions, and its default."""
HOMES = ("home", "default", "standing", "half_sitting", "neutral")
"""Names of home poses in SRDF files, in the order of preference."""
ELBOW_UP = {"shoulder_lift_joint": -1, "elbow_joint": 1, "wrist_1_joint": -1, "wrist_2_joint": -1}
"""Home pose of Universal Robots' arms, whose SRDFs have none, in quarter turns; their zero pose is singular."""
ENDS = ("tool", "tcp", "ee_link", "end_effector", "gripper_frame")
"""Parts of names of end effectors, in the order of preference."""


def stock_robots() -> dict[str, Path]:
    """Return the URDFs of installed packages by file name, or by package/name if file names are equal."""
    found: list[Path] = []
    with suppress(importlib.metadata.PackageNotFoundError):
        files = importlib.metadata.files(PACKAGE) or []
        found += [Path(str(file.locate())).resolve() for file in files if file.suffix == ".urdf"]
    cache = Path(os.environ.get(CACHE[0]) or CACHE[1]).expanduser()
    found += sorted(cache.rglob("*.urdf")) if cache.is_dir() else []
    counts = Counter(path.stem for path in found)
    names = (path.stem if counts[path.stem] == 1 else f"{_package(path).name}/{path.stem}" for path in found)
    return dict(sorted(zip(names, found), key=lambda item: item[0].lower()))


def stock_robot(name: str, lock: Mapping[str, float] | None = None) -> FmuOptions:
    """Return the options with which a robot of an installed package is built.

    The home pose and the possible controlled links come from the package's SRDF file, if it has them. Among several
    links, one with the name of a tool is controlled, or else the one that the most joints move.

    Args:
        name: a name of ``stock_robots``, e.g. "panda".
        lock: positions, rad or m, of the joints to fix, by name or shell pattern; the home pose leaves them out.

    Raises:
        BuildError: there is no such robot, or it cannot be read.
    """
    known = stock_robots()
    if name not in known:
        begun = [each for each in known if each.lower().startswith(name.lower())]  # ur5_… of ur5
        remedy = choice(name, begun, 0.0) if begun else choice(name, known) if known else f"; {SOURCE}"
        raise BuildError(f"there is no robot '{name}'{remedy}")
    path = known[name]
    try:
        urdf = read_urdf(read_text(path, None))
    except RobotError as error:
        raise BuildError(f"{path.name}: {error}") from error
    semantics = _semantics(path)
    ends = [end for e in semantics.iterfind("end_effector") if (end := str(e.get("parent_link"))) in urdf.links]
    folder = next((parent.parent for parent in path.parents if parent.name == PACKAGE), None)
    fixed = {joint for pattern in lock or {} for joint in fnmatch.filter(urdf.joints, pattern)}
    home = {joint: value for joint, value in _home(semantics, urdf).items() if joint not in fixed}
    frame = min(ends or last_links(urdf), key=partial(_preference, urdf), default=None)
    return FmuOptions(urdf=path, mesh_dir=folder, frame=frame, q_start=home or None, lock=lock or {})


def _preference(urdf: Urdf, link: str) -> tuple[int, int]:
    """Return the sort key of a possible end effector: by its name, then by the number of joints that move it."""
    named = next((k for k, end in enumerate(ENDS) if end in link), len(ENDS))
    return named, -sum(joint.moves for joint in urdf.chain(link))


def _package(path: Path) -> Path:
    return path.parent.parent


def _semantics(path: Path) -> ET.Element:
    """Return the SRDF whose name equals the URDF's, or is the beginning of it; empty without one."""
    files = sorted((_package(path) / "srdf").glob("*.srdf"), key=lambda file: -len(file.stem))
    fitting = [file for file in files if path.stem.startswith(file.stem)]
    if not fitting:
        return ET.Element("robot")
    try:
        return parse_robot(read_text(fitting[0], None), "SRDF")
    except RobotError as error:
        raise BuildError(f"'{fitting[0]}': {error}") from error


def _home(semantics: ET.Element, urdf: Urdf) -> dict[str, float]:
    """Return the positions of the independent joints in the home pose, rad or m."""
    states = {str(state.get("name")): state for state in reversed(semantics.findall("group_state"))}
    state = next((states[name] for name in (*HOMES, *reversed(states)) if name in states), None)
    if state is None and ELBOW_UP.keys() <= urdf.joints.keys():
        return {joint: 0.25 * tau * turns for joint, turns in ELBOW_UP.items()}
    home = {}
    for element in [] if state is None else state.iterfind("joint"):
        joint = urdf.joints.get(str(element.get("name")))
        with suppress(ValueError):  # a floating base has several values
            if joint is not None and joint.moves and joint.leader == joint.name:
                home[joint.name] = value = float(str(element.get("value")))
                if joint.type == "revolute" and not joint.low <= value <= joint.high:  # a full turn is the same pose
                    home[joint.name] += tau * round((0.5 * (joint.low + joint.high) - value) / tau)
    return home
