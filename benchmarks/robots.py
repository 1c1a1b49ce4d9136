"""Build and run every URDF of example-robot-data without changes, and compare FMI 3.0 with 2.0.

    python benchmarks/robots.py                      all, about 20 minutes
    python benchmarks/robots.py panda ur5            those whose path has one of these words
    python benchmarks/robots.py --versions [WORD …]  ten robots in FMI 3.0 and 2.0, about 10 minutes
    python benchmarks/robots.py --falls [WORD …]     bare robots that fall onto their stops, about 10 minutes

It prints a table in Markdown, and returns exit status 1 if a result is wrong.

Each robot runs for 1 s and is logged in both flavours. If a robot has several last links, the frame is the first of
those that most joints move. "error" is the difference of the bare plant from SciPy's DOP853 (Radau for damped joints)
on Pinocchio's dynamics, rad or m, 0.1 s after a start at 1 rad/s or m/s in each joint, without limits and friction,
at rtol 1e-9. Times are processor times of a step of 10 ms under the default control at rest on its target, including
its message in the bag. A URDF that is refused for a reason that is not in REFUSED is wrong.

Versions: each robot under each control starts at 0.3 rad/s or m/s in each joint, with a force at its frame, and makes
steps of 10 ms for 1 s in FMPy's `simulate_fmu`. All values of q, v, x and tau are compared bit for bit; a difference is
wrong. Ratios are of 3.0 to 2.0: bytes of the library, and processor time of a step including reading its outputs, the
least of interleaved runs.

Falls: native FMUs without a controller start at rest and fall for 0.3 s in steps of 10 ms, with the URDF's joint
friction and without friction. "worst step" is the step with the longest processor time, of which the least of ROUNDS
runs counts. "error" is the largest difference of a joint in the first 0.1 s from a run at rtol 1e-8, atol 1e-11 and
max_step 0.1 ms, rad or m.
"""

from __future__ import annotations

import logging
import re
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

import fmpy
import numpy as np
import pinocchio as pin
from arms import ROBOTS
from report import print_judged
from scipy.integrate import solve_ivp

import twodof
from twodof.export.urdf_source import last_links
from twodof.fmu import Instance, instantiate
from twodof.plant.robot import Robot, load_robot
from twodof.plant.urdf import read_urdf
from twodof.plant.variables import CONTROLS

REFUSED = (
    "of type 'floating'",
    "of type 'planar'",
    "of type 'spherical'",
    "no joint moves a link",
    "no mass or no inertia about its axis",
    "which does not exist",
    "not physical",
    "has no links",
)
COMPARED = (
    "ur_description/urdf/ur3_robot.urdf",
    "ur_description/urdf/ur5_robot.urdf",
    "ur_description/urdf/ur10_robot.urdf",
    "panda_description/urdf/panda.urdf",
    "z1_description/urdf/z1.urdf",
    "kinova_description/robots/kinova.urdf",
    "xarm_description/urdf/xarm7.urdf",
    "so_arm_description/urdf/so100.urdf",
    "tiago_description/robots/tiago_no_hand.urdf",
    "baxter_description/urdf/baxter.urdf",
)
FALLING = (
    "tiago_description/robots/tiago_dual.urdf",
    "tiago_description/robots/tiago.urdf",
    "g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf",
    "centauro_description/urdf/centauro.urdf",
    "talos_data/robots/talos_full_v2.urdf",
    "allegro_hand_description/urdf/allegro_left_hand.urdf",
)
FALL_STEPS, EXACT = 30, {"rtol": 1e-8, "atol": 1e-11, "max_step": 1e-4}
FLIGHT = 0.1  # s
GROUPS = ("q", "v", "x", "tau")
STEP, STEPS, ROUNDS = 0.01, 100, 60
MOST_SECONDS = 60.0  # s of processor time, after which a run of a stiff robot is cut short


class Clock(twodof.Sink):
    """Processor time at the first sample and at the latest, s."""

    first = last = 0.0

    def write(self, sample: twodof.Sample) -> None:
        """Note the processor time."""
        self.last = time.process_time()
        self.first = self.first or self.last

    def late(self) -> bool:
        """Return True if the run took too long."""
        return self.last > self.first + MOST_SECONDS


def frame_of(text: str) -> str:
    """Return the first of the last links that most joints move; the root if no joint moves."""
    urdf = read_urdf(text)
    ends = last_links(urdf) or [urdf.root]
    return max(ends, key=lambda link: sum(joint.moves for joint in urdf.chain(link)))


def apart(fmu: Path, robot: Robot) -> float:
    """Return the bare plant's largest difference from SciPy's solution on Pinocchio's dynamics."""
    n, model = len(robot.joints), robot.model
    model.gravity.linear = np.array([0.0, 0.0, -9.81])
    data, damping = model.createData(), np.array(robot.damping)
    G = np.eye(n) if robot.coupling is None else robot.coupling

    def motion(_: float, y: np.ndarray) -> np.ndarray:
        Q, V = G @ y[:n] + robot.offset, G @ y[n:]
        M = pin.crba(model, data, Q)
        M = G.T @ (np.triu(M) + np.triu(M, 1).T) @ G
        h = G.T @ pin.nonLinearEffects(model, data, Q, V)
        return np.concatenate([y[n:], np.linalg.solve(M, -damping * y[n:] - h)])

    settings = {"rtol": 1e-9, "atol": 1e-12, "q_min": -1e9, "q_max": 1e9, "friction": 0.0}
    settings["v_start"] = 1.0  # at rest some are in equilibrium, and nothing would be compared
    samples = list(twodof.samples(fmu, stop_time=FLIGHT, settings=settings))
    y0 = [*samples[0].q, *samples[0].v]
    method = "Radau" if damping.any() else "DOP853"
    end = solve_ivp(motion, (0.0, FLIGHT), y0, method, rtol=1e-10, atol=1e-12).y[:n, -1]
    return float(np.abs(end - samples[-1].q).max())


def built(urdf: Path, folder: Path) -> list[str]:
    """Return a row of the table: joints, frame, error, µs a step of either flavour."""
    text = urdf.read_text("utf-8")
    frame = frame_of(text)
    times = []
    for native in (False, True):
        options = twodof.FmuOptions(urdf=urdf, frame=frame, native=native)
        fmu = twodof.build_fmu(folder / f"robot{native:d}.fmu", options, overwrite=True)
        clock, bag = Clock(), twodof.Bag(folder / "bag", overwrite=True)
        summary = twodof.simulate(fmu, bag, clock, stop_time=1.0, stop=clock.late)
        steps = summary.last.k
        short = "" if steps == 100 else f" ({steps} of 100 steps)"
        times.append(f"{1e6 * (clock.last - clock.first) / steps:.0f}{short}")
    options = twodof.FmuOptions(urdf=urdf, frame=frame, native=True, control="effort", meshes=False)
    robot = load_robot(text, frame, "xyz")
    off = apart(twodof.build_fmu(folder / "bare.fmu", options, overwrite=True), robot)
    return [str(len(robot.joints)), frame, f"{off:.0e}", *times]


# --- FMI 3.0 against 2.0 ---


def simulated(path: Path) -> np.ndarray:
    """Return all samples, by FMPy: rows of q, v, x and tau."""
    fmu = twodof.load_fmu(path)
    starts = {"v_start": [0.3] * len(fmu.joints), "f_ext": [1.0, 2.0, -3.0]}
    names: list[str] = list(GROUPS)
    values: dict[str, object] = dict(starts)
    if fmu.version == 2:
        names = [name for group in GROUPS for name in fmu.vector(group)]
        values = {n: v for g, all_ in starts.items() for n, v in zip(fmu.vector(g), all_)}
    rows = fmpy.simulate_fmu(
        str(path),
        fmi_type="CoSimulation",
        stop_time=STEPS * STEP,
        step_size=STEP,
        output_interval=STEP,
        start_values=values,
        output=names,
    )
    return np.array([np.hstack([np.ravel(row[name]) for name in names]) for row in rows])


def seconds(fmu: twodof.Fmu, instance: Instance) -> float:
    """Return the processor time of a run, s."""
    instance.reset()
    instance.initialise(0.0, np.inf, {name: 0.3 for name in fmu.vector("v_start")})
    read = instance.reader([name for group in GROUPS for name in fmu.vector(group)])
    start = time.process_time()
    for k in range(STEPS):
        instance.step(k * STEP, STEP)
        read()
    return time.process_time() - start


def library_size(path: Path) -> int:
    """Return the size of the binary in bytes."""
    with zipfile.ZipFile(path) as archive:
        return sum(i.file_size for i in archive.infolist() if i.filename[:9] == "binaries/")


def compared(urdf: Path, control: str, folder: Path) -> tuple[list[str], bool]:
    """Return a row of the table, and True if all values are equal."""
    frame = frame_of(urdf.read_text("utf-8"))
    paths = []
    for fmi in (2, 3):
        options = twodof.FmuOptions(urdf=urdf, frame=frame, control=control, native=True, fmi=fmi, meshes=False)
        paths.append(twodof.build_fmu(folder / f"fmi{fmi}.fmu", options, overwrite=True))
    two, three = map(simulated, paths)
    size = library_size(paths[1]) / library_size(paths[0])
    fmus = [twodof.load_fmu(path) for path in paths]
    with instantiate(fmus[0]) as old, instantiate(fmus[1]) as new:
        times = [(seconds(fmus[0], old), seconds(fmus[1], new)) for _ in range(ROUNDS)]
    best = np.min(times, axis=0)
    equal = two.shape == three.shape == (STEPS + 1, two.shape[1]) and bool((two == three).all())
    moved = f"{np.ptp(two, axis=0).max():.2g}"
    words = "yes" if equal else f"**no**, {np.abs(two - three).max():.1e}"
    row = [str(len(fmus[0].joints)), frame, control, words, moved, f"{size:.3f}"]
    return [*row, f"{best[1] / best[0]:.3f}"], equal


# --- Bare robots that fall onto their stops ---


def fall(instance: Instance, fmu: twodof.Fmu, settings: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the processor time of each step, s, and q after it."""
    instance.reset()
    values = {n: x for group, x in settings.items() for n in fmu.vector(group) or [group]}
    instance.initialise(0.0, np.inf, values)
    read, times, rows = instance.reader(fmu.vector("q")), [], []
    for k in range(FALL_STEPS):
        start = time.process_time()
        instance.step(k * STEP, STEP)
        times.append(time.process_time() - start)
        rows.append(read())
    return np.array(times), np.array(rows)


def fallen(urdf: Path, folder: Path) -> list[list[str]]:
    """Return rows of the table: friction, worst step, error."""
    frame = frame_of(urdf.read_text("utf-8"))
    options = twodof.FmuOptions(urdf=urdf, frame=frame, control="effort", native=True, meshes=False)
    fmu = twodof.load_fmu(twodof.build_fmu(folder / "bare.fmu", options, overwrite=True))
    rows = []
    for friction in (None, 0.0):
        settings = {} if friction is None else {"friction": friction}
        with instantiate(fmu) as instance:
            runs = [fall(instance, fmu, settings) for _ in range(ROUNDS)]
            _, exact = fall(instance, fmu, settings | EXACT)
        worst = 1e3 * np.min([times for times, _ in runs], axis=0).max()
        off = np.abs(exact - runs[0][1])[: round(FLIGHT / STEP)].max()
        words = "none" if friction is not None else "as in the URDF"
        rows.append([str(len(fmu.joints)), words, f"{worst:.1f} ms", f"{off:.0e}"])
    return rows


def fallen_rows(words: list[str], folder: Path) -> Iterator[tuple[list[str], bool]]:
    """Yield rows of the table, each with True."""
    yield ["URDF", "joints", "friction", "worst step", "error"], True
    for name in FALLING:
        if not words or any(word in name for word in words):
            for row in fallen(ROBOTS / name, folder):
                yield [Path(name).name, *row], True


def built_rows(words: list[str], folder: Path) -> Iterator[tuple[list[str], bool]]:
    """Yield rows of the table, each with True if it is right."""
    yield ["URDF", "joints", "frame", "error", "Python, µs a step", "native"], True
    for urdf in sorted(ROBOTS.rglob("*.urdf")):
        name = str(urdf.relative_to(ROBOTS))
        if words and not any(word in name for word in words):
            continue
        try:
            yield [name, *built(urdf, folder)], True
        except (twodof.TwoDofError, ValueError) as error:
            reason = re.sub(r"\s+", " ", str(error)).replace(f"{ROBOTS}/", "")
            right = any(known in reason for known in REFUSED)
            yield [name, "", f"refused: {reason[:160]}", "", "", ""], right


def compared_rows(words: list[str], folder: Path) -> Iterator[tuple[list[str], bool]]:
    """Yield rows of the table, each with True if it is right."""
    yield ["URDF", "joints", "frame", "control", "equal", "moved", "bytes", "time"], True
    for name in COMPARED:
        for control in CONTROLS if not words or any(word in name for word in words) else ():
            row, equal = compared(ROBOTS / name, control, folder)
            yield [Path(name).name, *row], equal


def main() -> int:
    """Print the table; return 1 if a result is wrong."""
    logging.disable(logging.WARNING)
    words = [word for word in sys.argv[1:] if word[:2] != "--"]
    rows = compared_rows if "--versions" in sys.argv else fallen_rows if "--falls" in sys.argv else built_rows
    with tempfile.TemporaryDirectory() as folder:
        return print_judged(rows(words, Path(folder)))


if __name__ == "__main__":
    sys.exit(main())
