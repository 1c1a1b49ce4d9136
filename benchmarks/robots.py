"""Every URDF of example-robot-data as it is: built, run for 1 s and logged in both flavours.

    python benchmarks/robots.py             all, about 20 minutes
    python benchmarks/robots.py panda ur5   those whose path has one of these words

Prints a table in Markdown. A robot with several last links is built with the first of those that
most joints move. "off" is how far the bare plant, thrown at 1 rad/s or m/s a joint for 0.1 s
without limits at rtol 1e-9, ends from SciPy's DOP853 (Radau where joints are damped) on
Pinocchio's dynamics, rad or m. Times are processor time for a step of 10 ms of the default
control at rest on its target, its message in the bag included. Ends with status 1 if a URDF is
refused for none of the reasons in REFUSED.
"""

from __future__ import annotations

import logging
import re
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import twodof
from twodof.export.urdf_source import last_links
from twodof.plant.robot import Robot, load_robot
from twodof.plant.urdf import read_urdf

REFUSED = (
    "of type 'floating'", "of type 'planar'", "of type 'spherical'", "has no moving joint",
    "no mass or no inertia about its axis", "which does not exist", "not physical",
    "has no links",
)  # fmt: skip
FLIGHT = 0.1  # s
PATIENCE = 60.0  # s of processor time, after which a run of a stiff robot is cut short


class Clock(twodof.Sink):
    """Processor time at the first sample and at the latest, s."""

    first = last = 0.0

    def write(self, sample: twodof.Sample) -> None:
        """Look at it."""
        self.last = time.process_time()
        self.first = self.first or self.last

    def late(self) -> bool:
        """Whether it has taken too long."""
        return self.last > self.first + PATIENCE


def robots_folder() -> Path:
    """Where example-robot-data keeps its robots."""
    for parent in Path(pin.__file__).parents:
        folder = parent / "share" / "example-robot-data" / "robots"
        if folder.is_dir():
            return folder
    raise SystemExit("install example-robot-data")


def frame_of(text: str) -> str:
    """The last link that most joints move, the first of several; the root where none moves."""
    urdf = read_urdf(text)
    ends = last_links(urdf) or [urdf.root]
    return max(ends, key=lambda link: sum(joint.moves for joint in urdf.chain(link)))


def apart(fmu: Path, robot: Robot) -> float:
    """How far the bare plant's flight ends from another solver's on Pinocchio's dynamics."""
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

    settings = {"rtol": 1e-9, "atol": 1e-12, "q_min": -1e9, "q_max": 1e9}
    settings["v_start"] = 1.0  # at rest some are in equilibrium, and nothing would be compared
    samples = list(twodof.samples(fmu, stop_time=FLIGHT, settings=settings))
    y0 = [*samples[0].q, *samples[0].v]
    method = "Radau" if damping.any() else "DOP853"
    end = solve_ivp(motion, (0.0, FLIGHT), y0, method, rtol=1e-10, atol=1e-12).y[:n, -1]
    return float(np.abs(end - samples[-1].q).max())


def measure(urdf: Path, folder: Path) -> list[str]:
    """A row of the table: joints, frame, how far off, µs a step of either flavour."""
    text = urdf.read_text("utf-8")
    frame = frame_of(text)
    times = []
    for native in (False, True):
        options = twodof.FmuOptions(urdf=urdf, frame=frame, native=native, live_documentation=False)
        fmu = twodof.build_fmu(folder / f"robot{native:d}.fmu", options)
        clock, bag = Clock(), twodof.Bag(folder / "bag", overwrite=True)
        summary = twodof.simulate(fmu, bag, clock, stop_time=1.0, stop=clock.late)
        steps = summary.last.k
        short = "" if steps == 100 else f" ({steps} of 100 steps)"
        times.append(f"{1e6 * (clock.last - clock.first) / steps:.0f}{short}")
    options = twodof.FmuOptions(urdf=urdf, frame=frame, native=True, control="effort", meshes=False)
    robot = load_robot(text, frame, "xyz")
    off = apart(twodof.build_fmu(folder / "bare.fmu", options), robot)
    return [str(len(robot.joints)), frame, f"{off:.0e}", *times]


def main() -> int:
    """Print the table; 1 where a URDF fails that should not."""
    logging.disable(logging.WARNING)
    words, wrong, root = sys.argv[1:], 0, robots_folder()
    every = [
        p for p in sorted(root.rglob("*.urdf")) if not words or any(w in str(p) for w in words)
    ]
    print("| URDF | joints | frame | off | Python, µs a step | native |\n| --- |" + " --- |" * 5)
    with tempfile.TemporaryDirectory() as folder:
        for urdf in every:
            name = str(urdf.relative_to(root))
            try:
                row = measure(urdf, Path(folder))
            except (twodof.TwoDofError, ValueError) as error:
                reason = re.sub(r"\s+", " ", str(error)).replace(str(root) + "/", "")
                wrong += not any(known in reason for known in REFUSED)
                row = ["", f"refused: {reason[:160]}", "", "", ""]
            print(f"| {name} | " + " | ".join(row) + " |", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
