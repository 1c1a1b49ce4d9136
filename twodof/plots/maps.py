"""Interactive map of a sweep on a page: two maps side by side, a Pareto front, and the clicked run.

``maps.js`` draws them from the table's columns with plotly, whose compressed library is on the page.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..bag.reader import read_bags
from ..bag.records import ReadBudget
from ..errors import BagError
from ..sweeps.ranking import METRICS, beyond_limits
from .interactive import figures_html
from .settings import WRITTEN
from .strokes import downsampled

if TYPE_CHECKING:
    import pandas

MOST_RUNS, MOST_VALUES = 20_000, 1_000_000  # runs on a page, and their values; of more, an evenly spaced selection
MOST_NUMBERS = 2_000_000  # points of all curves of a page; later runs have no curves
MOST_CURVES, POINTS = 2000, 200  # number of runs whose curves a page contains, and of points in each curve
CROSSES = "×: beyond the URDF's effort or velocity limits"
HOLLOW = "hollow: not defined, as the settling time of a run that did not settle"


def map_page(table: pandas.DataFrame, varied: Sequence[str], bags: Path | None, best: Sequence[int]) -> str:
    """Return the HTML of the interactive map; "" without plotly.

    Args:
        bags: folder with a bag of each run, whose curves are shown when the run is clicked; None: none.
        best: initially selected run, if any.
    """
    if find_spec("plotly") is None:
        return ""
    most = min(MOST_RUNS, MOST_VALUES // (len(varied) + len(METRICS)))
    rows = table.iloc[:: max(1, -(-len(table) // most))]
    metrics = [name for name in METRICS if rows[name].notna().any()]
    columns = {name: _numbers(rows[name].to_numpy(dtype=float)) for name in ("run", *varied, *metrics)}
    beyond = beyond_limits(rows)
    options = table.attrs["provenance"]["options"]
    content = {
        "varied": [*varied],
        "metrics": {name: METRICS[name].title for name in metrics},
        "units": {name: WRITTEN.get(unit, unit) for name, unit in table.attrs["units"].items()},
        "columns": columns,
        "outcome": rows["outcome"].tolist(),
        "beyond": beyond.tolist(),
        "best": [int(run) for run in best],
        "again": [f"twodof run {quote(table.attrs['provenance']['fmu']['file'])}"]
        + [f"--stop-time {options['stop_time']:g}", f"--step {options['step']:g}"]
        + [f"--set {quote(f'{name}={str(value).lower()}')}" for name, value in options["settings"].items()],
        "quoted": {name: quote(name) for name in varied},
        "curves": _curves(rows, bags),
    }
    gaps = bool(rows[metrics].isna().any(axis=None))
    key = "; ".join(["circle: the run below", *[CROSSES] * bool(beyond.any()), *[HOLLOW] * gaps])
    return f'<p>{key}</p>\n<div id="maps"></div>\n{figures_html(content, "maps.js")}'


def _numbers(values: NDArray[np.float64]) -> list[float | None]:
    return [float(f"{value:.9g}") if np.isfinite(value) else None for value in values.tolist()]


def _curves(rows: pandas.DataFrame, bags: Path | None) -> dict[str, dict[str, object]]:
    """Return the curves of runs with a bag, by run number: distance from the target, or joint positions."""
    curves: dict[str, dict[str, object]] = {}
    if bags is None or not bags.is_dir():
        return curves
    room, budget = MOST_NUMBERS, ReadBudget()
    for run in rows["run"].tolist()[:MOST_CURVES]:
        if room < 0:  # the other runs have no curves
            break
        try:
            (bag,) = read_bags([bags / f"{run:06d}"], budget)
            lines = {name: bag.q[:, i] for i, name in enumerate(bag.joints)}
            if bag.x.size and bag.x.shape == bag.target.shape:
                lines = {"distance from the target, m": np.linalg.norm(bag.x - bag.target, axis=1), **lines}
            stored = bag.stored_verdict  # a run without a verdict was killed, and judging 2000 takes minutes
        except BagError:
            continue
        drawn = {name: downsampled(values, POINTS) for name, values in lines.items()}
        room -= bag.q.size // POINTS + sum(map(len, drawn.values()))
        curves[str(run)] = {
            "verdict": stored.lines[0] if stored else "",
            "lines": {name: [_numbers(bag.t[k]), _numbers(lines[name][k])] for name, k in drawn.items()},
        }
    return curves
