"""One figure of one run or of several: joints, the arm in its workspace, and the error.

Sizes are in inches of paper. Printed 17 cm wide, as the text of an A4 page is, the smallest letters
are 5 pt high; more than ROWS joints take a wider page.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from functools import partial
from itertools import chain
from math import ceil, log10
from pathlib import Path
from typing import Any

from ..bag.provenance import each_robot
from ..bag.recording import Recording
from .figure import TICK_STYLE, Drawing, drawn
from .interactive import body
from .panels import (
    KINDS,
    UNITS,
    Curve,
    Look,
    Panel,
    duration,
    error_panel,
    joint_panels,
    outline,
    title,
    track_looks,
)  # fmt: skip
from .scales import GREY, INK, PALE
from .strokes import draw_view, key, line, set_ticks
from .track import Track, read_tracks
from .words import common_settings, outcome, summary
from .workspace import SIDE, views, workspace_title

# isort: split
from matplotlib.axes import Axes  # where it is missing, twodof.figure says so
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

ROWS = 16  # of joints; more stand in columns beside each other
NAMES, TICKS, GAP, MARGIN = 0.65, 0.5, 0.55, 0.15
"""Widths: joints' names, ticks' numbers, between joints' panels, margin."""
PANEL = {1: 1.75, 2: 1.75, 3: 1.1}
"""Width of joints' panels, by how many each joint has."""
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
        bags: bags, or their folders; all robots of one that has several.
        urdf, frame: the robot and its end effector, as in ``track.read_tracks``.

    Raises:
        BagError, PlotError: naming what is wrong.
    """
    return drawn(drawing(read_tracks(each_of(bags), urdf=urdf, frame=frame)))


def each_of(bags: Sequence[Recording | str | Path]) -> list[Recording | Path]:
    """Bags, and of those that have several robots each robot's."""
    parts = ([bag] if isinstance(bag, Recording) else each_robot(Path(bag)) for bag in bags)
    return [part for several in parts for part in several]


def drawing(tracks: Sequence[Track]) -> Drawing:
    """What to draw of tracks; the table has a column for each."""
    first, *others = tracks
    table = [summary(first), *(summary(other, first) for other in others)]
    name = first.name + (f"-and-{len(tracks) - 1}-more" if len(tracks) > 1 else "")
    return Drawing(title(tracks), name, partial(_draw, tracks), table, partial(body, tracks))


class _Page:
    """What goes where: sizes in inches from the upper left corner.

    Joints are rows of a panel for each kind (a single joint has a row for each), the error is below
    them, the workspace is beside them, in one view above the other.
    """

    def __init__(self, figure: Figure, tracks: Sequence[Track], looks: Sequence[Look]) -> None:
        self.figure = figure
        self.panels = joint_panels(tracks)
        self.error = error_panel(tracks)
        self.views = views(tracks, looks)

        kinds = len({panel.kind for panel in self.panels})
        joints = len(self.panels) // kinds
        self.alone = joints == 1
        self.columns = 1 if self.alone else kinds
        self.rows = kinds if self.alone else ceil(joints / ceil(joints / ROWS))
        self.left = MARGIN + TICKS + NAMES * (not self.alone)
        self.cell = 2 * PANEL[2] + GAP if self.alone else PANEL[kinds]
        self.block = self.columns * (self.cell + GAP) + NAMES
        self.across = self.block * ceil(joints / self.rows) - NAMES - GAP
        if self.alone:
            self.across = self.cell
        self.side = self.left + self.across + GAP + 0.1
        self.width = (self.side + SIDE if self.views else self.left + self.across) + MARGIN

        self.gap = BETWEEN * (1 + self.alone)
        self.pitch = min(max(JOINTS / self.rows, LOWEST), HIGHEST)
        self.view = 0.0
        below = BELOW + BETWEEN + ERROR if self.error else 0.0
        body = self.rows * self.pitch - self.gap + below
        if self.views:
            count = len(self.views)
            least, most = VIEWS[count]
            body = max(body, count * (least + BELOW) - BELOW + KEY)
            self.view = min(most, (body - KEY + BELOW) / count - BELOW)
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

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        x, y = self.at(left, top + height)
        box = (x, y, width / self.width, height / (self.bottom + BELOW))
        axes = self.figure.add_axes(box)
        axes.tick_params(which="both", **TICK_STYLE)
        return axes


def _draw(tracks: Sequence[Track], figure: Figure) -> None:
    looks = track_looks(tracks)
    page = _Page(figure, tracks, looks)
    _draw_head(page, tracks, looks)
    end = duration(tracks)
    _draw_joints(page, looks, end)
    if page.error:
        axes = page.axes(page.left, page.bottom - ERROR, page.across, ERROR)
        _draw_error(axes, page.error, looks)
        _time_axis(axes, end)
    below = []
    for i, view in enumerate(page.views):
        axes = page.axes(page.side, page.top + i * (page.view + BELOW), SIDE, page.view)
        draw_view(axes, view, aspect=page.view / SIDE)
        below.append(axes)
    if below:
        below[0].set_title(workspace_title(tracks), pad=ABOVE)
        below[-1].legend(
            handles=key(page.views), loc="upper left", ncols=3, handlelength=1.7,
            columnspacing=1.0, bbox_to_anchor=(0.0, -BELOW / page.view),
        )  # fmt: skip


def _draw_head(page: _Page, tracks: Sequence[Track], looks: Sequence[Look]) -> None:
    """What was run, and where there are several bags the key that tells them apart."""
    name = _end(title(tracks), page.letters // 2)
    page.figure.text(*page.at(MARGIN, 0.28), name, fontsize=11, fontweight="bold")
    for i, words in enumerate(page.settings):
        page.figure.text(*page.at(MARGIN, 0.48 + i * LINE), words, color=GREY)
    if len(looks) > 1:
        letters = int(0.8 * page.letters) - 10
        handles = [
            Line2D([], [], label=_end(look.label, letters), **line(look.colour, look.dashes))
            for look in looks
        ]
        page.figure.legend(
            handles=handles,
            loc="upper left", bbox_to_anchor=page.at(MARGIN, 0.4 + LINE * len(page.settings)),
            ncols=page.keys, handlelength=3.5, fontsize=8.0,
        )  # fmt: skip


def _end(text: str, letters: int) -> str:
    """As much of a text's end as there is room for."""
    return text if len(text) <= letters else f"…{text[1 - letters :]}"


def _time_axis(axes: Axes, end: float, *, labelled: bool = True) -> None:
    axes.set_xlim(0.0, end)
    set_ticks(axes.xaxis, 5)
    if labelled:
        axes.set_xlabel("time in s")
    else:
        axes.tick_params(labelbottom=False)


def _draw_curve(axes: Axes, curve: Curve, label: str, **look: Any) -> None:
    kept = outline(curve.y)
    axes.plot(curve.t[kept], curve.y[kept], label=label, **look)


# --- joints ---


def _draw_joints(page: _Page, looks: Sequence[Look], end: float) -> None:
    units: dict[str, list[str]] = {}
    for panel in page.panels:
        units.setdefault(panel.kind, []).append(panel.unit)
    for i, panel in enumerate(page.panels):
        place, column = divmod(i, page.columns)
        block, row = divmod(place, page.rows)
        left = page.left + block * page.block + column * (page.cell + GAP)
        top = page.top + row * page.pitch
        axes = page.axes(left, top, page.cell, page.pitch - page.gap)
        _draw_joint(axes, panel, looks)
        last = row == page.rows - 1 or i + page.columns >= len(page.panels)
        _time_axis(axes, end, labelled=last)
        parts = {part for unit in units[panel.kind] for part in unit.split(" or ")}
        several = [unit for unit in UNITS[panel.kind] if unit in parts]
        if row == 0 or page.alone:
            what = KINDS[panel.kind] + f" of {panel.joint}" * page.alone
            axes.set_title(f"{what} in {' or '.join(several)}", pad=ABOVE)
        if column == 0 and not page.alone:
            label = _wrapped(panel.joint, page.pitch)
            if len(several) > 1 and panel.unit == "m":
                label += "\n(m)"
            middle = page.at(left - TICKS, top + 0.5 * (page.pitch - page.gap))
            page.figure.text(*middle, label, fontsize=7.5, ha="right", va="center")


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


def _draw_joint(axes: Axes, panel: Panel, looks: Sequence[Look]) -> None:
    for curve in panel.curves:
        look = looks[curve.track]
        marker = "o" if len(curve.t) == 1 else ""
        _draw_curve(
            axes, curve, look.label, marker=marker, markersize=3, **line(look.colour, look.dashes)
        )
    for limit in panel.limits:
        axes.axhline(
            limit, color=INK, linewidth=0.9, dashes=(7, 2, 1.5, 2), zorder=1.9, label="limit"
        )
    _tell(axes, panel.told)
    axes.set_ylim(*panel.range)
    set_ticks(axes.yaxis, 4)


def _tell(axes: Axes, text: str) -> None:
    axes.text(1.0, 1.01, text, transform=axes.transAxes, ha="right", va="bottom",
              fontsize=7.0, color=GREY)  # fmt: skip


# --- the error ---


def _draw_error(axes: Axes, panel: Panel, looks: Sequence[Look]) -> None:
    axes.set_yscale("log", nonpositive="mask")
    _decades(axes, *panel.range)
    for curve in panel.closed_forms:
        _draw_curve(
            axes, curve, panel.told, color=PALE, linewidth=4.0, solid_capstyle="butt", zorder=1.5
        )
    handles = axes.get_lines()[:1]  # one tells of all closed forms
    for curve in panel.curves:
        look = looks[curve.track]
        _draw_curve(axes, curve, look.label, **line(look.colour, look.dashes))
    axes.set_title(f"Distance from the target in {panel.unit}")
    if handles:
        axes.legend(handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.02))
    else:
        _tell(axes, panel.told)


def _decades(axes: Axes, low: float, high: float) -> None:
    """Whole decades and their ticks."""
    axes.set_ylim(low, high)
    axes.yaxis.set_major_locator(LogLocator(numticks=6))
    few = high < 5000.0 * low
    axes.yaxis.set_minor_locator(LogLocator(subs=range(2, 10)) if few else NullLocator())
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(_power_of_ten))


def _power_of_ten(value: float, _position: int | None = None) -> str:
    digits = str(round(log10(value))).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"10{digits}"
