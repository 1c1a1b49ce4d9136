"""The arm in its workspace: how it stands, the end effector's path, targets, what it can reach."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from itertools import chain
from typing import Any

import numpy as np

from .closed_form import Array
from .lines import Look, drawable, set_ticks
from .scales import GREY, INK, PALE, SMALLEST_RANGE
from .track import Track

# isort: split
from matplotlib.axes import Axes  # where it is missing, twodof.figure says so
from matplotlib.lines import Line2D

MANY_TARGETS = 12


def planes(tracks: Sequence[Track]) -> list[tuple[int, int]]:
    """Axes (0, 1, 2 for x, y, z) of each view: one where all lies in a plane, else top and side."""
    points = [p for t in tracks if t.motion for p in (t.motion.path, t.motion.start, t.motion.end)]
    if not points:
        return []
    every = np.concatenate(points)
    extent = np.nanmax(every, axis=0) - np.nanmin(every, axis=0)
    if (extent <= 1e-6 * extent.max()).any():
        first, second = sorted(np.argsort(extent, kind="stable")[1:].tolist())
        return [(first, second)]
    return [(0, 1), (int(extent[1] > extent[0]), 2)]


def draw_view(
    axes: Axes,
    plane: tuple[int, int],
    tracks: Sequence[Track],
    looks: Sequence[Look],
    aspect: float,
) -> None:
    """Arms, paths, targets and reach, projected along the third axis; aspect is height : width."""
    columns = list(plane)
    starts: list[Array] = []
    for track, look in zip(tracks, looks):
        if track.motion is None:
            continue
        motion = track.motion
        if not any(np.array_equal(motion.start, other) for other in starts):
            starts.append(motion.start)
            _draw_arm(axes, motion.start[:, columns], PALE, 3.5, "arm at the start")
        colour = GREY if len(tracks) == 1 else look.colour
        _draw_arm(axes, motion.end[:, columns], colour, look.arm, "arm at the end")
    drawn = [p[:, columns] for t in tracks if t.motion for p in (t.motion.start, t.motion.end)]
    for track, look in zip(tracks, looks):
        if track.motion is None:
            continue
        path = track.motion.path[:, columns]
        axes.plot(*path[drawable(path)].T, label="path", zorder=4, **look.line)
        drawn.append(path)
        if track.task:
            drawn.append(_draw_target(axes, columns, track))
    points = np.concatenate(drawn)
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    half = max(1.15 * float(np.max((high - low) / (1.0, aspect))) / 2, SMALLEST_RANGE)
    (x, y), (dx, dy) = (low + high) / 2, (half, half * aspect)
    axes.set(xlim=(x - dx, x + dx), ylim=(y - dy, y + dy))
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{'xyz'[plane[0]]} in m", ylabel=f"{'xyz'[plane[1]]} in m")
    set_ticks(axes.xaxis, 5)
    set_ticks(axes.yaxis, 5)
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    for (x, y), radius in _reaches(plane, tracks):
        axes.plot(
            x + radius * np.cos(angle), y + radius * np.sin(angle), color=GREY, linewidth=0.9,
            linestyle=(0, (6, 4)), scalex=False, scaley=False, zorder=2,
            label=f"reach {radius:.3g} m",
        )  # fmt: skip


def key(views: Sequence[Axes]) -> list[Line2D]:
    """One handle for each label; those of several tracks in grey."""
    handles: dict[str, Line2D] = {}
    for line in chain(*(axes.get_lines() for axes in views)):
        label = str(line.get_label())
        if label in handles and line.get_color() != handles[label].get_color():
            handles[label] = copy(handles[label])
            handles[label].set_color(GREY)
            handles[label].set_markeredgecolor(GREY)
            handles[label].set_linestyle("-")
        handles.setdefault(label, line)
    return list(handles.values())


def _draw_arm(axes: Axes, points: Array, colour: str, width: float, label: str) -> None:
    axes.plot(
        *points.T, color=colour, linewidth=width, marker="o", markersize=width + 1.5,
        markerfacecolor="white", markeredgecolor=colour, markeredgewidth=0.3 * width,
        solid_joinstyle="round", solid_capstyle="round", label=label,
        zorder=3 if colour != PALE else 2.5, markevery=slice(0, -1),
    )  # fmt: skip


def _draw_target(axes: Axes, columns: Sequence[int], track: Track) -> Array:
    """Mark the targets in the order in which they held; the points that were marked, × 2."""
    assert track.task is not None
    target = np.full((len(track.t), 3), np.nan)
    target[:, ["xyz".index(axis) for axis in track.task.axes]] = track.task.target
    target = target[:, columns]
    changed = np.r_[True, (track.task.target[1:] != track.task.target[:-1]).any(axis=1)]
    distinct = target[changed]
    look: dict[str, Any] = {"color": INK, "zorder": 5, "label": "target"}
    controlled = np.isfinite(distinct[0])
    if controlled.all():
        marks: dict[str, Any] = {"marker": "+", "markersize": 11, "markeredgewidth": 1.3}
        if len(distinct) > MANY_TARGETS:
            marks = {"linewidth": 0.8}
            distinct = distinct[drawable(distinct)]
        else:
            look["linestyle"] = "none"
        axes.plot(*distinct.T, **marks, **look)
    else:  # a line where the other axis is not controlled
        for x, y in distinct[-MANY_TARGETS:]:
            if np.isfinite(x):
                axes.axvline(x, linewidth=0.8, **look)
            elif np.isfinite(y):
                axes.axhline(y, linewidth=0.8, **look)
    return distinct


def _reaches(
    plane: tuple[int, int], tracks: Sequence[Track]
) -> list[tuple[tuple[float, float], float]]:
    """Centre and radius of each different circle that lies in the plane."""
    found = {}
    for track in tracks:
        reach = track.motion.reach if track.motion else None
        if reach and reach.normal not in plane:
            x, y = (float(reach.centre[axis]) for axis in plane)
            found[round(x, 9), round(y, 9), round(reach.radius, 9)] = ((x, y), reach.radius)
    return list(found.values())
