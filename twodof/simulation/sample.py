"""A sample of a run at a communication point, and the interface of its consumers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import hypot
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import SimulationError
from .experiments import Experiment
from .input_values import Setting, Value
from .pace import RealTime
from .verdict import Verdict

if TYPE_CHECKING:
    from typing_extensions import Self

TakeRows = Callable[[NDArray[np.float64]], object]
"""Function that receives OUTPUTS of consecutive samples side by side, N × values."""


class Sample(NamedTuple):
    """State, outputs and inputs at one communication point.

    Attributes:
        k: number of communication steps so far.
        t: time, s.
        q, v: joint positions (rad, m) and velocities, n values each.
        x: position of the end effector along the task axes, m; empty if the FMU has none.
        tau: control effort applied, N·m or N; empty if the FMU has none.
        inputs: values of all inputs at t, by name.
        since: the communication point from which on the inputs have these values, s.
        stamp: time stamp of the sample's messages, ns since the epoch.
        quat: orientation of the end effector, a unit quaternion x, y, z, w; empty if the FMU has none.
        q_meas, v_meas: measured values at the controller's latest sample, like q and v; empty if the FMU has none.
        signals: values of the experiment's ``signals``.
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
    q_meas: tuple[float, ...] = ()
    v_meas: tuple[float, ...] = ()
    signals: tuple[float, ...] = ()

    def __repr__(self) -> str:
        parts = ", ".join(f"{name}={_brief(getattr(self, name))}" for name in ("q", "v", "x", "tau"))
        return f"<Sample {self.k} at {self.t:g} s: {parts}>"

    @property
    def target(self) -> tuple[float, ...] | None:
        """Target x_des, m, one value for each of x; None if the FMU has no such inputs."""
        return self._given("x_des", len(self.x))

    @property
    def target_quat(self) -> tuple[float, ...] | None:
        """Unit quaternion of quat_des; None if the FMU has no such inputs, or if they are 0."""
        given = self._given("quat_des", len(self.quat)) or ()
        length = hypot(*given)
        return tuple(value / length for value in given) if length else None

    def _given(self, group: str, size: int) -> tuple[float, ...] | None:
        values = [self.inputs.get(f"{group}[{k + 1}]") for k in range(size)]
        return tuple(map(float, values)) if values and None not in values else None  # type: ignore[arg-type]


def _brief(values: tuple[float, ...]) -> str:
    """Return up to three values with three significant digits as text."""
    shown = [f"{value:.3g}" for value in values]
    return f"({', '.join(shown if len(shown) <= 3 else [*shown[:2], f'… {len(shown)}'])})"


class Sink:
    """Consumer of samples: a context that receives the experiment and then each sample.

    A derived class must define ``write``; the other methods do nothing here. Sinks that receive commands override
    ``command`` and so change the inputs of the run.

    ::

        with sink.begin(run):
            for sample in samples(run):
                sink.write(sample)
    """

    @property
    def takes_rows(self) -> bool:
        """True if ``take_rows`` can replace ``write``; False here.

        A run whose sinks all take rows, and whose inputs do not change, makes no samples between the first and the last
        one, to save time.
        """
        return False

    def begin(self, run: Experiment) -> Self:
        """Receive the experiment of the following samples; return self, a context manager."""
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        pass

    def write(self, sample: Sample) -> None:
        """Receive one sample."""

    def take_rows(self, first: Sample) -> TakeRows:
        """Receive the first sample; return a function that receives the OUTPUTS of further ones."""
        raise NotImplementedError

    def command(self, stop: Callable[[], bool], pace: RealTime | None) -> Mapping[str, Setting] | None:
        """Return new inputs from the latest sample's time on; ``stop`` and ``pace`` are those of the run."""
        return None

    def resume(self, sample: Sample, error: SimulationError) -> Mapping[str, Setting] | None:
        """Return start values to continue from the sample before a discarded step, or None to fail."""
        return None

    def conclude(self, verdict: Callable[[], Verdict]) -> None:
        """Receive a function that returns the verdict, after the last sample of a run that did not fail."""
