"""Batches of a sweep's runs for workers, and retries of runs whose worker died."""

from collections import Counter, deque
from collections.abc import Iterator
from itertools import islice
from math import nan

from .runner import Point, Row, lost

BATCH_TIME = 0.25  # s, of one batch
MAX_BATCH = 256
MOST_DEATHS = 3  # deaths of a run's worker, two of them during batches of this run only
GIVEN_UP = "the process that ran it died, repeatedly"
LOOK = 0.2  # s between two checks of ``stop``


class Batches:
    """Divides points into batches of about a quarter of a second.

    If a worker dies, each unfinished run of its batch is repeated in a batch of its own. A run that kills two more
    workers has the outcome "crashed".

    Args:
        left: number of runs that have no row yet.
    """

    def __init__(self, points: Iterator[Point], left: int) -> None:
        self._points, self.left = points, left
        self._size = 1
        self._suspects: deque[Point] = deque()
        self._deaths: Counter[int] = Counter()

    def next(self, *, alone: bool) -> list[Point]:
        """Return the next batch; empty if all runs are taken, or if the rest must run alone and cannot yet."""
        batch = list(islice(self._points, self._size))
        return [self._suspects.popleft()] if not batch and alone and self._suspects else batch

    def done(self, rows: list[Row], duration: float) -> list[Row]:
        """Return the rows of a batch, and adapt the batch size to its time, s."""
        self.left -= len(rows)
        if duration > 0.0:
            fitting = int(BATCH_TIME * len(rows) / duration)
            self._size = max(1, min(MAX_BATCH, fitting, 4 * self._size))
        return rows

    def died(self, batch: list[Point]) -> list[Row]:
        """Return the rows of runs that are given up after the death of a worker."""
        self._deaths.update(number for number, _ in batch)
        self._suspects.extend(p for p in batch if self._deaths[p[0]] < MOST_DEATHS)
        given_up = [p for p in batch if self._deaths[p[0]] >= MOST_DEATHS]
        return self.done([lost(p, nan, "crashed", GIVEN_UP) for p in given_up], 0.0)
