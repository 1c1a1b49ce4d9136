"""Style, header and files of all figures of bags and sweeps."""

import html
import io
import os
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import chain, islice
from math import ceil
from pathlib import Path
from string import Template
from typing import NamedTuple, cast

from ..bounds import MAX_STYLES
from ..errors import PlotError
from ..files import data_file, descriptor_of, free_name, head_of, read_file, refusing, write_file
from ..version import __version__, needing
from .strokes import GREY, HAIR, INK, Style

STYLES = "matplotlibrc"  # matplotlib reads a file of this name in the working directory while it is imported
if os.path.lexists(STYLES):
    try:
        with refusing(PlotError, f"plot in this folder, move its file '{STYLES}'"):
            read_file(STYLES, MAX_STYLES).decode("utf-8")
    except UnicodeDecodeError as error:
        raise PlotError(f"cannot plot in this folder, move its file '{STYLES}': it is not UTF-8 text") from error
with needing(PlotError, "plot", "view"):
    import matplotlib.style
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.lines import Line2D

STYLE = {
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.0,
    "axes.titlelocation": "left",
    "text.color": INK,
    "text.parse_math": False,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "lines.linewidth": 1.4,
    "lines.dash_capstyle": "butt",
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.borderpad": 0.0,
    "legend.borderaxespad": 0.0,
    "savefig.dpi": 200,
    "svg.hashsalt": "twodof",
    "pdf.fonttype": 42,
}
LETTER = 0.058  # inches, mean width
MOST_TEXTS, MOST_LINES = 20, 10  # above the panels, and of each text
TICK_STYLE: Style = {
    "direction": "in",
    "width": 0.7,
    "color": GREY,
    "labelsize": 7.0,
    "labelcolor": INK,
    "grid_color": HAIR,
    "grid_linewidth": 0.6,
}
"""Styles that are set on each panel, because matplotlib makes ticks while it draws, in the user's style."""


class Plot(Figure):
    """A figure that notebooks display automatically."""

    def _repr_png_(self) -> bytes:
        return _rendered(self, "png")


class Drawing(NamedTuple):
    """Content of a figure or page."""

    title: str
    name: str  # default name of the file
    draw: Callable[[Figure], None]  # function that draws into an empty figure, and sets the figure's size
    columns: Sequence[Mapping[str, str]]  # columns of the table below the figure on a page
    # function that returns the HTML that replaces the figure on a page; None: show the figure
    body: Callable[[], str] | None = None
    above: Callable[[], str] | None = None  # function that returns the HTML above the figure on a page


def drawn(drawing: Drawing) -> Figure:
    """Return a figure of a drawing."""
    return _draw(drawing, Plot())


def save(drawing: Drawing, output: str | Path | None = None) -> Path:
    """Save a drawing atomically to a file; return its path.

    Args:
        output: .png, .svg, .pdf, or .html, a page with the figure and a table; None: the drawing's name and .png in
            the working directory, with a number if another file has that name.
    """
    path = Path(output) if output is not None else free_name(drawing.name, ".png", _is_ours)
    kind = file_kind(path)
    content = html_of(drawing) if kind == "html" else _rendered(drawn(drawing), kind)
    with refusing(PlotError, f"write '{path}'"):
        write_file(path, content)
    return path


def file_kind(path: str | Path) -> str:
    """Return the kind of file by its name: "png", "svg", "pdf" or "html"."""
    kind = Path(path).suffix.lower().removeprefix(".")
    kind = kind or ("" if descriptor_of(path) is None else "png")
    if kind not in ("png", "svg", "pdf", "html"):
        raise PlotError(f"'{path}': the name of a plot ends in .png, .svg, .pdf or .html")
    return kind


def show(drawing: Drawing) -> bool:
    """Show a figure in a window until it is closed; return False without a display."""
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
        return False  # avoids the import of pyplot, which takes a third of a second
    from matplotlib import pyplot as plt

    try:
        figure = plt.figure()
    except Exception:  # each toolkit raises its own exceptions; the caller then saves a file
        return False
    if figure.canvas.required_interactive_framework is None:
        plt.close(figure)
        return False
    _draw(drawing, figure)
    plt.show()
    return True


def draw_head(
    figure: Figure, title: str, texts: Iterable[str], size: tuple[float, float], handles: Sequence[Line2D] = ()
) -> SubFigure:
    """Draw a title, texts and a legend; return the subfigure for the panels, of a size in inches."""
    letters = int((size[0] - 0.3) / LETTER)
    lines = [line for text in islice(texts, MOST_TEXTS) for line in _wrapped(text, letters)]
    for handle in handles:
        handle.set_label(_end(str(handle.get_label()), int(0.8 * letters) - 10))
    longest = max((len(str(handle.get_label())) for handle in handles), default=0)
    columns = max(1, letters // (12 + longest))
    rows = len(lines) + ceil(len(handles) / columns)
    figure.set_size_inches(size[0], size[1] + 0.45 + 0.17 * rows)
    figure.set_layout_engine("constrained", w_pad=0.05, h_pad=0.05, wspace=0.0, hspace=0.0)
    style: Style = {"x": 0.1 / size[0], "ha": "left", "fontsize": 11, "fontweight": "bold"}
    figure.suptitle(_end(title, letters // 2), **style)
    room = figure.add_subfigure(figure.add_gridspec()[0])
    legend = room.legend(
        handles=handles,
        title="\n".join(lines),
        alignment="left",
        loc="outside upper left",
        ncols=columns,
        handlelength=3.5,
        fontsize=8.0,
        title_fontsize=8.0,
        borderaxespad=0.8,
    )
    legend.get_title().set_color(GREY)
    return room


def _wrapped(text: str, letters: int) -> list[str]:
    """Return a text in lines, without the end of a long text: Matplotlib takes a second for 300 lines."""
    return textwrap.wrap(text[: (MOST_LINES + 1) * letters], letters, max_lines=MOST_LINES, placeholder=" …")


def _end(text: str, letters: int) -> str:
    """Return the longest end of a text that fits."""
    return text if len(text) <= letters else f"…{text[1 - letters :]}"


def plain_style() -> AbstractContextManager[None]:
    """Return a context without the styles of a matplotlibrc, which may lie in the working directory and run LaTeX."""
    return cast(AbstractContextManager[None], matplotlib.style.context(["default", STYLE]))


def _draw(drawing: Drawing, figure: Figure) -> Figure:
    with plain_style():
        drawing.draw(figure)
    for axes in figure.axes:
        if axes.get_label() != "<colorbar>":
            axes.tick_params(which="both", **TICK_STYLE)
    return figure


def _rendered(figure: Figure, kind: str) -> bytes:
    """Return the figure as a file's content; equal figures give equal bytes."""
    metadata: dict[str, dict[str, str | None]] = {
        "png": {"Software": f"twodof {__version__}"},
        "svg": {"Creator": f"twodof {__version__}", "Date": None},
        "pdf": {"Creator": f"twodof {__version__}", "CreationDate": None},
    }
    content = io.BytesIO()
    with plain_style():
        figure.savefig(content, format=kind, metadata=metadata[kind])
    return content.getvalue()


def html_of(drawing: Drawing) -> bytes:
    """Return a self-contained page: the drawing's own body or the figure as SVG, and a table."""
    if drawing.body:
        body = drawing.body()
    else:
        svg = _rendered(drawn(drawing), "svg").decode()
        body = svg[svg.index("<svg") :]
    if drawing.above:
        body = drawing.above() + body
    title = html.escape(drawing.title)
    rows = "\n".join(
        f"<tr><th>{html.escape(key)}</th>"
        + "".join(
            f"<td>{'<br/>'.join(html.escape(column.get(key, '')).splitlines())}</td>" for column in drawing.columns
        )
        + "</tr>"
        for key in dict.fromkeys(chain(*drawing.columns))
    )
    page = Template(data_file("plots", "page.html").read_text("utf-8"))
    colours = {"ink": INK, "grey": GREY, "hair": HAIR}
    return page.substitute(colours, title=title, body=body, rows=rows).encode()


def _is_ours(path: Path) -> bool:
    start = head_of(path, 1024)
    return start.startswith(b"\x89PNG") and b"tEXtSoftware\0twodof " in start
