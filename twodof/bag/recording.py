"""A recording: a bag's samples as arrays, and the run's settings from its provenance."""

from __future__ import annotations

import json
from array import array
from collections import ChainMap
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from math import ceil, inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from ..errors import BagError
from ..files import fits, shown
from ..notebook import card, picture
from ..plant.urdf import Urdf
from ..ros.messages import TRUE_STATES
from ..simulation.aim import errors
from ..simulation.experiments import NANOSECONDS, TIME_TOLERANCE
from ..simulation.input_values import Value
from ..simulation.setup import Setup, robot_of
from ..simulation.setup import setup as setup_of
from ..simulation.verdict import SHAPE, judged, verdict_in
from ..simulation.verdict import Verdict as Verdict
from ..version import needing
from .provenance import KNOWN_UNTIL, MAX_TAIL, Provenance
from .records import Stamps

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Steps = NDArray[np.int64]
Changes = list[tuple[int, dict[str, Value]]]
"""Ascending communication points, and the values of inputs and parameters that change at each."""
Schedule = list[tuple[int, Mapping[str, Value]]]
"""Ascending communication points, from 0 on, and the values of inputs and parameters that apply from each on."""

MOST_LOST = 10  # lost samples, as a multiple of the existing ones


@dataclass(frozen=True)
class TopicCount:
    """One topic of a bag: its name, message type and number of messages."""

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class ReceivedTargets:
    """Targets received on a bag's /target: for each sample the latest one."""

    frame: str  # frame of the points
    points: Array  # N × 3, m; NaN before the first one


class Inputs:
    """Inputs and parameters of a run over time, evaluated once for all recordings of a bag."""

    def __init__(self, provenance: Provenance) -> None:
        self.provenance, self._columns = provenance, dict[tuple[str, ...], list[tuple[Steps, Array]]]()

    @cached_property
    def changes(self) -> Changes:
        """Changed values with the communication point from which on they apply."""
        run = self.provenance
        changes: Changes = []
        for time, values in run.get("input_changes", []):
            k = max(0, ceil((time - run["start_time"]) / run["step"] - TIME_TOLERANCE))
            if not changes or k != changes[-1][0]:
                changes.append((k, {}))
            changes[-1][1].update(values)
        if not all(map(isfinite, chain(self._starts.values(), *(values.values() for _, values in changes)))):
            raise ValueError("values are not finite")
        return changes

    @cached_property
    def schedule(self) -> Schedule:
        """All values with the communication point from which on they apply; no change precedes the first sample."""
        schedule: Schedule = [(0, ChainMap({}, self._starts))]
        changed: dict[str, Value] = {}
        for k, values in self.changes:
            changed = {**changed, **values}
            schedule.append((k, ChainMap(changed, self._starts)))
        return schedule

    @property
    def _starts(self) -> dict[str, Value]:
        return self.provenance.get("start_values", {})

    def columns(self, names: tuple[str, ...]) -> list[tuple[Steps, Array]]:
        """Return the communication points from which on values of some variables apply, and these values."""
        if names not in self._columns:
            found = {name: (array("q", [0]), array("d", [self._starts[name]])) for name in names}
            for k, values in self.changes:
                for name in found.keys() & values.keys():
                    begins, column = found[name]
                    begins.append(k)
                    column.append(values[name])
            self._columns[names] = [(np.array(begins), np.array(column)) for begins, column in found.values()]
        return self._columns[names]


@dataclass(frozen=True, repr=False)
class Recording:
    """A bag read back: N samples of n joints and m task axes.

    A recording for drawing has only some of the samples of a large bag.

    Attributes:
        path: the bag's folder.
        topics: all topics of the bag.
        count: number of samples in the bag.
        stamps: time stamps of the joint states, ns since the epoch, N, ascending.
        joints: joint names.
        q, v: positions (rad, m) and velocities, N × n.
        tau: efforts (N·m, N), N × n, or N × 0 without efforts.
        received: points received on /target; None without such points.
        provenance: content of run.json, {} for a third-party bag.
        inputs: the inputs in the provenance, evaluated once for all recordings of a bag.

    Raises:
        BagError: attributes from the provenance raise it if the provenance does not fit the samples, and ``steps``
            raises it without provenance.
    """

    path: Path
    topics: tuple[TopicCount, ...]
    count: int
    stamps: Stamps
    joints: tuple[str, ...]
    q: Array
    v: Array
    tau: Array
    received: ReceivedTargets | None
    provenance: Provenance
    inputs: Inputs | None = None

    def __repr__(self) -> str:
        return f"<Recording '{self.path}': {self.count} samples in {self.t[-1]:g} s of {', '.join(self.joints)}>"

    def _repr_html_(self) -> str:
        facts = {topic.name: f"{topic.count} × {topic.type}" for topic in self.topics}
        curves = picture(((self.t, q) for q in self.q.T), "t in s", f"q of {', '.join(self.joints)}")
        return card(f"Recording of {self.t[-1]:g} s, {shown(self.path)}", facts, curves)

    @property
    def t(self) -> Array:
        """Time since the first sample, s, N."""
        return cast(Array, (self.stamps - self.stamps[0]) / NANOSECONDS)

    @property
    def axes(self) -> str:
        """Task axes, letters of "xyz"; "" if unknown."""
        return str(self.provenance.get("axes") or "")

    @property
    def measured(self) -> bool:
        """True if q and v are measured values; then /joint_states_true has the true ones."""
        return any(topic.name.endswith(TRUE_STATES) for topic in self.topics)

    @cached_property
    def _inputs(self) -> Inputs:
        known = self.inputs
        return known if known is not None and known.provenance is self.provenance else Inputs(self.provenance)

    @cached_property
    def schedule(self) -> Schedule:
        """Values of inputs and parameters, with the communication point from which on they apply."""
        with self._fitting():
            last = self._last
            return [(k, values) for k, values in self._inputs.schedule if k < last or k == 0]

    @cached_property
    def changes(self) -> Changes:
        """Values of inputs and parameters that change, with the communication point from which on they apply."""
        with self._fitting():
            last = self._last
            return [(k, values) for k, values in self._inputs.changes if k < last or k == 0]

    @property
    def _last(self) -> int:
        return int(self.steps[-1]) if self.provenance else 0

    @contextmanager
    def _fitting(self) -> Iterator[None]:
        try:
            yield
        except (KeyError, ValueError, ArithmeticError) as error:
            raise BagError(f"the run.json in '{self.path}' does not fit its samples") from error

    @cached_property
    def steps(self) -> Steps:
        """Number of communication steps before each sample; a recovered bag may have gaps."""
        step = self.provenance.get("step", 0.0)
        least = self.t[-1] / (MOST_LOST * max(self.count, len(self.t)))
        if not (0.0 < step < inf and least <= step):
            raise BagError(f"the run.json in '{self.path}' does not fit its samples")
        steps: Steps = np.rint(self.t / step).astype(np.int64)
        return steps

    @cached_property
    def target(self) -> Array:
        """Target position in effect up to each sample, along the task axes, m, N × m.

        It comes from the provenance, or else from the bag's /target in the robot's root frame. Without known task
        axes, it has all of x, y and z. It is N × 0 if unknown.
        """
        held = self.held("x_des", len(self.axes))
        if held.size:
            return held
        root = self.provenance.get("root")
        if self.received is None or root not in (None, self.received.frame):
            return np.empty((len(self.stamps), 0))
        return self.received.points[:, ["xyz".index(axis) for axis in self.axes or "xyz"]]

    @property
    def target_quat(self) -> Array:
        """Target orientation in effect up to each sample, quat_des, N × 4; N × 0 without one."""
        return self.held("quat_des", 4)

    def held(self, group: str, size: int) -> Array:
        """Return a vector of inputs in effect up to each sample, N × size; N × 0 if unknown."""
        names = tuple(f"{group}[{i + 1}]" for i in range(size))
        if not size or names[0] not in self.schedule[0][1] or KNOWN_UNTIL in self.provenance:
            return np.empty((len(self.stamps), 0))
        with self._fitting():
            columns = self._inputs.columns(names)
        # a change has no effect yet at its own communication point
        indexes = [np.maximum(np.searchsorted(begins, self.steps) - 1, 0) for begins, _ in columns]
        return np.column_stack([values[index] for (_, values), index in zip(columns, indexes)])

    def errors(self) -> dict[str, tuple[Array, Array]]:
        """Return the targets up to each sample and the magnitudes of the errors, m or rad, of "x", "quat" and "q"."""
        joints = self.held("q_des", self.q.shape[1])
        targets = {"x": self.target if self.x.size else self.x, "quat": self.target_quat, "q": joints}
        known = {name: target for name, target in targets.items() if target.size}
        now = {"x": self.x, "q": self.q, **({"quat": self.setup.orientations(self.q)} if "quat" in known else {})}
        return {name: (target, errors(name, now[name], target)[1]) for name, target in known.items()}

    @property
    def setup(self) -> Setup:
        """Robot and settings of the run, as far as the provenance has them."""
        run = self.provenance
        return self._setup(robot_of(run.get("urdf")), run.get("frame", ""), self.axes)

    def _setup(self, robot: Urdf | None, frame: str, axes: str) -> Setup:
        starts = {} if KNOWN_UNTIL in self.provenance else self.schedule[0][1]
        if self.measured:  # a measured velocity of 0 does not show that friction holds the joint
            starts = {name: value for name, value in starts.items() if not name.startswith("friction[")}
        step = self.provenance.get("step") or self.t[-1] / max(1, len(self.t) - 1)
        controller = self.provenance.get("controller", "")
        return setup_of(
            joints=self.joints, robot=robot, frame=frame, axes=axes, step=step, starts=starts, controller=controller
        )

    @property
    def stored_verdict(self) -> Verdict | None:
        """Stored verdict of the run that made the bag; None if the run was aborted or samples are missing."""
        facts = self.provenance.get("verdict")
        if facts is None or not fits(facts, SHAPE) or len(json.dumps(facts)) > MAX_TAIL:  # writers store less
            return None
        whole = facts["samples"] == self.count and abs(facts["duration"] - float(self.t[-1])) < TIME_TOLERANCE
        return verdict_in(facts) if whole else None

    @cached_property
    def verdict(self) -> Verdict:
        """Verdict of the run: the stored one, or else one computed from the samples.

        It considers efforts only if the bag has them, and targets only if the provenance has them.
        """
        if (stored := self.stored_verdict) is not None:
            return stored
        return self._judged(self.setup, self.x, self.target if self.x.size else self.x)

    def verdict_with(self, robot: Urdf, frame: str, axes: str, x: Array, target: Array) -> Verdict:
        """Return the verdict of a third-party bag's samples, given its robot, and its positions and targets, N × m."""
        return self._judged(self._setup(robot, frame, axes), x, target)

    def _judged(self, setup: Setup, x: Array, target: Array) -> Verdict:
        none, shape = np.empty((len(self.t), 0)), self.q.shape
        new = np.append(True, np.diff(self.stamps) > 0)  # two states at one time have no velocity between them
        targets = {"x": target, "quat": self.target_quat if x.size else none, "q": self.held("q_des", shape[1])}
        quat = setup.orientations(self.q) if targets["quat"].size else none
        if (v := self.v).shape != shape:
            v = np.zeros(shape)
            if new.sum() > 1:
                with np.errstate(invalid="ignore", over="ignore"):  # third-party positions may not be finite
                    v[new] = np.gradient(self.q[new], self.t[new], axis=0)
        values = {"q": self.q, "v": v, "x": x, "tau": self.tau if self.tau.shape == shape else none, "quat": quat}
        samples = {name: each[new] for name, each in values.items()}
        aims = {name: each[new] for name, each in targets.items() if each.size}
        changes = [(k * setup.step, values) for k, values in self.changes] if setup.starts else []
        return judged(setup, self.t[new], samples, aims, changes)

    @cached_property
    def x(self) -> Array:
        """Position of the end effector along the task axes, m, N × m; N × 0 without a known robot."""
        if self.provenance.get("urdf") is None or not self.axes:
            return np.empty((len(self.stamps), 0))
        if self.setup.robot is None or self.setup.frame not in self.setup.robot.links:
            raise BagError(f"the robot in '{self.path}' does not fit its samples")
        return self.setup.positions(self.q)

    def to_pandas(self) -> pd.DataFrame:
        """Return a DataFrame with one row per sample; index t in s.

        Columns are named as the FMU's variables, "q[1]" of the first joint.

        Raises:
            BagError: pandas is missing.
        """
        with needing(BagError, "make a DataFrame", "sweep"):
            import pandas as pd
        parts = {"q": self.q, "v": self.v, "tau": self.tau, "x": self.x, "x_des": self.target}
        columns = {f"{group}[{i + 1}]": part[:, i] for group, part in parts.items() for i in range(part.shape[1])}
        return pd.DataFrame(columns, index=pd.Index(self.t, name="t"))
