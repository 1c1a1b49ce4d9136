"""What the panels of a run share: looks of tracks, ticks, and few points in place of many."""

from __future__ import annotations

from math import ceil
from typing import Any, NamedTuple

import numpy as np

from ..bag.outline import extremes
from .closed_form import Array
from .scales import SMALLEST_RANGE
from .track import number

# isort: split
from matplotlib.axis import Axis  # where it is missing, twodof.figure says so
from matplotlib.path import Path as Polyline
from matplotlib.ticker import FuncFormatter, MaxNLocator

STEPS = (1, 2, 2.5, 5, 10)  # of ticks
CHUNKS = 1000
"""Parts of a long line over time that each keep their extremes; panels are fewer pixels wide."""
MANY_CORNERS = 20_000  # of a path; SVG and PDF have some 20 bytes for each
POINTS = 72.0  # an inch
SIDE = 2.8  # inches, width of the workspace


class Look(NamedTuple):
    """What tells a track from the others."""

    label: str
    colour: str
    dashes: Any
    arm: float  # width of the arm at its end: arms that end in the same place are all seen

    @property
    def line(self) -> dict[str, Any]:
        """As matplotlib's lines have it."""
        return {"color": self.colour, "linestyle": self.dashes}


def set_ticks(axis: Axis, most: int) -> None:
    """Round numbers, at most so many steps between them."""
    axis.set_major_locator(MaxNLocator(most, steps=STEPS))
    axis.set_major_formatter(FuncFormatter(lambda value, _position: number(value)))


def outline(values: Array) -> Any:
    """Indices of the samples with which a line over time looks as it does with all of them.

    Of each of CHUNKS parts the first, last, smallest and largest.
    """
    n = len(values)
    if n <= 4 * CHUNKS:
        return slice(None)
    return extremes(np.arange(n) // ceil(n / CHUNKS), [values])


def drawable(points: Array) -> Any:
    """Indices of the points, × 2, of a path: all, as matplotlib merges what lies on a line.

    Where that leaves too many corners, as of noise, those with which both coordinates over time
    look the same.
    """
    size = max(float(np.ptp(points, axis=0).max()), SMALLEST_RANGE)
    corners = np.asarray(Polyline(points * (POINTS * SIDE / size)).cleaned(simplify=True).vertices)
    if len(corners) <= MANY_CORNERS:
        return slice(None)
    return np.union1d(outline(points[:, 0]), outline(points[:, 1]))
