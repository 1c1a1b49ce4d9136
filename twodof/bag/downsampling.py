"""Downsample a recording for plotting without visible change (M4).

Time is divided into spans. The first and the last sample of each span are kept, and the samples at which a line has its
minimum or maximum. Source: Jugel et al., "M4: a visualization-oriented time series data aggregation", VLDB 7(10), 2014.
Spans grow by doubling, so that the extremes of a longer span are among those of its halves, which were kept.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from .recording import Array, Recording

Indices = NDArray[np.intp]


class Downsampler:
    """Incremental downsampler, which chooses among the samples kept so far and the new ones.

    It reduces at most ``most`` samples to at most a quarter of these. ``lines`` returns the curves of a recording, N
    values each, in addition to its positions and velocities.
    """

    def __init__(self, most: int, lines: Callable[[Recording], Sequence[Array]]) -> None:
        self.most, self._lines = most, lines
        self._span = 1  # ns

    def choose(self, bag: Recording) -> Indices:
        """Return the indices of the samples to keep."""
        lines = [*bag.q.T, *bag.v.T, *self._lines(bag)]
        duration = int(bag.stamps[-1] - bag.stamps[0])
        while self._span < duration / self.most:
            self._span *= 2
        chosen = extremes(bag.stamps // self._span, lines)
        while len(chosen) > self.most / 4 and self._span < duration:
            self._span *= 2
            chosen = extremes(bag.stamps // self._span, lines)
        fewer = np.linspace(0, len(chosen) - 1, int(self.most / 4)).astype(int)  # of more curves than samples
        return chosen[fewer] if len(chosen) > self.most / 4 else chosen


def extremes(parts: NDArray[np.int64], lines: Sequence[Array]) -> Indices:
    """Return the first and the last sample of each part, and the samples at which a line has an extreme.

    ``parts`` has the ascending part numbers of N samples, all ≥ 0. Values that are not finite are ignored.
    """
    starts = np.flatnonzero(np.diff(parts, prepend=-1))
    sizes = np.diff(starts, append=len(parts))
    kept = np.zeros(len(parts), bool)
    kept[starts] = kept[starts + sizes - 1] = True
    for line in lines:
        line = np.where(np.isfinite(line), line, np.nan)
        for extreme in (np.fmin, np.fmax):
            positions = np.flatnonzero(line == np.repeat(extreme.reduceat(line, starts), sizes))
            kept[positions[np.diff(parts[positions], prepend=-1) > 0]] = True
    return np.flatnonzero(kept)
