"""The stepping loop: steps an FMU at a fixed communication step and yields one sample per step.

    for k in 0..N-1:   t = start + k·h        never accumulated
        set the inputs at t; doStep(t, h); read the outputs; one sample at start + (k+1)·h

The initial state is the first sample, so N steps give N + 1 samples.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import nullcontext
from itertools import accumulate, chain, count
from math import dist, isfinite
from pathlib import Path
from struct import Struct
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, SimulationError, diverged, step_failure
from ..fmu import SPAN, Fmu, Instance, SystemInstance, advancing, instantiate
from ..plant.urdf import Urdf
from ..signatures import ignore, never, with_keywords_of
from .experiments import NANOSECONDS, TIME_TOLERANCE, Experiment, ExperimentOptions, experiment, pop_until
from .input_values import Setting, Value, resolve
from .judge import BLOCK, OUTPUTS, Judge
from .pace import RealTime
from .sample import Sample, TakeRows
from .setup import setup_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

OF_A_SAMPLE = (*OUTPUTS, "q_meas", "v_meas")
LARGE = 1e5  # in a setting's unit: larger settings are probably mistakes
FAR = 50.0  # m: a target farther from the end effector is probably in millimetres
FAST = 2e-4  # s of wall time: between longer steps, signals are handled


Stop = Callable[[], bool]
Samples = Generator[Sample, Mapping[str, Setting] | None, None]
Resume = Callable[[Sample, SimulationError], Mapping[str, Setting] | None]
"""Start values to continue after a discarded step, from the sample before it and the error; None to fail."""


@with_keywords_of(experiment)
def samples(
    run: Experiment | Fmu | str | Path,
    *,
    pace: RealTime | None = None,
    stop: Stop = never,
    ready: Callable[[], object] = ignore,
    resume: Resume = ignore,
    instance: Instance | SystemInstance | None = None,
    **options: Unpack[ExperimentOptions],
) -> Samples:
    """Run an FMU; yield the initial state, then one sample per communication step.

    Your loop may answer a sample with new inputs, ``run.send({"x_des": (0.2, 0.1)})``, which apply from that sample's
    time on.

    Args:
        run: the experiment, or an FMU together with options of ``experiment``.
        pace: waits until the time of each sample, as ``RealTime`` does; None: run as fast as possible.
        stop: called between two steps, and while the pace waits; True ends the run.
        ready: called after the initialisation, before time and stamps begin.
        resume: called after a discarded step; returns start values with which the FMU is initialised
            again to continue from the previous sample, or None to fail.
        instance: a new or reset instance of the FMU, which is not freed at the end of the run; None: the run
            instantiates the FMU itself.

    Raises:
        FmuError, InputError: before the first sample.
        SimulationError: the FMU refused or failed a call, or gave a value that is not finite.
    """
    run = as_experiment(run, options)
    yield from stepped(run, None, pace, stop, ready, resume, instance)


def stepped(
    run: Experiment,
    judge: Judge | None,
    pace: RealTime | None,
    stop: Stop,
    ready: Callable[[], object],
    resume: Resume,
    instance: Instance | SystemInstance | None,
    rows: Sequence[TakeRows] | None = None,
) -> Samples:
    """Yield the samples of a run; the judge receives the outputs of each as a buffer.

    With ``rows``, functions that receive rows of outputs, inputs must not change. Then only the first and the last
    sample are made: a sample takes as long as a step of a fast FMU. Functions may be added after the first sample.
    """
    kinds, due = run.fmu.variables, deque(run.changes)
    inputs = {n: v for n, v in run.start_values.items() if kinds[n].causality == "input"}
    with instantiate(run.fmu) if instance is None else nullcontext(instance) as instance:
        instance.initialise(run.start_time, run.time(run.steps), {**run.given, **run.texts})
        ready()
        (take, judged), since = _sampler(instance, run), run.start_time
        for k in count():
            sample = take(k, inputs, since)
            if judge is not None:
                judge.rows.write(judged)
                if not k % BLOCK:
                    judge.flush()
            if pace is not None:
                pace.wait(sample.t - run.start_time, stop)
            answer = yield sample
            if k == run.steps or stop():
                return
            if rows is not None and judge is not None:
                yield take(_step_in_spans(run, judge, stop, instance, sample, rows), inputs, since)
                return
            try:
                if answer or due:
                    by = sample.t + TIME_TOLERANCE * run.step
                    asked = {**pop_until(by, due), **resolve(run.fmu, answer or {})}
                    latest = {n: value for n, value in asked.items() if value != inputs.get(n)}
                    if latest:
                        instance.set(latest)
                        inputs, since = {**inputs, **latest}, sample.t
                        if judge is not None:
                            judge.change(latest)
                instance.step(sample.t, run.step)
            except SimulationError as error:
                again = _resumed(run, sample, error, resume)
                inputs = {name: again.get(name, value) for name, value in inputs.items()}
                since = sample.t
                if judge is not None:
                    judge.change(inputs)
                instance.reset()
                instance.initialise(since, run.time(run.steps), {**run.given, **run.texts, **inputs, **again})
                instance.step(since, run.step)


def _step_in_spans(
    run: Experiment,
    judge: Judge,
    stop: Stop,
    instance: Instance | SystemInstance,
    first: Sample,
    takers: Sequence[TakeRows],
) -> int:
    """Step from the first sample on; pass rows of outputs to judge and functions; return the index of the last step."""
    sizes = [len(run.fmu.vector(group)) for group in OUTPUTS]
    advance = advancing(instance, [*chain(*map(run.fmu.vector, OUTPUTS))], run.start_time, run.step)
    k, span, last = 0, 1, np.empty((0, sum(sizes)))
    while True:
        begin, size = time.perf_counter(), int(min(span, run.steps - k, BLOCK - k % BLOCK))
        rows, error = advance(k, size)
        fast = time.perf_counter() - begin < FAST * size
        finite = rows if np.isfinite(rows[-1:]).all() else rows[:-1]
        if len(finite):
            judge.rows.write(finite.data)
            for take in takers:
                take(finite)
            k, last = k + len(finite), finite
        if len(rows) > len(finite):
            raise diverged(k + 1, run.time(k + 1))
        if error is not None:
            sample_of = _maker(run, [*accumulate(sizes), *[sum(sizes)] * 2], first.stamp)
            sample = sample_of(k, tuple(last[-1].tolist()), first.inputs, first.since) if k else first
            _resumed(run, sample, error, ignore)
        if not k % BLOCK:
            judge.flush()
        if k == run.steps or stop():
            return k
        span = SPAN if fast else 1


def as_experiment(
    run: Experiment | Fmu | str | Path, options: ExperimentOptions, usual: ExperimentOptions | None = None
) -> Experiment:
    """Return the experiment itself, or make one from an FMU and the options of ``experiment``.

    Raises:
        FmuError, InputError: as ``experiment``; or options are given together with an experiment.
    """
    if not isinstance(run, Experiment):
        merged: ExperimentOptions = options if usual is None else {**usual, **options}
        return experiment(run, **merged)
    if options:
        beside = ", ".join(options)
        raise InputError(f"{beside} would have no effect with an experiment; give them to `experiment`")
    return run


def _sampler(
    instance: Instance | SystemInstance, run: Experiment
) -> tuple[Callable[[int, Mapping[str, Value], float], Sample], memoryview]:
    """Return a function that reads the outputs after k steps, with the inputs and their start time.

    The second result is a view of the latest OUTPUTS.
    """
    groups = [run.fmu.vector(group) for group in OF_A_SAMPLE]
    ends = list(accumulate(map(len, groups)))
    read, unpack = instance.reader([*chain(*groups)]), Struct(f"{ends[-1]}d").unpack
    signals = instance.reader(run.signals) if run.signals else tuple
    sample_of = _maker(run, ends, run.first_stamp())

    def take(k: int, inputs: Mapping[str, Value], since: float) -> Sample:
        values = unpack(read())
        if not isfinite(sum(values)) and not all(map(isfinite, values)):
            raise diverged(k, run.time(k))
        return sample_of(k, values, inputs, since, tuple(signals()))

    return take, memoryview(read()).cast("B")[: 8 * ends[len(OUTPUTS) - 1]]  # all reads use one buffer


def _maker(run: Experiment, ends: Sequence[int], first_stamp: int) -> Callable[..., Sample]:
    """Return a function that makes the sample after k steps; outputs that the FMU lacks are empty."""
    of_q, of_v, of_x, of_tau, *of_rest = (slice(a, b) for a, b in zip([0, *ends], ends))
    start, step = run.start_time, run.step

    def sample_of(
        k: int, values: tuple[float, ...], inputs: Mapping[str, Value], since: float, signals: tuple[float, ...] = ()
    ) -> Sample:
        stamp = first_stamp + round(k * step * NANOSECONDS)
        parts = values[of_q], values[of_v], values[of_x], values[of_tau]
        quat, q_meas, v_meas = (values[of] for of in of_rest)
        return Sample(k, start + k * step, *parts, inputs, since, stamp, quat, q_meas, v_meas, signals)

    return sample_of


def _resumed(run: Experiment, sample: Sample, error: SimulationError, resume: Resume) -> dict[str, Value]:
    """Return start values with which a run continues after a failed step; raise its error if there are none."""
    doubt = _too_large(run, sample) or far_target(sample)
    failure = step_failure(sample.k, sample.t, error, f"; {doubt}" if doubt else "")
    settings = resume(sample, failure) if error.outcome == "discarded" else None
    if settings is None:
        raise failure from error
    return resolve(run.fmu, settings)


def _too_large(run: Experiment, sample: Sample) -> str:
    """Return a text that names settings that are so large that they may be the cause of a failure; "" if none are."""
    given = {**run.given, **sample.inputs}
    usual, kinds = run.fmu.start_values, run.fmu.variables
    large = [name for name, value in given.items() if abs(value) > LARGE and value != usual.get(name)]
    named = ", ".join(f"{name} = {given[name]:g} {kinds[name].unit or ''}".strip() for name in large[:3])
    return f"a setting may be too large: {named}" if large else ""


def far_target(sample: Sample) -> str:
    """Return a question about a target that no robot of usual size reaches; "" for others."""
    away = dist(sample.x, sample.target) if sample.target else 0.0
    return (
        f"the target x_des is {away:.4g} m from the end effector; is the target in millimetres?" if away > FAR else ""
    )


def at_rest(fmu: Fmu, sample: Sample) -> dict[str, tuple[float, ...]] | None:
    """Return start values with which the robot rests at a sample's position, with its target there.

    With them a run can continue after a discarded step; across a singularity, speeds can become infinite in finite
    time. Return None if the FMU has no such variables.
    """
    still = (0.0,) * len(sample.v)
    start = {"q_start": sample.q, "v_start": still}
    targets = {
        "x_des": sample.x,
        "quat_des": sample.quat,
        "q_des": sample.q,
        "v_des": still,
        "a_des": still,
        "tau_cmd": still,
    }
    meant = {group: value for group, value in targets.items() if value and fmu.vector(group)}
    return {**start, **meant} if meant and all(map(fmu.vector, start)) else None


def judge_of(run: Experiment, robot: Urdf | None) -> Judge:
    """Return a judge of a run's samples, with the robot that the FMU carries."""
    sizes = [len(run.fmu.vector(group)) for group in OUTPUTS]
    return Judge(setup_of(run.fmu, robot, run.step, run.start_values), sizes)
