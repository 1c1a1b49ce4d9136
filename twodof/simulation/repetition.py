"""Runs that are repeated with other settings, in memory."""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import ceil

from ..errors import FmuError, SimulationError
from ..fmu import Instance, System, SystemInstance, evaluations_in, instantiate
from ..fmu.instance import logger
from ..signatures import ignore
from .experiments import Experiment
from .judge import Judge
from .remedies import Repetition
from .setup import robot_of
from .stepping import Stop, judge_of, stepped

MOST_STEPS = 5000  # communication steps, the most of a run that is repeated
BUDGET = 6e7  # evaluations times joints in all repetitions of a run, about 5 s: independent of the machine's load
TOO_LONG = "the run takes too long"


def is_repeatable(run: Experiment) -> bool:
    """Return whether a run can be repeated: it is short, and its native FMUs of this package have no side effects."""
    parts = run.fmu.components.values() if isinstance(run.fmu, System) else [run.fmu]
    return run.steps <= MOST_STEPS and all(fmu.is_native for fmu in parts)


@dataclass
class Repeater:
    """Repeats an experiment with other settings.

    Attributes:
        stop: called between steps; True ends the repetitions.
        left: evaluations of the equations of motion, times joints, that they may still take.
    """

    run: Experiment
    stop: Stop
    left: float = BUDGET

    def __call__(self, plans: Sequence[Repetition]) -> list[Judge | str]:
        """Run the experiment again for each plan; return for each its judge, or why there is none ("": it failed).

        A run may take half of the remaining evaluations, so that a slow run does not prevent all others. If ``stop``
        returns true, all results are "", because causes with and without results are not comparable.
        """
        try:
            with instantiate(self.run.fmu) as instance, _without_messages():
                count = evaluations_in(instance)
                results = [self._limited(_changed(self.run, plan), instance, count) for plan in plans]
        except (FmuError, SimulationError):  # the file was replaced meanwhile, or an instance cannot be reset
            return [""] * len(plans)
        return [""] * len(plans) if self.stop() else results

    def _limited(self, run: Experiment, instance: Instance | SystemInstance, count: Callable[[], float]) -> Judge | str:
        """Return the judge of a run, or why there is none; both depend on the run alone."""
        before, joints = count(), len(run.fmu.joints)

        def is_over() -> bool:
            return (count() - before) * joints > self.left / 2.0

        result = _judged(run, instance, lambda: is_over() or self.stop())
        over = is_over()
        self.left -= (count() - before) * joints
        return TOO_LONG if over else result or ""


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
