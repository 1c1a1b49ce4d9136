"""The native engine by robot, path and compiler: beside CasADi's C, with effort limits, by gcc.

    python benchmarks/engine.py [JOINTS ...]

Processor time of one step of 10 ms in C, of the default arm and of chains with so many joints (2,
7, 16 and 30 if none are given; thirty take minutes to compile). CasADi's code (generated.py) runs
in the same integrator, at the best of its builds; it does without ranks and payloads. In each round
all programs run once, so that noise of the machine hits all alike; ratios are medians over the
rounds. No limit is reached.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from generated import rivals  # noqa: E402
from steps import (  # noqa: E402
    Arm,
    Figure,
    by_own_compiler,
    chain,
    native_cost,
    processor,
    shipped_arm,
)

ROUNDS = 15
JOINTS = (2, 7, 16, 30)
PATHS = ("M cancels", "general")
CASADI_BAR, LIMITS_BAR, GCC_BAR = 1.0, 1.25, 1.2


def programs(n: int, folder: Path) -> dict[str, Callable[[], float]]:
    """What is timed of one robot; names of rivals end in how they were built."""
    arm = shipped_arm() if n == 2 else chain(n)
    free = Arm(replace(arm.robot, effort=(1e6,) * n), arm.starts)
    pushed = Arm(free.robot, {**free.starts, "tau_ext": (1e-3,) * n})
    limited = Arm(free.robot, {**free.starts, "limit_effort": True})
    return {
        "M cancels": native_cost(free, folder),
        "general": native_cost(pushed, folder),
        "limits on": native_cost(limited, folder),
        "M cancels, cc": by_own_compiler(free, folder),
        "general, cc": by_own_compiler(pushed, folder),
        **{f"M cancels: {name}": cost for name, cost in rivals(free, folder, False).items()},
        **{f"general: {name}": cost for name, cost in rivals(pushed, folder, True).items()},
    }


def best(path: str, rounds: list[dict[str, float]]) -> str:
    """The rival's fastest build, by its median."""
    names = [name for name in rounds[0] if name.startswith(f"{path}: ")]
    return min(names, key=lambda name: median(times[name] for times in rounds))


def main(joints: Sequence[int] = JOINTS) -> list[Figure]:
    """Measure and print; the figures of which something is wanted."""
    figures = []
    print(f"{processor()}; processor time of a step of 10 ms, and ratios\n")
    print("joints  M cancels    general  / CasADi  limits on / off        cc / zig")
    for n in joints:
        with tempfile.TemporaryDirectory(prefix="twodof_") as folder:
            costs = programs(n, Path(folder))
            rounds = [{name: cost() for name, cost in costs.items()} for _ in range(ROUNDS)]

        def ratio(a: str, b: str, rounds: list[dict[str, float]] = rounds) -> float:
            return median(times[a] / times[b] for times in rounds)

        rows = [best(path, rounds) for path in PATHS]
        taken = [f"{1e6 * median(r[path] for r in rounds):8.1f} µs" for path in PATHS]
        against = "".join(f"{ratio(path, row):5.2f}" for path, row in zip(PATHS, rows))
        gcc = "".join(f"{ratio(f'{path}, cc', path):8.2f}" for path in PATHS)
        limits = ratio("limits on", "M cancels")
        print(f"{n:6}{taken[0]}{taken[1]}{against}{limits:17.2f}{gcc}", flush=True)
        print("       CasADi's best builds: " + "; ".join(rows))
        ours = "engine by zig, flags as in its FMU"
        ratios = {
            f"{ours} / CasADi's C by the best of its builds, {row}": (path, row, CASADI_BAR)
            for path, row in zip(PATHS, rows)
        }
        ratios[f"{ours}, limits of effort on / off"] = ("limits on", "M cancels", LIMITS_BAR)
        ratios |= {f"the same by cc / {ours}, {p}": (f"{p}, cc", p, GCC_BAR) for p in PATHS}
        figures += [
            Figure(f"{n} joints: {what}", f"{ratio(a, b):.2f}", f"<= {bar:g}")
            for what, (a, b, bar) in ratios.items()
        ]
    print(
        f"\nwanted: <= {CASADI_BAR:g} of CasADi, limits on <= {LIMITS_BAR} of off,"
        f" cc <= {GCC_BAR} of zig"
    )
    return figures


if __name__ == "__main__":
    main([*map(int, sys.argv[1:])] or JOINTS)
