"""Pacing of a run to the wall clock."""

from __future__ import annotations

import time
from collections.abc import Callable
from math import inf

from ..errors import InputError
from ..signatures import never

LONGEST_SLEEP = 0.1  # s, between two checks of `stop`


class RealTime:
    """Pace a run to the wall clock.

    Args:
        speed: simulated seconds per second.

    Attributes:
        missed: number of samples that were ready after their time.
        worst: the largest delay, s.
    """

    def __init__(self, speed: float = 1.0) -> None:
        if not 0.0 < speed < inf:
            raise InputError(f"`speed` {speed:g} must be > 0")
        self._speed, self.missed = speed, 0
        self.worst = 0.0
        self._start: float | None = None

    def restart(self) -> None:
        """Make the next sample due now, and count time from it."""
        self._start = None

    def wait(self, elapsed: float, stop: Callable[[], bool] = never) -> None:
        """Wait until ``elapsed`` s of simulated time have passed since the first call, or ``stop`` returns true."""
        now = time.perf_counter()
        elapsed /= self._speed
        if self._start is None:
            self._start = now - elapsed
        due = self._start + elapsed
        left = due - now
        while left > 0.0 and not stop():
            time.sleep(min(left, LONGEST_SLEEP))
            left = due - time.perf_counter()
        if due < now:
            self.missed += 1
            self.worst = max(self.worst, now - due)
