"""Peak efforts and speeds of a run, and those that exceed the URDF's limits."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import NamedTuple

import numpy as np

from ..fmu import Fmu, Values
from ..plant.urdf import RobotError, read_urdf
from ..plant.variables import EXACT as EXACT

BLOCK = 4096  # samples that are compared at a time


class Limits(NamedTuple):
    """Effort (N·m, N) and velocity limits of an FMU's joints, infinite where there is none."""

    effort: tuple[float, ...]
    velocity: tuple[float, ...]


class Excess(NamedTuple):
    """A joint's peak effort or velocity, with the URDF's limit that it exceeds and their unit."""

    joint: str
    quantity: str
    peak: float
    limit: float
    unit: str


def limits_of(fmu: Fmu) -> Limits:
    """Return the limits in the FMU's URDF; a follower's velocity limit counts for its leader.

    Raises:
        FmuError: the URDF cannot be read.
    """
    text, names = fmu.urdf, fmu.joints
    try:
        joints = {} if text is None else read_urdf(text).joints
    except RobotError:
        joints = {}
    if not {*names} <= joints.keys():
        return Limits((inf,) * len(names), (inf,) * len(names))
    speeds = dict.fromkeys(joints, inf)
    for joint in joints.values():
        if joint.ratio:
            speeds[joint.leader] = min(speeds[joint.leader], joint.velocity / abs(joint.ratio))
    return Limits(tuple(joints[n].effort for n in names), tuple(speeds[n] for n in names))


class Peaks:
    """Largest magnitude of each output of a run, in constant memory."""

    def __init__(self, outputs: Sequence[str]) -> None:
        self._outputs, self._largest = outputs, np.zeros(len(outputs))
        self._rows, self._most = bytearray(), 8 * BLOCK * len(outputs)

    def add(self, row: Values) -> None:
        """Add the outputs at one sample."""
        self._rows += row
        if len(self._rows) >= self._most:
            self._compare()

    def _compare(self) -> None:
        rows = np.frombuffer(bytes(self._rows)).reshape(-1, len(self._largest))
        self._largest = np.abs(rows).max(axis=0, initial=0.0).clip(self._largest)
        self._rows.clear()

    def beyond(self, limits: Limits, fmu: Fmu) -> tuple[Excess, ...]:
        """Return the peaks that exceed a limit, the worst first."""
        self._compare()
        peaks = dict(zip(self._outputs, self._largest.tolist()))
        found = [
            Excess(joint, quantity, peaks[name], limit, fmu.variables[name].unit or "")
            for quantity, group, bounds in zip(limits._fields, ("tau", "v"), limits)
            for joint, name, limit in zip(fmu.joints, fmu.vector(group), bounds)
            if peaks[name] > limit * (1.0 + EXACT)
        ]
        return tuple(sorted(found, key=lambda excess: -excess.peak / excess.limit))
