"""The native engine by robot, path and compiler: what effort limits cost, and gcc beside zig.

    python benchmarks/engine.py [JOINTS ...]

Processor time of one step of 10 ms in C, of the default arm and of chains with so many joints (2,
7, 16 and 30 if none are given; thirty take a minute to compile). In each round all programs run
once, so that noise of the machine hits all alike; ratios are medians over the rounds. No limit is
reached.
"""

from __future__ import annotations

import importlib.util
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from run import Arm, chain, native_cost, processor, shipped_arm  # noqa: E402

ROUNDS = 15
JOINTS = (2, 7, 16, 30)
LIMITS_BAR, GCC_BAR = 1.25, 1.2


def by_own_compiler(arm: Arm, folder: Path) -> Callable[[], float]:
    """As native_cost, where ziglang is not installed."""
    found = importlib.util.find_spec
    with patch("importlib.util.find_spec", lambda name: None if name == "ziglang" else found(name)):
        return native_cost(arm, folder)


def programs(n: int, folder: Path) -> dict[str, Callable[[], float]]:
    """What is timed of one robot."""
    arm = shipped_arm() if n == 2 else chain(n)
    free = Arm(replace(arm.robot, effort=(1e6,) * n), arm.starts)

    def of(compiled: Callable[..., Any], **starts: Any) -> Callable[[], float]:
        return compiled(Arm(free.robot, {**free.starts, **starts}), folder)

    pushed = {"tau_ext": (1e-3,) * n}
    return {
        "M cancels": of(native_cost),
        "general": of(native_cost, **pushed),
        "limits on": of(native_cost, limit_effort=True),
        "M cancels, cc": of(by_own_compiler),
        "general, cc": of(by_own_compiler, **pushed),
    }


def main() -> None:
    """Measure and print."""
    print(f"{processor()}; processor time of a step of 10 ms, and ratios\n")
    print("joints  M cancels    general  limits on / off  cc / zig: M cancels  general")
    for n in map(int, sys.argv[1:] or JOINTS):
        with tempfile.TemporaryDirectory(prefix="twodof_") as folder:
            costs = programs(n, Path(folder))
            rounds = [{name: cost() for name, cost in costs.items()} for _ in range(ROUNDS)]

        def ratio(a: str, b: str, rounds: list[dict[str, float]] = rounds) -> float:
            return median(times[a] / times[b] for times in rounds)

        cancels, general = (1e6 * median(r[name] for r in rounds) for name in [*costs][:2])
        limits = ratio("limits on", "M cancels")
        plain, full = ratio("M cancels, cc", "M cancels"), ratio("general, cc", "general")
        print(
            f"{n:6} {cancels:8.1f} µs {general:7.1f} µs {limits:16.2f} {plain:20.2f} {full:8.2f}",
            flush=True,
        )
    print(f"\nwanted: limits on <= {LIMITS_BAR} of off, cc <= {GCC_BAR} of zig")


if __name__ == "__main__":
    main()
