"""Runs that are repeated with other settings, in memory."""

import logging
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from math import ceil

from ..errors import FmuError, SimulationError
from ..fmu import Fmu, Instance, System, SystemInstance, instantiate
from ..fmu.instance import logger
from ..signatures import ignore, never
from .experiments import Experiment
from .judge import Judge
from .removal import Repetition
from .setup import robot_of
from .stepping import judge_of, stepped

MOST_STEPS = 5000  # communication steps of the repetitions of a run


def is_repeatable(run: Experiment) -> bool:
    """Return whether a run is short, and of native FMUs of this package, which have no effects outside."""
    parts = run.fmu.components.values() if isinstance(run.fmu, System) else [run.fmu]
    return run.steps <= MOST_STEPS and all(map(_is_native, parts))


def _is_native(fmu: Fmu) -> bool:
    own = str(fmu.description.generationTool).startswith("twodof ")
    return own and not fmu.description.coSimulation.needsExecutionTool


def repeated(run: Experiment, plans: Sequence[Repetition]) -> list[Judge | None]:
    """Run an experiment again for each plan; return the judges.

    A judge is None if the run failed, or if it needs more steps than MOST_STEPS leaves.
    """
    left: float = MOST_STEPS
    judges = list[Judge | None]()
    try:
        with instantiate(run.fmu) as instance, _without_messages():
            for plan in plans:
                again = _changed(run, plan)
                within = again.steps <= left
                left -= again.steps if within else 0
                judges.append(_judged(again, instance) if within else None)
    except FmuError:  # the file was replaced meanwhile
        return [None] * len(plans)
    return judges


def _changed(run: Experiment, plan: Repetition) -> Experiment:
    settings = dict(plan.settings)
    return replace(
        run,
        given={**run.given, **settings},
        start_values={**run.start_values, **settings},
        changes=[(t, {n: v for n, v in inputs.items() if n not in settings}) for t, inputs in run.changes],
        steps=run.steps + ceil(plan.longer / run.step),
        signals=(),
    )


def _judged(run: Experiment, instance: Instance | SystemInstance) -> Judge | None:
    judge = judge_of(run, robot_of(run.fmu.urdf))
    try:
        deque(stepped(run, judge, None, never, ignore, ignore, instance), maxlen=0)
    except SimulationError:
        return None
    finally:
        instance.reset()
    judge.flush()
    return judge


@contextmanager
def _without_messages() -> Iterator[None]:
    """Discard log messages of FMUs."""

    def reject(_record: logging.LogRecord) -> bool:
        return False

    logger.addFilter(reject)
    try:
        yield
    finally:
        logger.removeFilter(reject)
