"""The gain map: metrics of a sweep over the varied variables.

For one variable, each metric is a curve. For two, it is a heat map, or dots if values are random. For more variables,
each pair has a row of such maps, which show the best value over the other variables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import combinations
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import PlotError
from ..export.closed_form import Array
from ..sweeps.ranking import METRICS, ROUNDING, USE, beyond_limits, candidates, ranked, remark
from .figure import Drawing, draw_head, html_of
from .maps import CROSSES, HOLLOW, map_page
from .settings import WRITTEN
from .strokes import COLOURS, GREY, HAIR, INK, PALE, SMALLEST_ERROR, Style

# isort: split
from matplotlib.axes import Axes  # if matplotlib is missing, figure raises
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

if TYPE_CHECKING:
    import pandas

    from ..sweeps.ranking import Expression

PAIRED = ("settling_time", "overshoot", "peak_effort")
"""Metrics that are drawn for pairs of variables: speed, and its cost in precision and effort."""
MOST_PAIRS = 10
MOST_DOTS = 20_000  # of a panel, for which Matplotlib takes 0.2 s
WIDTH, HEIGHT = 3.2, 2.5  # inches, of a panel with axes and colour bar
WIDE = 10.0  # ratio of largest to smallest value from which on colours are logarithmic
BEST: Style = dict(marker="*", s=90, color=COLOURS[1], edgecolors="white", linewidths=0.7)
BEYOND: Style = dict(marker="X", s=10, color=INK, edgecolors="white", linewidths=0.4)
CRITICAL: Style = dict(linestyle=(0, (4, 2)), linewidth=1.2)
MISSING: Style = dict(facecolor=HAIR, hatch="////", edgecolor="#c3cad1", linewidth=0.0)


class _Panel(NamedTuple):
    """A picture of a metric over one or two variables."""

    metric: str
    x: str
    y: str | None = None


def map_html(sweep: pandas.DataFrame | str | Path) -> bytes:
    """Return the page of a sweep's map, given its table, or its folder with the bags of its runs."""
    if isinstance(sweep, (str, Path)):
        from ..sweeps.results import read_sweep

        folder = Path(sweep)
        return html_of(drawing(read_sweep(folder), folder.resolve().name, bags=folder / "bags"))
    return html_of(drawing(sweep, "sweep"))


def drawing(table: pandas.DataFrame, name: str, cost: Expression | None = None, bags: Path | None = None) -> Drawing:
    """Return the drawing of a sweep, given the result of ``read_sweep``.

    Args:
        cost: cost by which the page ranks runs; None: rank by RANKED.
        bags: folder with a bag of each run, whose curves a page shows.
    """
    provenance = table.attrs["provenance"]
    design = provenance["design"]
    varied = [*design["grids"], *design["ranges"]]
    best = ranked(table, cost)
    if best.empty:
        raise PlotError(f"'{name}' has no finished run")
    shown = {"run": "run", **{name: f"{name}{_in(table.attrs['units'][name])}" for name in varied}}
    known = [key for key in METRICS if table[key].notna().any()]
    shown |= {key: f"{METRICS[key].title}{_in(METRICS[key].unit)}" for key in known}
    columns = [{title: f"{row[key]:.4g}" for key, title in shown.items()} for row in best.head(5).to_dict("records")]
    title = f"{provenance['fmu']['name']}: {len(table)} runs over {', '.join(varied)}"
    options = provenance["options"]
    settings = [f"{options['stop_time']:g} s each in steps of {options['step']:g} s"]
    settings += [f"{name} = {value:g}" for name, value in options["settings"].items()]
    draw = partial(_draw, table, varied, {*design["grids"]}, title, ", ".join(settings))
    page = partial(map_page, table, varied, bags, best["run"].head(1).tolist())
    return Drawing(title, Path(name).name, draw, columns, above=page)


def _in(unit: str) -> str:
    return f", {WRITTEN.get(unit, unit)}" if unit else ""


def _draw(
    table: pandas.DataFrame, varied: Sequence[str], grids: set[str], title: str, settings: str, figure: Figure
) -> None:
    panels, across = _panels(table, varied)
    rows = ceil(len(panels) / across)
    key = "★ least"
    beyond = _thinned(table[beyond_limits(table)] if len(varied) < 3 else table[:0])
    if len(beyond):
        key += f"    {CROSSES}"
    if len(varied) > 1:
        key += f"    hatched, {HOLLOW}"
    if {"Kp", "Kd"} <= {*varied}:
        key += "    dashed: critical damping, Kd = 2 √Kp"
    texts = (settings, key, remark(table))
    inside = draw_head(figure, title, texts, (WIDTH * across, HEIGHT * rows))
    grid, possible = inside.add_gridspec(rows, across), candidates(table)
    counts, shared = table.index.isin(possible.index), table
    for i, panel in enumerate(panels):
        axes = inside.add_subplot(grid[i])
        axes.set_label(f"{panel.metric} over {panel.x}" + (f" and {panel.y}" if panel.y else ""))
        if panel.y is None:
            _draw_curve(axes, table, panel)
        else:
            if len(varied) > 2 and i % across == 0:  # a row of panels shares its variables
                shared = _best_of_pair(table, counts, panels[i : i + across])
            draw = _draw_cells if {panel.x, panel.y} <= grids else _draw_dots
            shown = draw(axes, shared, panel)
            _draw_critical(axes, panel, "white" if draw is _draw_cells else GREY)
            bar = inside.colorbar(shown, ax=axes)
            bar.ax.tick_params(labelsize=7.0, color=GREY, labelcolor=INK, width=0.7)
            bar.outline.set_visible(False)
            if isinstance(shown.norm, LogNorm):
                _label_decades(bar.ax.yaxis)
            else:
                bar.locator = MaxNLocator(5)
        axes.scatter(beyond[panel.x], beyond[panel.y or panel.metric], zorder=2.5, **BEYOND)
        _mark_best(axes, possible, table.attrs["units"], panel)


def _best_of_pair(table: pandas.DataFrame, counts: NDArray[np.bool_], panels: Sequence[_Panel]) -> pandas.DataFrame:
    """Return the least value of each metric over all other variables, among the candidates."""
    pair = [panels[0].x, panels[0].y]
    values = {panel.metric: table[panel.metric].where(counts) for panel in panels}
    return table[pair].assign(**values).groupby(pair, as_index=False).min()


def _thinned(rows: pandas.DataFrame) -> pandas.DataFrame:
    """Return evenly spaced rows, as many as a picture shows."""
    return rows.iloc[:: max(1, -(-len(rows) // MOST_DOTS))]


def _panels(table: pandas.DataFrame, varied: Sequence[str]) -> tuple[list[_Panel], int]:
    """Return the panels, and the number of panels in a row."""
    metrics = [metric for metric in METRICS if metric not in USE]
    telling = [metric for metric in metrics if table[metric].nunique() > 1]
    telling = telling or [metric for metric in metrics if table[metric].notna().any()]
    if len(varied) <= 2:
        return [_Panel(metric, *varied) for metric in telling], 3
    chosen = [metric for metric in PAIRED if metric in telling] or telling[:1]
    pairs = list(combinations(varied, 2))[:MOST_PAIRS]
    return [_Panel(metric, *pair) for pair in pairs for metric in chosen], len(chosen)


def _draw_curve(axes: Axes, table: pandas.DataFrame, panel: _Panel) -> None:
    rows = _thinned(table[[panel.x, panel.metric]].sort_values(panel.x))
    values = rows[panel.metric].to_numpy(dtype=float)
    style = "-" if len(rows) > 60 else "o-"
    axes.plot(rows[panel.x], values, style, color=COLOURS[0], markersize=3.0)
    if isinstance(_norm(values), LogNorm):
        axes.set_yscale("log")
        _label_decades(axes.yaxis)


def _draw_cells(axes: Axes, rows: pandas.DataFrame, panel: _Panel) -> ScalarMappable:
    cells = rows.pivot(index=panel.y, columns=panel.x, values=panel.metric)
    values = np.ma.masked_invalid(cells.to_numpy(dtype=float))
    axes.grid(False)
    axes.patch.set(**MISSING)
    return axes.pcolormesh(
        _edges(cells.columns.to_numpy()),
        _edges(cells.index.to_numpy()),
        values,
        norm=_norm(values.compressed()),
        cmap="viridis",
        rasterized=values.size > 2500,
        edgecolors="face",
        linewidth=0.3,  # avoids seams in viewers of SVG and PDF
    )


def _draw_dots(axes: Axes, rows: pandas.DataFrame, panel: _Panel) -> ScalarMappable:
    rows = _thinned(rows)
    missing = rows[rows[panel.metric].isna()]
    axes.scatter(missing[panel.x], missing[panel.y], s=7, facecolors="none", edgecolors=PALE)
    return axes.scatter(
        rows[panel.x],
        rows[panel.y],
        c=rows[panel.metric],
        s=12,
        linewidths=0.0,
        cmap="viridis",
        norm=_norm(rows[panel.metric].to_numpy(dtype=float)),
    )


def _draw_critical(axes: Axes, panel: _Panel, colour: str) -> None:
    """Draw the curve of critical damping of e'' + Kd e' + Kp e = 0: Kd = 2 √Kp."""
    if {panel.x, panel.y} == {"Kp", "Kd"}:
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        gains = np.linspace(max(left, 0.0), right, 200)
        critical = 2 * np.sqrt(gains) if panel.x == "Kp" else gains**2 / 4
        axes.plot(gains, critical, color=colour, **CRITICAL)
        axes.set(xlim=(left, right), ylim=(low, high))


def _mark_best(axes: Axes, possible: pandas.DataFrame, units: Mapping[str, str], panel: _Panel) -> None:
    """Mark the candidate with the smallest value; mark none if several are equal."""
    values = possible[panel.metric]
    wanted = [name for name in (panel.x, panel.y, panel.metric) if name]
    least = possible.loc[values <= values.min() + ROUNDING * max(1.0, abs(values.min())), wanted]
    metric = METRICS[panel.metric]
    axes.set_title(f"{metric.title}{_in(metric.unit)}", pad=14.0)
    value = least[panel.metric].min()  # NaN without candidates
    shown = f"{value:.3g}" if value > ROUNDING else "0"
    text = f"least in {len(least)} runs: {shown}" if len(least) else "not defined"
    if len(least) == 1:
        best = least.iloc[0]
        axes.scatter([best[panel.x]], [best[panel.y or panel.metric]], zorder=3, **BEST)
        at = ", ".join(f"{name} {best[name]:.4g}" for name in (panel.x, panel.y) if name)
        text = f"★ {shown} at {at}"
    axes.annotate(text, (0, 1), (0, 4), xycoords="axes fraction", textcoords="offset points", fontsize=7.0, color=GREY)
    named = {name: f"{name}{_in(unit)}" for name, unit in units.items()}
    axes.set(xlabel=named[panel.x], ylabel=named[panel.y] if panel.y else "")


def _label_decades(axis: Axis) -> None:
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 1000 * low else (1,), numticks=7))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def _edges(values: Array) -> Array:
    """Return the edges of cells around ascending values."""
    if len(values) == 1:  # an unfinished sweep
        return np.array([values[0] - 0.5, values[0] + 0.5])
    middles = (values[1:] + values[:-1]) / 2
    return np.array([2 * values[0] - middles[0], *middles, 2 * values[-1] - middles[-1]])


def _norm(values: Array) -> Normalize:
    """Return the colour scale of values, linear or logarithmic."""
    known = values[np.isfinite(values)]
    if not known.size:
        return Normalize(0.0, 1.0)
    low, high = known.min(), known.max()
    least = max(low, SMALLEST_ERROR)
    return LogNorm(least, high) if low > 0.0 and high > WIDE * least else Normalize(low, high)
