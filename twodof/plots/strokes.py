"""Renderer-independent lines and markers, their colours, and the smallest visible sizes."""

from __future__ import annotations

from collections.abc import Iterable
from math import ceil
from typing import Any, NamedTuple

import numpy as np

from ..bag.downsampling import Indices, extremes
from ..export.closed_form import Array
from ..notebook import COLOURS as COLOURS

Style = dict[str, Any]  # keywords of a matplotlib artist
INK, GREY, PALE, HAIR = "#1f2933", "#5b6570", "#b4bcc4", "#e6e9ec"
ALARM = "#D55E00"
DASHES = ((), (5, 1.5), (7, 1.5, 1, 1.5), (1.5, 1))
"""Dash patterns: lengths of dashes and gaps, in line widths. Combined with the colours, whose number is coprime to
theirs, they distinguish 28 curves.
"""

SMALLEST_RANGE = 1e-3  # rad, m, rad/s, m/s: smaller motion is shown as rest
SMALLEST_ERROR = 1e-12  # m: smaller errors are rounding errors


class LineStyle(NamedTuple):
    """Style of a curve: a colour and one of DASHES."""

    label: str
    colour: str
    dashes: tuple[float, ...]


class Stroke(NamedTuple):
    """A line in a picture, or markers."""

    label: str
    track: int | None  # index of the track, or None
    # x, y: horizontal and vertical coordinates; one is empty for lines across the whole picture at the other's values
    x: Array
    y: Array
    colour: str
    width: float  # line width in points; 0: no line
    dashes: tuple[float, ...] = ()
    mark: str = ""  # marker at all points: "o" (not at the last point), "+", "v", "x", "." or ""
    depth: float = 4.0  # drawing order; higher strokes cover lower ones
    joint: str = ""  # joint of the track; "": the stroke belongs to the whole track
    kind: str = ""  # quantity of the values, for which a page shows numbers; "": none
    framed: bool = True  # whether the limits of the picture must include it

    @property
    def is_limit(self) -> bool:
        """True for a limit, and not for a curve with the same label."""
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


def line_styles(names: Iterable[str]) -> list[LineStyle]:
    """Return a style for each name."""
    return [LineStyle(name, COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)]) for i, name in enumerate(names)]


def downsampled(values: Array, most: int) -> Indices:
    """Return the indices of a limited number of samples that draw the same line (M4).

    Each part keeps its first, last, smallest and largest sample, and both ends of its steepest rise and fall: a jump
    remains a jump when the user zooms in. Parts are as short as the limit allows.
    """
    kept: Indices = np.arange(len(values))
    size = 1
    with np.errstate(all="ignore"):  # differences of infinities
        rise = np.diff(values)
    lines = [values, np.append(rise, np.nan), np.append(np.nan, rise)]
    while len(kept) > most:
        size = max(2 * size, ceil(2 * len(kept) / most))
        kept = extremes(np.arange(len(values)) // size, lines)
    return kept
