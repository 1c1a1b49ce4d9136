"""Step FMUs many times in one call, if the library of one of them has `twodof_span`, as native FMUs of twodof do.

A call from Python takes longer than a step of a small robot's FMU. Spans are short, so that signals are handled.
"""

from collections.abc import Callable, Sequence
from ctypes import c_double, c_int, c_size_t, c_void_p
from functools import partial
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from ..errors import FmuError, SimulationError
from .instance import Instance, Part
from .loading import Prepared
from .system_instance import SystemInstance

SPAN = 256  # steps at most
Rows = NDArray[np.float64]
Advance = Callable[[int, int], tuple[Rows, SimulationError | None]]
"""Function that steps from index k on, n times; returns rows of outputs, and the error that ended the span, if any."""


def advancing(instance: Instance | SystemInstance, names: Sequence[str], start: float, h: float) -> Advance:
    """Return a function that steps an FMU or a system in spans and reads Real variables after each step.

    A row with a number that is not finite ends a span.
    """
    table = np.empty((SPAN, len(names)))
    parts = instance.parts(names, table.ctypes.data)
    calls = [call for *_, call in parts if call is not None]
    span = next(filter(None, (span_of(each) for _, each, _ in parts)), None)
    if span is None or len(calls) < len(parts):
        return _in_python(instance, names, start, h)
    failed, times = (c_int * 2)(), np.empty(SPAN)
    before = (Prepared * len(calls))(*calls), len(calls), c_void_p(times.ctypes.data), c_double(h)
    after = c_void_p(table.ctypes.data), c_size_t(len(names)), failed

    def advance(k: int, n: int) -> tuple[Rows, SimulationError | None]:
        times[:n] = start + np.arange(k, k + n) * h
        done = span(*before, n, *after)
        error = None if failed[0] == len(calls) else _refused(parts[failed[0]], failed[1])
        return table[:done].copy(), error

    return advance


def span_of(instance: Instance) -> Callable[..., int] | None:
    """Return the function `twodof_span` of an FMU's library; None without it."""
    return getattr(instance.slave.dll, "twodof_span", None)


def evaluations_in(instance: Instance | SystemInstance) -> Callable[[], float]:
    """Return a function that counts the evaluations of the equations of motion in all steps of native FMUs.

    Raises:
        FmuError: an FMU does not count them.
    """
    counts = []
    for part in {part for _, part, _ in instance.parts([], 0)}:
        if (count := getattr(part.slave.dll, "twodof_evaluations", None)) is None:
            raise FmuError(f"'{part.fmu.path}' does not count its evaluations; build it again")
        count.restype = c_double
        counts.append(partial(count, c_void_p(part.slave.component)))
    return lambda: sum(count() for count in counts)


def _refused(part: Part, status: int) -> SimulationError:
    """Return the error of a call that was refused."""
    name, instance, _ = part
    error = instance.failure_in_c(status)
    return SimulationError(f"'{name}': {error}", outcome=error.outcome) if name else error


def _in_python(instance: Instance | SystemInstance, names: Sequence[str], start: float, h: float) -> Advance:
    """Return a function that makes each call from Python."""
    step, read = instance.step, instance.reader(names)

    def advance(k: int, n: int) -> tuple[Rows, SimulationError | None]:
        rows, failure = bytearray(), None
        for i in range(k, k + n):
            try:
                step(start + i * h, h)
                values = read()
            except SimulationError as error:
                failure = error
                break
            rows += values
            if not isfinite(sum(values)):
                break
        return np.frombuffer(rows).reshape(-1, len(names)), failure

    return advance
