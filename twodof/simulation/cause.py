"""A cause of a run's failure, and the kinds of causes."""

from typing import NamedTuple

import numpy as np

from .setup import Array

KINDS = {
    "diverged": "a value that is not finite",
    "degrees": "a value in degrees instead of radians",
    "reach": "the target is out of reach",
    "gain": "a gain of 0, or gains far from the usual ones",
    "feedforward": "a target that rests, with a target velocity or acceleration",
    "unstable": "a sampled loop that is unstable or close to it",
    "sampling": "an oscillation as fast as the steps of controller or communication",
    "limit": "a joint at its position limit",
    "friction": "a joint that sticks",
    "saturation": "a motor at its effort limit",
    "load": "a load that the controller does not know",
    "damping": "too little damping",
    "singularity": "a singular pose",
    "time": "gains that are too slow for the duration",
    "drag": "damping of the joints that the controller does not know",
    "effort": "an effort beyond the URDF's limit",
    "velocity": "a speed beyond the URDF's limit",
}
"""Kinds of causes in their order; a cause may lead to those after it."""
EFFORT_UNITS = {"rad": "N·m", "m": "N"}  # by the joint's unit
FLOOR = 1e-4  # m, rad: a smaller error is the integrator's
SMALL = 0.02  # part of an error below which a cause does not count
MOTION = ("effort", "velocity")  # kinds that show what the motion needs, and do not cause it
FOLLOWING = ("limit", "saturation", "singularity")  # kinds that follow from a target out of reach or an unstable loop
MOVING = ("unstable", "sampling", "damping", "time")  # kinds of errors that still move
ROUNDING = 5e-10  # a smaller element of a printed vector is 0
MANY_CHANGES = 12  # changes of a target beyond which it counts as moving


class Cause(NamedTuple):
    """A cause in words, and its kind, a key of KINDS.

    Attributes:
        share: share of the samples or of a limit, by which causes of a kind are ranked; 0 without one.
        joint, subject: joint, and input or parameter, concerned; or "".
        time: time at which it was first seen, s since the first sample; None if it holds for the whole run.
        point: nearest reachable position in the root frame, m; () for other kinds.
        noted: whether it is a consequence of another cause or of the motion.
        part: part of the error late in the run that this cause has, as in ``balance``; None if it is unknown.
        tried: errors at the end of a repeated run without the cause, in words; "" without one.
        removes: part of the error that was removed in it; None without one.
    """

    kind: str
    text: str
    share: float = 0.0
    joint: str = ""
    time: float | None = None
    point: tuple[float, ...] = ()
    noted: bool = False
    subject: str = ""
    part: float | None = None
    tried: str = ""
    removes: float | None = None


def point_text(values: Array) -> str:
    """Return a vector as text, without rounding errors."""
    return f"({', '.join(f'{value:.4g}' for value in np.where(np.abs(values) < ROUNDING, 0.0, values))})"
