"""HTML of results for notebooks: a table of facts and a small SVG picture, without scripts. Progress of slow tasks."""

import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import copy_context
from html import escape
from threading import Event, Thread
from time import perf_counter
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Colours of Okabe & Ito, "Color universal design", 2008, without their yellow, too pale on paper."""

WIDTH, HEIGHT, EDGE = 320.0, 160.0, 18.0  # px; the edge holds the labels
SMALLEST_RANGE = 1e-9  # smaller ranges are drawn as one value
MOST_PARTS = 300  # about one part for each pixel
TICK = 1.0  # s until a slow task has a line, and between its updates


def in_notebook() -> bool:
    """Return whether a notebook shows progress: its kernel runs this process, and TQDM_DISABLE is not set."""
    return "ipykernel.zmqshell" in sys.modules and not os.environ.get("TQDM_DISABLE")


@contextmanager
def busy(what: str) -> Iterator[None]:
    """Show the name of a slow task and its duration in a notebook; elsewhere do nothing."""
    if not in_notebook():
        yield
        return
    from IPython import display

    done, begin = Event(), perf_counter()
    line = cast(Any, display).DisplayHandle()

    def show() -> None:
        tell = line.display
        while not done.wait(TICK):
            tell({"text/plain": f"{what}: {perf_counter() - begin:.0f} s"}, raw=True)
            tell = line.update
        if tell == line.update:
            tell({"text/plain": ""}, raw=True)

    thread = Thread(target=copy_context().run, args=(show,))  # the context has the cell
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def card(title: str, facts: Mapping[str, object], picture: str = "") -> str:
    """Return a table with a title, a row for each fact, and a picture next to it; file names may not be UTF-8."""
    rows = (f"<tr><th>{escape(name)}</th><td>{escape(str(fact))}</td></tr>" for name, fact in facts.items())
    table = f"<table><caption>{escape(title)}</caption>{''.join(rows)}</table>"
    text = f'<div style="display:flex;gap:1em;flex-wrap:wrap;align-items:center">{table}{picture}</div>'
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def picture(
    curves: Iterable[tuple[ArrayLike, ArrayLike]], x: str, y: str, *, dots: bool = False, equal: bool = False
) -> str:
    """Return an SVG picture of curves in one pair of axes; points that are not finite are left out.

    Args:
        curves: x and y values of each curve, drawn in the order of ``COLOURS``.
        x, y: axis labels; the picture adds the range of each axis.
        dots: draw points instead of lines.
        equal: use the same scale for both axes.
    """
    kept = [_thinned(np.column_stack(curve)) for curve in curves]
    points = np.concatenate([*kept, np.empty((0, 2))])
    if not points.size:
        return ""
    (left, low), (right, high) = points.min(axis=0), points.max(axis=0)
    wide, tall = max(right - left, SMALLEST_RANGE), max(high - low, SMALLEST_RANGE)
    across, up = (WIDTH - 2 * EDGE) / wide, (HEIGHT - 2 * EDGE) / tall
    if equal:
        across = up = min(across, up)
    drawn = []
    for i, curve in enumerate(kept):
        colour = COLOURS[i % len(COLOURS)]
        pixels = [(EDGE + (px - left) * across, HEIGHT - EDGE - (py - low) * up) for px, py in curve]
        if dots:
            drawn += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="2.5" fill="{colour}"/>' for a, b in pixels]
        else:
            line = " ".join(f"{a:.1f},{b:.1f}" for a, b in pixels)
            drawn.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
    texts = (
        f'<text x="{EDGE}" y="{HEIGHT - 2}">{escape(x)}: {left:.4g} to {right:.4g}</text>'
        f'<text x="{EDGE}" y="10">{escape(y)}: {low:.4g} to {high:.4g}</text>'
    )
    size = f'viewBox="0 0 {WIDTH:g} {HEIGHT:g}" width="{WIDTH:g}" height="{HEIGHT:g}"'
    style = 'font-family="sans-serif" font-size="10" fill="currentColor"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} {style}>{"".join(drawn)}{texts}</svg>'


def _thinned(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the finite points of a curve; of a long curve, the lowest and the highest point of each part."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) <= 2 * MOST_PARTS:
        return points
    parts = np.array_split(np.arange(len(points)), MOST_PARTS)
    kept = [part[extreme(points[part, 1])] for part in parts for extreme in (np.argmin, np.argmax)]
    return np.asarray(points[np.unique(kept)])
