"""The arm in its workspace: how it stands, the end effector's path, targets, what it can reach.

What is drawn, whoever draws it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from .closed_form import Array
from .panels import Look, outline
from .scales import GREY, INK, PALE, SMALLEST_RANGE
from .track import Track

# isort: split
from matplotlib.path import Path as Polyline  # where it is missing, twodof.figure says so

MANY_TARGETS = 12
MANY_CORNERS = 20_000  # of a path; SVG and PDF have some 20 bytes for each
POINTS = 72.0  # an inch
SIDE = 2.8  # inches, width of the workspace


class Stroke(NamedTuple):
    """A line in a view, or marks.

    Attributes:
        label: what it is.
        track: whose, or None.
        points: × 2, m; not a number where the other coordinate alone is meant, along a whole line.
        colour: as in HTML.
        width: of the line in points; 0: none.
        dashes: as in ``panels.DASHES``.
        mark: "o" at all points but the last, "+" at all, or "".
        depth: what is higher is drawn over what is lower.
        framed: whether the view must show it.
    """

    label: str
    track: int | None
    points: Array
    colour: str
    width: float
    dashes: tuple[float, ...] = ()
    mark: str = ""
    depth: float = 4.0
    framed: bool = True


class View(NamedTuple):
    """A projection along one of the root's axes.

    Attributes:
        axes: letters of the axes across and up.
        strokes: in the order of their making.
        low, high: corners of what must be shown, m.
    """

    axes: str
    strokes: tuple[Stroke, ...]
    low: Array
    high: Array

    def box(self, aspect: float) -> tuple[Array, Array]:
        """Low and high corners of a frame, height : width as given, with room at its edges."""
        size = self.high - self.low
        half = max(1.15 * float(np.max(size / (1.0, aspect))) / 2, SMALLEST_RANGE)
        middle, reach = (self.low + self.high) / 2, np.array([half, half * aspect])
        return middle - reach, middle + reach


def workspace_title(tracks: Sequence[Track]) -> str:
    """Whose path, in what."""
    told = dict.fromkeys(f"{t.motion.frame} in {t.motion.root}" for t in tracks if t.motion)
    return f"Path of {', '.join(told)}"


def views(tracks: Sequence[Track], looks: Sequence[Look]) -> list[View]:
    """One where all lies in a plane, else from above and from the side; none without a robot."""
    return [_view(plane, tracks, looks) for plane in _planes(tracks)]


def _planes(tracks: Sequence[Track]) -> list[tuple[int, int]]:
    """Axes (0, 1, 2 for x, y, z) of each view."""
    points = [p for t in tracks if t.motion for p in (t.motion.path, t.motion.start, t.motion.end)]
    if not points:
        return []
    every = np.concatenate(points)
    extent = np.nanmax(every, axis=0) - np.nanmin(every, axis=0)
    if (extent <= 1e-6 * extent.max()).any():
        first, second = sorted(np.argsort(extent, kind="stable")[1:].tolist())
        return [(first, second)]
    return [(0, 1), (int(extent[1] > extent[0]), 2)]


def _view(plane: tuple[int, int], tracks: Sequence[Track], looks: Sequence[Look]) -> View:
    columns = list(plane)
    strokes = [
        *_arms(columns, tracks, looks),
        *_paths(columns, tracks, looks),
        *_circles(plane, tracks),
    ]
    framed = np.concatenate([stroke.points for stroke in strokes if stroke.framed])
    low, high = np.nanmin(framed, axis=0), np.nanmax(framed, axis=0)
    return View("".join("xyz"[axis] for axis in plane), tuple(strokes), low, high)


def _arms(columns: list[int], tracks: Sequence[Track], looks: Sequence[Look]) -> Iterator[Stroke]:
    """At the start, once where several start alike, and at the end.

    Those at the end are ever thinner: arms that end in the same place are all seen.
    """
    starts: list[Array] = []
    alone = len(tracks) == 1
    for i, (track, look) in enumerate(zip(tracks, looks)):
        if track.motion is None:
            continue
        start, end = track.motion.start, track.motion.end
        if not any(np.array_equal(start, other) for other in starts):
            starts.append(start)
            yield Stroke(
                "arm at the start", i if alone else None, start[:, columns], PALE,
                3.5, mark="o", depth=2.5,
            )  # fmt: skip
        width = 3.5 if alone else 5.0 - 3.5 * i / (len(tracks) - 1)
        colour = GREY if alone else look.colour
        yield Stroke("arm at the end", i, end[:, columns], colour, width, mark="o", depth=3.0)


def _paths(columns: list[int], tracks: Sequence[Track], looks: Sequence[Look]) -> Iterator[Stroke]:
    for i, (track, look) in enumerate(zip(tracks, looks)):
        if track.motion is None:
            continue
        path = track.motion.path[:, columns]
        yield Stroke("path", i, path[_drawable(path)], look.colour, 1.4, look.dashes)
        if track.task:
            yield _target(columns, i, track)


def _target(columns: list[int], i: int, track: Track) -> Stroke:
    """Targets in the order in which they held: marks, or where there are many a line."""
    assert track.task is not None
    target = np.full((len(track.t), 3), np.nan)
    target[:, ["xyz".index(axis) for axis in track.task.axes]] = track.task.target
    changed = np.r_[True, (track.task.target[1:] != track.task.target[:-1]).any(axis=1)]
    distinct = target[changed][:, columns]
    if not np.isfinite(distinct[0]).all():  # a line where the other axis is not controlled
        return Stroke("target", i, distinct[-MANY_TARGETS:], INK, 0.8, depth=5.0)
    if len(distinct) > MANY_TARGETS:
        return Stroke("target", i, distinct[_drawable(distinct)], INK, 0.8, depth=5.0)
    return Stroke("target", i, distinct, INK, 0.0, mark="+", depth=5.0)


def _circles(plane: tuple[int, int], tracks: Sequence[Track]) -> list[Stroke]:
    """Each different circle of reach that lies in the plane."""
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    found: dict[tuple[float, ...], Stroke] = {}
    for track in tracks:
        reach = track.motion.reach if track.motion else None
        if reach and reach.normal not in plane:
            centre = reach.centre[list(plane)]
            key = tuple(np.round([*centre, reach.radius], 9))
            found[key] = Stroke(
                f"reach {reach.radius:.3g} m", None, centre + reach.radius * circle, GREY, 0.9,
                (6, 4), depth=2.0, framed=False,
            )  # fmt: skip
    return list(found.values())


def _drawable(points: Array) -> Any:
    """Indices of the points, × 2, of a path: all, as matplotlib merges what lies on a line.

    Where that leaves too many corners, as of noise, those with which both coordinates over time
    look the same.
    """
    size = max(float(np.ptp(points, axis=0).max()), SMALLEST_RANGE)
    corners = np.asarray(Polyline(points * (POINTS * SIDE / size)).cleaned(simplify=True).vertices)
    if len(corners) <= MANY_CORNERS:
        return slice(None)
    return np.union1d(outline(points[:, 0]), outline(points[:, 1]))
