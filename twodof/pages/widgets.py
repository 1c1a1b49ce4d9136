"""What a page's control panel is made of: switches, sliders, a readout, plots."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np

from ..plots.scales import COLOURS, GREY, SMALLEST_RANGE
from .page import Array, Page

BUCKETS = 400
"""Parts of a long line over time that each keep their extremes; a plot is as many pixels wide."""


class Switch:
    """Two buttons in one place, of which one is shown; a click means what its button said.

    A single button with two labels would mean the other one while the label is on its way.

    Args:
        page: the page.
        on, off: labels, of what turns it on and off.
        change: told what was asked for.
        state: which it is at first.
        options: of viser's buttons.
    """

    def __init__(
        self, page: Page, on: str, off: str, change: Callable[[bool], None], state: bool,
        **options: Any,
    ) -> None:  # fmt: skip
        self._buttons = (page.gui.add_button(on, **options), page.gui.add_button(off, **options))
        self._buttons[0].on_click(lambda event: change(True))
        self._buttons[1].on_click(lambda event: change(False))
        self.show(state)

    def show(self, state: bool, off: str | None = None) -> None:
        """Show the state that it is in, and another label of what turns it off."""
        for button, visible in zip(self._buttons, (not state, state)):
            if button.visible != visible:
                button.visible = visible
        if off is not None:
            self._buttons[1].label = off


class Readout:
    """A table of names and numbers.

    Each number is the text of an element with the attribute ``data-value``, its name. ``names``
    are those of lines in the plots, whose colours they have.
    """

    def __init__(self, page: Page, names: Sequence[str] = ()) -> None:
        self._handle = page.gui.add_html("")
        self._colours = dict(zip(names, cycle(COLOURS)))

    def show(self, rows: Mapping[str, str]) -> None:
        """Show values by their names."""
        lines = "".join(
            f'<tr><td style="color:{self._colours.get(name, GREY)};padding:1px 10px 1px 0">'
            f"{html.escape(name)}</td>"
            f'<td data-value="{html.escape(name)}">{html.escape(value)}</td></tr>'
            for name, value in rows.items()
        )
        self._handle.content = (
            '<table style="font-size:12.5px;font-variant-numeric:tabular-nums;margin:2px 10px">'
            f"{lines}</table>"
        )


def add_sliders(
    page: Page, labels: Sequence[str], ranges: Sequence[tuple[float, float]],
    starts: Sequence[float], release: str, change: Callable[[list[float]], None],
) -> None:  # fmt: skip
    """Sliders whose values go to ``change``; with a button ``release`` that sets all to 0."""
    sliders = []
    for label, (low, high), start in zip(labels, ranges, starts):
        low, high = min(low, start), max(high, start)
        sliders.append(page.gui.add_slider(label, low, high, (high - low) / 200, start))

    def pushed(event: Any) -> None:
        change([float(slider.value) for slider in sliders])

    def released(event: Any) -> None:
        for slider in sliders:
            slider.value = 0.0

    for slider in sliders:
        slider.on_update(pushed)
    if release:
        page.gui.add_button(release).on_click(released)


class Plot:
    """Lines over time, with a mark at the present time.

    Args:
        page: the page.
        title: what is drawn, with its unit.
        names: of the lines.
        t: times, N values, s.
        rows: values, N × lines.
        marked: with the mark, and a range of values that is that of the rows for good.
    """

    def __init__(
        self, page: Page, title: str, names: Sequence[str], t: Array, rows: Array, *, marked: bool
    ) -> None:
        times, values = outline(t, rows)
        self._lines = (times, *values.T)
        self._marked = marked
        dots = {"show": False}
        series: list[Any] = [{"label": "t"}]
        for name, colour in zip(names, cycle(COLOURS)):
            series.append({"label": name, "stroke": colour, "width": 1.5, "points": dots})
        # a line of rounding errors is drawn flat
        soft = {"pad": 0.1, "soft": SMALLEST_RANGE, "mode": 1}
        y: Any = {"range": {"min": {**soft, "soft": 0.0}, "max": soft}}
        if marked:
            series.append({"label": "now", "stroke": "#d0342c", "width": 1.0, "points": dots})
            finite = values[np.isfinite(values)]
            low, high = (finite.min(), finite.max()) if len(finite) else (0.0, 1.0)
            margin = max(0.06 * (high - low), SMALLEST_RANGE)
            self._range = float(low - margin), float(high + margin)
            y = {"range": self._range}
        self._handle = page.gui.add_uplot(
            self._data(0.0), tuple(series), title=title, height=150,
            scales={"x": {"time": False}, "y": y},
            legend={"show": False}, cursor={"show": False}, padding=(8, 24, 0, 0),
        )  # fmt: skip

    def show(self, t: Array, rows: Array) -> None:
        """Draw other lines."""
        self._lines = (t, *rows.T)
        self._handle.data = self._data(0.0)

    def mark(self, time: float) -> None:
        """Move the mark."""
        self._handle.data = self._data(time)

    def _data(self, time: float) -> tuple[Array, ...]:
        if not self._marked:
            return self._lines
        line = np.full(len(self._lines[0]), np.nan)
        at = min(max(int(np.searchsorted(self._lines[0], time)), 1), len(line) - 1)
        line[at - 1 : at + 1] = self._range[: len(line)]
        return (*self._lines, line)


def outline(t: Array, rows: Array) -> tuple[Array, Array]:
    """At most 2·BUCKETS points of N that keep each line's extremes; times and values."""
    if len(t) <= 2 * BUCKETS:
        return t, rows
    edges = np.linspace(0, len(t), BUCKETS + 1).astype(int)[:-1]
    times = np.repeat(t[edges], 2)
    times[1::2] = (t[edges] + np.append(t[edges[1:]], t[-1])) / 2
    values = np.empty((2 * BUCKETS, rows.shape[1]))
    values[0::2] = np.minimum.reduceat(rows, edges, axis=0)
    values[1::2] = np.maximum.reduceat(rows, edges, axis=0)
    return times, values
