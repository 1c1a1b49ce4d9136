"""One figure of one run or of several: joints, the arm in its workspace, and the error.

Sizes are in inches of paper. Printed 17 cm wide, as the text of an A4 page is, the smallest letters
are 5 pt high; more than ROWS joints take a wider page.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from functools import partial
from itertools import chain
from math import ceil
from pathlib import Path

from ..bag.provenance import each_robot
from ..bag.recording import Recording
from .artists import add_axes, draw, key, line, set_decades, set_ticks
from .figure import Drawing, drawn
from .interactive import body
from .panels import (
    KINDS,
    TARGET,
    UNITS,
    Looks,
    Panel,
    duration,
    error_panel,
    joint_names,
    joint_panels,
    title,
)  # fmt: skip
from .strokes import GREY, INK, Look, looks
from .track import Track, read_tracks
from .words import common_settings, labels, outcome, summary
from .workspace import SIDE, View, views, workspace_title

# isort: split
from matplotlib.axes import Axes  # where it is missing, twodof.figure says so
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

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
POINTS = 4000  # of a curve; panels are fewer pixels wide


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

    def __init__(self, figure: Figure, tracks: Sequence[Track], bags: Sequence[Look]) -> None:
        self.figure = figure
        names = ["", *joint_names(tracks)]
        looks: Looks = {(i, name): look for i, look in enumerate(bags) for name in names}
        self.panels = joint_panels(tracks, looks)
        self.error = error_panel(tracks, looks)
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
        if any(stroke.is_target for panel in self.panels for stroke in panel.strokes):
            self.settings.append(TARGET)
        if len(tracks) == 1 and tracks[0].task:
            self.settings += textwrap.wrap(outcome(tracks[0]), letters)
        self.keys = max(1, letters // (12 + max(len(look.label) for look in bags)))
        lines = len(self.settings) + (ceil(len(bags) / self.keys) if len(bags) > 1 else 0)
        self.top = 0.8 + LINE * lines
        self.bottom = self.top + body
        figure.set_size_inches(self.width, self.bottom + BELOW)

    def at(self, left: float, top: float) -> tuple[float, float]:
        return left / self.width, 1.0 - top / (self.bottom + BELOW)


def _draw(tracks: Sequence[Track], figure: Figure) -> None:
    bags = looks(labels(tracks))
    page = _Page(figure, tracks, bags)
    _draw_head(page, tracks, bags)
    end = duration(tracks)
    _draw_joints(page, end)
    if page.error:
        axes = add_axes(page.figure, page.left, page.bottom - ERROR, page.across, ERROR)
        _draw_error(axes, page.error)
        _time_axis(axes, end)
    below = []
    for i, view in enumerate(page.views):
        axes = add_axes(page.figure, page.side, page.top + i * (page.view + BELOW), SIDE, page.view)
        _draw_view(axes, view, page.view / SIDE)
        below.append(axes)
    if below:
        below[0].set_title(workspace_title(tracks), pad=ABOVE)
        below[-1].legend(
            handles=key(stroke for view in page.views for stroke in view.strokes),
            loc="upper left", ncols=3, handlelength=1.7,
            columnspacing=1.0, bbox_to_anchor=(0.0, -BELOW / page.view),
        )  # fmt: skip


def _draw_head(page: _Page, tracks: Sequence[Track], bags: Sequence[Look]) -> None:
    """What was run, and where there are several bags the key that tells them apart."""
    name = _end(title(tracks), page.letters // 2)
    page.figure.text(*page.at(MARGIN, 0.28), name, fontsize=11, fontweight="bold")
    for i, words in enumerate(page.settings):
        page.figure.text(*page.at(MARGIN, 0.48 + i * LINE), words, color=GREY)
    if len(bags) > 1:
        letters = int(0.8 * page.letters) - 10
        handles = [
            Line2D([], [], label=_end(look.label, letters), **line(look.colour, look.dashes))
            for look in bags
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


def _draw_view(axes: Axes, view: View, aspect: float) -> None:
    """Draw it; aspect is height : width."""
    low, high = view.box(aspect)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), autoscale_on=False)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{view.axes[0]} in m", ylabel=f"{view.axes[1]} in m")
    set_ticks(axes.xaxis, 5)
    set_ticks(axes.yaxis, 5)
    draw(axes, view.strokes)


# --- joints ---


def _draw_joints(page: _Page, end: float) -> None:
    units: dict[str, list[str]] = {}
    for panel in page.panels:
        units.setdefault(panel.kind, []).append(panel.unit)
    for i, panel in enumerate(page.panels):
        place, column = divmod(i, page.columns)
        block, row = divmod(place, page.rows)
        left = page.left + block * page.block + column * (page.cell + GAP)
        top = page.top + row * page.pitch
        axes = add_axes(page.figure, left, top, page.cell, page.pitch - page.gap)
        _draw_joint(axes, panel)
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


def _draw_joint(axes: Axes, panel: Panel) -> None:
    own = [stroke.thinned(POINTS) for stroke in panel.strokes if not stroke.is_limit]
    limits = {stroke.y[0]: stroke for stroke in panel.strokes if stroke.is_limit}
    draw(axes, [*own, *(limit._replace(colour=INK) for limit in limits.values())])
    _tell(axes, panel.note)
    axes.set_ylim(*panel.range)
    set_ticks(axes.yaxis, 4)


def _tell(axes: Axes, text: str) -> None:
    axes.text(1.0, 1.01, text, transform=axes.transAxes, ha="right", va="bottom",
              fontsize=7.0, color=GREY)  # fmt: skip


# --- the error ---


def _draw_error(axes: Axes, panel: Panel) -> None:
    axes.set_yscale("log", nonpositive="mask")
    set_decades(axes, *panel.range)
    draw(axes, [stroke.thinned(POINTS) for stroke in panel.strokes])
    axes.set_title(f"Distance from the target in {panel.unit}")
    if any(not stroke.kind for stroke in panel.strokes):  # one tells of all closed forms
        axes.legend(handles=axes.get_lines()[:1], loc="lower right", bbox_to_anchor=(1.0, 1.02))
    else:
        _tell(axes, panel.note)
