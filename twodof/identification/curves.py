"""Efforts and positions along recordings, as measured and as a model gives them before and after a fit."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from ..plant.robot import Robot
from .inertials import model_with
from .parameters import Dynamics
from .prediction import Prediction, deviation, predict
from .stretches import Array, Stretch

Table = Sequence[Sequence[str]]  # rows of texts; the first is the heading


class Curve(NamedTuple):
    """A stretch of a recording with N samples of n joints."""

    bag: int  # index of the recording
    t: Array  # time since the first sample of the bag, s, N
    effort: Array  # recorded efforts at the times at which they act, N × n
    # efforts of the model before and after the fit, along the measured motion; NaN where a joint may rest, because its
    # friction is not known there. 2 × N × n
    modelled: Array
    measured: Array  # measured positions of a held-out stretch, N × n; empty for a fitted one
    simulated: Array  # simulated positions before and after the fit, 2 × N × n; empty for a fitted stretch


class Comparison(NamedTuple):
    """A model before and after a fit, compared with recordings."""

    curves: tuple[Curve, ...]  # fitted, then held-out stretches
    # root mean square of simulated minus measured positions before and after the fit, rad or m, 2 × n; empty if no
    # stretch is held out
    deviations: tuple[tuple[float, ...], tuple[float, ...]]


def compare(
    robot: Robot,
    models: Sequence[tuple[Dynamics, float]],
    fitted: Sequence[Stretch],
    held: Sequence[Stretch],
    finished: Callable[[], None],
) -> Comparison:
    """Compare two models with all stretches.

    Args:
        models: values of the parameters and delay of the efforts, s, before and after the fit.
        fitted, held: stretches that were fitted and held out.
        finished: called after each simulation of a held-out stretch, two for each.
    """
    predictions: list[list[Prediction]] = [[], []]
    for each, (values, delay) in zip(predictions, models):
        for stretch in held:
            each.append(predict(robot, values, delay, stretch))
            finished()
    curves = [_curve(robot, models, stretch) for stretch in (*fitted, *held)]
    for k, (stretch, pair) in enumerate(zip(held, zip(*predictions)), start=len(fitted)):
        simulated = np.array([each.q for each in pair])
        simulated[:, pair[0].begins] = np.nan  # each window begins at the measured position
        curves[k] = curves[k]._replace(measured=stretch.measured, simulated=simulated)
    before, after = (tuple(deviation(held, each).tolist()) if held else () for each in predictions)
    return Comparison(tuple(curves), (before, after))


def _curve(robot: Robot, models: Sequence[tuple[Dynamics, float]], stretch: Stretch) -> Curve:
    at = stretch.t - models[1][1]
    effort = np.stack([np.interp(at, stretch.t, column) for column in stretch.tau.T], axis=1)
    modelled = np.array([np.where(stretch.moving, efforts(robot, values, stretch), np.nan) for values, _ in models])
    return Curve(stretch.bag, stretch.t, effort, modelled, np.empty((0, 0)), np.empty((0, 0, 0)))


def efforts(robot: Robot, values: Dynamics, stretch: Stretch) -> Array:
    """Return the efforts, as recorded, N × n, that the inverse dynamics needs for a measured motion."""
    model = model_with(robot.model, values.inertial, values.gravity)
    C = np.eye(len(robot.joints)) if robot.coupling is None else robot.coupling
    data = model.createData()
    states = zip((stretch.q + values.offset) @ C.T + robot.offset, stretch.v @ C.T, stretch.a @ C.T)
    links = np.array([pin.rnea(model, data, *state) for state in states]) @ C
    own = values.friction * np.sign(stretch.v) + values.damping * stretch.v + values.armature * stretch.a + values.bias
    return np.asarray((links + own) / values.gain)
