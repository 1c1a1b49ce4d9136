"""Robots for the native tests, and their engines compiled and loaded once a session."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import math
import os
import subprocess
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import fmpy
import numpy as np
import pinocchio as pin
from scratch import run_folder
from tools import needs

from twodof.export.compiler import compile_library, host_platform
from twodof.export.flavours import engine_sources
from twodof.export.mechanism_source import mechanism_source
from twodof.export.native import model_header
from twodof.plant.plant import Plant
from twodof.plant.robot import Robot, load_robot
from twodof.plant.variables import Variable, variable_table

ROOT = Path(__file__).parents[1]
HERE = Path(__file__).parent / "native"
GUID = "0123456789abcdef"
SCRATCH = run_folder() / "native"
"""Folder of compiled programs, for all processes of a run of the tests."""


def robots_folder() -> Path:
    """Return the folder of example-robot-data's URDFs."""
    for parent in Path(pin.__file__).parents:
        folder = parent / "share" / "example-robot-data" / "robots"
        if folder.is_dir():
            return folder
    raise FileNotFoundError("the package example-robot-data is not installed")


# URDF below robots_folder(), frame, axes
ROBOTS = {
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "tool0", "xyz"),
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand_tcp", "xyz"),
    "panda_finger": ("panda_description/urdf/panda.urdf", "panda_rightfinger", "xyz"),
    "z1": ("z1_description/urdf/z1.urdf", "gripperMover", "zx"),
    "double_pendulum": ("double_pendulum_description/urdf/double_pendulum.urdf", "link2", "y"),
    "anymal_c": ("anymal_c_simple_description/urdf/anymal.urdf", "LF_FOOT", "xyz"),
    "tiago": ("tiago_description/robots/tiago_no_hand.urdf", "wrist_ft_tool_link", "xyz"),
    "baxter": ("baxter_description/urdf/baxter.urdf", "l_gripper_l_finger", "xyz"),
    "finger": ("finger_edu_description/robots/finger_edu.urdf", "finger_tip_link", "x"),
}


@dataclass(frozen=True)
class Model:
    """A robot, its variables and the sources of its native FMU."""

    robot: Robot
    table: list[Variable]
    starts: dict
    control: str = "task"

    def plant(self) -> Plant:
        plant = Plant(self.robot, self.table, self.control)
        plant.initialise()
        return plant

    def index(self, name: str) -> int:
        return next(i for i, v in enumerate(self.table) if name in (v.name, v.group))

    def reference(self, name: str) -> int:
        return self.index(name) + 1

    def sources(self, *more: Path, fmi: int = 2) -> dict[str, bytes]:
        headers = (Path(fmpy.__file__).parent / "c-code").glob(f"fmi{fmi}*.h")
        files = engine_sources(self.control, fmi)
        files |= {path.name: path.read_bytes() for path in (*headers, *more)}
        files["mechanism.c"] = mechanism_source(self.robot, self.table).encode()
        files["model.h"] = model_header(self.robot, self.table, self.control, GUID, fmi).encode()
        return files


@functools.cache
def model(name: str, control: str = "task") -> Model:
    """The shipped arm, or a robot of ROBOTS at the middle of its limits."""
    if name == "twodof":
        robot = load_robot(urdf_path(name).read_text(), "EndEffector", "xy")
        starts = {"q_start": (0.5, 0.35), "x_des": (0.2, 0.05), "gravity": (0.0, -9.81, 0.0)}
        starts["quat_des"] = (0.0, 0.0, math.sin(0.425), math.cos(0.425))
        return Model(robot, variable_table(robot, starts, control), starts, control)
    _, frame, axes = ROBOTS.get(name) or (name, last_link(name), "xyz")
    return from_urdf(urdf_path(name).read_text(), frame, axes, control)


def urdf_path(name: str) -> Path:
    """The URDF of the shipped arm, of a robot of ROBOTS, or of a path below robots_folder()."""
    if name == "twodof":
        return ROOT / "urdf" / "2dof.urdf"
    return robots_folder() / (ROBOTS[name][0] if name in ROBOTS else name)


def last_link(name: str) -> str:
    """The link that the last joint of a URDF moves."""
    joints = [j for j in ET.parse(urdf_path(name)).iter("joint") if j.get("type", "fixed") != "fixed"]
    return joints[-1].findall("child")[0].attrib["link"]


def coupling(name: str, joints: Sequence[str] = ()) -> tuple[np.ndarray, np.ndarray]:
    """G and c of the positions G q + c of joints, from <mimic> and not from Pinocchio."""
    names = list(joints or model(name).robot.model.names)[0 if joints else 1 :]
    mimics = {
        str(joint.get("name")): mimic
        for joint in ET.parse(urdf_path(name)).iter("joint")
        for mimic in joint.findall("mimic")
    }
    alone = [name for name in names if name not in mimics]
    G, c = np.zeros((len(names), len(alone))), np.zeros(len(names))
    for i, joint in enumerate(names):
        mimic = mimics.get(joint)
        leader = joint if mimic is None else str(mimic.get("joint"))
        G[i, alone.index(leader)] = 1.0 if mimic is None else float(mimic.get("multiplier", 1))
        c[i] = 0.0 if mimic is None else float(mimic.get("offset", 0))
    return G, c


class Reduced:
    """Pinocchio's results in the coordinates of the independent joints."""

    def __init__(self, reference: pin.Model, name: str, armature: Sequence[float] | None = None) -> None:
        self.model, self.data = reference, reference.createData()
        self.G, self.c = coupling(name)
        self.armature = np.zeros(self.G.shape[1]) if armature is None else armature

    def mass_matrix(self, q):
        M = pin.crba(self.model, self.data, self.G @ q + self.c)
        return self.G.T @ (np.triu(M) + np.triu(M, 1).T) @ self.G + np.diag(self.armature)

    def forward_dynamics(self, q, v, tau):
        h = self.G.T @ pin.nonLinearEffects(self.model, self.data, self.G @ q + self.c, self.G @ v)
        return np.linalg.solve(self.mass_matrix(q), tau - h)

    def jacobian(self, q, frame):
        Q = self.G @ q + self.c
        J = pin.computeFrameJacobian(self.model, self.data, Q, frame, pin.LOCAL_WORLD_ALIGNED)
        return J @ self.G

    def energy(self, q, v):
        Q, V = self.G @ q + self.c, self.G @ v
        kinetic = pin.computeKineticEnergy(self.model, self.data, Q, V)
        return kinetic + pin.computePotentialEnergy(self.model, self.data, Q)


def from_urdf(urdf: str, frame: str, axes: str, control: str = "task") -> Model:
    robot = load_robot(urdf, frame, axes)
    rest = tuple(0.2 if low < 0.2 < high else 0.5 * (low + high) for low, high in zip(robot.q_min, robot.q_max))
    starts = {"q_start": rest, "x_des": (0.0,) * len(axes)}
    plant = Plant(robot, variable_table(robot, starts))
    plant.initialise()
    starts["x_des"] = tuple(plant.x)
    starts["quat_des"] = tuple(plant.quat)
    return Model(robot, variable_table(robot, starts, control), starts, control)


def library(name: str, control: str = "task") -> Path:
    """The shared library of a model's FMU, as shipped.

    It is written once: if a loaded library is overwritten, the next dlopen crashes.
    """
    folder = SCRATCH / f"{name}-{control}"
    with written_once(folder) as begun:
        if begun:
            content = compile_library(model(name, control).sources(), host_platform(), "Arm")
            (begun / "Arm.so").write_bytes(content)
    return folder / "Arm.so"


@contextmanager
def written_once(folder: Path) -> Iterator[Path | None]:
    """A temporary folder that becomes another one at the end; None if that exists."""
    if folder.exists():
        yield None
        return
    SCRATCH.mkdir(mode=0o700, exist_ok=True)
    begun = Path(tempfile.mkdtemp(dir=SCRATCH))
    yield begun
    with suppress(OSError):  # another process was sooner
        begun.rename(folder)


class Engine:
    """A model's engine with its inner functions, compiled by the machine's own compiler."""

    def __init__(self, of: Model, flags: tuple[str, ...] = ()) -> None:
        self.model = of
        path = executable(of, HERE / "probe.c", flags=("-shared", "-fPIC", *flags))
        self.lib = ctypes.CDLL(str(path))
        self.n, self.m = len(of.robot.joints), len(of.robot.axes)

    def call(self, name: str, *arguments: float | np.ndarray) -> int:
        values = (ctypes.c_double(a) if isinstance(a, float) else a.ctypes.data_as(ctypes.c_void_p) for a in arguments)
        return getattr(self.lib, f"probe_{name}")(*values)

    def task(self, q, v):
        """Position, Jacobian and drift in the task rows."""
        rows = self.m + 3 * (self.model.control == "pose")
        x, J, drift = np.empty(self.m), np.empty((rows, self.n)), np.empty(rows)
        self.call("task", q, v, x, J, drift)
        return x, J, drift

    def effort_of_force(self, q, force):
        tau = np.empty(self.n)
        self.call("effort_of_force", q, force, tau)
        return tau

    def inverse_dynamics(self, q, v, a, gravity):
        tau = np.empty(self.n)
        self.call("inverse_dynamics", q, v, a, gravity, tau)
        return tau

    def acceleration_of_effort(self, q, tau):
        a = np.empty(self.n)
        self.call("acceleration_of_effort", q, tau, a)
        return a

    def failure(self) -> tuple[int, int, float]:
        """The refusal of the last step: the reason, the fastest joint, and its rate in 1/s."""
        row = np.empty(3)
        self.call("failure", row)
        return int(row[0]), int(row[1]), float(row[2])

    def values(self, plant: Plant) -> np.ndarray:
        """All variables of a Python plant by value reference; computed ones are 0."""
        row = []
        for variable in self.model.table:
            if variable.causality in ("output", "local") and variable.group not in ("q", "v"):
                row.append(0.0)
                continue
            value = getattr(plant, variable.group)
            row.append(float(value if variable.index is None else value[variable.index]))
        return np.array(row)

    def group(self, values: np.ndarray, name: str) -> np.ndarray:
        return values[[i for i, v in enumerate(self.model.table) if v.group == name]]


@functools.cache
def engine(name: str, control: str = "task") -> Engine:
    return Engine(model(name, control))


@functools.cache
def damped_arm(damping: float) -> Engine:
    """The shipped arm with damped joints."""
    if not damping:
        return engine("twodof")
    urdf = (ROOT / "urdf" / "2dof.urdf").read_text()
    text = urdf.replace("<limit", f'<dynamics damping="{damping!r}"/><limit')
    return Engine(from_urdf(text, "EndEffector", "xy"))


def shipped(of: Engine, **changes: object) -> Plant:
    """Return a plant of the shipped arm with its start values, or with others."""
    plant = of.model.plant()
    start = {"q_start": [0.5, 0.35], "x_des": [0.2, 0.05], "gravity": [0.0, -9.81, 0.0]}
    for name, value in {**start, **changes}.items():
        setattr(plant, name, value)
    plant.initialise()
    return plant


def executable(of: Model, *more: Path, flags: tuple[str, ...] = (), fmi: int = 2) -> Path:
    """C files of the tests, which include the FMU's, compiled by the machine's own compiler with the tests' headers."""
    files = of.sources(*more, fmi=fmi)
    digest = hashlib.sha256(repr((flags, sorted(files.items()))).encode()).hexdigest()[:16]
    folder = SCRATCH / digest
    with written_once(folder) as begun:
        if begun is None:
            return folder / "program"
        for file, content in files.items():
            (begun / file).write_bytes(content)
        level = "-O1" if len(of.robot.joints) <= 2 else "-O0"  # seconds, where it is long
        subprocess.run(
            [
                needs("gcc"),
                "-std=c99",
                level,
                "-ffp-contract=off",
                "-Wall",
                "-Wextra",
                "-pedantic",
                "-Werror",
                "-fcx-limited-range",
                "-fno-math-errno",
                "-fvisibility=hidden",
                *flags,
                "-o",
                "program",
                "directional.c",
                *(path.name for path in more if path.suffix == ".c"),
                "-lm",
            ],
            cwd=begun,
            check=True,
            env={**os.environ, "LC_ALL": "C"},
        )
    return folder / "program"


def deviation(a, b) -> float:
    """The largest difference, relative to the largest of b or to 1."""
    return np.abs(np.subtract(a, b)).max() / max(1.0, np.abs(b).max())


def loaded(plant) -> pin.Model:
    """Pinocchio's model with the payload as a separate body."""
    robot = plant.robot
    reference = robot.model.copy()
    reference.gravity.linear = np.array(plant.gravity)
    frame = reference.frames[robot.frame_id]
    placement = frame.placement * pin.SE3(np.eye(3), np.array(plant.payload_com))
    reference.appendBodyToJoint(frame.parentJoint, pin.Inertia(plant.payload, np.zeros(3), np.zeros((3, 3))), placement)
    return reference


def random_plant(name: str, control: str, rng):
    plant = model(name, control).plant()
    n = len(plant.q)
    plant.q, plant.v = rng.uniform(-2, 2, n).tolist(), rng.normal(0, 2, n).tolist()
    plant.f_ext, plant.tau_ext = rng.normal(0, 5, 3).tolist(), rng.normal(0, 3, n).tolist()
    plant.payload, plant.payload_com = rng.uniform(0, 3), rng.normal(0, 0.1, 3).tolist()
    plant.damping, plant.armature = rng.uniform(0, 3, n).tolist(), rng.uniform(0, 2, n).tolist()
    return plant
