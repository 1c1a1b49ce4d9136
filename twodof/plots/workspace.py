"""Lines of the arm in its workspace: start, end, path, targets and reach."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..export.closed_form import Array
from .panels import CURVE, THIN, LineStyles
from .strokes import ALARM, GREY, INK, PALE, SMALLEST_RANGE, Stroke, downsampled
from .track import Task, Track

# isort: split
from matplotlib.path import Path as Polyline  # figure raises if matplotlib is missing

MANY_TARGETS = 12
MANY_CORNERS = 20_000  # points of a path; each takes about 20 bytes in SVG and PDF
POINTS = 72.0  # points per inch
SIDE = 2.8  # inches, width of the workspace


class View(NamedTuple):
    """A projection along one of the root's axes."""

    axes: str  # letters of the horizontal and the vertical axis
    strokes: tuple[Stroke, ...]
    across: tuple[float, float]  # across, up: limits of the axes, with space at the edges, m
    up: tuple[float, float]


def workspace_title(tracks: Sequence[Track]) -> str:
    """Return the title, with the frame of the path and the view."""
    frames = dict.fromkeys(f"{t.motion.frame} in {t.motion.root}" for t in tracks if t.motion)
    return f"Path of {', '.join(frames)}"


def views(tracks: Sequence[Track], line_styles: LineStyles) -> list[View]:
    """Return one view for planar motion, else a top view and a side view; none without a robot."""
    return [_view(plane, tracks, line_styles) for plane in _planes(tracks)]


def _planes(tracks: Sequence[Track]) -> list[tuple[int, int]]:
    """Return the axes (0, 1, 2 for x, y, z) of each view."""
    points = [p for t in tracks if t.motion for p in (t.motion.path, t.motion.start, t.motion.end)]
    if not points:
        return []
    every = np.concatenate(points)
    extent = np.nanmax(every, axis=0) - np.nanmin(every, axis=0)
    if (extent <= 1e-6 * extent.max()).any():
        first, second = sorted(np.argsort(extent, kind="stable")[1:].tolist())
        return [(first, second)]
    return [(0, 1), (int(extent[1] > extent[0]), 2)]


def _view(plane: tuple[int, int], tracks: Sequence[Track], line_styles: LineStyles) -> View:
    strokes = [*_arms(plane, tracks, line_styles), *_paths(plane, tracks, line_styles), *_circles(plane, tracks)]
    limits = []
    for values in ("x", "y"):
        seen = np.concatenate([getattr(stroke, values) for stroke in strokes if stroke.framed])
        low, high = np.nanmin(seen), np.nanmax(seen)
        half, middle = max(0.575 * (high - low), SMALLEST_RANGE), 0.5 * (low + high)
        limits.append((float(middle - half), float(middle + half)))
    return View("".join("xyz"[axis] for axis in plane), tuple(strokes), *limits)


def _arms(plane: tuple[int, int], tracks: Sequence[Track], line_styles: LineStyles) -> Iterator[Stroke]:
    """Return the arms at the start, with equal ones drawn once, and at the end.

    Arms at the end have decreasing widths, so that all arms with the same end are visible.
    """
    starts: list[Array] = []
    alone = len(tracks) == 1
    for i, track in enumerate(tracks):
        if track.motion is None:
            continue
        start, end = track.motion.start, track.motion.end
        if not any(np.array_equal(start, other) for other in starts):
            starts.append(start)
            label, owner = "arm at the start", i if alone else None
            yield Stroke(label, owner, start[:, plane[0]], start[:, plane[1]], PALE, 3.5, mark="o", depth=2.5)
        width = 3.5 if alone else 5.0 - 3.5 * i / (len(tracks) - 1)
        colour = GREY if alone else line_styles[i, ""].colour
        yield Stroke("arm at the end", i, end[:, plane[0]], end[:, plane[1]], colour, width, mark="o", depth=3.0)


def _paths(plane: tuple[int, int], tracks: Sequence[Track], line_styles: LineStyles) -> Iterator[Stroke]:
    for i, track in enumerate(tracks):
        if track.motion is not None:
            path, line = _drawable(track.motion.path[:, plane]), line_styles[i, ""]
            yield Stroke("path", i, path[:, 0], path[:, 1], line.colour, CURVE, line.dashes)
        if track.task:
            yield _target(plane, i, track.task)
        for cause in track.verdict.causes if track.motion is not None else ():
            if cause.point:
                x, y = (np.array([cause.point[axis]]) for axis in plane)
                yield Stroke("nearest reachable", i, x, y, ALARM, 0.0, mark="x", depth=5.5)


def _target(plane: tuple[int, int], i: int, task: Task) -> Stroke:
    """Return targets in order of time: markers, or a line if there are many."""
    known = task.target[np.isfinite(task.target).all(axis=1)]
    changed = np.r_[True, (known[1:] != known[:-1]).any(axis=1)]
    along = dict(zip(task.axes, known[changed].T))
    x, y = (along.get("xyz"[axis], np.empty(0)) for axis in plane)
    if len(x) != len(y):  # a line across the picture, because the other axis is not controlled
        return Stroke("target", i, x[-MANY_TARGETS:], y[-MANY_TARGETS:], INK, THIN, depth=5.0)
    if len(x) > MANY_TARGETS:
        points = _drawable(np.column_stack([x, y]))
        return Stroke("target", i, points[:, 0], points[:, 1], INK, THIN, depth=5.0)
    return Stroke("target", i, x, y, INK, 0.0, mark="+", depth=5.0)


def _circles(plane: tuple[int, int], tracks: Sequence[Track]) -> list[Stroke]:
    """Return the distinct reach circles in the plane of the view."""
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    circles: dict[tuple[float, ...], Stroke] = {}
    for track in tracks:
        reach = track.motion.reach if track.motion else None
        if reach and reach.normal not in plane:
            centre = reach.centre[list(plane)]
            key = tuple(np.round([*centre, reach.radius], 9))
            x, y = (centre + reach.radius * circle).T
            label = f"reach {reach.radius:.3g} m"
            circles[key] = Stroke(label, None, x, y, GREY, THIN, (6, 4), depth=2.0, framed=False)
    return list(circles.values())


def _drawable(points: Array) -> Array:
    """Return the points of a path, × 2.

    All points are drawn, because matplotlib merges collinear ones. If too many remain, for example with noise, both
    coordinates are downsampled over time without a visible change.
    """
    size = max(float(np.ptp(points, axis=0).max()), SMALLEST_RANGE)
    corners = np.asarray(Polyline(points * (POINTS * SIDE / size)).cleaned(simplify=True).vertices)
    if len(corners) <= MANY_CORNERS:
        return points
    x, y = (downsampled(values, MANY_CORNERS // 5) for values in points.T)
    return np.asarray(points[np.union1d(x, y)])
