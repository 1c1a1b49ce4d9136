"""Strokes, their key and ticks, as matplotlib has them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import log10
from typing import Any

from .figure import TICK_STYLE
from .settings import number
from .strokes import GREY, Stroke

# isort: split
from matplotlib.axes import Axes  # where it is missing, twodof.figure says so
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

STEPS = (1, 2, 2.5, 5, 10)  # of ticks


def add_axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """An empty panel, in inches from the upper left corner."""
    across, up = figure.get_size_inches()
    axes = figure.add_axes((left / across, 1.0 - (top + height) / up, width / across, height / up))
    axes.tick_params(which="both", **TICK_STYLE)
    return axes


def line(colour: str, dashes: Sequence[float]) -> dict[str, Any]:
    """A look as matplotlib's lines have it."""
    return {"color": colour, "linestyle": (0, tuple(dashes)) if dashes else "-"}


def draw(axes: Axes, strokes: Iterable[Stroke]) -> None:
    """Draw them, each over those before that are as deep."""
    for stroke in strokes:
        look = {**line(stroke.colour, stroke.dashes), "label": stroke.label}
        look |= {"linewidth": stroke.width, "zorder": stroke.depth}
        if not stroke.is_whole:
            axes.plot(stroke.x, stroke.y, **{**look, **_marks(stroke)})
            continue
        for value in stroke.x:
            axes.axvline(value, **look)
        for value in stroke.y:
            axes.axhline(value, **look)


def _marks(stroke: Stroke) -> dict[str, Any]:
    if stroke.mark == "+":
        return {"marker": "+", "markersize": 11, "markeredgewidth": 1.3, "linestyle": "none"}
    if stroke.mark == ".":
        return {"marker": "o", "markersize": 3}
    if stroke.mark:
        return {
            "marker": "o", "markersize": stroke.width + 1.5, "markerfacecolor": "white",
            "markeredgecolor": stroke.colour, "markeredgewidth": 0.3 * stroke.width,
            "solid_joinstyle": "round", "solid_capstyle": "round", "markevery": slice(0, -1),
        }  # fmt: skip
    return {"solid_capstyle": "butt"}


def key(strokes: Iterable[Stroke]) -> list[Line2D]:
    """One handle for each label; those of several tracks in grey."""
    handles: dict[str, Stroke] = {}
    for stroke in strokes:
        first = handles.setdefault(stroke.label, stroke)
        if first.colour != stroke.colour:
            handles[stroke.label] = first._replace(colour=GREY, dashes=())
    return [
        Line2D(
            [0, 1], [0, 1], label=stroke.label, linewidth=stroke.width,
            **{**line(stroke.colour, stroke.dashes), **_marks(stroke)},
        )
        for stroke in handles.values()
    ]  # fmt: skip


def set_ticks(axis: Axis, most: int) -> None:
    """Round numbers, at most so many steps between them."""
    axis.set_major_locator(MaxNLocator(most, steps=STEPS))
    axis.set_major_formatter(FuncFormatter(lambda value, _position: number(value)))


def set_decades(axes: Axes, low: float, high: float) -> None:
    """Whole decades up, and their ticks."""
    axes.set_ylim(low, high)
    axis = axes.yaxis
    axis.set_major_locator(LogLocator(numticks=6))
    few = high < 5000.0 * low
    axis.set_minor_locator(LogLocator(subs=range(2, 10)) if few else NullLocator())
    axis.set_minor_formatter(NullFormatter())
    axis.set_major_formatter(FuncFormatter(_power_of_ten))


def _power_of_ten(value: float, _position: int | None = None) -> str:
    digits = str(round(log10(value))).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"10{digits}"
