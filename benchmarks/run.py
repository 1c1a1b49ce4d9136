"""Times the guide's listing, the plant, the FMU and the logger in one run, and prints a table.

    python benchmarks/run.py

Simulators take turns of ten steps, loggers turns of some thousand messages, so that noise of the
machine hits all alike; times are medians. Steps are timed in processor time: on an idle machine
it is the wall time, on a busy one a long step is interrupted more often than a short one, which
would flatter the short ones. Logging is timed in wall time, as it waits for the disk.

Beside its time each simulator has its distance from the exact solution, so that nobody compares
the speed of things that compute something else: in the default run both task axes obey
e'' + 40 e' + 50 e = 0 for the error e, which has a closed form. Needs the packages of the extra
"test". Takes less than a minute.
"""

from __future__ import annotations

import importlib.metadata
import math
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import fmpy
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE), str(ROOT)]

from listing import PendulumSimulator  # noqa: E402

import twodof  # noqa: E402
from twodof.plant import Plant, load_robot, variable_table  # noqa: E402

URDF = ROOT / "urdf" / "2dof.urdf"
STEP, STEPS = 0.01, 500  # s; the default run of 5 s
Q_START, X_DES, KP, KD, LINK = (0.5, 0.35), (0.2, 0.05), 50.0, 40.0, 0.15
PASSES, TURN = 4, 10
LOG_ROUNDS, LOG_TURN = 5, 20_000
FMU_BAR, LOG_BAR, HELP_BAR = 5.0, 1.5, 0.3
BUSY = 1.1


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


class PlantAlone:
    def __init__(self) -> None:
        robot = load_robot(URDF.read_text("utf-8"), "EndEffector", "xy")
        starts = {"q_start": Q_START, "x_des": X_DES, "gravity": (0.0, -9.81, 0.0)}
        self.plant = Plant(robot, variable_table(robot, starts))

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
    bare = FmuInFmpy(fmu, folder / "bare", outputs=False)
    reading = FmuInFmpy(fmu, folder / "reading", outputs=True)
    master = Master(fmu)
    for simulator in (bare, reading, master):
        stack.callback(simulator.free)
    listing, counted = Listing(), CountedPlant()
    return [
        Row("listing", "the guide's program as written", listing, listing.evaluations),
        Row("plant", "twodof.plant.Plant.step", PlantAlone(), counted_by(counted)),
        Row("FMU", "one doStep through FMPy", bare, bar=FMU_BAR),
        Row("FMU, read", "doStep, then getReal of all outputs", reading),
        Row("master", "one sample of twodof.samples", master),
    ]


def counted_by(counted: CountedPlant) -> Callable[[], int]:
    """Right-hand sides of the whole default run, from a run of its own."""

    def evaluations() -> int:
        accuracy(counted)
        return counted.evaluations()

    return evaluations


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

    Medians over turns that are long enough to hold their share of flushes and commits.
    """
    run = twodof.experiment(fmu)
    first = twodof.Sample(0, 0.0, (0.5, 0.35), (0.1, 0.2), (0.2, 0.1), (1.0, 0.3), {})
    samples = [first._replace(k=k, t=k * STEP) for k in range(LOG_TURN * LOG_ROUNDS)]
    stamps = [1_700_000_000_000_000_000 + round(s.t * 1e9) for s in samples]
    walls: dict[tuple[str, bool], list[float]] = {}
    with ExitStack() as stack:
        writes = []
        for storage in ("mcap", "sqlite3"):
            bag = twodof.Bag(folder / f"bag-{storage}", run, storage=storage, stamp_start=1.7e9)
            ours = stack.enter_context(bag).write
            theirs = bare_rosbags(stack, folder / f"bare-{storage}", storage)
            writes.append(((storage, False), theirs, stamps))
            writes.append(((storage, True), ours, samples))
        for turn in range(0, len(samples), LOG_TURN):
            for key, write, items in writes:
                chosen = items[turn : turn + LOG_TURN]
                begin = time.perf_counter()
                for item in chosen:
                    write(item)
                walls.setdefault(key, []).append((time.perf_counter() - begin) / LOG_TURN)
    median = {key: statistics.median(wall) for key, wall in walls.items()}
    return {key: (median[key, False], median[key, True]) for key in ("mcap", "sqlite3")}


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
    program = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from twodof.cli import main; main()"
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
    twodof.simulate(run, [twodof.Bag(folder / "whole", run)])
    return time.perf_counter() - begin


# --- how it is printed ---


def main() -> None:
    packages = ("numpy", "scipy", "pin", "fmpy", "pythonfmu", "rosbags")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages)
    print(f"twodof {twodof.__version__}, Python {platform.python_version()}, {versions}\n")
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="twodof_") as name, ExitStack() as stack:
        folder = Path(name)
        rows = table(stack, folder)
        fmu = folder / "TwoDof.fmu"
        print_steps(rows, *step_times([row.simulator for row in rows]))
        print_logs(log_times(folder, fmu))
        print_once(help_time(), run_time(folder, fmu))
    print(f"\n{time.perf_counter() - begin:.0f} s in all")


def print_steps(rows: Sequence[Row], times: Sequence[float], busy: float) -> None:
    print(
        f"One communication step of 10 ms in the default run of {STEPS * STEP:g} s"
        f" (medians of {PASSES * STEPS} steps)\n"
    )
    line = "  {:10} {:36} {:>9} {:>8} {:>11} {:>6}   {}"
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
        "\n  rhs / step: evaluations of the right-hand side; the FMU runs those of the plant."
    )
    if busy > BUSY:
        print(f"  The machine was busy: wall time was {busy:.2f} times the processor time.")


def print_logs(logs: dict[str, tuple[float, float]]) -> None:
    print(
        "\nLogging one JointState of two joints"
        f" (wall time, medians of {LOG_ROUNDS} turns of {LOG_TURN} messages)\n"
    )
    line = "  {:10} {:>14} {:>14} {:>8}   {}"
    print(line.format("storage", "bare rosbags", "twodof.Bag", "ratio", "wanted"))
    for storage, (bare, ours) in logs.items():
        ratio = ours / bare
        wanted = f"<= {LOG_BAR:g}: {verdict(ratio <= LOG_BAR)}"
        print(
            line.format(
                storage, f"{1e6 * bare:.1f} µs", f"{1e6 * ours:.1f} µs", f"{ratio:.2f}", wanted
            )
        )
    print(
        "\n  bare rosbags: serialize_cdr and Writer.write of a message built beforehand, no more."
        "\n  twodof.Bag: from a Sample; builds the message, and flushes twice a second."
    )


def print_once(seconds_of_help: float, seconds_of_run: float) -> None:
    faster = STEPS * STEP / seconds_of_run
    line = "  {:56} {:>8}   {}"
    print("\nOnce (wall time)\n")
    wanted = f"<= {HELP_BAR:g} s: {verdict(seconds_of_help <= HELP_BAR)}"
    print(line.format("twodof --help (median of 5 processes)", f"{seconds_of_help:.2f} s", wanted))
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
