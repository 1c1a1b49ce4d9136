"""Measured robots, and their engines compiled with a C program."""

from __future__ import annotations

import ctypes
import importlib.util
import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pinocchio as pin

import twodof
from twodof.export.compiler import compile_library, host_platform
from twodof.export.flavours import native_flavour
from twodof.plant.plant import Plant
from twodof.plant.robot import Robot, load_robot
from twodof.plant.variables import variable_table

HERE = Path(__file__).resolve().parent
URDF = HERE.parent / "urdf" / "2dof.urdf"
ROBOTS = next(
    folder
    for parent in Path(pin.__file__).parents
    if (folder := parent / "share" / "example-robot-data" / "robots").is_dir()
)
"""The robots of the package example-robot-data."""
STEP = 0.01  # s
STEPS = 500  # of the default run
Q_START, X_DES = (0.5, 0.35), (0.2, 0.05)
STARTS = {
    "q_start": Q_START,
    "x_des": X_DES,
    "gravity": (0.0, -9.81, 0.0),
    "quat_des": (0.0, 0.0, math.sin(sum(Q_START) / 2), math.cos(sum(Q_START) / 2)),
}
Sources = dict[str, bytes]


@dataclass(frozen=True)
class Arm:
    """A robot, the start values of its run by group, and its control."""

    robot: Robot
    starts: dict[str, Any]
    control: str = "task"


def shipped_arm(control: str = "task") -> Arm:
    return Arm(load_robot(URDF.read_text("utf-8"), "EndEffector", "xy"), STARTS, control)


def panda(control: str = "task") -> Arm:
    """Return the stock Panda with fixed fingers, because one mimics the other."""
    tree = without_shapes((ROBOTS / "panda_description/urdf/panda.urdf").read_text("utf-8"))
    for joint in tree.findall("joint"):
        if "finger" in joint.get("name", ""):
            joint.set("type", "fixed")
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)
    return spatial_arm(tree, "panda_hand_tcp", (0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.8), control)


def ur5(control: str = "task") -> Arm:
    tree = without_shapes((ROBOTS / "ur_description/urdf/ur5_robot.urdf").read_text("utf-8"))
    return spatial_arm(tree, "tool0", (0.0, -1.0, 1.0, 0.3, 1.0, 0.2), control)


def chain(n: int, control: str = "task") -> Arm:
    """Return a chain of rods whose joints rotate alternately about y and z."""
    links = [
        f'<link name="l{i}"><inertial><origin xyz="0.05 0 0"/><mass value="0.5"/>'
        '<inertia ixx="1e-4" iyy="5e-4" izz="5e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        f'<joint name="j{i}" type="revolute"><parent link="l{i - 1}"/><child link="l{i}"/>'
        f'<origin xyz="0.1 0 0"/><axis xyz="{"0 1 0" if i % 2 else "0 0 1"}"/>'
        '<limit lower="-3" upper="3" effort="100" velocity="10"/></joint>'
        for i in range(1, n + 1)
    ]
    tree = ET.fromstring(f'<robot name="chain"><link name="l0"/>{"".join(links)}</robot>')
    return spatial_arm(tree, f"l{n}", (0.2,) * n, control)


def spatial_arm(tree: ET.Element, frame: str, q_start: tuple[float, ...], control: str = "task") -> Arm:
    """Return an arm with three task axes whose target is 0.1 m from its start along each."""
    robot = load_robot(ET.tostring(tree, encoding="unicode"), frame, "xyz")
    starts: dict[str, Any] = {"q_start": q_start, "x_des": (0.0, 0.0, 0.0)}
    plant = Plant(robot, variable_table(robot, starts))
    plant.initialise()
    starts |= {"x_des": tuple(x - 0.1 for x in plant.x), "quat_des": tuple(plant.quat)}
    return Arm(robot, starts, control)


def without_shapes(urdf: str) -> ET.Element:
    tree = ET.fromstring(urdf)
    for link in tree.findall("link"):
        for shape in link.findall("visual") + link.findall("collision"):
            link.remove(shape)
    return tree


def compiled(
    arm: Arm, folder: Path, program: str, change: Callable[[Sources], None] = lambda _: None, flags: Sequence[str] = ()
) -> ctypes.CDLL:
    """Compile a C program that includes the engine's files, with the flags of the FMU.

    Args:
        change: the engine's sources, by name.
        flags: more of them for the compiler.
    """
    name = f"engine{len([*folder.glob('engine*')])}"
    table = variable_table(arm.robot, arm.starts, arm.control)
    options = twodof.FmuOptions(name=name, control=arm.control)
    files = native_flavour(options, arm.robot, table, 2, ()).files
    sources = {Path(path).name: content for path, content in files.items()}
    sources[program] = (HERE / program).read_bytes()
    change(sources)
    units = ("directional.c", program)
    path = folder / name
    path.write_bytes(compile_library(sources, host_platform(), name, units=units, flags=flags))
    return ctypes.CDLL(str(path))


def native_cost(
    arm: Arm, folder: Path, change: Callable[[Sources], None] = lambda _: None, flags: Sequence[str] = ()
) -> Callable[[], float]:
    """Return a function that measures a step of the native engine in C, s."""
    step_cost = compiled(arm, folder, "native_step.c", change, flags).step_cost
    step_cost.argtypes, step_cost.restype = (ctypes.c_double, ctypes.c_int), ctypes.c_double
    return lambda: float(step_cost(STEP, STEPS))


def by_own_compiler(*of: Any) -> Callable[[], float]:
    """Return the function of native_cost, built by the machine's compiler."""
    find = importlib.util.find_spec
    with patch("importlib.util.find_spec", lambda name: None if name == "ziglang" else find(name)):
        return native_cost(*of)
