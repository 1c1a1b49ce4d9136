"""Sinks that keep the samples of a run, or measure its memory."""

import resource
from pathlib import Path

from twodof.simulation.sample import Sample, Sink


class Collector(list[Sample], Sink):
    """The sink that keeps what it is given."""

    def write(self, sample: Sample) -> None:
        self.append(sample)


class Memory(Sink):
    """The sink that looks at this process's memory each so many samples."""

    def __init__(self, every: int) -> None:
        self._every = every
        self._looks: list[int] = []

    def write(self, sample: Sample) -> None:
        if sample.k and sample.k % self._every == 0:
            self._looks.append(resident())

    @property
    def growth(self) -> int:
        """By how much it was above that of the first look in both of the last two looks, bytes.

        What waits to be stored comes and goes.
        """
        return min(self._looks[-2:]) - self._looks[0]


def resident() -> int:
    """Memory of this process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
