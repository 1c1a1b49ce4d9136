"""Design of a sweep: the values of the variables in each run."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import isfinite, prod

import numpy as np
from numpy.typing import NDArray

from ..bounds import MAX_RUNS, MAX_SWEEP, MIB
from ..errors import InputError
from ..fmu import Fmu
from ..simulation.input_values import Setting, resolve
from ..simulation.verdict import METRICS

OWN_COLUMNS = (*METRICS, "run", "end_time", "outcome", "message", "cost")
"""Columns of a table besides the varied variables."""


@dataclass(frozen=True)
class Design:
    """Runs 0 … N − 1: every combination of the grids, each with the same random draws."""

    grids: Mapping[str, tuple[float, ...]]  # values by variable; the last one changes fastest
    ranges: Mapping[str, tuple[float, float]]  # low and high by variable, drawn uniformly
    draws: int = 1  # number of draws of all ranges; 1 without ranges
    seed: int = 0  # seed of the draws

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the variables, grids first."""
        return (*self.grids, *self.ranges)

    def __len__(self) -> int:
        """Return the number of runs."""
        return prod(map(len, self.grids.values())) * self.draws

    def points(self) -> NDArray[np.float64]:
        """Return values of ``names`` in each run, N × number of variables."""
        low, high = np.array([*self.ranges.values()]).reshape(-1, 2).T
        drawn = np.random.default_rng(self.seed).uniform(low, high, (self.draws, len(low)))
        combinations = np.array([*product(*self.grids.values())])
        return np.hstack([np.repeat(combinations, self.draws, axis=0), np.tile(drawn, (len(combinations), 1))])


def make_design(
    fmu: Fmu,
    grid: Mapping[str, Iterable[float]],
    ranges: Mapping[str, Sequence[float]],
    random: int,
    seed: int,
    settings: Mapping[str, Setting],
) -> Design:
    """Return the design, checked against the FMU and the other settings."""
    grids, limits = {}, {}
    for name, values in grid.items():
        try:
            if isinstance(values, str):  # its characters would be the values
                raise TypeError
            grids[name] = tuple(map(float, values))
        except (TypeError, ValueError) as error:
            raise InputError(f"the grid of {name} is {values!r:.50}; give its values, as [20, 50, 80]") from error
    for name, pair in ranges.items():
        try:
            low, high = map(float, pair)
        except (TypeError, ValueError) as error:
            raise InputError(f"the range of {name} is {pair!r:.50}; give low and high, as (20, 80)") from error
        if not (isfinite(low) and isfinite(high) and low < high):
            raise InputError(f"the range of {name}, {low:g} to {high:g}, does not ascend")
        limits[name] = (low, high)
    if not grids and not limits:
        raise InputError("there is nothing to vary; give values of an input with `grid`")
    if limits and random < 1:
        raise InputError(f"{random} random draws of {', '.join(limits)}; give at least 1 with `random`")
    if random and not limits:
        raise InputError(f"`random` {random} needs a range")
    if seed < 0:
        raise InputError(f"the seed {seed} is negative")
    design = Design(grids, limits, max(1, random), seed)
    if len(design) > MAX_RUNS:
        raise InputError(f"the design has {len(design)} runs; at most {MAX_RUNS} are possible")
    if 8 * len(design) * (len(grids) + len(limits) + len(OWN_COLUMNS)) > MAX_SWEEP:
        varied = f"{len(design)} runs over {len(grids) + len(limits)} variables"
        raise InputError(f"a table of {varied} exceeds {MAX_SWEEP // MIB} MiB; vary fewer, or in several sweeps")
    owner = dict.fromkeys(resolve(fmu, settings), "the settings")
    for name, values in {**grids, **limits}.items():
        if not values:
            raise InputError(f"the grid of {name} is empty")
        if name in OWN_COLUMNS:
            raise InputError(f"{name} cannot be varied: a sweep's table has a column of its own with this name")
        if len(set(values)) < len(values):
            raise InputError(f"the grid of {name} has a value twice")
        if not all(map(isfinite, values)):
            raise InputError(f"the grid of {name} has a value that is not finite")
        for element in resolve(fmu, {name: values[0]}):
            if element in owner:
                raise InputError(f"{element} gets values from {owner[element]} and from {name}")
            owner[element] = f"the design of {name}"
    return design
