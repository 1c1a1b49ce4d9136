"""Cost of a step of the tutorial's listing and of FMUs, and of a logged message.

    python benchmarks/steps.py

Simulators take turns of ten steps, loggers turns of some thousand messages, so that the machine's noise affects all of
them. Times are medians of processor time. On an idle machine this is the wall time; on a busy one, wall time would
favour short steps, because long ones are interrupted more often.

Ratios depend on the processor, which is printed. Each simulator also has its distance from the exact solution, so that
no incorrect program is compared by speed alone: in the default run the error e of each task axis obeys e'' + 40 e' + 50
e = 0, which has a closed form. It needs the packages of the extra "test" and a C compiler, and takes less than a
minute.
"""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol

import fmpy
import numpy as np
from arms import Q_START, STEP, STEPS, URDF, X_DES
from listing import PendulumSimulator
from report import Figure, machine, print_figures, print_rows
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import twodof

KP, KD, LINK = 50.0, 40.0, 0.15
PASSES, TURN = 3, 10
LOG_ROUNDS, LOG_TURN = 7, 20_000
FMU_BAR, NATIVE_BAR = 5.0, 300.0


class Simulator(Protocol):
    """A program that advances the default run; ``restart`` is called before the first step."""

    def restart(self) -> None: ...
    def step(self, k: int) -> None:
        """Do the timed communication step that starts at k·STEP."""

    def q(self) -> Sequence[float]:
        """Return the joint angles, rad; not timed."""


class Listing:
    def restart(self) -> None:
        self.program = PendulumSimulator(URDF)

    def step(self, _k: int) -> None:
        self.program.step()

    def q(self) -> Sequence[float]:
        return self.program.q.tolist()


class FmuInFmpy:
    """An FMU stepped by bare FMPy calls, without this package's master."""

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


def simulators(stack: ExitStack, folder: Path) -> dict[str, Simulator]:
    """Return the simulators by name, the listing first."""
    rows: dict[str, Simulator] = {"the listing, as written": Listing()}
    for flavour, native in (("Python", False), ("native", True)):
        fmu = twodof.build_fmu(folder / f"{flavour}.fmu", twodof.FmuOptions(native=native))
        for what in ("one doStep through FMPy", "doStep, then getReal of all outputs"):
            outputs = "getReal" in what
            simulator = FmuInFmpy(fmu, folder / f"{flavour}{outputs}", outputs=outputs)
            stack.callback(simulator.free)
            rows[f"{flavour} FMU, {what}"] = simulator
    return rows


# --- what is measured ---


def exact(k: int) -> np.ndarray:
    """Return the position of the end effector after k steps, m, by the closed form of e(t) from rest."""
    t, root = k * STEP, math.sqrt(KD * KD / 4 - KP)
    decay = math.exp(-KD / 2 * t)
    share = decay * (math.cosh(root * t) + KD / 2 / root * math.sinh(root * t))
    return np.array(X_DES) + (position(Q_START) - X_DES) * share


def position(q: Sequence[float]) -> np.ndarray:
    """Return the end effector's position at angles q, m."""
    elbow = np.array([math.cos(q[0]), math.sin(q[0])])
    wrist = np.array([math.cos(q[0] + q[1]), math.sin(q[0] + q[1])])
    return LINK * (elbow + wrist)


def accuracy(simulator: Simulator) -> float:
    """Return the largest distance from the exact solution at any sample of the default run, m."""
    simulator.restart()
    largest = 0.0
    for k in range(STEPS):
        simulator.step(k)
        largest = max(largest, float(np.linalg.norm(position(simulator.q()) - exact(k + 1))))
    return largest


def step_times(simulators: Sequence[Simulator], passes: int = PASSES) -> list[float]:
    """Return the median processor time of a step of each, s, over interleaved parts of default runs."""
    times: list[list[int]] = [[] for _ in simulators]
    for _ in range(passes):
        for simulator in simulators:
            simulator.restart()
        for turn in range(0, STEPS, TURN):
            for simulator, taken in zip(simulators, times, strict=True):
                for k in range(turn, turn + TURN):
                    begin = time.thread_time_ns()
                    simulator.step(k)
                    taken.append(time.thread_time_ns() - begin)
    return [statistics.median(taken) * 1e-9 for taken in times]


def log_times(folder: Path, fmu: Path) -> dict[str, tuple[float, float]]:
    """Measure the time of one JointState in bare rosbags and in this package's bag, s, by storage.

    Times are medians over bags written in turns, from the first message to the closed file, in processor time of all
    threads, because this package's bag stores in a thread.
    """
    run = twodof.experiment(fmu)
    first = twodof.Sample(0, 0.0, (0.5, 0.35), (0.1, 0.2), (0.2, 0.1), (1.0, 0.3), {}, 0.0, 0)
    stamps = [1_700_000_000_000_000_000 + round(k * STEP * 1e9) for k in range(LOG_TURN)]
    samples = [first._replace(k=k, t=k * STEP, stamp=stamp) for k, stamp in enumerate(stamps)]
    costs = {}
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
        costs[storage] = (statistics.median(walls[0]), statistics.median(walls[1]))
    return costs


def log_time(stack: ExitStack, write: Callable[[Any], None], items: Sequence[Any]) -> float:
    """Measure the processor time of one message, s: writing all messages, and closing the bag on the stack."""
    begin = time.process_time()
    for item in items:
        write(item)
    stack.close()
    return (time.process_time() - begin) / len(items)


def bare_rosbags(stack: ExitStack, path: Path, storage: str) -> Callable[[int], None]:
    """Return a function that writes the same message at a stamp."""
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
    writer = stack.enter_context(Writer(path, version=8, storage_plugin=StoragePlugin[storage.upper()]))
    connection = writer.add_connection("/joint_states", kind, typestore=store)
    serialize, write = store.serialize_cdr, writer.write
    return lambda stamp: write(connection, stamp, serialize(message, kind))


def main() -> list[Figure]:
    """Measure and print; return the figures that have a bound."""
    with tempfile.TemporaryDirectory(prefix="twodof_") as name, ExitStack() as stack:
        folder = Path(name)
        rows = simulators(stack, folder)
        times = step_times([*rows.values()])
        faster = [times[0] / seconds for seconds in times]
        print_rows(
            f"A communication step of 10 ms, of a run of {STEPS * STEP:g} s of the default arm",
            ("", "time", "times faster", "off exact solution"),
            *(
                (what, f"{1e6 * seconds:.0f} µs", f"{ratio:.1f}", f"{accuracy(simulator):.0e} m")
                for (what, simulator), seconds, ratio in zip(rows.items(), times, faster)
            ),
        )
        print_rows(
            "A JointState of two joints in bags, flushes included",
            ("", "bare rosbags", "twodof.Bag", "messages in the same time"),
            *(
                (storage, f"{1e6 * bare:.1f} µs", f"{1e6 * ours:.1f} µs", f"{bare / ours:.2f}")
                for storage, (bare, ours) in log_times(folder, folder / "native.fmu").items()
            ),
        )
    bars = {"Python": FMU_BAR, "native": NATIVE_BAR}
    return [
        Figure(f"the listing, as written, / {what}", f"{ratio:.1f}", f">= {bars[what[:6]]:g}")
        for what, ratio in zip(rows, faster)
        if what[:6] in bars and what != "Python FMU, doStep, then getReal of all outputs"
    ]


if __name__ == "__main__":
    print(machine())
    print_figures(main())
