"""Interactive figure of runs on a page: zoom, a cursor through all panels, switchable joints and bags.

One panel for each quantity has the curves of all joints. The page contains plotly's figures (data and layout) and its
library, compressed; ``interactive.js`` unpacks and links them.
"""

import base64
import html
import json
from collections.abc import Mapping, Sequence

import numpy as np

from ..errors import PlotError
from ..export.closed_form import Array
from ..files import JsonObject
from ..version import needing
from .panels import CURVE, HELD, KINDS, TARGET, LineStyles, Panel, duration, joint_names, panels_of
from .scripts import packed, script
from .strokes import GREY, HAIR, INK, Stroke, line_styles
from .track import Track
from .words import labels
from .workspace import View, views, workspace_title

POINTS = 120_000
"""Number of points of all curves together. An hour of seven joints at 100 Hz is drawn by its extremes every three
seconds, and the page has about 4 MB.
"""
ROW, GAP, EDGE, TOP = 150, 34, 44, 50
"""Height of a panel, distance between panels, and margins below and above all panels, pixels. The margin above has
space for the heading and plotly's buttons.
"""
FONT_SIZE = 12  # pixels
Chart = JsonObject  # a figure of plotly, or a part of one, as JSON
LAYOUT: Chart = {
    "font": {"family": "sans-serif", "size": FONT_SIZE, "color": INK},
    "plot_bgcolor": "white",
    "paper_bgcolor": "white",
    "showlegend": False,
    "separators": ".",
    "dragmode": "zoom",
    "margin": {"l": 64, "r": 14, "t": TOP, "b": EDGE},
}
AXIS: dict[str, object] = {
    "gridcolor": HAIR,
    "linecolor": GREY,
    "zeroline": False,
    "showline": True,
    "exponentformat": "power",
}


def body(tracks: Sequence[Track]) -> str:
    """Return the HTML body of the page."""
    over = over_time(tracks)
    content = {"figures": [over, *in_workspace(tracks)], "rows": _rows(tracks)}
    return f'{_verdicts(tracks)}<div id="plots"></div>\n{_thinned(tracks, over)}{figures_html(content)}'


def figures_html(content: object, name: str = "interactive.js") -> str:
    """Return the HTML with plotly's library and the content, both compressed, and the script that draws them.

    ``interactive.js`` draws figures, and the rows of their legend, into the page's element "plots".
    """
    with needing(PlotError, "plot into a page", "view"):
        from plotly.offline import get_plotlyjs
    return (
        f'<script type="text/plain" id="library">{packed(get_plotlyjs().encode())}</script>\n'
        f'<script type="text/plain" id="content">{packed(json.dumps(content).encode())}</script>\n'
        f"<script>\n{script('plots', name)}</script>\n"
    )


def _verdicts(tracks: Sequence[Track]) -> str:
    """Return the lines of a run's verdict, or the first line of each verdict for several runs."""
    lines: Sequence[str] = tracks[0].verdict.lines
    if len(tracks) > 1:
        lines = [f"{label}: {track.verdict.lines[0]}" for label, track in zip(labels(tracks), tracks)]
    return f'<p class="verdict">{"<br/>".join(map(html.escape, lines))}</p>\n'


def _numbers(values: Array) -> dict[str, str]:
    """Return numbers in plotly's exact binary form."""
    content = np.ascontiguousarray(values, dtype="<f8").tobytes()
    return {"dtype": "f8", "bdata": base64.b64encode(content).decode()}


def _line(stroke: Stroke) -> dict[str, object]:
    dash = ",".join(f"{stroke.width * part:g}px" for part in stroke.dashes)
    return {"color": stroke.colour, "width": stroke.width, "dash": dash or "solid"}


def _trace(stroke: Stroke) -> dict[str, object]:
    """Return plotly's trace for a line or markers of a track's joint, grouped by kind."""
    mark: dict[str, object] = {"color": stroke.colour}
    if stroke.mark == "+":
        mark = {"symbol": "cross-thin-open", "size": 13, "color": INK, "line": {"width": 1.6}}
    elif stroke.mark in ("v", "x"):
        mark = {"symbol": {"v": "triangle-down", "x": "x-thin-open"}[stroke.mark], "size": 10, "color": stroke.colour}
    elif stroke.mark == "o":
        line = {"color": stroke.colour, "width": 0.35 * stroke.width}
        size = [1.4 * stroke.width + 1.5] * (len(stroke.x) - 1) + [0.0]
        mark = {"size": size, "color": "white", "line": line}
    modes = [*["lines"] * (stroke.width > 0.0), *["markers"] * bool(stroke.mark)]
    return {
        "type": "scatter",
        "mode": "+".join(modes),
        "name": stroke.label,
        "marker": mark,
        "x": _numbers(stroke.x),
        "y": _numbers(stroke.y),
        "line": {**_line(stroke), "simplify": False},  # plotly's simplification changes curves visibly
        "meta": [stroke.track, stroke.joint, stroke.kind],
    }


def _thinned(tracks: Sequence[Track], figure: Chart) -> str:
    """Return notes, as HTML, on tracks of which only some samples are drawn."""
    text = ""
    for i, track in enumerate(tracks):
        own = (trace["x"]["bdata"] for trace in figure["data"] if trace["meta"][0] == i)
        drawn = max((len(x) * 3 // 32 for x in own), default=0)  # doubles as base64
        if drawn < track.recording.count:
            text += (
                f"<p>A curve of '{html.escape(track.name)}' is drawn through at most {drawn} of"
                f" {track.recording.count} samples: of each part of it the ends, extremes, and both"
                " sides of the greatest steps. Fewer joints are drawn through more.</p>\n"
            )
    return text


def _line_styles(tracks: Sequence[Track]) -> LineStyles:
    """Return styles: colours distinguish tracks or joints, whichever are more, and dashes the others."""
    bags, joints = line_styles(labels(tracks)), line_styles(joint_names(tracks))
    by_bag = len(bags) > len(joints)
    own = {}
    for i, bag in enumerate(bags):
        own[i, ""] = bag if by_bag else bag._replace(colour=INK)
        for joint in joints:
            colour, dashes = (bag, joint) if by_bag else (joint, bag)
            own[i, joint.label] = joint._replace(colour=colour.colour, dashes=dashes.dashes)
    return own


def _rows(tracks: Sequence[Track]) -> list[dict[str, object]]:
    """Return the legend's rows: each track, and each of its joints."""
    return [
        {
            "bag": i,
            "joint": joint,
            "label": line.label,
            "colour": line.colour,
            "dashes": ",".join(f"{CURVE * part:g}" for part in line.dashes),
        }
        for (i, joint), line in _line_styles(tracks).items()
    ]


# --- over time ---


def over_time(tracks: Sequence[Track]) -> Chart:
    """Return a figure of tracks with a row for each quantity."""
    own = _line_styles(tracks)
    rows: dict[str, list[Panel]] = {}
    for panel in sorted(panels_of(tracks, own), key=lambda panel: [*KINDS].index(panel.kind)):
        heading = f"{KINDS[panel.kind]} in {panel.unit}"
        if panel.kind == "error" and panel.note:
            heading += f": {panel.note}"
        rows.setdefault(heading, []).append(panel)
    return stacked(rows, duration(tracks))


def stacked(rows: Mapping[str, Sequence[Panel]], seconds: float) -> Chart:
    """Return a figure with a row for each heading, on one time axis; panels of a row share its axes."""
    height = len(rows) * (ROW + GAP) - GAP
    time = {
        **AXIS,
        "range": [0.0, seconds],
        "title": {"text": "time in s"},
        "anchor": f"y{len(rows)}",
        "showspikes": True,
        "spikemode": "across",
        "spikethickness": 1,
        "spikecolor": GREY,
        "spikedash": "solid",
        "spikesnap": "hovered data",
    }
    layout = {
        **LAYOUT,
        "height": height + EDGE + TOP,
        "xaxis": time,
        "hovermode": "x",
        "hoverdistance": -1,
        "spikedistance": -1,
        "hoversubplots": "axis",
        "annotations": [],
    }
    most = POINTS // sum(not s.is_limit for each in rows.values() for p in each for s in p.strokes)
    data = []
    for row, (heading, panels) in enumerate(rows.items(), start=1):
        top = 1.0 - (row - 1) * (ROW + GAP) / height
        layout[f"yaxis{row}"] = _value_axis(panels, top, top - ROW / height)
        strokes = [stroke for panel in panels for stroke in panel.strokes]
        if any(stroke.label == "target" and not stroke.kind for stroke in strokes):
            heading += f"; {TARGET}"
        if any(stroke.label == HELD for stroke in strokes):
            heading += f"; {HELD}"
        layout["annotations"].append(_heading(heading, top))
        for stroke in sorted(strokes, key=lambda stroke: stroke.depth):
            hover = "none" if stroke.kind else "skip"
            panel_axes = {"xaxis": "x", "yaxis": f"y{row}", "hoverinfo": hover}
            data.append({**_trace(stroke.thinned(most)), **panel_axes})
    return {"data": data, "layout": layout}


def _value_axis(panels: Sequence[Panel], top: float, bottom: float) -> dict[str, object]:
    low = min(panel.range[0] for panel in panels)
    high = max(panel.range[1] for panel in panels)
    axis = {**AXIS, "anchor": "x", "domain": [max(bottom, 0.0), top]}
    if panels[0].kind == "error":
        font = {"size": FONT_SIZE / 1.25}  # Plotly enlarges powers of 10
        decades = {"type": "log", "dtick": 3 if high > 1e6 * low else 1, "tickfont": font}
        return {**axis, **decades, "range": np.log10([low, high]).tolist()}
    pad = 0.04 * (high - low)  # keeps curves away from the edges
    return {**axis, "range": [low - pad, high + pad], "nticks": 6}


def _heading(text: str, top: float) -> dict[str, object]:
    text = html.escape(text, quote=False)  # plotly reads tags
    return {
        "text": text,
        "x": 0.0,
        "y": top,
        "xref": "paper",
        "yref": "paper",
        "xanchor": "left",
        "yanchor": "bottom",
        "showarrow": False,
        "font": {"size": 13},
    }


# --- the workspace ---


def in_workspace(tracks: Sequence[Track]) -> list[dict[str, object]]:
    """Return a figure for each view."""
    return [_view(view, workspace_title(tracks)) for view in views(tracks, _line_styles(tracks))]


def _view(view: View, title: str) -> dict[str, object]:
    axes = [
        {**AXIS, "title": {"text": f"{letter} in m"}, "range": limits, "nticks": 6}
        for letter, limits in zip(view.axes, (view.across, view.up))
    ]
    strokes = sorted(view.strokes, key=lambda stroke: stroke.depth)
    layout = {
        **LAYOUT,
        "height": 394 + TOP,
        "annotations": [_heading(title, 1.0)],
        "hovermode": "closest",
        "xaxis": axes[0],
        "yaxis": {**axes[1], "scaleanchor": "x"},
        "shapes": [line for stroke in strokes if stroke.is_whole for line in _whole_lines(stroke)],
    }
    hover = {"hovertemplate": "%{x:.4f}, %{y:.4f} m"}
    data = [{**_trace(stroke), **hover} for stroke in strokes if not stroke.is_whole]
    return {"data": data, "layout": layout}


def _whole_lines(stroke: Stroke) -> list[dict[str, object]]:
    """Return shapes for lines at one coordinate, which traces cannot draw."""
    up = [{"x0": x, "x1": x, "y0": 0, "y1": 1, "yref": "paper"} for x in stroke.x]
    across = [{"x0": 0, "x1": 1, "y0": y, "y1": y, "xref": "paper"} for y in stroke.y]
    return [{"type": "line", "line": _line(stroke), **ends} for ends in up + across]
