"""Errors of one output of a run from its target, in constant memory."""

from collections.abc import Mapping
from math import inf, nan

import numpy as np

from ..bounds import MAX_VALUE
from .cause import FLOOR
from .setup import Array

BAND = 0.02  # band of the settling time, as a fraction of the initial error
SMALLEST_MOVE = 1e-9  # m: a smaller move counts as a start at the target, without a settling time
HELD = 1e-3  # m, rad: band of the settling time for an output that starts at its target


class Aim:
    """Errors of one output from its target: position, orientation or joints."""

    def __init__(self) -> None:
        self.squares = 0.0
        self.began, self.outside, self.strayed, self.first, self.last, self.past = 0.0, -inf, -inf, nan, nan, 0.0
        self.way: Array = np.empty(0)

    def begin(self, t: float, e: Array, size: float) -> None:
        """Start a move to a new target, from an error vector (empty for an angle) and its magnitude."""
        self.began, self.outside, self.strayed = t, t, t
        self.first, self.last, self.past, self.way = size, size, 0.0, e

    def add(self, t: Array, e: Array, size: Array) -> None:
        """Add N samples of the move."""
        if size.max() > BAND * self.first:
            self.outside = t[np.flatnonzero(size > BAND * self.first)[-1]]
        if size.max() > HELD:
            self.strayed = t[np.flatnonzero(size > HELD)[-1]]
        if self.way.size and SMALLEST_MOVE <= self.first < inf:
            self.past = max(self.past, -float((e @ self.way).min()) / self.first**2)
        self.last = float(size[-1])


def moves(aims: Mapping[str, Aim]) -> set[str]:
    """Return the outputs that move to their targets: the others start there, or much nearer than one that moves."""
    firsts = {name: aim.first for name, aim in aims.items()}
    least = FLOOR if max(firsts.values(), default=0.0) >= FLOOR else SMALLEST_MOVE
    return {name for name, first in firsts.items() if first >= least}


def unsettled(aims: Mapping[str, Aim]) -> set[str]:
    """Return the outputs that end farther from their targets than settled ones do."""
    moved = moves(aims)
    return {name for name, aim in aims.items() if aim.last > (BAND * aim.first if name in moved else HELD)}


def errors(name: str, now: Array, target: Array) -> tuple[Array, Array]:
    """Return the error vectors of N samples (empty for an angle) and their magnitudes."""
    if name == "quat":
        return np.empty((len(now), 0)), angles(now, target)
    e = target - now
    with np.errstate(over="ignore"):  # infinite from errors of 1e154 on
        return e, np.sqrt((e * e).sum(axis=1))


def angles(quat: Array, target: Array) -> Array:
    """Return the angle of each unit quaternion from a target quaternion of any length but 0, rad."""
    target = target / np.linalg.norm(target, axis=-1, keepdims=True)
    apart = [np.linalg.norm(quat - side, axis=1) for side in (target, -target)]
    return np.asarray(4.0 * np.arcsin(np.minimum(1.0, 0.5 * np.minimum(*apart))))


def judgeable(rows: Array, targets: Mapping[str, Array]) -> int:
    """Return the number of samples before the first one with a value that is not finite or beyond MAX_VALUE."""
    tables = [rows, *targets.values()]
    if all(np.abs(table).max(initial=0.0) <= MAX_VALUE for table in tables):
        return len(rows)
    sound = np.logical_and.reduce(
        [np.broadcast_to((np.abs(table) <= MAX_VALUE).all(axis=1), len(rows)) for table in tables]
    )
    return len(rows) if sound.all() else int(sound.argmin())
