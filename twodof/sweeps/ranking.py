"""Rank the runs of a sweep that are within the URDF's limits."""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..simulation.expressions import Expression as Expression
from ..simulation.expressions import expression
from ..simulation.judge import EXACT
from ..simulation.setup import Array
from ..simulation.verdict import METRICS as METRICS

if TYPE_CHECKING:
    import pandas

RANKED = {
    "settling_time": "by settling time",
    "peak_effort": "by peak effort",
    "final_error": "by final error",
    "final_turn_error": "by final orientation error",
    "final_joint_error": "by final joint error",
}
"""Criteria of the ranking in words; each one breaks ties of the previous ones."""
USE = ["effort_use", "velocity_use"]
ROUNDING = 1e-12  # relative, and absolute below 1: values with a smaller difference are equal


def ranks(values: Array) -> NDArray[np.int64]:
    """Return the rank of each value, 0 for the smallest; values that are equal up to rounding share a rank.

    NaN has the last rank.
    """
    distinct, index = np.unique(values, return_inverse=True)
    begins, most = [], -inf
    for value in distinct.tolist():
        begins.append(value > most)  # NaN never begins a rank
        if begins[-1]:
            most = value + ROUNDING * max(1.0, abs(value))
    rank: NDArray[np.int64] = np.cumsum(begins, dtype=np.int64) - 1 + np.isnan(distinct)
    return rank[index]


def beyond_limits(table: pandas.DataFrame) -> pandas.Series:
    """Return which runs exceed an effort or velocity limit of the URDF."""
    return (table[USE] > 1.0 + EXACT).any(axis=1)


def candidates(table: pandas.DataFrame) -> pandas.DataFrame:
    """Return finished runs within the URDF's limits, or all finished runs if none is within them."""
    finished = table[table["outcome"] == "finished"]
    possible = finished[~beyond_limits(finished)]
    return finished if possible.empty else possible


def cost_of(text: str | None) -> Expression | None:
    """Return the expression of a cost of metrics, such as "settling + 0.1*peak_effort"; None for None."""
    return None if text is None else expression(text, METRICS, condition=False)


def _keys(runs: pandas.DataFrame, cost: Expression | None) -> list[NDArray[np.int64]]:
    """Return the ranks of runs by a cost, or by each of RANKED."""
    if cost is not None:
        return [ranks(np.broadcast_to(cost.value(runs), len(runs)))]
    return [ranks(runs[name].to_numpy(dtype=float)) for name in RANKED]


def ranked(table: pandas.DataFrame, cost: Expression | None = None) -> pandas.DataFrame:
    """Return the candidates, the best first, by a cost or by settling time, peak effort and final errors."""
    runs = candidates(table)
    if cost is not None and len(runs):
        value = np.broadcast_to(cost.value(runs), len(runs))
        runs = runs.assign(cost=value)[["run", "cost", *runs.columns[1:]]] if "cost" not in runs else runs
    return runs.iloc[np.lexsort(_keys(runs, cost)[::-1])] if len(runs) else runs


def equals(runs: pandas.DataFrame, cost: Expression | None = None) -> int:
    """Count the ranked runs that equal the first, up to rounding."""
    keys = np.array(_keys(runs, cost))
    return int((keys == keys[:, :1]).all(axis=0).sum()) if len(runs) else 0


def remark(table: pandas.DataFrame) -> str:
    """Return a note on the number of finished runs that exceed the URDF's limits; "" if none does."""
    finished = table[table["outcome"] == "finished"]
    count = int(beyond_limits(finished).sum())
    beyond = "the URDF's effort or velocity limits"
    if 0 < count == len(finished):
        return f"all {count} finished runs exceed {beyond}, the best too"
    some = f"{count} of {len(finished)} finished runs exceed {beyond} and are not ranked"
    return some if count else ""
