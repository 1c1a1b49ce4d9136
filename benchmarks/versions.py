"""FMI 3.0 against FMI 2.0: ten robots under every control, co-simulation bit for bit.

    python benchmarks/versions.py         all, about 10 minutes
    python benchmarks/versions.py panda   those whose path has this word

Prints a table in Markdown. Each robot is thrown at 0.3 rad/s or m/s a joint, with a force at its
frame, and steps 10 ms for 1 s, in FMPy's `simulate_fmu`; what is compared are all values of q, v,
x and tau. Ratios are of 3.0 to 2.0: bytes of the library, and processor time of a step with its
outputs read, the least of interleaved runs. Ends with status 1 where a value differs.
"""

from __future__ import annotations

import logging
import sys
import tempfile
import time
import zipfile
from pathlib import Path

import fmpy
import numpy as np
from robots import frame_of, robots_folder

import twodof
from twodof.fmu import Instance, instantiate
from twodof.plant.variables import CONTROLS

ROBOTS = (
    "ur_description/urdf/ur3_robot.urdf", "ur_description/urdf/ur5_robot.urdf",
    "ur_description/urdf/ur10_robot.urdf", "panda_description/urdf/panda.urdf",
    "z1_description/urdf/z1.urdf", "kinova_description/robots/kinova.urdf",
    "xarm_description/urdf/xarm7.urdf", "so_arm_description/urdf/so100.urdf",
    "tiago_description/robots/tiago_no_hand.urdf", "baxter_description/urdf/baxter.urdf",
)  # fmt: skip
GROUPS = ("q", "v", "x", "tau")
STEP, STEPS, ROUNDS = 0.01, 100, 60


def simulated(path: Path) -> np.ndarray:
    """All samples, by FMPy: a row of q, v, x and tau each."""
    fmu = twodof.load_fmu(path)
    starts = {"v_start": [0.3] * len(fmu.joints), "f_ext": [1.0, 2.0, -3.0]}
    names: list[str] = list(GROUPS)
    values: dict[str, object] = dict(starts)
    if fmu.version == 2:
        names = [name for group in GROUPS for name in fmu.vector(group)]
        values = {n: v for g, all_ in starts.items() for n, v in zip(fmu.vector(g), all_)}
    rows = fmpy.simulate_fmu(
        str(path), fmi_type="CoSimulation", stop_time=STEPS * STEP, step_size=STEP,
        output_interval=STEP, start_values=values, output=names,
    )  # fmt: skip
    return np.array([np.hstack([np.ravel(row[name]) for name in names]) for row in rows])


def seconds(fmu: twodof.Fmu, instance: Instance) -> float:
    """Processor time of a run."""
    instance.reset()
    instance.initialise(0.0, np.inf, {name: 0.3 for name in fmu.vector("v_start")})
    read = instance.reader([name for group in GROUPS for name in fmu.vector(group)])
    start = time.process_time()
    for k in range(STEPS):
        instance.step(k * STEP, STEP)
        read()
    return time.process_time() - start


def library_size(path: Path) -> int:
    """Bytes of the binary."""
    with zipfile.ZipFile(path) as archive:
        return sum(i.file_size for i in archive.infolist() if i.filename[:9] == "binaries/")


def measure(urdf: Path, control: str, folder: Path) -> tuple[list[str], bool]:
    """A row of the table, and whether all values are equal."""
    frame = frame_of(urdf.read_text("utf-8"))
    paths = []
    for fmi in (2, 3):
        options = twodof.FmuOptions(
            urdf=urdf, frame=frame, control=control, native=True, fmi=fmi, meshes=False,
            live_documentation=False,
        )  # fmt: skip
        paths.append(twodof.build_fmu(folder / f"fmi{fmi}.fmu", options))
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


def main() -> int:
    """Print the table; 1 where the versions differ."""
    logging.disable(logging.WARNING)
    words, different, root = sys.argv[1:], 0, robots_folder()
    chosen = [path for path in ROBOTS if not words or any(word in path for word in words)]
    print("| URDF | joints | frame | control | equal | moved | bytes | time |")
    print("| --- |" + " --- |" * 7)
    with tempfile.TemporaryDirectory() as folder:
        for name in chosen:
            for control in CONTROLS:
                row, equal = measure(root / name, control, Path(folder))
                different += not equal
                print(f"| {Path(name).name} | " + " | ".join(row) + " |", flush=True)
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
