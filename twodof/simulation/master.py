"""The master: runs FMUs, one or several in one loop, and passes each sample to sinks."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..errors import InputError, SimulationError
from ..fmu import Fmu, Instance, SystemInstance
from ..notebook import in_notebook
from ..signatures import ignore, never, with_keywords_of
from .experiments import Experiment, ExperimentOptions, experiment
from .input_values import Setting
from .judge import Judge
from .pace import RealTime
from .progress import Progress
from .removal import Repeat
from .repetition import Repeater, is_repeatable
from .run_summary import Summary
from .sample import Sample, Sink, TakeRows
from .setup import robot_of
from .stepping import Resume, Stop, as_experiment, far_target, judge_of, stepped
from .verdict import conclude

if TYPE_CHECKING:
    from typing_extensions import Unpack

LOG = logging.getLogger(__name__)
Steer = Callable[[], Mapping[str, Setting] | None]
"""New inputs after a sample; None for no change."""


@with_keywords_of(experiment)
def simulate(
    run: Experiment | Fmu | str | Path,
    *sinks: Sink,
    pace: RealTime | None = None,
    stop: Stop = never,
    instance: Instance | SystemInstance | None = None,
    steer: Steer = ignore,
    resume: Resume = ignore,
    **options: Unpack[ExperimentOptions],
) -> Summary:
    """Run an FMU and pass every sample to every sink; sinks open once the FMU is initialised.

    A notebook shows a progress bar. ``samples`` describes the other arguments, and the errors.

    Args:
        stop: as in ``samples``, but after up to 256 short steps if the inputs do not change.
        steer: called after each sample; returns new inputs, which apply from that sample's time on. Inputs
            that a sink commands take precedence.
    """
    run = as_experiment(run, options)
    if other := next((sink for sink in sinks if not isinstance(sink, Sink)), None):
        raise TypeError(f"a sink is an instance of Sink, such as twodof.Bag('my_bag'), not {other!r}")
    bars = (Progress(),) if in_notebook() else ()
    member = Member(run, (*sinks, *bars), steer, resume, instance)
    return simulate_together([member], pace=pace, stop=stop)[0]


run = simulate  # the name of the command


class Member(NamedTuple):
    """One of several runs that advance together; the fields are arguments of ``simulate``."""

    run: Experiment
    sinks: Sequence[Sink]
    steer: Steer = ignore
    resume: Resume = ignore
    instance: Instance | SystemInstance | None = None

    def steered(self, pace: RealTime | None, stop: Stop) -> Steer:
        """Return a function that returns the new inputs after a sample; inputs from sinks take precedence."""
        commands = [sink.command for sink in self.sinks if type(sink).command is not Sink.command]

        def steer() -> Mapping[str, Setting] | None:
            asked = self.steer() or {}
            for command in commands:
                asked = {**asked, **(command(stop, pace) or {})}
            return asked

        return steer if commands else self.steer

    @property
    def takes_rows(self) -> bool:
        """True if the inputs do not change and all sinks take rows of outputs."""
        varies = self.run.changes or self.run.signals or self.steer is not ignore or self.resume is not ignore
        return not varies and all(sink.takes_rows for sink in self.sinks)

    def repeat(self, last: Sample, stop: Stop) -> Repeat | None:
        """Return a function that repeats the run, until ``stop`` returns true; None if it cannot be repeated."""
        steered = self.steer is not ignore or any(type(sink).command is not Sink.command for sink in self.sinks)
        whole = last.k == self.run.steps and self.instance is None and not steered
        return Repeater(self.run, stop) if whole and is_repeatable(self.run) else None

    def resumed(self, sample: Sample, error: SimulationError) -> Mapping[str, Setting] | None:
        """Return the first start values from ``resume`` or a sink with which to continue after a discarded step."""
        every = (resume(sample, error) for resume in (self.resume, *(sink.resume for sink in self.sinks)))
        return next((values for values in every if values is not None), None)


def simulate_together(members: Sequence[Member], *, pace: RealTime | None = None, stop: Stop = never) -> list[Summary]:
    """Run FMUs in one loop: all reach a communication point before any continues.

    Args:
        members: the runs; start time, step and stop time must be equal, and for several runs also the first stamp.
        pace, stop: as in ``simulate``, for all runs.

    Raises:
        InputError: their times differ.
        FmuError, SimulationError: as ``simulate``.
    """
    times = {(run.start_time, run.step, run.steps, run.stamp_start) for run, *_ in members}
    start, stamp, ended = members[0].run.start_time, members[0].run.stamp_start, False
    rows: list[TakeRows] | None = [] if len(members) == 1 and members[0].takes_rows and pace is None else None
    halt = stop if rows is not None else lambda: ended
    if len(times) > 1 or (stamp is None and len(members) > 1):
        raise InputError("runs in one loop need equal start time, step, stop time and first stamp")
    with ExitStack() as stack:

        def begin() -> None:
            """Open the sinks; the last run calls it, so that no sink is open if an earlier run fails."""
            for sink in [sink.begin(run) for run, sinks, *_ in members for sink in sinks]:
                stack.enter_context(sink)

        sources = []
        judges = [judge_of(run, robot_of(run.fmu.urdf)) for run, *_ in members]
        if len(judges) == 1:
            stack.enter_context(_explaining(*judges))
        for member, judge in zip(members, judges):
            ready = begin if member is members[-1] else lambda: None
            source = stepped(member.run, judge, None, halt, ready, member.resumed, member.instance, rows)
            sources.append(stack.enter_context(closing(source)))
        latest = [next(source) for source in sources]
        for member, first in zip(members, latest):
            if doubt := far_target(first):
                LOG.warning(f"'{member.run.fmu.path}': {doubt}")
        sends, steers = [s.send for s in sources], [m.steered(pace, stop) for m in members]
        writes = [(k, sink.write) for k, member in enumerate(members) for sink in member.sinks]
        started = time.perf_counter()
        if rows is not None:
            writes, rows[:] = [], [sink.take_rows(latest[0]) for sink in members[0].sinks]
        while True:
            if pace is not None:
                pace.wait(latest[0].t - start, stop)
            for k, write in writes:
                write(latest[k])
            answers = [steer() for steer in steers]
            ended = stop()
            try:
                latest = [send(answer) for send, answer in zip(sends, answers)]
            except StopIteration:
                break
        taken = time.perf_counter() - started
        summaries: list[Summary] = []
        for last, member, judge in zip(latest, members, judges):
            summaries.append(Summary(last, taken, last.k < member.run.steps, judge, member.repeat(last, stop)))
            for sink in member.sinks:
                sink.conclude(partial(getattr, summaries[-1], "verdict"))
    return summaries


@contextmanager
def _explaining(judge: Judge) -> Iterator[None]:
    """Add the first cause that the samples show to the error of a failed step."""
    try:
        yield
    except SimulationError as error:
        judge.flush()
        if judge.count < 2:
            raise
        causes = [cause for cause in conclude(judge).causes if not cause.noted]
        if not causes:
            raise
        raise SimulationError(f"{error}; until then: {causes[0].text}", error.k, error.outcome) from error
