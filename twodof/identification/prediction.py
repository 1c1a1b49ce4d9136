"""Simulate the plant under recorded efforts from measured states, for comparison with the measured motion."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..plant.plant import DiscardError, Plant
from ..plant.robot import Robot
from ..plant.urdf import UNBOUNDED
from ..plant.variables import Starts, variable_table
from .inertials import model_with
from .parameters import Dynamics
from .stretches import Array, Stretch

WINDOW = 1.0  # s of simulation from one measured state
RTOL, ATOL = 1e-5, 1e-7


class Prediction(NamedTuple):
    """A stretch that was simulated in windows."""

    q: Array  # simulated positions as the encoders would measure them, N × n; NaN where the simulation failed
    begins: tuple[int, ...]  # indices of the samples at which windows begin


def plant_of(robot: Robot, values: Dynamics, step: float) -> Plant:
    """Return the bare plant of a robot with given values of its parameters."""
    n = len(robot.joints)
    starts: Starts = {
        "q_start": (0.0,) * n,
        "x_des": (0.0,) * len(robot.axes),
        **{name: tuple(getattr(values, name).tolist()) for name in ("friction", "damping", "armature", "gravity")},
        "q_min": (-UNBOUNDED,) * n,
        "q_max": (UNBOUNDED,) * n,
        "rtol": RTOL,
        "atol": ATOL,
        "max_step": step,
    }
    robot = replace(robot, model=model_with(robot.model, values.inertial, values.gravity))
    return Plant(robot, variable_table(robot, starts, "effort"), "effort")


def predict(robot: Robot, values: Dynamics, delay: float, stretch: Stretch) -> Prediction:
    """Simulate a stretch in windows, each from the measured state at its start; ``delay`` is that of the efforts, s."""
    plant, h = plant_of(robot, values, stretch.step), stretch.step
    edges = stretch.t[:, None] + np.array([0.0, 0.5 * h]) - delay  # beginning and middle of each step
    effort = (
        np.stack([np.interp(edges[:, 1], stretch.t, column) for column in stretch.tau.T], 1) * values.gain - values.bias
    )
    q = np.full_like(stretch.q, np.nan)
    begins = range(0, len(q) - 1, max(1, round(WINDOW / h)))
    for begin, end in zip(begins, [*begins[1:], len(q)]):
        plant.q = (stretch.q[begin] + values.offset).tolist()
        plant.v = stretch.v[begin].tolist()
        q[begin] = stretch.q[begin]
        for k in range(begin, end - 1):
            plant.tau_cmd = effort[k].tolist()
            try:
                plant.step(h)
            except DiscardError:
                break
            q[k + 1] = np.array(plant.q) - values.offset
    return Prediction(q, tuple(begins))


def deviation(stretches: Sequence[Stretch], predictions: Sequence[Prediction]) -> Array:
    """Return the root mean square of simulated minus measured positions of each joint, rad or m, n."""
    errors = np.concatenate([p.q - s.measured for s, p in zip(stretches, predictions)])
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))
