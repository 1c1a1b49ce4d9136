"""Page of a fit: its verdict, tables, and curves as measured and as the model gives them."""

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from itertools import chain, repeat

import numpy as np

from ..plots.figure import Drawing, html_of
from ..plots.interactive import Chart, figures_html, stacked
from ..plots.panels import CURVE, THIN, Panel
from ..plots.strokes import COLOURS, GREY, HAIR, INK, LineStyle, Stroke
from .curves import Curve, Table
from .prediction import WINDOW
from .stretches import Array

STYLES = (
    LineStyle("measured", INK, ()),
    LineStyle("model before the fit", GREY, (3, 2)),
    LineStyle("model after the fit", COLOURS[1], ()),
)
BEFORE = 1  # index of its style
WIDTHS, DEPTHS = (THIN, THIN, 2.0 * CURVE), (2.5, 1.5, 2.0)  # the measured curve is a line on the model's band
MOST_OPEN = 15  # rows of a table that is not folded
SPACE = 1.0  # s between two stretches on the time axis
LINES = "Thin: measured; thick: model; dashed: model before the fit; grey band: held out of the fit."


def fit_page(
    title: str,
    lines: Sequence[str],
    tables: Mapping[str, Table],
    facts: Mapping[str, str],
    joints: Mapping[str, str],
    curves: Sequence[Curve],
) -> bytes:
    """Return a self-contained page.

    Args:
        lines: the verdict, then remarks.
        tables: tables by caption; long ones except the first are folded.
        facts: table at the end of the page.
        joints: units of positions, rad or m, by joint.
        curves: the stretches.

    Raises:
        PlotError: plotly is missing.
    """
    first, *others = (escape(line[:1].upper() + line[1:]) for line in lines)
    text = f'<p class="verdict"><b>{first}</b><br/>{"<br/>".join(others)}</p>\n'
    for k, (caption, rows) in enumerate(tables.items()):
        shown = " open" if k == 0 or len(rows) <= MOST_OPEN else ""
        text += f"<details{shown}><summary>{escape(caption)}</summary><table>{_html(rows)}</table></details>\n"
    content = {"figures": [*_figures(joints, curves)], "rows": [*_legend(joints)]}
    text += f'<p>{LINES}</p>\n<div id="plots"></div>\n{figures_html(content)}'
    return html_of(Drawing(title, "fit", lambda figure: None, [facts], body=lambda: text))


def _html(rows: Table) -> str:
    tags = chain(["th"], repeat("td"))
    cells = ("".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in row) for tag, row in zip(tags, rows))
    return "".join(f"<tr>{row}</tr>" for row in cells)


def _legend(joints: Mapping[str, str]) -> Iterator[dict[str, object]]:
    """Return the legend's rows: each kind of curve, and each of its joints."""
    for i, style in enumerate(STYLES):
        dashes = ",".join(f"{WIDTHS[i] * part:g}" for part in style.dashes)
        for joint in ("", *joints):
            yield {"bag": i, "joint": joint, "label": joint or style.label, "colour": style.colour, "dashes": dashes}


def _figures(joints: Mapping[str, str], curves: Sequence[Curve]) -> Iterator[Chart]:
    """Return a figure of efforts and residuals, and one of positions of held-out stretches, if there are any."""
    curves = sorted(curves, key=lambda curve: (curve.bag, curve.t[0]))
    rows: dict[str, list[Panel]] = {}
    times = _times(curves)
    for i, (joint, unit) in enumerate(joints.items()):
        unit = "N·m" if unit == "rad" else "N"
        lines = [(curve.effort[:, i], *curve.modelled[:, :, i]) for curve in curves]
        rows[f"Effort of {joint} in {unit}"] = [_panel("tau", joint, unit, times, lines)]
        rest = [(none := np.full_like(effort, np.nan), none, effort - after) for effort, _, after in lines]
        rows[f"Measured less model, {joint} in {unit}"] = [_panel("residual", joint, unit, times, rest)]
    figure = _stacked(rows, times)
    band = {
        "type": "rect",
        "y0": 0,
        "y1": 1,
        "yref": "paper",
        "fillcolor": HAIR,
        "line": {"width": 0},
        "layer": "below",
    }
    held = [(time, curve) for time, curve in zip(times, curves) if curve.measured.size]
    figure["layout"]["shapes"] = [{**band, "x0": time[0], "x1": time[-1]} for time, _ in held]
    yield figure
    if held:
        curves = [curve for _, curve in held]
        times, rows = _times(curves), {}
        for i, (joint, unit) in enumerate(joints.items()):
            lines = [(curve.measured[:, i], *curve.simulated[:, :, i]) for curve in curves]
            rows[f"Position of {joint} in {unit}; windows of {WINDOW:g} s"] = [_panel("q", joint, unit, times, lines)]
        yield _stacked(rows, times)


def _stacked(rows: Mapping[str, Sequence[Panel]], times: Sequence[Array]) -> Chart:
    figure = stacked(rows, times[-1][-1])
    figure["layout"]["xaxis"]["range"] = [times[0][0], times[-1][-1]]
    return figure


def _times(curves: Sequence[Curve]) -> list[Array]:
    """Return the times of stretches, s: those of the first bag, and the other bags' after them."""
    times, offset, bag = list[Array](), 0.0, curves[0].bag
    for curve in curves:
        if curve.bag != bag:
            bag, offset = curve.bag, float(times[-1][-1]) + SPACE - float(curve.t[0])
        times.append(curve.t + offset)
    return times


def _panel(kind: str, joint: str, unit: str, times: Sequence[Array], lines: Sequence[Sequence[Array]]) -> Panel:
    """Return a panel, whose range contains the measured and the fitted curve."""
    strokes = []
    for i, style in enumerate(STYLES):
        y = _joined([line[i] for line in lines])
        if not np.isnan(y).all():
            pen = (style.colour, THIN if kind == "residual" else WIDTHS[i], style.dashes, "", DEPTHS[i])
            strokes.append(Stroke(style.label, i, _joined(times), y, *pen, joint=joint, kind=kind))
    values = np.concatenate([stroke.y for stroke in strokes if stroke.track != BEFORE])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    pad = 0.06 * max(high - low, 1e-9)
    return Panel(kind, joint, unit, tuple(strokes), "", (low - pad, high + pad))


def _joined(parts: Sequence[Array]) -> Array:
    """Return arrays as one, with NaN after each."""
    return np.concatenate([np.append(part, np.nan) for part in parts])
