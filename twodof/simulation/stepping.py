"""The stepping loop: steps an FMU at a fixed communication step and yields one sample per step.

    for k in 0..N-1:   t = start + k·h        never accumulated
        set the inputs at t; doStep(t, h); read the outputs; one sample at start + (k+1)·h

The initial state is the first sample, so N steps give N + 1 samples.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import nullcontext
from itertools import accumulate, chain, count
from math import dist, isfinite
from pathlib import Path
from struct import Struct
from typing import TYPE_CHECKING

from ..errors import InputError, SimulationError, diverged, step_failure
from ..fmu import Fmu, Instance, SystemInstance, instantiate
from ..plant.urdf import Urdf
from ..signatures import ignore, never, with_keywords_of
from .experiments import NANOSECONDS, TIME_TOLERANCE, Experiment, ExperimentOptions, experiment, pop_until
from .input_values import Setting, Value, resolve
from .judge import BLOCK, OUTPUTS, Judge
from .pace import RealTime
from .sample import Sample
from .setup import setup_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

OF_A_SAMPLE = (*OUTPUTS, "q_meas", "v_meas")
LARGE = 1e5  # in a setting's unit: larger settings are probably mistakes
FAR = 50.0  # m: a target farther from the end effector is probably in millimetres


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
        pace: waits until the time of each sample.
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
) -> Samples:
    """Yield the samples of a run; the judge receives the outputs of each as a buffer."""
    kinds, due = run.fmu.variables, deque(run.changes)
    inputs = {n: v for n, v in run.start_values.items() if kinds[n].causality == "input"}
    with instantiate(run.fmu) if instance is None else nullcontext(instance) as instance:
        instance.initialise(run.start_time, run.time(run.steps), {**run.given, **run.texts})
        ready()
        take, since = _sampler(instance, run, ignore if judge is None else judge.rows.write), run.start_time
        full = 0
        for k in count():
            sample = take(k, inputs, since)
            if k == full and judge is not None:
                judge.flush()
                full += BLOCK
            if pace is not None:
                pace.wait(sample.t - run.start_time, stop)
            answer = yield sample
            if k == run.steps or stop():
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


def stepped_rows(
    run: Experiment,
    judge: Judge,
    stop: Stop,
    ready: Callable[[], object],
    first: Callable[[Sample], Sequence[Callable[[bytes], object]]],
    instance: Instance | SystemInstance,
) -> Sample:
    """Step an FMU whose inputs do not change, and return the last sample.

    It makes no samples between the first and the last one, which take as long as a step of a fast FMU.

    Args:
        run, judge, stop, ready, instance: as of ``stepped``.
        first: receives the first sample; returns functions that receive the outputs of each further one as bytes.
    """
    inputs = {n: v for n, v in run.start_values.items() if run.fmu.variables[n].causality == "input"}
    instance.initialise(run.start_time, run.time(run.steps), {**run.given, **run.texts})
    ready()
    take, start, h, step = _sampler(instance, run, ignore), run.start_time, run.step, instance.step
    sample = take(0, inputs, start)
    groups = [run.fmu.vector(group) for group in OUTPUTS]
    read, unpack = instance.reader([*chain(*groups)]), Struct(f"{sum(map(len, groups))}d").unpack
    row, k, watch = bytes(read()), 0, judge.rows.write
    watch(row)
    judge.flush()
    adds = first(sample)
    while k < run.steps and not stop():
        try:
            step(start + k * h, h)
        except SimulationError as error:
            sample_of = _maker(run, [*accumulate(len(run.fmu.vector(group)) for group in OF_A_SAMPLE)], sample.stamp)
            _resumed(run, sample_of(k, unpack(row), inputs, start), error, ignore)
        row, k = bytes(read()), k + 1
        values = unpack(row)
        if not isfinite(sum(values)) and not all(map(isfinite, values)):
            raise diverged(k, run.time(k))
        watch(row)
        for add in adds:
            add(row)
        if not k % BLOCK:
            judge.flush()
    return take(k, inputs, start)


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
    instance: Instance | SystemInstance, run: Experiment, watch: Callable[[memoryview], object]
) -> Callable[[int, Mapping[str, Value], float], Sample]:
    """Return a function that reads the outputs after k steps, with the inputs and their start time."""
    groups = [run.fmu.vector(group) for group in OF_A_SAMPLE]
    ends = list(accumulate(map(len, groups)))
    read, unpack = instance.reader([*chain(*groups)]), Struct(f"{ends[-1]}d").unpack
    judged = memoryview(read()).cast("B")[: 8 * ends[len(OUTPUTS) - 1]]  # a view of the buffer that all reads use
    signals = instance.reader(run.signals) if run.signals else tuple
    sample_of = _maker(run, ends, run.first_stamp())

    def take(k: int, inputs: Mapping[str, Value], since: float) -> Sample:
        values = unpack(read())
        if not isfinite(sum(values)) and not all(map(isfinite, values)):
            raise diverged(k, run.time(k))
        watch(judged)
        return sample_of(k, values, inputs, since, tuple(signals()))

    return take


def _maker(run: Experiment, ends: Sequence[int], first_stamp: int) -> Callable[..., Sample]:
    """Return a function that makes the sample after k steps; outputs whose ends are beyond its values are empty."""
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
    """Return start values with which a run continues after a failed step; raise without them."""
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
    return f"the target x_des is {away:.4g} m from the end effector; is it in millimetres?" if away > FAR else ""


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
