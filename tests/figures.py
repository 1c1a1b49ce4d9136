"""Contents of a figure of runs, by its artists."""

import re
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.text import Text


def lines(axes: Axes, label: str) -> list[Line2D]:
    return [line for line in axes.get_lines() if line.get_label() == label]


def points(line: Line2D) -> np.ndarray:
    return np.column_stack([line.get_xdata(), line.get_ydata()])


def only(axes: Axes, label: str) -> np.ndarray:
    (line,) = lines(axes, label)
    return points(line)


def heights(axes: Axes, label: str) -> list[float]:
    """Return the heights of level lines, the lowest first."""
    return sorted(points(line)[0, 1] for line in lines(axes, label))


def legend_of(axes: Axes) -> list[str]:
    """Return the legend of the panel, or of its part of the figure."""
    own = axes.get_legend()
    (found,) = [own] if own else axes.figure.legends
    return [text.get_text() for text in found.get_texts()]


class Panels(NamedTuple):
    """The panels of a figure, joints in the order of their rows."""

    q: list[Axes]
    v: list[Axes]
    error: Axes | None
    views: list[Axes]


def panels(figure: Figure) -> Panels:
    error = [axes for axes in figure.axes if axes.get_title("left").startswith("Distance")]
    views = [axes for axes in figure.axes if re.fullmatch("[xyz] in m", axes.get_xlabel())]
    joints = [axes for axes in figure.axes if axes not in (*error, *views)]
    if any(axes.get_title("left").startswith("Velocity") for axes in joints):
        return Panels(joints[0::2], joints[1::2], error[0] if error else None, views)
    return Panels(joints, [], error[0] if error else None, views)


def texts(figure: Figure) -> list[str]:
    """Return texts line by line."""
    return [line for text in figure.findobj(Text) for line in text.get_text().splitlines()]


def key(figure: Figure) -> Legend:
    """Return the labels that distinguish tracks."""
    (legend,) = figure.subfigs[0].legends
    return legend


def key_of(figure: Figure) -> list[str]:
    return [text.get_text() for text in key(figure).get_texts()]


def notes(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.texts]


def boxes(figure: Figure) -> list[tuple[Text, Any]]:
    """Return all visible texts and their bounding boxes, in pixels."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    ticks = {}
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            slack = 1e-9 * (high - low)
            for tick in axis.get_major_ticks():
                ticks[tick.label1] = low - slack <= tick.get_loc() <= high + slack
                ticks[tick.label2] = False
    found = []
    for text in figure.findobj(Text):
        if text.get_text().strip() and text.get_visible() and ticks.get(text, True):
            found.append((text, text.get_window_extent(canvas.get_renderer())))
    return found


def assert_legible(figure: Figure) -> None:
    """Assert that no text is cut off, overlaps another, or is smaller than 5 pt on an A4 page."""
    seen = boxes(figure)
    assert len(seen) > 10
    width, height = figure.canvas.get_width_height()
    texts = [text for text, _ in seen]
    low, high = (
        np.array([corner(box) for _, box in seen])
        for corner in (lambda box: (box.x0, box.y0), lambda box: (box.x1, box.y1))
    )
    for text, inside in zip(texts, np.all((low >= 0) & (high <= (width, height)), axis=1)):
        assert inside, f"{text} is cut off"
    common = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    for i, j in np.argwhere(np.triu((common >= 1.0).all(axis=2), k=1)):
        raise AssertionError(f"{texts[i]} lies on {texts[j]}")
    for axes in figure.axes:
        own, box = {*axes.findobj(Text)}, axes.bbox
        common = np.minimum(high, (box.x1, box.y1)) - np.maximum(low, (box.x0, box.y0))
        for i in np.flatnonzero((common >= 1.0).all(axis=1)):
            assert texts[i] in own, f"{texts[i]} lies on a panel"
    on_paper = 17.0 / 2.54 / max(17.0 / 2.54, figure.get_size_inches()[0])
    assert min(text.get_fontsize() for text in texts) * on_paper > 5.0
