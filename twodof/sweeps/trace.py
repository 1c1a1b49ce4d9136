"""The outputs of one run as arrays, without a sample for each step."""

from __future__ import annotations

from itertools import accumulate, chain

import numpy as np

from ..errors import SimulationError, diverged, step_failure
from ..fmu import Instance
from ..simulation.experiments import Experiment
from ..simulation.master import OUTPUTS
from .metrics import Array


def trace(run: Experiment, instance: Instance) -> dict[str, Array]:
    """The outputs q, v, x, tau and quat at all samples of a run without changes, N + 1 × values.

    For whoever needs the numbers alone, without a ``Sample`` for each; errors as of ``samples``.
    """
    instance.initialise(run.start_time, run.time(run.steps), run.given)
    groups = [run.fmu.vector(group) for group in OUTPUTS]
    ends = [*accumulate(map(len, groups))]
    rows, read, step = bytearray(), instance.reader([*chain(*groups)]), instance.step
    start, h = run.start_time, run.step
    rows += read()
    try:
        for k in range(int(run.steps)):
            step(start + k * h, h)
            rows += read()
    except SimulationError as error:
        _check_finite(run, rows, ends[-1])
        raise step_failure(k, run.time(k), error) from error
    table = _check_finite(run, rows, ends[-1])
    return dict(zip(OUTPUTS, np.split(table, ends[:-1], axis=1)))


def _check_finite(run: Experiment, rows: bytearray, width: int) -> Array:
    table = np.asfortranarray(np.frombuffer(rows, np.float64).reshape(-1, width))  # fast along time
    if np.isfinite(table).all():
        return table
    astray = np.flatnonzero(~np.isfinite(table).all(axis=1))
    raise diverged(int(astray[0]), run.time(int(astray[0])))
