"""Many random targets, most of them out of reach: no step may fail, hang or leave the limits.

    python benchmarks/targets.py              2,000 targets, about 8 minutes
    python benchmarks/targets.py 100          fewer
    python benchmarks/targets.py --only 17    target 17 again, step by step where it is slow

Each target lies in a box of 1 m around the shipped arm, whose reach is 0.3 m; each run starts at
rest at random angles within the limits and takes 200 steps of 10 ms. Run k of a seed is the same
whatever the count. Times are processor time, so that other programs do not matter. Ends with
status 1 if anything went wrong.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import isfinite, pi
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from twodof.plant.plant import Plant  # noqa: E402
from twodof.plant.robot import load_robot  # noqa: E402
from twodof.plant.variables import variable_table  # noqa: E402

STEP, STEPS = 0.01, 200  # s; 2 s
HALF_BOX = 0.5  # m
SLOW = 0.5  # s: a step that takes longer counts as wrong
HANGING = 5.0  # s after which a step is ended
NOTABLE = 0.02  # s: steps that take longer are printed by --only
ARM = {"q_start": (0.5, 0.35), "x_des": (0.2, 0.05), "gravity": (0.0, -9.81, 0.0)}


@dataclass
class Findings:
    """What went wrong, one line each, and the extremes with the run and step they come from."""

    failures: list[str] = field(default_factory=list)
    not_finite: list[str] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)
    slow: list[str] = field(default_factory=list)
    unreachable: int = 0
    slowest: tuple[float, str] = (0.0, "")
    fastest: tuple[float, str] = (0.0, "")

    def add(self, kind: list[str], line: str) -> None:
        kind.append(line)
        print(f"WRONG {line}", flush=True)

    def wrong(self) -> int:
        return sum(map(len, (self.failures, self.not_finite, self.outside, self.slow)))


class HangingError(Exception):
    """Raised inside a step that takes too long."""


@contextmanager
def ended_after(seconds: float) -> Iterator[None]:
    """Raise HangingError in a block that takes longer."""

    def end(_signal: int, _frame: object) -> None:
        raise HangingError

    before = signal.signal(signal.SIGVTALRM, end)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("count", nargs="?", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, metavar="K", help="one target, with its slow steps")
    options = parser.parse_args()
    plant = shipped_plant()
    chosen = range(options.count) if options.only is None else [options.only]
    findings = Findings()
    begin = reported = time.perf_counter()
    for done, k in enumerate(chosen, start=1):
        run_target(plant, options.seed, k, findings, verbose=options.only is not None)
        now = time.perf_counter()
        if now - reported > 10.0 or done == len(chosen):
            reported = now
            print(
                f"{done:5d} of {len(chosen)} targets, {now - begin:4.0f} s,"
                f" slowest step {1e3 * findings.slowest[0]:.0f} ms,"
                f" {findings.wrong()} wrong",
                flush=True,
            )
    print_summary(findings, len(chosen), time.perf_counter() - begin)
    return 1 if findings.wrong() else 0


def shipped_plant() -> Plant:
    robot = load_robot((ROOT / "urdf" / "2dof.urdf").read_text("utf-8"), "EndEffector", "xy")
    return Plant(robot, variable_table(robot, ARM))


def run_target(plant: Plant, seed: int, k: int, findings: Findings, *, verbose: bool) -> None:
    """One target; everything notable goes into the findings."""
    rng = np.random.default_rng([seed, k])
    low, high = np.array(plant.robot.q_min), np.array(plant.robot.q_max)
    plant.q_start = rng.uniform(low, high).tolist()
    plant.x_des = rng.uniform(-HALF_BOX, HALF_BOX, 2).tolist()
    plant.initialise()
    findings.unreachable += np.hypot(*plant.x_des) > 0.3
    for step in range(STEPS):
        q, v = plant.q, plant.v
        where = (
            f"seed {seed}, target {k}, step {step}:"
            f" q = {q}, v = {v}, x_des = {plant.x_des}, q_start = {plant.q_start}"
        )
        begin = time.thread_time()
        try:
            with ended_after(HANGING):
                plant.step(STEP)
        except HangingError:
            findings.add(findings.slow, f"{where}: ended after {HANGING:g} s")
            return
        except Exception as error:  # any is a finding
            findings.add(findings.failures, f"{where}: {error!r}")
            return
        taken = time.thread_time() - begin
        findings.slowest = max(findings.slowest, (taken, where))
        findings.fastest = max(findings.fastest, (max(map(abs, plant.v)), where))
        if verbose and taken > NOTABLE:
            print(f"{1e3 * taken:6.0f} ms  {where}")
        if taken > SLOW:
            findings.add(findings.slow, f"{where}: {taken:.3f} s")
        if not all(map(isfinite, [*plant.q, *plant.v, *plant.x, *plant.tau])):
            findings.add(findings.not_finite, where)
            return
        if not all(a <= x <= b for a, x, b in zip(low, plant.q, high, strict=True)):
            findings.add(findings.outside, f"{where}: q = {plant.q}")


def print_summary(findings: Findings, count: int, wall: float) -> None:
    print(f"\n{count} random targets, {count * STEPS} steps of {1e3 * STEP:g} ms, {wall:.0f} s")
    for label, lines in (
        ("failures", findings.failures),
        ("values that are not finite", findings.not_finite),
        ("positions outside the limits", findings.outside),
        (f"steps over {SLOW:g} s", findings.slow),
    ):
        print(f"  {label:31} {len(lines)}")
    print(f"  targets out of reach            {findings.unreachable}")
    slowest, where = findings.slowest
    print(f"  slowest step                    {1e3 * slowest:.1f} ms")
    print(f"    {where}")
    speed, where = findings.fastest
    print(f"  largest joint speed             {speed:.4g} rad/s ({speed / (2 * pi):.3g} turns/s)")
    print(f"    {where}")


if __name__ == "__main__":
    sys.exit(main())
