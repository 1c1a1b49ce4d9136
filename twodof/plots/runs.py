"""One figure of one run or of several: joints, the arm in its workspace, and the error.

Sizes are in inches of paper. Printed 17 cm wide, as the text of an A4 page is, the smallest letters
are 5 pt high.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from functools import partial
from itertools import chain, product
from math import ceil, floor, log10
from pathlib import Path

import numpy as np

from ..bag.recording import Recording
from .closed_form import Array
from .figure import DASHES, TICK_STYLE, Drawing, drawn
from .lines import SIDE, Look, outline, set_ticks
from .scales import COLOURS, GREY, INK, PALE, SMALLEST_ERROR, SMALLEST_RANGE
from .track import JointTrack, Track, number, read_tracks
from .words import common_settings, labels, outcome, summary
from .workspace import draw_view, key, planes

# isort: split
from matplotlib.axes import Axes  # where it is missing, twodof.figure says so
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

NAMES, TICKS, PANEL, GAP, MARGIN = 0.65, 0.5, 1.75, 0.6, 0.15
"""Widths: joints' names, ticks' numbers, joints' panels and between them, margin."""
LINE, BETWEEN, BELOW, KEY = 0.17, 0.2, 0.4, 0.42
"""Heights: a line of text, between panels, the ticks and label below them, the workspace's key."""
JOINTS, LOWEST, HIGHEST, ERROR = 3.6, 0.58, 1.6, 1.4
"""Heights: of all joints, the least and most of one's, and of the error."""
VIEWS = {1: (3.0, 5.0), 2: (1.8, 3.4)}
"""Least and most height of a view of the workspace, by the number of views."""
LETTER = 0.058  # mean width
ABOVE = 13.0  # points from a panel to its title, with room for the limits between


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
    first, *others = tracks
    table = [summary(first), *(summary(other, first) for other in others)]
    name = first.name + (f"-and-{len(tracks) - 1}-more" if len(tracks) > 1 else "")
    return Drawing(_title(tracks), name, partial(_draw, tracks), table)


class _Page:
    """What goes where: sizes in inches from the upper left corner.

    Joints are rows of position and velocity (a single joint has two rows), the error is below them,
    the workspace is beside them, in one view for each of ``planes``.
    """

    def __init__(self, figure: Figure, tracks: Sequence[Track], looks: Sequence[Look]) -> None:
        joints = [joint for track in tracks for joint in track.joints]
        self.figure = figure
        self.names = list(dict.fromkeys(joint.name for joint in joints))
        self.kinds = "qv" if any(joint.v.size for joint in joints) else "q"
        self.planes = planes(tracks)
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
        draw_view(axes, plane, tracks, looks, aspect=page.view / SIDE)
        views.append(axes)
    if views:
        views[0].set_title(_workspace(tracks), pad=ABOVE)
        views[-1].legend(
            handles=key(views), loc="upper left", ncols=3, handlelength=1.7,
            columnspacing=1.0, bbox_to_anchor=(0.0, -BELOW / page.view),
        )  # fmt: skip


def _draw_head(page: _Page, tracks: Sequence[Track], looks: Sequence[Look]) -> None:
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


def _looks(tracks: Sequence[Track]) -> list[Look]:
    def arm(i: int) -> float:
        return 3.5 if len(tracks) == 1 else 5.0 - 3.5 * i / (len(tracks) - 1)

    return [
        Look(label, COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)], arm(i))
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
    set_ticks(axes.xaxis, 5)
    if labelled:
        axes.set_xlabel("time in s")
    else:
        axes.tick_params(labelbottom=False)


# --- joints ---


def _draw_joints(page: _Page, tracks: Sequence[Track], looks: Sequence[Look]) -> None:
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


def _draw_joint(axes: Axes, lines: Sequence[tuple[Array, JointTrack, Look]], kind: str) -> None:
    shown = [(t, getattr(joint, kind), look) for t, joint, look in lines]
    shown = [(t, y, look) for t, y, look in shown if y.size]
    for t, y, look in shown:
        kept = outline(y)
        marker = "o" if len(t) == 1 else ""
        axes.plot(t[kept], y[kept], label=look.label, marker=marker, markersize=3, **look.line)
    low, high = _range([y for _, y, _ in shown])
    if kind == "q":
        low, high = _draw_limits(axes, [joint for _, joint, _ in lines], low, high)
    pad = 0.06 * (high - low)
    axes.set_ylim(low - pad, high + pad)
    set_ticks(axes.yaxis, 4)


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


# --- the error ---


def _draw_error(axes: Axes, tracks: Sequence[Track], looks: Sequence[Look]) -> None:
    """Distance from the target over time, and what it is in closed form."""
    tasks = [(track.t, track.task, look) for track, look in zip(tracks, looks) if track.task]
    axes.set_yscale("log", nonpositive="mask")
    _decades(axes, np.concatenate([task.error for _, task, _ in tasks]))
    disturbances = dict.fromkeys(chain(*(task.disturbances for _, task, _ in tasks)))
    name = "closed form" + (f" without {', '.join(disturbances)}" if disturbances else "")
    name = "\n".join(textwrap.wrap(name, 36))
    for t, task, look in tasks:
        if task.closed_form is not None:
            kept = outline(task.closed_form)
            axes.plot(
                t[kept], task.closed_form[kept], color=PALE, linewidth=4.0,
                solid_capstyle="butt", zorder=1.5, label=name,
            )  # fmt: skip
        kept = outline(task.error)
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
