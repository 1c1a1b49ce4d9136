"""The figure of runs on a page: zoom, a cursor through all panels, joints and bags switched.

Of each quantity one panel has the curves of all joints. What stands on the page is plotly's figures
as it has them, data and layout, and its library, packed; ``interactive.js`` unpacks and joins them.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..errors import PlotError
from ..files import data_file, packed
from .closed_form import Array
from .panels import (
    KINDS,
    Curve,
    Look,
    Panel,
    close_outline,
    duration,
    error_panel,
    joint_names,
    joint_panels,
    looks,
    track_looks,
)  # fmt: skip
from .scales import GREY, HAIR, INK, PALE
from .track import Track
from .workspace import Stroke, View, views, workspace_title

POINTS = 120_000
"""Of all curves. An hour of seven joints at 100 Hz is known by its extremes every three seconds,
and the page has some four megabytes."""
ROW, GAP, EDGE, TOP = 150, 34, 44, 50
"""Pixels: a panel's height, between panels, below the last, and above the first, for its heading
and plotly's buttons above that."""
LAYOUT: dict[str, Any] = {
    "font": {"family": "sans-serif", "size": 12, "color": INK}, "plot_bgcolor": "white",
    "paper_bgcolor": "white", "showlegend": False, "separators": ".", "dragmode": "zoom",
    "margin": {"l": 64, "r": 14, "t": TOP, "b": EDGE},
}  # fmt: skip
AXIS = {
    "gridcolor": HAIR,
    "linecolor": GREY,
    "zeroline": False,
    "showline": True,
    "exponentformat": "power",
}


def body(tracks: Sequence[Track]) -> str:
    """What stands on the page.

    Raises:
        PlotError: plotly is missing.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as missing:
        raise PlotError(
            f"cannot plot into a page: {missing}; install the package 'plotly' (the extra 'view')"
        ) from missing
    over = over_time(tracks)
    content = {"figures": [over, *in_workspace(tracks)], "rows": _rows(tracks)}
    script = data_file("plots", "interactive.js").read_text("utf-8")
    return (
        f'<div id="plots"></div>\n{_thinned(tracks, over)}'
        f'<script type="text/plain" id="library">{packed(get_plotlyjs().encode())}</script>\n'
        f'<script type="text/plain" id="content">{packed(json.dumps(content).encode())}</script>\n'
        f"<script>\n{script}</script>"
    )


def _text(name: str) -> str:
    """As plotly has it, which reads tags in what it shows."""
    return html.escape(name, quote=False)


def _numbers(values: Array) -> dict[str, str]:
    """As plotly has arrays: bytes, which are exact."""
    content = np.ascontiguousarray(values, dtype="<f8").tobytes()
    return {"dtype": "f8", "bdata": base64.b64encode(content).decode()}


def _line(colour: str, dashes: Sequence[float] = (), width: float = 1.4) -> dict[str, Any]:
    told = ",".join(f"{width * part:g}px" for part in dashes)
    return {"color": colour, "width": width, "dash": told or "solid"}


def _thinned(tracks: Sequence[Track], figure: dict[str, Any]) -> str:
    """Which samples are drawn, where they are not all: a line for each track."""
    lines = []
    for i, track in enumerate(tracks):
        own = [t["x"]["bdata"] for t in figure["data"] if t["meta"][0] == i and "bdata" in t["x"]]
        drawn = max((len(base64.b64decode(x)) // 8 for x in own), default=0)
        if drawn < track.recording.count:
            lines.append(
                f"<p>A curve of '{_text(track.name)}' is drawn through at most {drawn} of"
                f" {track.recording.count} samples: of each part of it the ends, extremes, and both"
                " sides of the greatest steps. Fewer joints are drawn through more.</p>\n"
            )
    return "".join(lines)


# --- what is switched ---


def _looks(tracks: Sequence[Track]) -> dict[tuple[int, str], Look]:
    """Of each track's joints, and of the track itself, whose joint is "".

    Colours tell apart what there is more of, dashes the other.
    """
    bags, joints = track_looks(tracks), looks(joint_names(tracks))
    by_bag = len(bags) > len(joints)
    found = {}
    for i, bag in enumerate(bags):
        for joint in joints:
            colour, dashes = (bag, joint) if by_bag else (joint, bag)
            found[i, joint.label] = Look(joint.label, colour.colour, dashes.dashes)
        found[i, ""] = bag if by_bag else bag._replace(colour=INK)
    return found


def _rows(tracks: Sequence[Track]) -> list[dict[str, Any]]:
    """Of the legend: each track, and each of its joints."""
    found = []
    for (i, joint), look in _looks(tracks).items():
        swatch = ",".join(f"{1.4 * part:g}" for part in look.dashes)
        row = {"bag": i, "joint": joint, "label": look.label, "colour": look.colour}
        found.append({**row, "dashes": swatch})
    return sorted(found, key=lambda row: (row["bag"], row["joint"] != ""))


# --- over time ---


def over_time(tracks: Sequence[Track]) -> dict[str, Any]:
    """A row for each quantity, on one axis of time."""
    rows: dict[tuple[str, str], list[Panel]] = {}
    for kind in KINDS:
        for panel in joint_panels(tracks):
            if panel.kind == kind:
                rows.setdefault((kind, panel.unit), []).append(panel)
    if error := error_panel(tracks):
        rows["error", error.unit] = [error]
    look = _looks(tracks)
    drawn = [panel for panels in rows.values() for panel in panels]
    curves = sum(len(panel.curves) + len(panel.closed_forms) for panel in drawn)
    end = duration(tracks)
    height = len(rows) * (ROW + GAP) - GAP
    time = {
        **AXIS, "range": [0.0, end], "title": {"text": "time in s"}, "anchor": f"y{len(rows)}",
        "showspikes": True, "spikemode": "across", "spikethickness": 1, "spikecolor": GREY,
        "spikedash": "solid", "spikesnap": "hovered data",
    }  # fmt: skip
    layout = {
        **LAYOUT, "height": height + EDGE + TOP, "xaxis": time, "hovermode": "x",
        "hoverdistance": -1, "spikedistance": -1, "hoversubplots": "axis", "annotations": [],
    }  # fmt: skip
    data: list[dict[str, Any]] = []
    for row, ((kind, unit), panels) in enumerate(rows.items(), start=1):
        top = 1.0 - (row - 1) * (ROW + GAP) / height
        layout[f"yaxis{row}"] = _value_axis(panels, top, top - ROW / height)
        name = KINDS.get(kind, "Distance from the target")
        heading = f"{name} in {unit}"
        if kind == "error" and not panels[0].closed_forms:  # of which nobody asks here what it is
            heading = ": ".join(filter(None, (heading, panels[0].told)))
        layout["annotations"].append(_heading(heading, top))
        for panel in panels:
            for trace in _traces(panel, look, end, POINTS // curves):
                data.append({**trace, "xaxis": "x", "yaxis": f"y{row}"})
    return {"data": data, "layout": layout}


def _value_axis(panels: Sequence[Panel], top: float, bottom: float) -> dict[str, Any]:
    low = min(panel.range[0] for panel in panels)
    high = max(panel.range[1] for panel in panels)
    axis = {**AXIS, "anchor": "x", "domain": [max(bottom, 0.0), top], "range": [low, high]}
    if panels[0].kind == "error":
        logarithmic = {"type": "log", "dtick": 1}
        if high > 1e6 * low:
            logarithmic["dtick"] = 3
        return {**axis, **logarithmic, "range": np.log10([low, high]).tolist()}
    pad = 0.04 * (high - low)  # off the edges, whatever another joint's range is
    return {**axis, "range": [low - pad, high + pad], "nticks": 6}


def _heading(text: str, top: float) -> dict[str, Any]:
    return {
        "text": _text(text), "x": 0.0, "y": top, "xref": "paper", "yref": "paper",
        "xanchor": "left", "yanchor": "bottom", "showarrow": False, "font": {"size": 13},
    }  # fmt: skip


def _traces(
    panel: Panel, look: dict[tuple[int, str], Look], end: float, most: int
) -> Iterator[dict[str, Any]]:
    """Closed forms, limits and curves, which belong to a track's joint and are told of it."""
    for curve in panel.closed_forms:
        yield _trace(curve, "", _line(PALE, width=4.0), most, told="", hoverinfo="skip")
    for curve in panel.curves:
        own = look[curve.track, panel.joint]
        for limit in panel.limits:
            yield {
                "type": "scatter", "mode": "lines", "x": [0.0, end], "y": [limit, limit],
                "line": _line(own.colour, (7, 2, 1.5, 2), 0.9), "hoverinfo": "skip",
                "meta": [curve.track, panel.joint, ""],
            }  # fmt: skip
    for curve in panel.curves:
        own = look[curve.track, panel.joint]
        line = _line(own.colour, own.dashes)
        yield _trace(curve, panel.joint, line, most, told=panel.kind, hoverinfo="none")


def _trace(
    curve: Curve, joint: str, line: dict[str, Any], most: int, *, told: str, hoverinfo: str
) -> dict[str, Any]:
    kept = close_outline(curve.y, most)
    return {
        "type": "scatter", "mode": "lines" if len(curve.t) > 1 else "markers",
        "x": _numbers(curve.t[kept]), "y": _numbers(curve.y[kept]),
        "line": {**line, "simplify": False},  # which bends curves visibly
        "marker": {"color": line["color"]}, "meta": [curve.track, joint, told],
        "hoverinfo": hoverinfo,
    }  # fmt: skip


# --- the workspace ---


def in_workspace(tracks: Sequence[Track]) -> list[dict[str, Any]]:
    """A figure for each view."""
    bags = [look for (_, joint), look in _looks(tracks).items() if not joint]
    return [_view(view, workspace_title(tracks)) for view in views(tracks, bags)]


def _view(view: View, title: str) -> dict[str, Any]:
    low, high = view.box(1.0)
    across = {"title": {"text": f"{view.axes[0]} in m"}, "range": [low[0], high[0]], "nticks": 6}
    up = {"title": {"text": f"{view.axes[1]} in m"}, "range": [low[1], high[1]], "nticks": 6}
    layout = {
        **LAYOUT, "height": 394 + TOP, "annotations": [_heading(title, 1.0)],
        "hovermode": "closest",
        "xaxis": {**AXIS, **across, "constrain": "domain"},
        "yaxis": {**AXIS, **up, "scaleanchor": "x", "constrain": "domain"}, "shapes": [],
    }  # fmt: skip
    data = []
    for stroke in sorted(view.strokes, key=lambda stroke: stroke.depth):
        if np.isfinite(stroke.points).all():
            data.append(_stroke(stroke))
        else:
            layout["shapes"] += _whole_lines(stroke)
    return {"data": data, "layout": layout}


def _stroke(stroke: Stroke) -> dict[str, Any]:
    mark: dict[str, Any] = {"color": stroke.colour}
    if stroke.mark == "+":
        mark = {"symbol": "cross-thin-open", "size": 13, "color": INK, "line": {"width": 1.6}}
    elif stroke.mark:
        line = {"color": stroke.colour, "width": 0.35 * stroke.width}
        size = [1.4 * stroke.width + 1.5] * (len(stroke.points) - 1) + [0.0]
        mark = {"size": size, "color": "white", "line": line}
    modes = [*["lines"] * (stroke.width > 0.0), *["markers"] * bool(stroke.mark)]
    return {
        "type": "scatter", "mode": "+".join(modes), "name": stroke.label, "marker": mark,
        "x": _numbers(stroke.points[:, 0]), "y": _numbers(stroke.points[:, 1]),
        "line": _line(stroke.colour, stroke.dashes, stroke.width),
        "hovertemplate": "%{x:.4f}, %{y:.4f} m", "meta": [stroke.track, "", ""],
    }  # fmt: skip


def _whole_lines(stroke: Stroke) -> list[dict[str, Any]]:
    """Where a coordinate alone is meant, which is not one of a trace."""
    look = {"type": "line", "line": _line(stroke.colour, stroke.dashes, stroke.width)}
    shapes = []
    for x, y in stroke.points:
        if np.isfinite(x):
            ends = {"x0": x, "x1": x, "y0": 0, "y1": 1, "yref": "paper"}
        else:
            ends = {"x0": 0, "x1": 1, "y0": y, "y1": y, "xref": "paper"}
        shapes.append({**look, **ends})
    return shapes
