"""Times the guide's listing, the plant, the FMUs and the logger in one run, and prints tables.

    python benchmarks/steps.py

Simulators take turns of ten steps, loggers turns of some thousand messages, so that noise of the
machine hits all alike; times are medians. Steps are timed in processor time: on an idle machine
it is the wall time, on a busy one a long step is interrupted more often than a short one, which
would flatter the short ones. Logging is timed in wall time, as it waits for the disk.

The native engine is timed from C too, where Python's calls do not count, beside a C program that
does the same run with MuJoCo, and for arms of 2 to 16 joints.

Ratios depend on the processor, which is printed. Beside its time each simulator has its distance
from the exact solution, so that nobody compares the speed of things that compute something else: in
the default run both task axes obey e'' + 40 e' + 50 e = 0 for the error e, which has a closed form.
Needs the packages of the extra "test", and a C compiler. Takes less than a minute.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import importlib.util
import itertools
import math
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol
from unittest.mock import patch

import fmpy
import numpy as np
import pinocchio as pin
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE), str(ROOT)]

from listing import PendulumSimulator  # noqa: E402

import twodof  # noqa: E402
from twodof.export.compiler import (  # noqa: E402
    FLAGS,
    compile_library,
    host_platform,
)
from twodof.export.flavours import native_flavour  # noqa: E402
from twodof.plant.plant import Plant  # noqa: E402
from twodof.plant.robot import Robot, load_robot  # noqa: E402
from twodof.plant.variables import variable_table  # noqa: E402

URDF = ROOT / "urdf" / "2dof.urdf"
STEP, STEPS = 0.01, 500  # s; the default run of 5 s
MUJOCO_SIDES = 4 * 10  # right-hand sides of a step: RK4 at 1 ms
Q_START, X_DES, KP, KD, LINK = (0.5, 0.35), (0.2, 0.05), 50.0, 40.0, 0.15
STARTS = {"q_start": Q_START, "x_des": X_DES, "gravity": (0.0, -9.81, 0.0)}
PASSES, TURN = 3, 10
LOG_ROUNDS, LOG_TURN = 7, 20_000
C_ROUNDS = 15
FMU_BAR, NATIVE_BAR = 5.0, 300.0
CC = ("cc", "-O2")
BUSY = 1.1


class Figure(NamedTuple):
    """What was measured beside what is wanted; both sides are named with their settings."""

    what: str
    measured: str
    wanted: str


class Simulator(Protocol):
    """Something that advances the default run; ``restart`` comes before the first step."""

    def restart(self) -> None: ...
    def step(self, k: int) -> None:
        """One communication step from k·STEP on; this is timed."""

    def q(self) -> Sequence[float]:
        """Joint angles, rad; not timed."""


@dataclass(frozen=True)
class Row:
    """One row of the table.

    Attributes:
        evaluations: right-hand sides of a whole run, asked after one; None where unknown.
        bar: how many times faster than the listing it shall be at least.
    """

    name: str
    about: str
    simulator: Simulator
    evaluations: Callable[[], int] | None = None
    bar: float | None = None


class Listing:
    def restart(self) -> None:
        self.program = PendulumSimulator(URDF)

    def step(self, _k: int) -> None:
        self.program.step()

    def q(self) -> Sequence[float]:
        return self.program.q.tolist()

    def evaluations(self) -> int:
        return self.program.evaluations


@dataclass(frozen=True)
class Arm:
    """A robot and the start values of its run, by group of variables."""

    robot: Robot
    starts: dict[str, Any]


def shipped_arm() -> Arm:
    return Arm(load_robot(URDF.read_text("utf-8"), "EndEffector", "xy"), STARTS)


class PlantAlone:
    def __init__(self, arm: Arm) -> None:
        self.plant = Plant(arm.robot, variable_table(arm.robot, arm.starts))

    def restart(self) -> None:
        self.plant.initialise()

    def step(self, _k: int) -> None:
        self.plant.step(STEP)

    def q(self) -> Sequence[float]:
        return self.plant.q


class CountedPlant(PlantAlone):
    """The plant with a counter around its right-hand side, which is why it is not timed."""

    def restart(self) -> None:
        super().restart()
        self.count = 0
        acceleration = Plant._equations_of_motion(self.plant)

        def counted(q: np.ndarray, v: np.ndarray) -> Sequence[float]:
            self.count += 1
            return acceleration(q, v)

        self.plant._equations_of_motion = lambda: counted

    def evaluations(self) -> int:
        return self.count


class FmuInFmpy:
    """An FMU stepped by bare FMPy calls; of this package's master nothing is used."""

    def __init__(self, path: Path, folder: Path, *, outputs: bool) -> None:
        description = fmpy.read_model_description(str(path))
        unzipped = fmpy.extract(str(path), unzipdir=str(folder))
        self.slave = fmpy.instantiate_fmu(unzipped, description, "CoSimulation")
        variables = [v for v in description.modelVariables if v.causality == "output"]
        self.outputs = [v.valueReference for v in variables]
        self.angles = [v.valueReference for v in variables if v.name.startswith("q[")]
        if outputs:
            self.step = self.step_and_read  # type: ignore[method-assign]
        self.begin()

    def begin(self) -> None:
        self.slave.setupExperiment(startTime=0.0)
        self.slave.enterInitializationMode()
        self.slave.exitInitializationMode()

    def restart(self) -> None:
        self.slave.reset()
        self.begin()

    def step(self, k: int) -> None:
        self.slave.doStep(k * STEP, STEP)

    def step_and_read(self, k: int) -> None:
        self.slave.doStep(k * STEP, STEP)
        self.slave.getReal(self.outputs)

    def q(self) -> Sequence[float]:
        return self.slave.getReal(self.angles)

    def free(self) -> None:
        self.slave.terminate()
        self.slave.freeInstance()


class Master:
    """What a loop over ``twodof.samples`` pays for each sample."""

    def __init__(self, path: Path) -> None:
        self.fmu = twodof.load_fmu(path)
        self.samples = None

    def restart(self) -> None:
        self.free()
        self.samples = twodof.samples(self.fmu)
        next(self.samples)

    def step(self, _k: int) -> None:
        self.sample = next(self.samples)

    def q(self) -> Sequence[float]:
        return self.sample.q

    def free(self) -> None:
        if self.samples is not None:
            self.samples.close()


def table(stack: ExitStack, folder: Path) -> list[Row]:
    """The rows, the listing first; another simulator is another entry."""
    fmu = twodof.build_fmu(folder / "TwoDof.fmu")
    native = twodof.build_fmu(folder / "Native.fmu", twodof.FmuOptions(native=True))
    bare = FmuInFmpy(fmu, folder / "bare", outputs=False)
    reading = FmuInFmpy(fmu, folder / "reading", outputs=True)
    native_bare = FmuInFmpy(native, folder / "native_bare", outputs=False)
    native_reading = FmuInFmpy(native, folder / "native_reading", outputs=True)
    master = Master(fmu)
    for simulator in (bare, reading, native_bare, native_reading, master):
        stack.callback(simulator.free)
    listing, arm = Listing(), shipped_arm()
    return [
        Row("listing", "the guide's program as written", listing, listing.evaluations),
        Row("plant", "twodof.plant.Plant.step", PlantAlone(arm), lambda: right_hand_sides(arm)),
        Row("FMU", "one doStep through FMPy", bare, bar=FMU_BAR),
        Row("FMU, read", "doStep, then getReal of all outputs", reading),
        Row("native FMU", "one doStep through FMPy", native_bare, bar=NATIVE_BAR),
        Row("native, read", "doStep, then getReal of all outputs", native_reading, bar=NATIVE_BAR),
        Row("master", "one sample of twodof.samples", master),
    ]


def right_hand_sides(arm: Arm) -> int:
    """Those of a whole run, from a run of its own."""
    counted = CountedPlant(arm)
    counted.restart()
    for k in range(STEPS):
        counted.step(k)
    return counted.evaluations()


# --- what is timed from C ---


@dataclass(frozen=True)
class RowInC:
    """One row of the table of steps in C.

    Attributes:
        path: which dynamics a step needs; "" where it is not the native engine's.
        cost: processor time of one step of 10 ms, s, the mean of one run.
        evaluations: right-hand sides of one step.
    """

    name: str
    joints: int
    path: str
    cost: Callable[[], float]
    evaluations: float


CANCELS, GENERAL = "M cancels", "general"
"""Where nothing but an unlimited control torque acts, M⁻¹ M need not be computed."""


def table_in_c(folder: Path) -> list[RowInC]:
    """The rows, MuJoCo first and then the native engine."""
    mujoco = mujoco_runner(folder)
    rows = [
        RowInC(f"MuJoCo, {kind}", 2, "", lambda kind=kind: mujoco(kind, STEPS)[0], MUJOCO_SIDES)
        for kind in ("free", "controlled")
    ]
    arms = {"shipped arm": shipped_arm(), "Panda, its damping": panda(), "chain": chain(16)}
    for name, arm in arms.items():
        pushed = {**arm.starts, "tau_ext": (1e-3,) * len(arm.robot.joints)}
        variants = {name: (arm, CANCELS), f"{name}, tau_ext": (Arm(arm.robot, pushed), GENERAL)}
        if any(arm.robot.damping):
            variants = {name: (arm, GENERAL)}
        for label, (chosen, path) in variants.items():
            cost, sides = native_cost(chosen, folder), right_hand_sides(chosen) / STEPS
            rows.append(RowInC(f"native, {label}", len(arm.robot.joints), path, cost, sides))
    return rows


def panda() -> Arm:
    """The Panda as it comes, but for its fingers, which are fixed: one mimics the other."""
    for parent in Path(pin.__file__).parents:
        path = parent / "share/example-robot-data/robots/panda_description/urdf/panda.urdf"
        if path.is_file():
            break
    tree = without_shapes(path.read_text("utf-8"))
    for joint in tree.findall("joint"):
        if "finger" in joint.get("name", ""):
            joint.set("type", "fixed")
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)
    return spatial_arm(tree, "panda_hand_tcp", (0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.8))


def chain(n: int) -> Arm:
    """Rods one after the other, their joints about y and z in turns."""
    tree = ET.Element("robot", name="chain")
    ET.SubElement(tree, "link", name="l0")
    for i in range(1, n + 1):
        link = ET.SubElement(tree, "link", name=f"l{i}")
        body = ET.SubElement(link, "inertial")
        ET.SubElement(body, "origin", xyz="0.05 0 0")
        ET.SubElement(body, "mass", value="0.5")
        ET.SubElement(
            body, "inertia", ixx="1e-4", iyy="5e-4", izz="5e-4", ixy="0", ixz="0", iyz="0"
        )
        joint = ET.SubElement(tree, "joint", name=f"j{i}", type="revolute")
        ET.SubElement(joint, "parent", link=f"l{i - 1}")
        ET.SubElement(joint, "child", link=f"l{i}")
        ET.SubElement(joint, "origin", xyz="0.1 0 0")
        ET.SubElement(joint, "axis", xyz="0 1 0" if i % 2 else "0 0 1")
        ET.SubElement(joint, "limit", lower="-3", upper="3", effort="100", velocity="10")
    return spatial_arm(tree, f"l{n}", (0.2,) * n)


def spatial_arm(tree: ET.Element, frame: str, q_start: tuple[float, ...]) -> Arm:
    """An arm of three task axes whose target is 0.1 m from its start along each."""
    robot = load_robot(ET.tostring(tree, encoding="unicode"), frame, "xyz")
    starts: dict[str, Any] = {"q_start": q_start, "x_des": (0.0, 0.0, 0.0)}
    plant = Plant(robot, variable_table(robot, starts))
    plant.initialise()
    return Arm(robot, {**starts, "x_des": tuple(x - 0.1 for x in plant.x)})


def without_shapes(urdf: str) -> ET.Element:
    tree = ET.fromstring(urdf)
    for link in tree.findall("link"):
        for shape in link.findall("visual") + link.findall("collision"):
            link.remove(shape)
    return tree


def engine_files(arm: Arm, name: str) -> dict[str, bytes]:
    """C files of an arm's native FMU, by name."""
    options, table = twodof.FmuOptions(name=name), variable_table(arm.robot, arm.starts)
    files = native_flavour(options, arm.robot, table, 2, ()).files
    return {Path(path).name: content for path, content in files.items()}


def native_cost(
    arm: Arm,
    folder: Path,
    change: Callable[[dict[str, bytes]], None] | None = None,
    flags: Sequence[str] = (),
) -> Callable[[], float]:
    """Times a run of the native engine in C, compiled as in its FMU, or with changed sources."""
    name = f"step{len(list(folder.glob('step*')))}"
    sources = engine_files(arm, name)
    sources["native_step.c"] = (HERE / "native_step.c").read_bytes()
    if change is not None:
        change(sources)
    path, units = folder / name, ("directional.c", "native_step.c")
    path.write_bytes(compile_library(sources, host_platform(), name, units=units, flags=flags))
    step_cost = ctypes.CDLL(str(path)).step_cost
    step_cost.argtypes, step_cost.restype = (ctypes.c_double, ctypes.c_int), ctypes.c_double
    return lambda: step_cost(STEP, STEPS)


def by_own_compiler(*of: Any) -> Callable[[], float]:
    """As native_cost, where ziglang is not installed."""
    found = importlib.util.find_spec
    with patch("importlib.util.find_spec", lambda name: None if name == "ziglang" else found(name)):
        return native_cost(*of)


def mujoco_runner(folder: Path) -> Callable[[str, int], tuple[float, list[float]]]:
    """Compiles mujoco_step.c; a run of so many steps gives a step's cost, s, and the last angles.

    A run has a process of its own, in which MuJoCo's Python package is not even imported.
    """
    (package,) = importlib.util.find_spec("mujoco").submodule_search_locations
    (library,) = Path(package).glob("libmujoco.*")
    program, urdf = folder / "mujoco_step", folder / "mujoco_arm.urdf"
    urdf.write_bytes(ET.tostring(without_shapes(URDF.read_text("utf-8"))))
    command = [*CC, f"-I{package}/include", str(HERE / "mujoco_step.c"), "-o", str(program)]
    subprocess.run([*command, str(library), f"-Wl,-rpath,{package}"], check=True)

    def run(kind: str, steps: int) -> tuple[float, list[float]]:
        command = [str(program), str(urdf), kind, str(steps)]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        cost, *q = map(float, done.stdout.split())
        return cost, q

    return run


def times_in_c(rows: Sequence[RowInC], rounds: int = C_ROUNDS) -> list[float]:
    """Median over the rounds, s; in each round every row runs once."""
    costs = [[row.cost() for row in rows] for _ in range(rounds)]
    return [statistics.median(taken) for taken in zip(*costs, strict=True)]


def growth(joints: Sequence[int], times: Sequence[float]) -> float:
    """The exponent p of time ~ joints^p, the largest between neighbours."""
    pairs = itertools.pairwise(zip(joints, times, strict=True))
    return max(math.log(t1 / t0) / math.log(n1 / n0) for (n0, t0), (n1, t1) in pairs)


# --- what is measured ---


def exact(k: int) -> np.ndarray:
    """Position of the end effector after k steps, m: e(t) from rest, in closed form."""
    t, root = k * STEP, math.sqrt(KD * KD / 4 - KP)
    decay = math.exp(-KD / 2 * t)
    share = decay * (math.cosh(root * t) + KD / 2 / root * math.sinh(root * t))
    return np.array(X_DES) + (position(Q_START) - X_DES) * share


def position(q: Sequence[float]) -> np.ndarray:
    """End effector of the arm at angles q, m."""
    elbow = np.array([math.cos(q[0]), math.sin(q[0])])
    wrist = np.array([math.cos(q[0] + q[1]), math.sin(q[0] + q[1])])
    return LINK * (elbow + wrist)


def accuracy(simulator: Simulator) -> float:
    """Largest distance from the exact solution at any sample of the default run, m."""
    simulator.restart()
    largest = 0.0
    for k in range(STEPS):
        simulator.step(k)
        largest = max(largest, float(np.linalg.norm(position(simulator.q()) - exact(k + 1))))
    return largest


def step_times(simulators: Sequence[Simulator], passes: int = PASSES) -> tuple[list[float], float]:
    """Median processor time of a step of each, s, and wall time over processor time of all.

    Whole default runs, in turns of some steps.
    """
    times: list[list[int]] = [[] for _ in simulators]
    wall = 0.0
    for _ in range(passes):
        for simulator in simulators:
            simulator.restart()
        begin_wall = time.perf_counter()
        for turn in range(0, STEPS, TURN):
            for simulator, taken in zip(simulators, times, strict=True):
                for k in range(turn, turn + TURN):
                    begin = time.thread_time_ns()
                    simulator.step(k)
                    taken.append(time.thread_time_ns() - begin)
        wall += time.perf_counter() - begin_wall
    total = sum(map(sum, times)) * 1e-9
    return [statistics.median(taken) * 1e-9 for taken in times], wall / total


def log_times(folder: Path, fmu: Path) -> dict[str, tuple[float, float]]:
    """Time of one JointState in bare rosbags and in this package's bag, s, by storage.

    Medians over bags written in turns, from the first message to the closed file, in processor
    time of all threads: this package's bag stores in one of its own.
    """
    run = twodof.experiment(fmu)
    first = twodof.Sample(0, 0.0, (0.5, 0.35), (0.1, 0.2), (0.2, 0.1), (1.0, 0.3), {}, 0.0, 0)
    stamps = [1_700_000_000_000_000_000 + round(k * STEP * 1e9) for k in range(LOG_TURN)]
    samples = [first._replace(k=k, t=k * STEP, stamp=stamp) for k, stamp in enumerate(stamps)]
    found = {}
    for storage in ("mcap", "sqlite3"):
        walls: tuple[list[float], list[float]] = ([], [])
        for turn in range(LOG_ROUNDS):
            with ExitStack() as stack:
                write = bare_rosbags(stack, folder / f"bare-{storage}-{turn}", storage)
                walls[0].append(log_time(stack, write, stamps))
            with ExitStack() as stack:
                path = folder / f"bag-{storage}-{turn}"
                bag = twodof.Bag(path, storage=storage).begin(run)
                write = stack.enter_context(bag).write
                walls[1].append(log_time(stack, write, samples))
        found[storage] = (statistics.median(walls[0]), statistics.median(walls[1]))
    return found


def log_time(stack: ExitStack, write: Callable[[Any], None], items: Sequence[Any]) -> float:
    """Processor time of one message, s: of writing all and closing the bag on the stack."""
    begin = time.process_time()
    for item in items:
        write(item)
    stack.close()
    return (time.process_time() - begin) / len(items)


def bare_rosbags(stack: ExitStack, path: Path, storage: str) -> Callable[[int], None]:
    """A function that writes one message, the same each time, at a stamp; nothing else."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/JointState"
    header = store.types["std_msgs/msg/Header"](
        stamp=store.types["builtin_interfaces/msg/Time"](sec=1, nanosec=2), frame_id=""
    )
    message = store.types[kind](
        header=header,
        name=["joint1", "joint2"],
        position=np.array([0.5, 0.35]),
        velocity=np.array([0.1, 0.2]),
        effort=np.array([]),
    )
    writer = stack.enter_context(
        Writer(path, version=8, storage_plugin=StoragePlugin[storage.upper()])
    )
    connection = writer.add_connection("/joint_states", kind, typestore=store)
    serialize, write = store.serialize_cdr, writer.write
    return lambda stamp: write(connection, stamp, serialize(message, kind))


def help_time() -> float:
    """Median time of five ``twodof --help``, each a process of its own, s."""
    program = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r}); from twodof.cli.main import main; main()"
    )
    walls = []
    for _ in range(5):
        begin = time.perf_counter()
        subprocess.run([sys.executable, "-c", program, "--help"], check=True, capture_output=True)
        walls.append(time.perf_counter() - begin)
    return statistics.median(walls)


def run_time(folder: Path, fmu: Path) -> float:
    """What ``twodof run`` does once it is loaded: the default run from the FMU to a bag, s."""
    begin = time.perf_counter()
    run = twodof.experiment(fmu)
    twodof.simulate(run, twodof.Bag(folder / "whole"))
    return time.perf_counter() - begin


# --- how it is printed ---


def main() -> list[Figure]:
    """Measure and print; the figures of which something is wanted."""
    packages = ("numpy", "scipy", "pin", "fmpy", "pythonfmu", "rosbags", "mujoco")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages)
    print(f"twodof {twodof.__version__}, Python {platform.python_version()}, {versions}")
    print(f"{processor()}\n")
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="twodof_") as name, ExitStack() as stack:
        folder = Path(name)
        rows = table(stack, folder)
        fmu = folder / "TwoDof.fmu"
        times, busy = step_times([row.simulator for row in rows])
        print_steps(rows, times, busy)
        in_c = table_in_c(folder)
        print_in_c(in_c, times_in_c(in_c))
        print_logs(log_times(folder, fmu))
        print_once(help_time(), run_time(folder, fmu))
    print(f"\n{time.perf_counter() - begin:.0f} s in all")
    listing = "the listing, as written, / "
    return [
        Figure(f"{listing}{row.name}, {row.about}", f"{times[0] / t:.1f}", f">= {row.bar:g}")
        for row, t in zip(rows, times)
        if row.bar is not None
    ]


def processor() -> str:
    """The machine's processor; a virtual one may hide its name, and seldom its numbers."""
    try:
        text = Path("/proc/cpuinfo").read_text("utf-8")
    except OSError:
        text = ""
    told = dict(re.findall(r"^(.+?)\t*: (.+)$", text, re.M))
    keys = ("cpu family", "model", "stepping")
    parts = [told.get("model name") or platform.processor() or platform.machine()]
    parts += [f"{key} {told[key]}" for key in keys if key in told]
    return ", ".join([*parts, f"{os.cpu_count()} cores"])


def print_steps(rows: Sequence[Row], times: Sequence[float], busy: float) -> None:
    print(
        f"One communication step of 10 ms in the default run of {STEPS * STEP:g} s"
        f" (medians of {PASSES * STEPS} steps)\n"
    )
    line = "  {:12} {:36} {:>9} {:>8} {:>11} {:>6}   {}"
    print(line.format("", "", "processor", "times", "off exact", "rhs", "").rstrip())
    print(line.format("row", "what it is", "time", "faster", "solution", "/ step", "wanted"))
    for row, seconds in zip(rows, times, strict=True):
        distance, faster = accuracy(row.simulator), times[0] / seconds
        sides = "" if row.evaluations is None else f"{row.evaluations() / STEPS:.1f}"
        print(
            line.format(
                row.name,
                row.about,
                f"{1e6 * seconds:.0f} µs",
                f"{faster:.1f}",
                length(distance),
                sides,
                "" if row.bar is None else f">= {row.bar:g}: {verdict(faster >= row.bar)}",
            ).rstrip()
        )
    print(
        "\n  times faster: than the listing. off exact solution: largest distance of the end"
        "\n  effector, at any sample, from the closed form of e'' + 40 e' + 50 e = 0."
        "\n  rhs / step: evaluations of the right-hand side; the FMUs run those of the plant."
    )
    if busy > BUSY:
        print(f"  The machine was busy: wall time was {busy:.2f} times the processor time.")


def print_in_c(rows: Sequence[RowInC], times: Sequence[float]) -> None:
    print(
        "\nThe same step of 10 ms in C, without Python"
        f" (processor time, medians of {C_ROUNDS} runs of {STEPS * STEP:g} s)\n"
    )
    line = "  {:28} {:>6}  {:9} {:>9} {:>6} {:>12} {:>11}"
    print(line.format("", "", "", "processor", "rhs", "times faster", "than MuJoCo"))
    print(line.format("row", "joints", "path", "time", "/ step", "free", "controlled"))
    for row, seconds in zip(rows, times, strict=True):
        faster = [f"{mujoco / seconds:.1f}" for mujoco in times[:2]]
        print(
            line.format(
                row.name, row.joints, row.path, f"{1e6 * seconds:.1f} µs",
                f"{row.evaluations:.1f}", *(faster if row.joints == rows[0].joints else ("", "")),
            ).rstrip()
        )  # fmt: skip
    for path in (CANCELS, GENERAL):
        chosen = [k for k, row in enumerate(rows) if row.path == path]
        power = growth([rows[k].joints for k in chosen], [times[k] for k in chosen])
        print(f"\n  Growth where the path is {path}: at most joints^{power:.2f}", end="")
    compiler = "zig cc" if importlib.util.find_spec("ziglang") else "cc"
    print(
        "\n\n  native: Dormand-Prince 5(4), rtol 1e-3, atol 1e-6, steps of 1 ms at most; with"
        "\n  controller and limits. Compiled as in its FMU:"
        f"\n  {' '.join((compiler, *FLAGS))}"
        "\n  MuJoCo: mj_step, RK4, steps of 1 ms; limits off, no shapes and so no contacts. The"
        f"\n  library as in its package, which is not imported; the loop in C, {' '.join(CC)}."
        "\n  free: no controller. controlled: by the guide's equations, in each stage of RK4."
        "\n  path: where only an unlimited control torque acts, M cancels; with damping, tau_ext or"
        "\n  effort limits it does not. Panda: as in example-robot-data, but that its fingers are"
        "\n  fixed, so that 7 joints move. chain: generated, without damping."
    )


def print_logs(logs: dict[str, tuple[float, float]]) -> None:
    print(
        "\nLogging one JointState of two joints"
        f" (processor time, medians of {LOG_ROUNDS} bags of {LOG_TURN} messages)\n"
    )
    line = "  {:10} {:>14} {:>14} {:>8}"
    print(line.format("storage", "bare rosbags", "twodof.Bag", "rate"))
    for storage, (bare, ours) in logs.items():
        times = f"{1e6 * bare:.1f} µs", f"{1e6 * ours:.1f} µs"
        print(line.format(storage, *times, f"{bare / ours:.2f}"))
    print(
        "\n  bare rosbags: serialize_cdr and Writer.write of a message built beforehand, no more."
        "\n  twodof.Bag: from a Sample; builds the message, and flushes twice a second."
        "\n  rate: messages in the same time, of bare rosbags'."
    )


def print_once(seconds_of_help: float, seconds_of_run: float) -> None:
    faster = STEPS * STEP / seconds_of_run
    line = "  {:56} {:>8}   {}"
    print("\nOnce (wall time)\n")
    help_line = line.format("twodof --help (median of 5 processes)", f"{seconds_of_help:.2f} s", "")
    print(help_line.rstrip())
    print(
        line.format(
            "default run: load the FMU, 501 samples, close the bag",
            f"{seconds_of_run:.2f} s",
            f"{faster:.1f} times real time",
        )
    )


def verdict(met: bool) -> str:
    return "met" if met else "MISSED"


def length(metres: float) -> str:
    """A distance in the unit that suits it."""
    return f"{1e3 * metres:.1f} mm" if metres >= 1e-4 else f"{metres:.0e} m"


if __name__ == "__main__":
    main()
