"""Strokes of the workspace, and the looks of lines and ticks, as matplotlib has them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np

from .scales import GREY
from .track import number
from .workspace import Stroke, View

# isort: split
from matplotlib.axes import Axes  # where it is missing, twodof.figure says so
from matplotlib.axis import Axis
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

STEPS = (1, 2, 2.5, 5, 10)  # of ticks


def line(colour: str, dashes: Sequence[float]) -> dict[str, Any]:
    """A look as matplotlib's lines have it."""
    return {"color": colour, "linestyle": (0, tuple(dashes)) if dashes else "-"}


def set_ticks(axis: Axis, most: int) -> None:
    """Round numbers, at most so many steps between them."""
    axis.set_major_locator(MaxNLocator(most, steps=STEPS))
    axis.set_major_formatter(FuncFormatter(lambda value, _position: number(value)))


def draw_view(axes: Axes, view: View, aspect: float) -> None:
    """Draw it; aspect is height : width."""
    low, high = view.box(aspect)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), autoscale_on=False)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{view.axes[0]} in m", ylabel=f"{view.axes[1]} in m")
    set_ticks(axes.xaxis, 5)
    set_ticks(axes.yaxis, 5)
    for stroke in view.strokes:
        look = {**line(stroke.colour, stroke.dashes), "label": stroke.label}
        look |= {"linewidth": stroke.width, "zorder": stroke.depth}
        x, y = stroke.points.T
        if np.isfinite(stroke.points).all():
            axes.plot(x, y, **{**look, **_marks(stroke)})
        for value in x[np.isnan(y) & np.isfinite(x)]:
            axes.axvline(value, **look)
        for value in y[np.isnan(x) & np.isfinite(y)]:
            axes.axhline(value, **look)


def _marks(stroke: Stroke) -> dict[str, Any]:
    if stroke.mark == "+":
        return {"marker": "+", "markersize": 11, "markeredgewidth": 1.3, "linestyle": "none"}
    if stroke.mark:
        return {
            "marker": "o", "markersize": stroke.width + 1.5, "markerfacecolor": "white",
            "markeredgecolor": stroke.colour, "markeredgewidth": 0.3 * stroke.width,
            "solid_joinstyle": "round", "solid_capstyle": "round", "markevery": slice(0, -1),
        }  # fmt: skip
    return {}


def key(views: Sequence[View]) -> list[Line2D]:
    """One handle for each label; those of several tracks in grey."""
    handles: dict[str, Stroke] = {}
    for stroke in chain.from_iterable(view.strokes for view in views):
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
