"""Outcome of a run: the outputs that are not at their targets, or do not follow them."""

from math import inf

import numpy as np

from .aim import BAND, HELD
from .cause import FLOOR
from .judge import OF_THE_END, Judge

SUCCESS = ("reached", "followed")
"""Words for a run whose outputs are all at their targets, or follow their moving targets."""
FOLLOWED = 0.1  # fraction of the target's travel: with a larger RMS error in the second half, a target is not followed


def missed_outputs(judge: Judge) -> list[str]:
    """Return the outputs that are not at their targets during the last part of the run, or do not follow them."""
    if judge.moving:
        halves = {name: judge.error_history(name)[len(judge.history()) // 2 :] for name in judge.aims}
        return [name for name, e in halves.items() if np.sqrt(np.mean(e * e)) > max(FOLLOWED * judge.travel, FLOOR)]
    missed = []
    for name, aim in judge.aims.items():
        late = errors_at_the_end(judge, name)
        held = aim.first <= FLOOR and (np.diff(late) <= 0.0).all()
        if not max(aim.last, late.max(initial=0.0)) <= max(BAND * aim.first, HELD if held else FLOOR) < inf:
            missed.append(name)
    return missed


def errors_at_the_end(judge: Judge, name: str) -> np.ndarray:
    """Return the magnitudes of an output's errors during the last part of the run, m or rad."""
    end = judge.changed + (1.0 - OF_THE_END) * (judge.duration - judge.changed)
    return judge.error_history(name)[judge.history() >= end]


def success(judge: Judge) -> str:
    """Return the word for a run whose outputs are all at their targets, or follow them."""
    return SUCCESS[judge.moving]
