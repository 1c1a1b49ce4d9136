"""Pages inline in a notebook: a running arm, a replay or a map of a sweep, all without a server or network."""

from __future__ import annotations

from html import escape
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

from ..bag.recording import Recording
from ..errors import PageError
from ..fmu import Fmu
from ..simulation.experiments import experiment
from .arm import page_of
from .replay import replay

if TYPE_CHECKING:
    import pandas

HEIGHT = 560  # pixels


class Inline:
    """A page that a notebook shows in an iframe."""

    def __init__(self, page: str, height: int) -> None:
        self._page, self._height = page, height

    def __repr__(self) -> str:
        return f"<page of {len(self._page) / 1024:.0f} KB>"

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{self._height}px;border:0"
        return f'<iframe srcdoc="{escape(self._page)}" style="{style}" allow="fullscreen"></iframe>'


def show(shown: Fmu | Recording | pandas.DataFrame | str | Path, *, height: int = HEIGHT) -> Inline:
    """Return the page of an FMU, a recording or a sweep for a notebook, which displays it as a cell's result.

    Args:
        shown: a native FMU, whose plant runs in the page; a recording, which is replayed; the table of a sweep, which
            becomes an interactive map; or the path of one of them.
        height: height of the iframe, pixels.

    Raises:
        FmuError, BagError, SweepError, PageError, PlotError, BuildError: as ``page``, ``view`` and ``plot`` raise.
    """
    folder = Path(shown) if isinstance(shown, (str, Path)) and Path(shown).is_dir() else None
    if isinstance(shown, (Fmu, str, Path)) and folder is None:
        page = page_of(experiment(shown, stop_time=inf))
    elif isinstance(shown, Recording) or (folder and not any(folder.glob("*.parquet"))):
        page, _ = replay(shown if isinstance(shown, Recording) else str(folder))
    elif folder or "provenance" in getattr(shown, "attrs", {}):
        from ..plots.sweeps import map_html  # needs the extra "sweep"

        page = map_html(shown)
    else:
        raise PageError("`show` shows an FMU, a recording, the table of a sweep, or the path of one of them")
    return Inline(page.decode(), height)
