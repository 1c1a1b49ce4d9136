"""False alarms of the verdict: forty runs of ten robots to random reachable targets, run by hand.

    python tests/random_good_runs.py [SEED]

A run is good if it stays within 2 % of its initial errors in its last tenth, and within the URDF's limits of effort and
speed. Both are computed here from the samples. A good run must have no cause, in Python and in the page.
"""

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from failures import ROBOTS, fmu_of
from page_causes import page_causes
from scipy.spatial.transform import Rotation

import twodof
from twodof.simulation.setup import robot_of

CONTROLS = ("task", "joint", "pose", "joint")
LEGS = ("arm", "a1", "anymal", "so100", "solo")  # too few joints for a pose


def random_runs(robot: str, rng: np.random.Generator) -> Iterator[twodof.Experiment]:
    """Yield four runs from the start to a random near posture, under various controls and gains."""
    for k, control in enumerate(CONTROLS):
        control = "task" if control == "pose" and robot in LEGS else control
        fmu = twodof.load_fmu(fmu_of(robot, control))
        low, high, start = (
            np.array([fmu.start_values[name] for name in fmu.vector(group)], float)
            for group in ("q_min", "q_max", "q_start")
        )
        q = start + rng.uniform(-0.2, 0.2, len(start))
        q = np.clip(q, np.maximum(low, -50.0) + 0.02, np.minimum(high, 50.0) - 0.02)
        Kp = rng.uniform(40.0, 150.0)
        Kd = 2.0 * np.sqrt(Kp) * rng.uniform(0.8, 1.3)
        settings: dict[str, Any] = {"Kp": Kp, "Kd": Kd, "max_step": 0.01, "limit_effort": bool(rng.integers(2))}
        settings |= {"control_period": 0.002} if k == 3 else {}
        if control == "joint":
            settings["q_des"] = q
        else:
            end = next(twodof.samples(fmu, settings={"q_start": q}))
            settings["x_des"] = end.x
            settings |= {"quat_des": end.quat, "Kp_rot": Kp, "Kd_rot": Kd} if control == "pose" else {}
        yield twodof.experiment(fmu, settings=settings, stop_time=3.0)


def is_good(run: twodof.Experiment, samples: list[twodof.Sample]) -> bool:
    """Return whether all errors settle within the URDF's limits."""
    values = run.start_values
    wanted = {group: np.array([values[name] for name in run.fmu.vector(f"{group}_des")]) for group in ("q", "x")}
    errors = [
        np.linalg.norm(np.array([getattr(s, group) for s in samples]) - target, axis=1)
        for group, target in wanted.items()
        if target.size
    ]
    if names := run.fmu.vector("quat_des"):
        target = Rotation.from_quat([values[name] for name in names])
        errors.append((Rotation.from_quat([s.quat for s in samples]).inv() * target).magnitude())
    robot = robot_of(run.fmu.urdf)
    assert robot is not None
    joints = [robot.joints[name] for name in run.fmu.joints]
    bounds = [np.array(each) for each in zip(*((joint.effort, joint.velocity) for joint in joints))]
    peaks = [np.abs([getattr(s, group) for s in samples]).max(axis=0) for group in ("tau", "v")]
    settled = all(error[-30:].max() <= 0.02 * error[0] for error in errors)
    return settled and all((peak <= bound).all() for peak, bound in zip(peaks, bounds))


def main(seed: int) -> None:
    """Print the number of good runs, and each of them that has a cause."""
    rng, good, alarms = np.random.default_rng(seed), 0, 0
    for robot in ROBOTS:
        for run in random_runs(robot, rng):
            samples = [*twodof.samples(run)]
            if not is_good(run, samples):
                continue
            verdict, page = twodof.verdict(samples, run), page_causes(run, samples)
            good += 1
            if verdict.causes or page or verdict.outcome != "reached":
                alarms += 1
                print(robot, run.given, *verdict.lines, page, sep="\n  ")
    print(f"seed {seed}: {good} of {len(CONTROLS) * len(ROBOTS)} runs are good; {alarms} of them have a cause")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
