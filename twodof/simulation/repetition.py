"""Runs that are repeated with other settings, in memory."""

import logging
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import ceil

from ..errors import FmuError, SimulationError
from ..fmu import Fmu, Instance, System, SystemInstance, instantiate
from ..fmu.instance import logger
from ..signatures import ignore
from .experiments import Experiment
from .judge import Judge
from .remedies import Repetition
from .setup import robot_of
from .stepping import Stop, judge_of, stepped

MOST_STEPS = 5000  # communication steps of a run that is repeated
PATIENCE = 5.0  # s of wall time of all repetitions of a run


def is_repeatable(run: Experiment) -> bool:
    """Return whether a run is short, and of native FMUs of this package, which have no effects outside."""
    parts = run.fmu.components.values() if isinstance(run.fmu, System) else [run.fmu]
    return run.steps <= MOST_STEPS and all(map(_is_native, parts))


def _is_native(fmu: Fmu) -> bool:
    own = str(fmu.description.generationTool).startswith("twodof ")
    return own and not fmu.description.coSimulation.needsExecutionTool


@dataclass
class Repeater:
    """Repeats an experiment with other settings.

    Attributes:
        stop: called between steps; True ends the repetitions.
        left: wall time that they may still take, s.
    """

    run: Experiment
    stop: Stop
    left: float = PATIENCE

    def __call__(self, plans: Sequence[Repetition]) -> list[Judge | None]:
        """Run the experiment again for each plan; return the judges, None for a run that failed.

        All are None if no time is left or ``stop`` returns true: causes with results and others are not comparable.
        """
        end = time.monotonic() + self.left

        def late() -> bool:
            return time.monotonic() > end or self.stop()

        try:
            with instantiate(self.run.fmu) as instance, _without_messages():
                judges = [_judged(_changed(self.run, plan), instance, late) for plan in plans]
        except (FmuError, SimulationError):  # the file was replaced meanwhile, or an instance cannot be reset
            return [None] * len(plans)
        whole = not late()
        self.left = end - time.monotonic()
        return judges if whole else [None] * len(plans)


def _changed(run: Experiment, plan: Repetition) -> Experiment:
    settings, end = dict(plan.settings), run.time(run.steps)
    due = [(t, {n: v for n, v in inputs.items() if n not in settings}) for t, inputs in run.changes if t <= end]
    return replace(
        run,
        given={**run.given, **settings},
        start_values={**run.start_values, **settings},
        changes=due,
        steps=run.steps + ceil(plan.longer / run.step),
        signals=(),
    )


def _judged(run: Experiment, instance: Instance | SystemInstance, stop: Stop) -> Judge | None:
    judge = judge_of(run, robot_of(run.fmu.urdf))
    try:
        (last,) = deque(
            stepped(run, judge, None, stop, ignore, ignore, instance, None if run.changes else ()), maxlen=1
        )
    except SimulationError:
        return None
    finally:
        instance.reset()
    judge.flush()
    return judge if last.k == run.steps else None


@contextmanager
def _without_messages() -> Iterator[None]:
    """Discard log messages of FMUs in this thread."""
    own = threading.get_ident()

    def reject(record: logging.LogRecord) -> bool:
        return record.thread != own

    logger.addFilter(reject)
    try:
        yield
    finally:
        logger.removeFilter(reject)
