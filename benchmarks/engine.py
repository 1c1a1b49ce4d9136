"""The native engine in C by robot, path and compiler, compared with MuJoCo and with C by CasADi.

    python benchmarks/engine.py [JOINTS ...]

Times are processor times without Python, for steps of 10 ms of the default arm, a Panda, and chains of JOINTS joints
(default: 2, 7, 16 and 30; 30 take minutes to compile). Each round runs all programs once, so that the machine's noise
affects all of them; ratios are medians over the rounds.

- Engine: Dormand-Prince 5(4), rtol 1e-3, atol 1e-6, largest step 1 ms, with controller and limits, which are not
  reached, compiled as in its FMU. If only an unlimited control torque acts, M cancels; otherwise the engine uses the
  general path.
- CasADi's code (generated.py) runs in the same integrator, in its fastest build, without rank checks and payloads.
- MuJoCo (mujoco_step.c): mj_step, RK4, steps of 1 ms, without limits, shapes and contacts; free, and with the
  tutorial's controller in each stage. The library is that of its Python package, which is not imported, because it
  makes the library read the clock, at more than the cost of a step.
- A derivative has a direction of all states, in Model Exchange; the least of many calls. A Jacobian has the derivatives
  of the accelerations with respect to all states and joint efforts, a column at a time, at new points.
"""

from __future__ import annotations

import ctypes
import importlib.util
import itertools
import math
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

from arms import (
    HERE,
    STEPS,
    URDF,
    Arm,
    by_own_compiler,
    chain,
    compiled,
    native_cost,
    panda,
    shipped_arm,
    ur5,
    without_shapes,
)
from generated import rivals
from report import Figure, machine, print_figures, print_rows

from twodof.plant.variables import CONTROLS, variable_table

ROUNDS = 15
JOINTS = (2, 7, 16, 30)
PATHS = ("M cancels", "general")
CASADI_BAR, LIMITS_BAR, GCC_BAR, DERIVATIVE_BAR = 1.0, 1.25, 1.2, 4.0
JACOBIAN_BARS = {"shipped_arm": 8.0, "ur5": 12.0, "panda": 12.0}  # under effort control
CALLS = 2000  # of a right-hand side
CC = ("cc", "-O2")
Costs = dict[str, float]


def programs(n: int, folder: Path) -> dict[str, Callable[[], float]]:
    """Return the timed programs of one robot; names of other engines end in their build."""
    arm = shipped_arm() if n == 2 else chain(n)
    free = Arm(replace(arm.robot, effort=(1e6,) * n), arm.starts)
    pushed = Arm(free.robot, {**free.starts, "tau_ext": (1e-3,) * n})
    limited = Arm(free.robot, {**free.starts, "limit_effort": True})
    costs = {
        "M cancels": native_cost(free, folder),
        "general": native_cost(pushed, folder),
        "limits on": native_cost(limited, folder),
        "M cancels, cc": by_own_compiler(free, folder),
        "general, cc": by_own_compiler(pushed, folder),
        **{f"M cancels: {name}": cost for name, cost in rivals(free, folder, False).items()},
        **{f"general: {name}": cost for name, cost in rivals(pushed, folder, True).items()},
    }
    if n == 2:
        mujoco = mujoco_runner(folder)
        for kind in ("free", "controlled"):
            costs[f"MuJoCo, {kind}"] = lambda kind=kind: mujoco(kind, STEPS)[0]
    return costs


def mujoco_runner(folder: Path) -> Callable[[str, int], tuple[float, list[float]]]:
    """Compile mujoco_step.c; return a function that runs some steps, and returns a step's cost, s, and the last angles.

    Each run has its own process, which does not import MuJoCo's Python package.
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


def derivative_costs(arm: Arm, folder: Path, calls: int = CALLS) -> tuple[float, float, float]:
    """Measure the right-hand side, a derivative, and the Jacobian by states and efforts, s; the least of the runs."""
    side_cost = compiled(arm, folder, "native_step.c").side_cost
    side_cost.restype = ctypes.c_double
    names = [variable.name for variable in variable_table(arm.robot, arm.starts, arm.control)]
    effort = names.index("tau_cmd[1]" if arm.control == "effort" else "tau_ext[1]")
    places = names.index("q[1]") + 1, names.index("der(q[1])") + 1, effort + 1, len(arm.robot.joints)
    rounds = [[side_cost(kind, calls // (1, 1, 10)[kind], *places) for kind in range(3)] for _ in range(200)]
    side, derivative, jacobian = map(min, zip(*rounds))
    return side, derivative, jacobian


def measured(joints: Sequence[int]) -> Iterator[tuple[int, list[Costs]]]:
    """Yield the costs of each round, by joints."""
    for n in joints:
        with tempfile.TemporaryDirectory(prefix="twodof_") as folder:
            costs = programs(n, Path(folder))
            yield n, [{name: cost() for name, cost in costs.items()} for _ in range(ROUNDS)]


def ratio(rounds: list[Costs], a: str, b: str) -> float:
    return median(times[a] / times[b] for times in rounds)


def best(path: str, rounds: list[Costs]) -> str:
    """Return CasADi's fastest build, by its median."""
    names = [name for name in rounds[0] if name.startswith(f"{path}: ")]
    return min(names, key=lambda name: median(times[name] for times in rounds))


def growth(joints: Sequence[int], times: Sequence[float]) -> float:
    """Return the largest exponent p of time ~ joints^p between neighbouring sizes."""
    pairs = itertools.pairwise(zip(joints, times, strict=True))
    return max(math.log(t1 / t0) / math.log(n1 / n0) for (n0, t0), (n1, t1) in pairs)


def figures_of(n: int, rounds: list[Costs]) -> Iterator[Figure]:
    """Yield the figures that have a bound."""
    ours = f"{n} joints: engine by zig, flags as in its FMU"
    for path in PATHS:
        row = best(path, rounds)
        against = f"{ratio(rounds, path, row):.2f}"
        yield Figure(f"{ours}, / CasADi's C, {row}", against, f"<= {CASADI_BAR:g}")
    limits = f"{ratio(rounds, 'limits on', 'M cancels'):.2f}"
    yield Figure(f"{ours}, limits of effort on / off", limits, f"<= {LIMITS_BAR}")
    for path in PATHS:
        gcc = f"{ratio(rounds, f'{path}, cc', path):.2f}"
        yield Figure(f"{ours}, {path}: the same by cc / that", gcc, f"<= {GCC_BAR}")


def main(joints: Sequence[int] = JOINTS) -> list[Figure]:
    """Measure and print; return the figures that have a bound."""
    head = (
        "joints",
        *PATHS,
        *(f"/ CasADi, {path}" for path in PATHS),
        "limits on / off",
        *(f"cc / zig, {path}" for path in PATHS),
    )
    rows, times, figures = [], [], []
    for n, rounds in measured(joints):
        figures += (here := [*figures_of(n, rounds)])
        times.append([median(costs[path] for costs in rounds) for path in PATHS])
        rows.append((n, *(f"{1e6 * t:.1f} µs" for t in times[-1]), *(f.measured for f in here)))
        for kind in ("free", "controlled") if n == 2 else ():
            name = f"MuJoCo, {kind}"
            cost = f"{1e6 * median(costs[name] for costs in rounds):.1f} µs"
            print(f"{name}: {cost}, {ratio(rounds, name, 'M cancels'):.1f} times the engine's")
    print_rows("A step of 10 ms in C", head, *rows)
    for path, taken in zip(PATHS, zip(*times)) if len(rows) > 1 else ():
        power = growth(joints, taken)
        print(f"  where the path is {path}, time grows by at most joints^{power:.2f}")
    with tempfile.TemporaryDirectory(prefix="twodof_") as name:
        folder = Path(name)
        cost = native_cost(panda(), folder)
        damped = 1e6 * median(cost() for _ in range(ROUNDS))
        print(f"  a Panda, 7 joints, its damping: {damped:.1f} µs")
        rows = [("", "right-hand side", "derivative", "ratio", "Jacobian", "ratio")]
        for arm, control in itertools.product((shipped_arm, ur5, panda), CONTROLS):
            side, *others = derivative_costs(arm(control), folder)
            ratios = [(f"{1e6 * cost:.3f} µs", f"{cost / side:.2f}") for cost in others]
            rows.append((f"{arm.__name__}, {control}", f"{1e6 * side:.3f} µs", *ratios[0], *ratios[1]))
            if control == "effort":
                bar = JACOBIAN_BARS[arm.__name__]
                what = f"{arm.__name__}: a Jacobian of the accelerations / the right-hand side"
                figures.append(Figure(what, ratios[1][1], f"<= {bar:g}"))
        print_rows("A directional derivative, and the Jacobian", *rows)
    worst = max(float(row[3]) for row in rows[1:])
    what = "a directional derivative / the right-hand side, at most"
    return [*figures, Figure(what, f"{worst:.2f}", f"<= {DERIVATIVE_BAR:g}")]


if __name__ == "__main__":
    print(machine())
    print_figures(main([*map(int, sys.argv[1:])] or JOINTS))
