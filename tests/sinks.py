"""Sinks that keep the samples of a run, or measure its memory."""

import resource
from pathlib import Path

from twodof.simulation.sample import Sample, Sink


class Collector(list[Sample], Sink):
    """A sink that keeps all samples."""

    def write(self, sample: Sample) -> None:
        self.append(sample)


class Memory(Sink):
    """A sink that measures this process's memory after each so many samples."""

    def __init__(self, every: int) -> None:
        self._every = every
        self._looks: list[int] = []

    def write(self, sample: Sample) -> None:
        if sample.k and sample.k % self._every == 0:
            self._looks.append(resident())

    @property
    def growth(self) -> int:
        """Return the smaller increase, in bytes, of the last two measurements over the first.

        The memory of waiting messages varies.
        """
        return min(self._looks[-2:]) - self._looks[0]


def resident() -> int:
    """Memory of this process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
