"""Renderer-independent lines and markers, their colours, and the smallest visible sizes."""

from __future__ import annotations

from collections.abc import Iterable
from math import ceil
from typing import Any, NamedTuple

import numpy as np

from ..bag.downsampling import Indices, extremes
from ..notebook import COLOURS as COLOURS
from .closed_form import Array

Style = dict[str, Any]
"""Keywords of a matplotlib artist."""
INK, GREY, PALE, HAIR = "#1f2933", "#5b6570", "#b4bcc4", "#e6e9ec"
ALARM = "#D55E00"
DASHES = ((), (5, 1.5), (7, 1.5, 1, 1.5), (1.5, 1))
"""On and off, in widths of the line. With the colours, whose number this does not divide, 28
curves look different."""

SMALLEST_RANGE = 1e-3  # rad, m, rad/s, m/s: what moves less is shown at rest
SMALLEST_ERROR = 1e-12  # m: what is below is rounding


class Look(NamedTuple):
    """Style of a curve: a colour and one of DASHES."""

    label: str
    colour: str
    dashes: tuple[float, ...]


class Stroke(NamedTuple):
    """A line in a picture, or markers.

    Attributes:
        track: whose, or None.
        x, y: across and up; empty for lines across the whole picture at the other's values.
        width: of the line in points; 0: none.
        mark: "o" at all points but the last, "+", "v", "x" or "." at all, or "".
        depth: what is higher is drawn over what is lower.
        joint: whose of the track; "": the track's own.
        kind: the quantity whose values it has, of those that a page tells; "": of none.
        framed: whether the picture must show it.
    """

    label: str
    track: int | None
    x: Array
    y: Array
    colour: str
    width: float
    dashes: tuple[float, ...] = ()
    mark: str = ""
    depth: float = 4.0
    joint: str = ""
    kind: str = ""
    framed: bool = True

    @property
    def is_limit(self) -> bool:
        """True for a limit, and not for a curve with that label."""
        return self.label == "limit" and not self.kind

    @property
    def is_whole(self) -> bool:
        """True for lines across the whole picture."""
        return len(self.x) != len(self.y)

    def thinned(self, most: int) -> Stroke:
        """Return the line downsampled to a number of points."""
        if len(self.x) <= most:
            return self
        kept = downsampled(self.y, most)
        return self._replace(x=self.x[kept], y=self.y[kept])


def looks(names: Iterable[str]) -> list[Look]:
    """Return a style for each name."""
    return [Look(name, COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)]) for i, name in enumerate(names)]


def downsampled(values: Array, most: int) -> Indices:
    """Return indices of a limited number of samples that draw the same line (M4).

    From near by too, so that a jump is one: of parts as short as may be the first, last, smallest
    and largest, and both sides of the greatest rise and fall.
    """
    kept: Indices = np.arange(len(values))
    size = 1
    with np.errstate(all="ignore"):  # between infinities
        rise = np.diff(values)
    lines = [values, np.append(rise, np.nan), np.append(np.nan, rise)]
    while len(kept) > most:
        size = max(2 * size, ceil(2 * len(kept) / most))
        kept = extremes(np.arange(len(values)) // size, lines)
    return kept
