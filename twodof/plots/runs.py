"""Figure of one or several runs: joints, the arm in its workspace, and the error.

Sizes are in inches of paper. At a width of 17 cm, the text width of an A4 page, the smallest letters are 5 pt high.
More than ROWS joints need a wider page.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import partial
from math import ceil, log10
from pathlib import Path

from ..bag.provenance import each_robot
from ..bag.recording import Recording
from ..bounds import MAX_PANELS
from ..errors import PlotError, path_of
from .figure import Drawing, draw_head, drawn
from .interactive import body
from .panels import HELD, KINDS, TARGET, UNITS, Panel, duration, joint_names, panels_of, title
from .settings import number
from .strokes import GREY, INK, Stroke, Style, line_styles
from .track import Track, read_tracks
from .words import common_settings, labels, outcome, summary
from .workspace import View, views, workspace_title

# isort: split
from matplotlib.axes import Axes  # figure raises if matplotlib is missing
from matplotlib.axis import Axis
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, NullFormatter

ROWS = 16  # rows of joints; more joints need further columns
NAMES, PANEL = 0.8, {1: 2.2, 2: 2.2, 3: 1.62}
"""Widths: of joint names, and of panels with ticks, by the number of panels for each joint."""
JOINTS, LOWEST, HIGHEST, ERROR = 3.6, 0.62, 1.6, 1.4
"""Heights: of all joints, minimum and maximum for one joint, and of the error."""
BESIDE = 3.3  # width of the workspace with axes and legend
VIEWS = {0: (0.0, 0.0), 1: (3.8, 5.8), 2: (4.8, 7.8)}
"""Minimum and maximum height of the workspace with its legend, by the number of views."""
ABOVE = 13.0  # points between a panel and its title, with space for limits
POINTS = 4000  # points of a curve; panels have fewer pixels


def plot(*bags: Recording | str | Path, urdf: str | Path | None = None, frame: str | None = None) -> Figure:
    """Return a figure of one bag, or of several for comparison.

    Args:
        bags: bags, or their folders; all robots of a bag are drawn.
        urdf, frame: the robot and its end effector, as in ``track.read_tracks``.

    Raises:
        BagError, PlotError: a bag or an argument is invalid; the message names it.
    """
    return drawn(drawing(read_tracks(each_of(bags), urdf=urdf, frame=frame)))


def each_of(bags: Sequence[Recording | str | Path]) -> list[Recording | Path]:
    """Return the bags; a bag of several robots is replaced by its robots."""
    parts = ([bag] if isinstance(bag, Recording) else each_robot(path_of(bag, "bag")) for bag in bags)
    return [part for several in parts for part in several]


def drawing(tracks: Sequence[Track]) -> Drawing:
    """Return the drawing of tracks; its table has a column for each."""
    first, *others = tracks
    table = [summary(first), *(summary(other, first) for other in others)]
    name = first.name + (f"-and-{len(tracks) - 1}-more" if len(tracks) > 1 else "")
    return Drawing(title(tracks), name, partial(_draw, tracks), table, partial(body, tracks))


def _draw(tracks: Sequence[Track], figure: Figure) -> None:
    """Draw the joints, the error below them, and the workspace next to them."""
    bags = line_styles(labels(tracks))
    names = ["", *joint_names(tracks)]
    own = {(i, name): line for i, line in enumerate(bags) for name in names}
    panels, pictures = panels_of(tracks, own), views(tracks, own)
    error = panels.pop() if panels[-1].kind == "error" else None
    kinds = len({panel.kind for panel in panels})
    joints = len(panels) // kinds
    if len(panels) > MAX_PANELS:
        remedy = "name some `joints`, or write a page (.html), which shows all"
        raise PlotError(f"{joints} joints are too many for a figure, which shows {MAX_PANELS // kinds}: {remedy}")
    across, blocks, rows = kinds, ceil(joints / ROWS), ceil(joints / ceil(joints / ROWS))
    width = blocks * (NAMES + kinds * PANEL[kinds])
    if joints == 1:
        across, rows, width = 1, kinds, 2 * PANEL[2]
    pitch = min(max(JOINTS / rows, LOWEST), HIGHEST)
    least, most = VIEWS[len(pictures)]
    height = max(rows * pitch + 0.5 + (ERROR + 0.6) * bool(error), least)
    texts = [common_settings(tracks)]
    texts += [TARGET] * any(joint.target.size for track in tracks for joint in track.joints)
    texts += [HELD] * any(stroke.label == HELD for panel in panels for stroke in panel.strokes)
    strokes = [stroke for panel in (*panels, *([error] if error else [])) for stroke in panel.strokes]
    marks = dict.fromkeys(stroke.label for stroke in strokes if stroke.mark == "v")
    texts += [f"▼ {', '.join(marks)}"] if marks else []
    texts += outcome(tracks[0]) if len(tracks) == 1 else []
    size = width + BESIDE * bool(pictures), height
    handles = [Line2D([], [], label=line.label, **_line(line.colour, line.dashes)) for line in bags * (len(bags) > 1)]
    room = draw_head(figure, title(tracks), texts, size, handles)
    if pictures:
        cells = room.add_gridspec(2, 2, width_ratios=(width, BESIDE), height_ratios=(most, max(height - most, 1e-3)))
        _draw_workspace(room.add_subfigure(cells[0, 1]), pictures, workspace_title(tracks))
        room = room.add_subfigure(cells[:, 0])
    heights = [pitch - 0.2] * rows + [ERROR] * bool(error)
    grid = room.add_gridspec(len(heights), blocks * across, height_ratios=heights)
    last = duration(tracks)
    for i, (panel, units) in enumerate(zip(panels, _units(panels))):
        block, row = divmod(i // across, rows)
        axes = room.add_subplot(grid[row, block * across + i % across])
        _draw_joint(axes, panel)
        _time_axis(axes, last, labelled=row == rows - 1 or i + across >= len(panels))
        if row == 0 or joints == 1:
            what = KINDS[panel.kind] + f" of {panel.joint}" * (joints == 1)
            axes.set_title(f"{what} in {' or '.join(units)}", pad=ABOVE)
        if i % across == 0 and joints > 1:
            label = _wrapped(panel.joint, pitch) + "\n(m)" * (units[1:] == [panel.unit] == ["m"])
            axes.set_ylabel(label, fontsize=7.5, rotation=0, ha="right", va="center")
    room.align_ylabels()
    if error:
        axes = room.add_subplot(grid[rows, :])
        _draw_error(axes, error)
        _time_axis(axes, last)


def _units(panels: Sequence[Panel]) -> list[list[str]]:
    """Return the units of all panels of each panel's kind."""
    found = {(panel.kind, unit) for panel in panels for unit in panel.unit.split(" or ")}
    return [[u for u in UNITS[panel.kind] if (panel.kind, u) in found] for panel in panels]


def _wrapped(name: str, height: float) -> str:
    """Return a joint's name broken after underscores and before capitals into lines that fit into its row."""
    lines = re.findall(r".{1,11}$|.{1,10}_|.{1,11}(?=[A-Z])|.{1,11}(?=.{3})", name)
    room = int(height / 0.13)
    if len(lines) > room:
        lines[room - 1 :] = [lines[room - 1][:10] + "…"]
    return "\n".join(lines)


def _time_axis(axes: Axes, end: float, *, labelled: bool = True) -> None:
    axes.set_xlim(0.0, end)
    _set_ticks(axes.xaxis, 5)
    axes.tick_params(labelbottom=labelled)
    axes.set_xlabel("time in s" * labelled)


def _draw_workspace(figure: SubFigure, pictures: Sequence[View], heading: str) -> None:
    every = figure.subplots(len(pictures), squeeze=False)[:, 0]
    for axes, view in zip(every, pictures):
        draw_view(axes, view)
    every[0].set_title(heading, pad=ABOVE)
    figure.legend(
        handles=_key(stroke for view in pictures for stroke in view.strokes),
        loc="outside lower left",
        ncols=3,
        handlelength=1.7,
        columnspacing=1.0,
        borderaxespad=0.9,
    )


def draw_view(axes: Axes, view: View) -> None:
    """Draw a view of the workspace."""
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{view.axes[0]} in m", ylabel=f"{view.axes[1]} in m")
    _set_ticks(axes.xaxis, 5)
    _set_ticks(axes.yaxis, 5)
    _draw_strokes(axes, view.strokes)
    axes.set_xlim(view.across, auto=True)  # so that the aspect ratio may widen them
    axes.set_ylim(view.up, auto=True)


def _draw_joint(axes: Axes, panel: Panel) -> None:
    own = [stroke.thinned(POINTS) for stroke in panel.strokes if not stroke.is_limit]
    limits = {stroke.y[0]: stroke for stroke in panel.strokes if stroke.is_limit}
    _draw_strokes(axes, [*own, *(limit._replace(colour=INK) for limit in limits.values())])
    _tell(axes, panel.note)
    axes.set_ylim(*panel.range)
    _set_ticks(axes.yaxis, 4)


def _tell(axes: Axes, text: str) -> None:
    axes.text(1.0, 1.01, text, transform=axes.transAxes, ha="right", va="bottom", fontsize=7.0, color=GREY)


def _draw_error(axes: Axes, panel: Panel) -> None:
    axes.set_yscale("log", nonpositive="mask")
    axes.set_ylim(*panel.range)
    axes.yaxis.set_major_formatter(_power_of_ten)
    axes.yaxis.set_minor_formatter(NullFormatter())
    _draw_strokes(axes, [stroke.thinned(POINTS) for stroke in panel.strokes])
    axes.set_title(f"{KINDS[panel.kind]} in {panel.unit}")
    if any(not stroke.kind and not stroke.mark for stroke in panel.strokes):  # one entry for all closed forms
        axes.legend(handles=axes.get_lines()[:1], loc="lower right", bbox_to_anchor=(1.0, 1.02))
    else:
        _tell(axes, panel.note)


# --- strokes ---


def _line(colour: str, dashes: Sequence[float]) -> Style:
    """Return matplotlib's line properties of a style."""
    return {"color": colour, "linestyle": (0, tuple(dashes)) if dashes else "-"}


def _draw_strokes(axes: Axes, strokes: Iterable[Stroke]) -> None:
    """Draw lines, those with the lowest depth first."""
    for stroke in strokes:
        line = {**_line(stroke.colour, stroke.dashes), "label": stroke.label}
        line |= {"linewidth": stroke.width, "zorder": stroke.depth}
        if not stroke.is_whole:
            axes.plot(stroke.x, stroke.y, **{**line, **_marks(stroke)})
            continue
        for value in stroke.x:
            axes.axvline(value, **line)
        for value in stroke.y:
            axes.axhline(value, **line)


def _marks(stroke: Stroke) -> Style:
    if stroke.mark == "+":
        return {"marker": "+", "markersize": 11, "markeredgewidth": 1.3, "linestyle": "none"}
    if stroke.mark in ("v", "x"):
        return {"marker": stroke.mark, "markersize": 6, "markeredgewidth": 1.3, "linestyle": "none"}
    if stroke.mark == ".":
        return {"marker": "o", "markersize": 3}
    if stroke.mark:
        return {
            "marker": "o",
            "markersize": stroke.width + 1.5,
            "markerfacecolor": "white",
            "markeredgecolor": stroke.colour,
            "markeredgewidth": 0.3 * stroke.width,
            "solid_joinstyle": "round",
            "solid_capstyle": "round",
            "markevery": slice(0, -1),
        }
    return {"solid_capstyle": "butt"}


def _key(strokes: Iterable[Stroke]) -> list[Line2D]:
    """Return one legend handle for each label; labels that several tracks share are grey."""
    handles: dict[str, Stroke] = {}
    for stroke in strokes:
        first = handles.setdefault(stroke.label, stroke)
        if first.colour != stroke.colour:
            handles[stroke.label] = first._replace(colour=GREY, dashes=())
    return [
        Line2D(
            [0, 1],
            [0, 1],
            label=stroke.label,
            linewidth=stroke.width,
            **{**_line(stroke.colour, stroke.dashes), **_marks(stroke)},
        )
        for stroke in handles.values()
    ]


def _set_ticks(axis: Axis, most: int) -> None:
    """Set round tick numbers, with a maximum number of steps between them."""
    axis.set_major_locator(MaxNLocator(most, steps=(1, 2, 2.5, 5, 10)))
    axis.set_major_formatter(lambda value, _position: number(value))


def _power_of_ten(value: float, _position: float) -> str:
    """Return the label of a tick on a logarithmic axis."""
    digits = str(round(log10(value))).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"10{digits}"
