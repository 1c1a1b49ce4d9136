"""Verdict of a run, from its bag or its samples."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from pathlib import Path

from ..errors import InputError
from ..simulation.experiments import Experiment
from ..simulation.judge import BLOCK
from ..simulation.sample import Sample
from ..simulation.setup import robot_of
from ..simulation.stepping import judge_of
from ..simulation.verdict import Verdict, conclude
from .reader import read_bag
from .recording import Recording


def verdict(run: Recording | str | Path | Iterable[Sample], experiment: Experiment | None = None) -> Verdict:
    """Return the verdict of a run: reached or not, how, and why.

    Args:
        run: a bag, its folder, or all samples of a run.
        experiment: the experiment of the samples.

    Raises:
        BagError, FmuError: the bag, or the robot in the experiment's FMU, cannot be read.
        InputError: samples are given without an experiment, or there are no samples.
    """
    if isinstance(run, Recording | str | Path):
        return (run if isinstance(run, Recording) else read_bag(run)).verdict
    if experiment is None:
        raise InputError("samples are judged with their `experiment`")
    judge, inputs = judge_of(experiment, robot_of(experiment.fmu.urdf)), None
    for k, sample in enumerate(run):
        if inputs is not None and sample.inputs is not inputs:
            judge.change({name: value for name, value in sample.inputs.items() if value != inputs[name]})
        inputs = sample.inputs
        judge.rows.write(array("d", (*sample.q, *sample.v, *sample.x, *sample.tau, *sample.quat)))
        if k % BLOCK == 0:
            judge.flush()
    if inputs is None:
        raise InputError("there are no samples to judge")
    return conclude(judge)
