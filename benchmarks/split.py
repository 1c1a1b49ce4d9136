"""Cost of a logged step of a system of plant and controller, relative to the two engines.

    python benchmarks/split.py [TURNS]

The engines' time is that of ``system_step.c``, which only loads the two native FMUs and connects them in C; it must end
at the same joint angles. A run of ``twodof.simulate`` has a bag, MCAP without fsync. Times are processor times of all
threads; both programs take turns, and ratios are medians over the turns. It needs a C compiler and takes less than a
minute.
"""

from __future__ import annotations

import ctypes
import sys
import tempfile
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
from arms import ROBOTS, STEP, without_shapes
from report import Figure, machine, print_figures, print_rows, spent

import twodof
from twodof.export.compiler import compile_library, host_platform, standard_headers
from twodof.fmu import System

SAMPLES, TURNS = 10_000, 7
BAR = 2.2
CONNECTED = (("plant", ("q", "v")), ("plant", ("tau_cmd",)), ("controller", ("q", "v")), ("controller", ("tau_cmd",)))


def shipped(path: Path) -> Path:
    return twodof.build_fmu(path, twodof.FmuOptions(part="split"))


def panda(path: Path) -> Path:
    """Build the stock Panda, whose target is 0.1 m from its start along each axis."""
    urdf = path.with_suffix(".urdf")
    tree = without_shapes((ROBOTS / "panda_description/urdf/panda.urdf").read_text("utf-8"))
    urdf.write_bytes(ET.tostring(tree))
    start = {"q_start": (0.0, -0.5, 0.0, -2.0, 0.0, 1.5, 0.8), "x_des": (0.4, -0.1, 0.5)}
    options = twodof.FmuOptions(urdf=urdf, frame="panda_hand_tcp", lock={"*finger*": 0.0}, part="split", settings=start)
    return twodof.build_fmu(path, options)


def engines(system: System, folder: Path) -> Callable[[], tuple[float, np.ndarray]]:
    """Return a function that measures a step of the two engines in C, s; it also returns the last q and v."""
    sources = {**standard_headers(), "system_step.c": (Path(__file__).parent / "system_step.c").read_bytes()}
    library = folder / "system_step"
    flags = ("-fvisibility=default", "-ldl")
    library.write_bytes(compile_library(sources, host_platform(), "system_step", units=["system_step.c"], flags=flags))
    cost = ctypes.CDLL(str(library)).system_cost
    cost.restype = ctypes.c_double
    paths, guids = [], []
    for name, fmu in system.components.items():
        with zipfile.ZipFile(system.path) as archive, zipfile.ZipFile(archive.open(fmu.inside)) as inside:
            paths.append(inside.extract(f"binaries/{fmu.platform}/{fmu.library}", folder / name).encode())
        guids.append(fmu.guid.encode())
    references = []
    for name, groups in CONNECTED:
        fmu = system.components[name]
        numbers = [fmu.variables[element].reference for group in groups for element in fmu.vector(group)]
        references.append((ctypes.c_uint * len(numbers))(*numbers))
    n = len(system.joints)
    last = (ctypes.c_double * (2 * n))()
    pointers = (ctypes.POINTER(ctypes.c_uint) * 4)(*(ctypes.cast(r, ctypes.POINTER(ctypes.c_uint)) for r in references))
    two = ctypes.c_char_p * 2

    def measure() -> tuple[float, np.ndarray]:
        seconds = cost(two(*paths), two(*guids), pointers, n, ctypes.c_double(STEP), SAMPLES, last)
        return float(seconds), np.array(last)

    return measure


def compared(name: str, path: Path, folder: Path, turns: int) -> Figure:
    """Return the figure of one system."""
    system = twodof.load_fmu(path)
    assert isinstance(system, System)
    run = twodof.experiment(system, stop_time=SAMPLES * STEP, step=STEP)
    in_c, rows, bag = engines(system, folder), [], folder / "bag"
    for _ in range(turns):
        seconds, last = in_c()
        rows.append((seconds, spent(lambda: twodof.simulate(run, twodof.Bag(bag, overwrite=True)))[0] / SAMPLES))
    recorded = twodof.read_bag(bag)
    np.testing.assert_array_equal(last, [*recorded.q[-1], *recorded.v[-1]])
    bare, ours = (1e6 * median(times) for times in zip(*rows))
    print_rows(
        f"A step of {name}, a run of {SAMPLES} steps of {STEP:g} s",
        ("C: both engines and their connections", f"{bare:.1f} µs"),
        ("twodof.simulate and its bag", f"{ours:.1f} µs"),
    )
    ratio = median(ours / bare for bare, ours in rows)
    what = f"{name}: a step in twodof.simulate with its bag, MCAP without fsync / both engines connected in C"
    return Figure(what, f"{ratio:.2f}", f"<= {BAR}")


def main(turns: int = TURNS) -> list[Figure]:
    """Measure and print; return the figures that have a bound."""
    figures = []
    for name, build in (("a split Panda", panda), ("the split default arm", shipped)):
        with tempfile.TemporaryDirectory(prefix="twodof_") as folder:
            figures.append(compared(name, build(Path(folder, "arm.ssp")), Path(folder), turns))
    return figures


if __name__ == "__main__":
    print(machine())
    print_figures(main(*map(int, sys.argv[1:])))
