"""The master: steps an FMU at a fixed communication step and yields one sample a step.

    for k in 0..N-1:   t = start + k·h        never accumulated
        set the inputs at t; doStep(t, h); read the outputs; one sample at start + (k+1)·h

The initial state is the first sample, so N steps give N + 1 samples.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, closing, nullcontext
from dataclasses import dataclass
from itertools import accumulate, chain, count
from math import asin, dist, hypot, inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from .errors import InputError, SimulationError, diverged, step_failure
from .experiments import (
    NANOSECONDS,
    TIME_TOLERANCE,
    Experiment,
    Setting,
    Value,
    experiment,
    resolve,
)
from .fmu import Fmu, Instance, instantiate

if TYPE_CHECKING:
    from typing_extensions import Self

LONGEST_SLEEP = 0.1  # s, after which it is asked whether to go on
OUTPUTS = ("q", "v", "x", "tau", "quat")


class Sample(NamedTuple):
    """What is known at one communication point.

    Attributes:
        k: communication steps done so far.
        t: time, s.
        q, v: joint positions (rad, m) and velocities, n values each.
        x: position of the end effector along the task axes, m; empty if the FMU has none.
        tau: control effort applied, N·m or N; empty if the FMU has none.
        inputs: values of all inputs by name, as they are at t.
        since: the communication point from which on the inputs have had these values, s.
        stamp: of the messages that tell of it, ns since the epoch.
        quat: orientation of the end effector, a unit quaternion x, y, z, w; empty if the FMU has
            none.
    """

    k: int
    t: float
    q: tuple[float, ...]
    v: tuple[float, ...]
    x: tuple[float, ...]
    tau: tuple[float, ...]
    inputs: Mapping[str, Value]
    since: float
    stamp: int
    quat: tuple[float, ...] = ()

    @property
    def target(self) -> tuple[float, ...] | None:
        """x_des, m, one value for each of x; None where the FMU has no such inputs."""
        return self._given("x_des", len(self.x))

    @property
    def target_quat(self) -> tuple[float, ...] | None:
        """quat_des at length 1; None where the FMU has no such inputs, or they are 0."""
        given = self._given("quat_des", len(self.quat)) or ()
        length = hypot(*given)
        return tuple(value / length for value in given) if length else None

    def _given(self, group: str, size: int) -> tuple[float, ...] | None:
        values = [self.inputs.get(f"{group}[{k + 1}]") for k in range(size)]
        return tuple(map(float, values)) if values and None not in values else None  # type: ignore[arg-type]

    @property
    def error(self) -> float | None:
        """Distance of the end effector from its target, m; None where there is no target."""
        return None if self.target is None else dist(self.x, self.target)

    @property
    def turn_error(self) -> float | None:
        """Angle between the end effector's orientation and its target, rad; None without one."""
        if self.target_quat is None:
            return None
        apart = (
            dist(self.quat, self.target_quat),
            hypot(*map(sum, zip(self.quat, self.target_quat))),
        )
        return 4.0 * asin(min(1.0, 0.5 * min(apart)))


class Sink:
    """Consumer of samples: a context that is given the experiment and then each sample.

    One of one's own needs ``write`` alone; the rest does nothing here.

    ::

        with sink.begin(run):
            for sample in samples(run):
                sink.write(sample)
    """

    def begin(self, run: Experiment) -> Self:
        """Take the experiment whose samples come; itself, to be entered."""
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: Any) -> None:
        pass

    def write(self, sample: Sample) -> None:
        """Take one sample."""


Resume = Callable[[Sample, SimulationError], Mapping[str, Setting] | None]
"""What a run goes on with after a step that was discarded: the sample before it, and the reason."""


class RealTime:
    """Paces a run to the wall clock.

    Args:
        speed: s of the run in a second.

    Attributes:
        missed: samples that were ready only after their time.
        worst: the largest delay, s.
    """

    def __init__(self, speed: float = 1.0) -> None:
        if not 0.0 < speed < inf:
            raise InputError(f"`speed` {speed:g} is no factor")
        self._speed, self.missed = speed, 0
        self.worst = 0.0
        self._start: float | None = None

    def restart(self) -> None:
        """The next sample is due at once, and those after it by that."""
        self._start = None

    def wait(self, elapsed: float, stop: Callable[[], bool] = lambda: False) -> None:
        """Wait until ``elapsed`` s of the run are due since the first call, or ``stop`` is true."""
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


def samples(
    run: Experiment | Fmu | str | Path,
    *,
    pace: RealTime | None = None,
    stop: Callable[[], bool] = lambda: False,
    ready: Callable[[], object] = lambda: None,
    resume: Resume = lambda sample, error: None,
    instance: Instance | None = None,
    **options: Any,
) -> Generator[Sample, Mapping[str, Setting] | None, None]:
    """Run an FMU; the initial state, then one sample a communication step.

    A loop of one's own may answer a sample with new inputs, ``run.send({"x_des": (0.2, 0.1)})``,
    which hold from that sample's time on.

    Args:
        run: the experiment, or an FMU with the options of ``experiment`` beside it.
        pace: waits before each sample until its time has come.
        stop: asked between two steps, and while it is waited for the next one's time; True ends the
            run.
        ready: called when the FMU is initialised, before time and stamps begin.
        resume: asked where a step was discarded; start values with which the FMU is initialised
            anew and goes on from the sample before, or None, and the run fails.
        instance: one of that FMU which is as instantiated, and stays when the run has ended;
            None: an own one.

    Raises:
        FmuError, InputError: before the first sample.
        SimulationError: the FMU refused or failed a call, or gave a value that is not finite.
    """
    if not isinstance(run, Experiment):
        run = experiment(run, **options)
    inputs, due = _inputs(run), deque(run.changes)
    with instantiate(run.fmu) if instance is None else nullcontext(instance) as instance:
        instance.initialise(run.start_time, run.time(run.steps), run.given)
        ready()
        take, since = _sampler(instance, run), run.start_time
        for k in count():
            sample = take(k, inputs, since)
            if pace is not None:
                pace.wait(sample.t - run.start_time, stop)
            answer = yield sample
            if k == run.steps or stop():
                return
            try:
                if answer or due:
                    asked = {**_changes_until(sample.t, due, run), **resolve(run.fmu, answer or {})}
                    latest = {n: value for n, value in asked.items() if value != inputs.get(n)}
                    if latest:
                        instance.set(latest)
                        inputs, since = {**inputs, **latest}, sample.t
                instance.step(sample.t, run.step)
            except SimulationError as error:
                again = _resumed(run, sample, error, resume)
                inputs = {name: again.get(name, value) for name, value in inputs.items()}
                since = sample.t
                instance.reset()
                instance.initialise(since, run.time(run.steps), {**run.given, **inputs, **again})
                instance.step(since, run.step)


def _inputs(run: Experiment) -> dict[str, Value]:
    variables = run.fmu.variables
    return {n: v for n, v in run.start_values.items() if variables[n].causality == "input"}


def _changes_until(
    t: float, due: deque[tuple[float, dict[str, Value]]], run: Experiment
) -> dict[str, Value]:
    """What the changes that are due by t set; they are due no more."""
    latest: dict[str, Value] = {}
    while due and due[0][0] <= t + TIME_TOLERANCE * run.step:
        latest.update(due.popleft()[1])
    return latest


def _sampler(
    instance: Instance, run: Experiment
) -> Callable[[int, Mapping[str, Value], float], Sample]:
    """A function that reads the outputs after k steps, with the inputs and since when they hold."""
    groups = [run.fmu.vector(group) for group in OUTPUTS]
    ends = list(accumulate(map(len, groups)))
    read = instance.reader([*chain(*groups)])
    of_q, of_v, of_x, of_tau, of_quat = (slice(a, b) for a, b in zip([0, *ends], ends))
    start, step, first_stamp = run.start_time, run.step, run.first_stamp()

    def take(k: int, inputs: Mapping[str, Value], since: float) -> Sample:
        t, values = start + k * step, tuple(read())
        if not all(map(isfinite, values)):
            raise diverged(k, t)
        stamp = first_stamp + round(k * step * NANOSECONDS)
        parts = values[of_q], values[of_v], values[of_x], values[of_tau]
        return Sample(k, t, *parts, inputs, since, stamp, values[of_quat])

    return take


def _resumed(
    run: Experiment, sample: Sample, error: SimulationError, resume: Resume
) -> dict[str, Value]:
    """Start values to go on with after a step that failed; where there are none, its failure."""
    failure = step_failure(sample.k, sample.t, error)
    settings = resume(sample, failure) if error.outcome == "discarded" else None
    if settings is None:
        raise failure from error
    return resolve(run.fmu, settings)


def at_rest(fmu: Fmu, sample: Sample) -> dict[str, tuple[float, ...]] | None:
    """Start values of a robot that rests where a sample has it, and is meant to be there.

    With them a run can go on after a step that was discarded: across a singularity, speeds can
    escape to infinity in finite time after a target that is out of reach. None where the FMU has
    no such variables.
    """
    still = (0.0,) * len(sample.v)
    start = {"q_start": sample.q, "v_start": still}
    targets = {
        "x_des": sample.x, "quat_des": sample.quat,
        "q_des": sample.q, "v_des": still, "a_des": still, "tau_cmd": still,
    }  # fmt: skip
    meant = {group: value for group, value in targets.items() if value and fmu.vector(group)}
    return {**start, **meant} if meant and all(map(fmu.vector, start)) else None


@dataclass(frozen=True)
class Summary:
    """How a run went.

    Attributes:
        last: the last sample.
        wall_time: s, without loading and initialisation.
        stopped: whether it was asked to end before its stop time.
    """

    last: Sample
    wall_time: float
    stopped: bool

    @property
    def error(self) -> float | None:
        """Distance of the end effector from its target at the end, m; None without a target."""
        return self.last.error


def simulate(
    run: Experiment | Fmu | str | Path,
    *sinks: Sink,
    pace: RealTime | None = None,
    stop: Callable[[], bool] = lambda: False,
    instance: Instance | None = None,
    steer: Callable[[], Mapping[str, Setting] | None] = lambda: None,
    resume: Resume = lambda sample, error: None,
    **options: Any,
) -> Summary:
    """Run an FMU and hand every sample to every sink, which is opened once the FMU is initialised.

    Other arguments and errors as in ``samples``.

    Args:
        steer: asked after each sample for new inputs, which hold from that sample's time on.
    """
    if not isinstance(run, Experiment):
        run = experiment(run, **options)
    with ExitStack() as stack:

        def begin() -> None:
            for sink in sinks:
                stack.enter_context(sink.begin(run))

        source = samples(run, pace=pace, stop=stop, ready=begin, resume=resume, instance=instance)
        sample = next(stack.enter_context(closing(source)))
        started = time.perf_counter()
        while True:
            for sink in sinks:
                sink.write(sample)
            answer = steer()
            try:
                sample = source.send(answer)
            except StopIteration:
                break
        return Summary(sample, time.perf_counter() - started, sample.k < run.steps)
