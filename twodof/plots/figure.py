"""Figures that go into files, windows and notebooks: their style, and how they are written.

All that is common to the figures of bags and of sweeps.
"""

from __future__ import annotations

import html
import io
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import PlotError
from ..files import free_name, head_of, refusing, write_file
from ..version import __version__
from .strokes import GREY, HAIR, INK

try:
    import matplotlib.style
    from matplotlib.figure import Figure
except ImportError as missing:
    raise PlotError(
        f"cannot plot: {missing}; install the package 'matplotlib' (the extra 'view')"
    ) from missing

STYLE = {
    "font.size": 8.0, "axes.titlesize": 8.5, "axes.labelsize": 8.0, "axes.titlelocation": "left",
    "text.color": INK, "text.parse_math": False, "axes.labelcolor": INK, "axes.edgecolor": GREY,
    "axes.linewidth": 0.7, "axes.grid": True, "axes.axisbelow": True, "lines.linewidth": 1.4,
    "lines.dash_capstyle": "butt", "legend.fontsize": 7.5, "legend.frameon": False,
    "legend.borderpad": 0.0, "legend.borderaxespad": 0.0, "savefig.dpi": 200,
    "svg.hashsalt": "twodof", "pdf.fonttype": 42,
}  # fmt: skip
TICK_STYLE: dict[str, Any] = {
    "direction": "in", "width": 0.7, "color": GREY, "labelsize": 7.0, "labelcolor": INK,
    "grid_color": HAIR, "grid_linewidth": 0.6,
}  # fmt: skip
"""Of each panel on its own: matplotlib makes ticks as it draws, when the style is the user's."""

STYLES = """html { overflow-y: scroll; }
h1 { font-size: 1.1em; margin: 0 0 .5em; overflow-wrap: anywhere; }
#plots { display: grid; grid-template-columns: minmax(0, 2fr) minmax(0, 1fr); gap: 1em; }
#plots .plot { min-width: 0; }
#side { overflow-x: auto; }
#legend { width: 100%; margin: 0 0 1em; font-size: 12px; font-variant-numeric: tabular-nums; }
#legend td, #legend th { padding: 1px 6px; text-align: right; white-space: nowrap; }
#legend td:first-child, #legend th:first-child { text-align: left; min-width: 5em; }
#legend label { display: flex; gap: .4em; align-items: center; cursor: pointer; }
#legend .joint label { padding-left: 1em; }
table.runs { display: block; overflow-x: auto; overflow-wrap: anywhere; }
.runs td { min-width: 5em; }
@media (max-width: 1150px) { #plots { grid-template-columns: minmax(0, 1fr); } }
@media (max-width: 500px) {
  #legend td, #legend th { padding: 1px 3px; } #legend .joint label { padding-left: 0; }
}
@media (prefers-color-scheme: dark) {
  html, html body { background: #141414; }
  body > :not(svg) { filter: invert(.92) hue-rotate(180deg); }
}
"""
"""Of pages. In the dark all but maps, whose colours are numbers, is turned inside out, with the
hues of curves."""


class Plot(Figure):
    """A figure that notebooks show without being asked."""

    def _repr_png_(self) -> bytes:
        return _rendered(self, "png")


class Drawing(NamedTuple):
    """What can be drawn into a figure, or stand on a page.

    Attributes:
        title: for people.
        name: of the file where the user gives none.
        draw: draws it into an empty figure, and sets the figure's size.
        columns: of the table that stands below it on a page.
        body: makes the HTML that stands on a page in place of the figure; None: the figure does.
    """

    title: str
    name: str
    draw: Callable[[Figure], None]
    columns: Sequence[Mapping[str, str]]
    body: Callable[[], str] | None = None


def drawn(drawing: Drawing) -> Figure:
    """A figure of it."""
    return _draw(drawing, Plot())


def save(drawing: Drawing, output: str | Path | None = None) -> Path:
    """Draw into a file, written whole or not at all; its path.

    Args:
        drawing: what to draw.
        output: .png, .svg, .pdf, or .html, a page with the figure and a table; None: the
            drawing's name and .png in the working directory, with a number where another file has
            that name.

    Raises:
        PlotError: another kind of file, or it cannot be written.
    """
    path = Path(output) if output is not None else free_name(drawing.name, ".png", _is_ours)
    kind = file_kind(path)
    content = _html(drawing) if kind == "html" else _rendered(drawn(drawing), kind)
    with refusing(PlotError, f"write '{path}'"):
        write_file(path, content)
    return path


def file_kind(path: str | Path) -> str:
    """The kind of file that a name asks for: "png", "svg", "pdf" or "html".

    Raises:
        PlotError: any other.
    """
    kind = Path(path).suffix.lower().removeprefix(".")
    if kind not in ("png", "svg", "pdf", "html"):
        raise PlotError(f"'{path}': the name of a plot ends in .png, .svg, .pdf or .html")
    return kind


def show(drawing: Drawing) -> bool:
    """Draw in a window and wait until it is closed; False where there is no display."""
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
        return False  # saves the third of a second that pyplot takes
    from matplotlib import pyplot as plt

    try:
        figure = plt.figure()
    except Exception:  # each toolkit has its own; a file is as good
        return False
    if figure.canvas.required_interactive_framework is None:
        plt.close(figure)
        return False
    _draw(drawing, figure)
    plt.show()
    return True


def _draw(drawing: Drawing, figure: Figure) -> Figure:
    with matplotlib.style.context(["default", STYLE]):
        drawing.draw(figure)
    return figure


def _rendered(figure: Figure, kind: str) -> bytes:
    """The figure as a file's content; equal figures give equal bytes."""
    metadata: dict[str, dict[str, str | None]] = {
        "png": {"Software": f"twodof {__version__}"},
        "svg": {"Creator": f"twodof {__version__}", "Date": None},
        "pdf": {"Creator": f"twodof {__version__}", "CreationDate": None},
    }
    content = io.BytesIO()
    with matplotlib.style.context(["default", STYLE]):
        figure.savefig(content, format=kind, metadata=metadata[kind])
    return content.getvalue()


def _html(drawing: Drawing) -> bytes:
    """A page that needs nothing else: its own body or the figure as SVG, and a table."""
    if drawing.body:
        body = drawing.body()
    else:
        svg = _rendered(drawn(drawing), "svg").decode()
        body = svg[svg.index("<svg") :]
    title = html.escape(drawing.title)
    columns = drawing.columns
    rows = "\n".join(
        f"<tr><th>{html.escape(key)}</th>"
        + "".join(f"<td>{html.escape(column.get(key, ''))}</td>" for column in columns)
        + "</tr>"
        for key in dict.fromkeys(chain(*columns))
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8"/>
<meta name="viewport" content="width=device-width, initial-scale=1"/>
<title>{title}</title>
<style>
{STYLES}body {{ font: 14px/1.5 sans-serif; color: {INK}; background: white; max-width: 1500px;
  margin: 0 auto; padding: 1em; }}
body > svg {{ width: 100%; max-width: 1100px; height: auto; }}
table {{ border-collapse: collapse; margin-top: 1em; }}
th, td {{ text-align: left; vertical-align: top; padding: 0.2em 1.5em 0.2em 0; }}
th {{ color: {GREY}; font-weight: normal; white-space: nowrap; }}
tr {{ border-top: 1px solid {HAIR}; }}
</style>
</head>
<body>
<h1>{title}</h1>
{body}
<table class="runs">
{rows}
</table>
</body>
</html>
""".encode()


def _is_ours(path: Path) -> bool:
    start = head_of(path, 1024)
    return start.startswith(b"\x89PNG") and b"tEXtSoftware\0twodof " in start
