"""One figure of one run or of several: joints, the arm in its workspace, and the error.

Sizes are in inches of paper. Printed 17 cm wide, as the text of an A4 page is, the smallest letters
are 5 pt high.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from copy import copy
from functools import partial
from itertools import chain, product
from math import ceil, floor, log10
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..bag.recording import Recording
from .figure import COLOURS, DASHES, GREY, INK, PALE, TICK_STYLE, Drawing, drawn
from .track import JointTrack, Track, number, read_tracks
from .words import common_settings, labels, outcome, summary

# isort: split
from matplotlib.axes import Axes  # where it is missing, twodof.figure says so
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.path import Path as Polyline
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

Array = NDArray[np.float64]

NAMES, TICKS, PANEL, GAP, SIDE, MARGIN = 0.65, 0.5, 1.75, 0.6, 2.8, 0.15
"""Widths: joints' names, ticks' numbers, joints' panels and between them, the workspace, margin."""
LINE, BETWEEN, BELOW, KEY = 0.17, 0.2, 0.4, 0.42
"""Heights: a line of text, between panels, the ticks and label below them, the workspace's key."""
JOINTS, LOWEST, HIGHEST, ERROR = 3.6, 0.58, 1.6, 1.4
"""Heights: of all joints, the least and most of one's, and of the error."""
VIEWS = {1: (3.0, 5.0), 2: (1.8, 3.4)}
"""Least and most height of a view of the workspace, by the number of views."""
LETTER = 0.058  # mean width
ABOVE = 13.0  # points from a panel to its title, with room for the limits between

STEPS = (1, 2, 2.5, 5, 10)  # of ticks
CHUNKS = 1000
"""Parts of a long line over time that each keep their extremes; panels are fewer pixels wide."""
MANY_CORNERS = 20_000  # of a path; SVG and PDF have some 20 bytes for each
POINTS = 72.0  # an inch
SMALLEST_RANGE = 1e-3  # rad, m, rad/s, m/s: what moves less is shown at rest
SMALLEST_ERROR = 1e-12  # m: what is below is rounding
MANY_TARGETS = 12


def plot(
    *bags: Recording | str | Path, urdf: str | Path | None = None, frame: str | None = None
) -> Figure:
    """A figure of one bag, or of several for comparison.

    Args:
        bags: bags, or their folders.
        urdf, frame: the robot and its end effector, as in ``track.read_tracks``.

    Raises:
        BagError, PlotError: naming what is wrong.
    """
    return drawn(drawing(read_tracks(bags, urdf=urdf, frame=frame)))


def drawing(tracks: Sequence[Track]) -> Drawing:
    """What to draw of tracks; the table has a column for each."""
    name = tracks[0].name + (f"-and-{len(tracks) - 1}-more" if len(tracks) > 1 else "")
    return Drawing(_title(tracks), name, partial(_draw, tracks), [*map(summary, tracks)])


class _Look(NamedTuple):
    """What tells a track from the others."""

    label: str
    colour: str
    dashes: Any
    arm: float  # width of the arm at its end: arms that end in the same place are all seen

    @property
    def line(self) -> dict[str, Any]:
        return {"color": self.colour, "linestyle": self.dashes}


class _Page:
    """What goes where: sizes in inches from the upper left corner.

    Joints are rows of position and velocity (a single joint has two rows), the error is below them,
    the workspace is beside them, in one view for each of ``planes``.
    """

    def __init__(self, figure: Figure, tracks: Sequence[Track], looks: Sequence[_Look]) -> None:
        joints = [joint for track in tracks for joint in track.joints]
        self.figure = figure
        self.names = list(dict.fromkeys(joint.name for joint in joints))
        self.kinds = "qv" if any(joint.v.size for joint in joints) else "q"
        self.planes = _planes(tracks)
        self.error = any(track.task for track in tracks)

        self.alone = len(self.names) == 1
        self.columns = 1 if self.alone else len(self.kinds)
        self.rows = len(self.kinds) if self.alone else len(self.names)
        self.left = MARGIN + TICKS + NAMES * (not self.alone)
        self.cell = 2 * PANEL + GAP if self.alone else PANEL
        self.across = self.columns * (self.cell + GAP) - GAP
        self.side = self.left + self.across + GAP + 0.1
        self.width = (self.side + SIDE if self.planes else self.left + self.across) + MARGIN

        self.gap = BETWEEN * (1 + self.alone)
        self.pitch = min(max(JOINTS / self.rows, LOWEST), HIGHEST)
        self.view = 0.0
        below = BELOW + BETWEEN + ERROR if self.error else 0.0
        body = self.rows * self.pitch - self.gap + below
        if self.planes:
            views = len(self.planes)
            least, most = VIEWS[views]
            body = max(body, views * (least + BELOW) - BELOW + KEY)
            self.view = min(most, (body - KEY + BELOW) / views - BELOW)
            self.pitch = (body - below + self.gap) / self.rows

        self.letters = letters = int((self.width - 2 * MARGIN) / LETTER)
        self.settings = textwrap.wrap(common_settings(tracks), letters)
        if len(tracks) == 1 and tracks[0].task:
            self.settings += textwrap.wrap(outcome(tracks[0]), letters)
        self.keys = max(1, letters // (12 + max(len(look.label) for look in looks)))
        lines = len(self.settings) + (ceil(len(looks) / self.keys) if len(looks) > 1 else 0)
        self.top = 0.8 + LINE * lines
        self.bottom = self.top + body
        figure.set_size_inches(self.width, self.bottom + BELOW)

    def at(self, left: float, top: float) -> tuple[float, float]:
        return left / self.width, 1.0 - top / (self.bottom + BELOW)

    def panel(self, left: float, top: float, width: float, height: float) -> Axes:
        x, y = self.at(left, top + height)
        box = (x, y, width / self.width, height / (self.bottom + BELOW))
        axes = self.figure.add_axes(box)
        axes.tick_params(which="both", **TICK_STYLE)
        return axes


def _draw(tracks: Sequence[Track], figure: Figure) -> None:
    looks = _looks(tracks)
    page = _Page(figure, tracks, looks)
    _draw_head(page, tracks, looks)
    _draw_joints(page, tracks, looks)
    if page.error:
        height = page.bottom - ERROR
        _draw_error(page.panel(page.left, height, page.across, ERROR), tracks, looks)
    views = []
    for i, plane in enumerate(page.planes):
        axes = page.panel(page.side, page.top + i * (page.view + BELOW), SIDE, page.view)
        _draw_view(axes, plane, tracks, looks, aspect=page.view / SIDE)
        views.append(axes)
    if views:
        views[0].set_title(_workspace(tracks), pad=ABOVE)
        views[-1].legend(
            handles=_key(views), loc="upper left", ncols=3, handlelength=1.7,
            columnspacing=1.0, bbox_to_anchor=(0.0, -BELOW / page.view),
        )  # fmt: skip


def _draw_head(page: _Page, tracks: Sequence[Track], looks: Sequence[_Look]) -> None:
    """What was run, and where there are several bags the key that tells them apart."""
    title = _end(_title(tracks), page.letters // 2)
    page.figure.text(*page.at(MARGIN, 0.28), title, fontsize=11, fontweight="bold")
    for i, line in enumerate(page.settings):
        page.figure.text(*page.at(MARGIN, 0.48 + i * LINE), line, color=GREY)
    if len(looks) > 1:
        told = [_end(look.label, int(0.8 * page.letters) - 10) for look in looks]
        page.figure.legend(
            handles=[Line2D([], [], label=t, **look.line) for t, look in zip(told, looks)],
            loc="upper left", bbox_to_anchor=page.at(MARGIN, 0.4 + LINE * len(page.settings)),
            ncols=page.keys, handlelength=3.5, fontsize=8.0,
        )  # fmt: skip


def _looks(tracks: Sequence[Track]) -> list[_Look]:
    def arm(i: int) -> float:
        return 3.5 if len(tracks) == 1 else 5.0 - 3.5 * i / (len(tracks) - 1)

    return [
        _Look(label, COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)], arm(i))
        for i, label in enumerate(labels(tracks))
    ]


def _title(tracks: Sequence[Track]) -> str:
    """The robots, or where they are not known the bags."""
    robots = dict.fromkeys(t.motion.robot for t in tracks if t.motion and t.motion.robot)
    return ", ".join(robots or dict.fromkeys(track.name for track in tracks))


def _end(text: str, letters: int) -> str:
    """As much of a text's end as there is room for."""
    return text if len(text) <= letters else f"…{text[1 - letters :]}"


def _workspace(tracks: Sequence[Track]) -> str:
    told = dict.fromkeys(f"{t.motion.frame} in {t.motion.root}" for t in tracks if t.motion)
    return f"Path of {', '.join(told)}"


def _time_axis(axes: Axes, tracks: Sequence[Track], *, labelled: bool = True) -> None:
    axes.set_xlim(0.0, max(float(track.t[-1]) for track in tracks) or 1.0)
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=STEPS))
    axes.xaxis.set_major_formatter(FuncFormatter(_tick))
    if labelled:
        axes.set_xlabel("time in s")
    else:
        axes.tick_params(labelbottom=False)


def _tick(value: float, _position: int | None = None) -> str:
    return number(value)


# --- joints ---


def _draw_joints(page: _Page, tracks: Sequence[Track], looks: Sequence[_Look]) -> None:
    """Position with its limits and velocity of each joint."""
    found = {joint.unit for track in tracks for joint in track.joints}
    units = [unit for unit in ("rad", "m") if unit in found or "" in found]
    for i, (name, kind) in enumerate(product(page.names, page.kinds)):
        row, column = divmod(i, page.columns)
        left, top = page.left + column * (page.cell + GAP), page.top + row * page.pitch
        axes = page.panel(left, top, page.cell, page.pitch - page.gap)
        lines = [
            (track.t, joint, look)
            for track, look in zip(tracks, looks)
            for joint in track.joints
            if joint.name == name
        ]
        _draw_joint(axes, lines, kind)
        _time_axis(axes, tracks, labelled=row == page.rows - 1)
        if row == 0 or page.alone:
            what = {"q": "Position", "v": "Velocity"}[kind] + f" of {name}" * page.alone
            unit = " or ".join(f"{u}/s" if kind == "v" else u for u in units)
            axes.set_title(f"{what} in {unit}", pad=ABOVE)
        if column == 0 and not page.alone:
            label = _wrapped(name, page.pitch)
            if len(units) > 1 and lines[0][1].unit == "m":
                label += "\n(m)"
            middle = top + 0.5 * (page.pitch - page.gap)
            page.figure.text(
                *page.at(page.left - TICKS, middle), label, fontsize=7.5, ha="right", va="center"
            )


def _wrapped(name: str, height: float) -> str:
    """A joint's name broken after its underscores into the lines that its row has room for."""
    parts = chain.from_iterable(textwrap.wrap(w, 11) for w in name.replace("_", "_ ").split())
    lines = [""]
    for part in parts:
        if len(lines[-1] + part) <= 11:
            lines[-1] += part
        else:
            lines.append(part)
    room = int(height / 0.13)
    if len(lines) > room:
        lines = [*lines[: room - 1], lines[room - 1][:10] + "…"]
    return "\n".join(lines)


def _draw_joint(axes: Axes, lines: Sequence[tuple[Array, JointTrack, _Look]], kind: str) -> None:
    shown = [(t, getattr(joint, kind), look) for t, joint, look in lines]
    shown = [(t, y, look) for t, y, look in shown if y.size]
    for t, y, look in shown:
        kept = _outline(y)
        marker = "o" if len(t) == 1 else ""
        axes.plot(t[kept], y[kept], label=look.label, marker=marker, markersize=3, **look.line)
    low, high = _range([y for _, y, _ in shown])
    if kind == "q":
        low, high = _draw_limits(axes, [joint for _, joint, _ in lines], low, high)
    pad = 0.06 * (high - low)
    axes.set_ylim(low - pad, high + pad)
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=STEPS))
    axes.yaxis.set_major_formatter(FuncFormatter(_tick))


def _draw_limits(
    axes: Axes, joints: Sequence[JointTrack], low: float, high: float
) -> tuple[float, float]:
    """Lines at the limits and their numbers; the range widened to the limits that are near."""
    pairs = dict.fromkeys((joint.low, joint.high) for joint in joints)
    limits = dict.fromkeys(limit for limit in chain(*pairs) if limit is not None)
    near = [x for x in limits if abs(2 * x - low - high) < 1.8 * (high - low)]
    low, high = min([low, *near]), max([high, *near])
    for limit in limits:
        axes.axhline(
            limit, color=INK, linewidth=0.9, dashes=(7, 2, 1.5, 2), zorder=1.9, label="limit"
        )
    text = "; ".join(filter(None, (_limits(*pair) for pair in pairs)))
    axes.text(1.0, 1.01, text, transform=axes.transAxes, ha="right", va="bottom", fontsize=7.0,
              color=GREY)  # fmt: skip
    return low, high


def _limits(low: float | None, high: float | None) -> str:
    found = [number(float(f"{limit:.3g}")) for limit in (low, high) if limit is not None]
    if low is not None and high == -low:
        return f"limits ±{found[1]}"
    return f"limit{'s' * (len(found) - 1)} {', '.join(found)}" if found else ""


def _range(values: Sequence[Array]) -> tuple[float, float]:
    """Smallest and largest value, at least SMALLEST_RANGE apart."""
    found = [y[np.isfinite(y)] for y in values]
    found = [y for y in found if y.size]
    low = min((float(y.min()) for y in found), default=0.0)
    high = max((float(y.max()) for y in found), default=0.0)
    short = max(0.0, SMALLEST_RANGE - (high - low))
    return low - 0.5 * short, high + 0.5 * short


def _outline(values: Array) -> Any:
    """Indices of the samples with which a line over time looks as it does with all of them.

    Of each of CHUNKS parts the first, last, smallest and largest, as in Jugel et al., "M4: a
    visualization-oriented time series data aggregation", VLDB 7(10), 2014.
    """
    n = len(values)
    if n <= 4 * CHUNKS:
        return slice(None)
    starts = np.arange(0, n, ceil(n / CHUNKS))
    size = int(starts[1])
    parts = np.pad(values, (0, len(starts) * size - n), mode="edge").reshape(-1, size)
    gaps = ~np.isfinite(parts)
    kept = [starts, starts + size - 1]
    kept.append(starts + np.argmin(np.where(gaps, np.inf, parts), axis=1))
    kept.append(starts + np.argmax(np.where(gaps, -np.inf, parts), axis=1))
    return np.unique(np.minimum(np.concatenate(kept), n - 1))


def _drawable(points: Array) -> Any:
    """Indices of the points, × 2, of a path: all, as matplotlib merges what lies on a line.

    Where that leaves too many corners, as of noise, those with which both coordinates over time
    look the same.
    """
    size = max(float(np.ptp(points, axis=0).max()), SMALLEST_RANGE)
    corners = np.asarray(Polyline(points * (POINTS * SIDE / size)).cleaned(simplify=True).vertices)
    if len(corners) <= MANY_CORNERS:
        return slice(None)
    return np.union1d(_outline(points[:, 0]), _outline(points[:, 1]))


# --- the workspace ---


def _planes(tracks: Sequence[Track]) -> list[tuple[int, int]]:
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


def _draw_view(
    axes: Axes,
    plane: tuple[int, int],
    tracks: Sequence[Track],
    looks: Sequence[_Look],
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
        axes.plot(*path[_drawable(path)].T, label="path", zorder=4, **look.line)
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
    for side in (axes.xaxis, axes.yaxis):
        side.set_major_locator(MaxNLocator(5, steps=STEPS))
        side.set_major_formatter(FuncFormatter(_tick))
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    for (x, y), radius in _reaches(plane, tracks):
        axes.plot(
            x + radius * np.cos(angle), y + radius * np.sin(angle), color=GREY, linewidth=0.9,
            linestyle=(0, (6, 4)), scalex=False, scaley=False, zorder=2,
            label=f"reach {radius:.3g} m",
        )  # fmt: skip


def _key(views: Sequence[Axes]) -> list[Line2D]:
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
            distinct = distinct[_drawable(distinct)]
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


# --- the error ---


def _draw_error(axes: Axes, tracks: Sequence[Track], looks: Sequence[_Look]) -> None:
    """Distance from the target over time, and what it is in closed form."""
    tasks = [(track.t, track.task, look) for track, look in zip(tracks, looks) if track.task]
    axes.set_yscale("log", nonpositive="mask")
    _decades(axes, np.concatenate([task.error for _, task, _ in tasks]))
    disturbances = dict.fromkeys(chain(*(task.disturbances for _, task, _ in tasks)))
    name = "closed form" + (f" without {', '.join(disturbances)}" if disturbances else "")
    name = "\n".join(textwrap.wrap(name, 36))
    for t, task, look in tasks:
        if task.closed_form is not None:
            kept = _outline(task.closed_form)
            axes.plot(
                t[kept], task.closed_form[kept], color=PALE, linewidth=4.0,
                solid_capstyle="butt", zorder=1.5, label=name,
            )  # fmt: skip
        kept = _outline(task.error)
        axes.plot(t[kept], task.error[kept], label=look.label, **look.line)
    axes.set_title("Distance from the target in m")
    handles = [line for line in axes.get_lines() if line.get_label() == name][:1]
    axes.legend(handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.02))
    _time_axis(axes, tracks)


def _decades(axes: Axes, error: Array) -> None:
    """Whole decades that show the error where it is not rounding, and their ticks."""
    low = floor(log10(max(float(error.min()), SMALLEST_ERROR)))
    high = max(low + 1, ceil(log10(max(float(error.max()), SMALLEST_ERROR))))
    axes.set_ylim(10.0**low, 10.0**high)
    axes.yaxis.set_major_locator(LogLocator(numticks=6))
    few = high - low <= 3
    axes.yaxis.set_minor_locator(LogLocator(subs=range(2, 10)) if few else NullLocator())
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(_power_of_ten))


def _power_of_ten(value: float, _position: int | None = None) -> str:
    digits = str(round(log10(value))).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"10{digits}"
