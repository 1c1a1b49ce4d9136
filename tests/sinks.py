"""Sinks of a run: what it gives, and the memory that it takes."""

from __future__ import annotations

import resource
from pathlib import Path

from twodof.simulation.sample import Sample, Sink


class Collector(list[Sample], Sink):
    """The sink that keeps what it is given."""

    def write(self, sample: Sample) -> None:
        self.append(sample)


class Memory(Sink):
    """The sink that looks at this process's memory each so many samples.

    Attributes:
        growth: most that it was above that of the first look, bytes.
    """

    def __init__(self, every: int) -> None:
        self._every, self._first, self.growth = every, 0, 0

    def write(self, sample: Sample) -> None:
        if sample.k == self._every:
            self._first = resident()
        elif sample.k > self._every and sample.k % self._every == 0:
            self.growth = max(self.growth, resident() - self._first)


def resident() -> int:
    """Memory of this process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
