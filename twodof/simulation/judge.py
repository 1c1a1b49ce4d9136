"""Reduce the samples of a run to the numbers of its verdict, in constant memory.

Definitions: e_k = x_des − x_k is the error of the end effector at t_k; under joint control e_k = q_des − q_k. e_0 is
the error at the last change of the target, and d = e_0 / |e_0| its direction. |·| is the Euclidean norm over the task
axes or joints, h the communication step, and θ_k the angle between the end effector's orientation and its target.
Nothing is interpolated: times and extremes are those of samples.
"""

from __future__ import annotations

import io
from collections import ChainMap
from collections.abc import Mapping, Sequence
from copy import copy
from math import inf, nan, sqrt

import numpy as np

from ..bounds import MAX_VALUE
from ..plant.variables import EXACT as EXACT
from .aim import Aim, errors, judgeable, moves, unsettled
from .cause import MANY_CHANGES, Cause
from .setup import Array, Setup

OF_THE_END = 0.1  # last fraction of a run, in which a moving target still changes and an error must stay in its band
AT_LIMIT = 1e-9  # rad or m; the plant sets a stopped joint to its limit exactly
BLOCK = 8192  # samples that are judged at a time; smaller blocks suffer from cold caches
KEPT = 2048  # minimum number of kept samples, of the whole run and of its end
OUTPUTS = ("q", "v", "x", "tau", "quat")
TARGETS = {"x": "x_des", "quat": "quat_des", "q": "q_des"}


class Judge:
    """Accumulator of a run's samples.

    The master writes each row of outputs to ``rows``, reports changed inputs by ``change``, and calls ``flush`` after
    each BLOCK rows.

    Args:
        sizes: number of values of each of OUTPUTS in a row, 0 if the run lacks it.

    Attributes:
        inputs: present values of changed inputs.
        latest: last change of inputs that are no targets: time in s, and values before and after by name.
        aims: errors by output, for outputs with a target.
        targets: present targets by output, 1 × values.
        lost: a value that is not finite, or beyond MAX_VALUE, as a cause; samples from it on are ignored.
        effort, speed: largest magnitude for each joint, n values; the following attributes also have n values.
        chatter: sum of the squares of the effort's changes between samples.
        saturated, low, high: number of samples at the effort limit, and after the first one at a position limit.
        moved: time of the last sample with a velocity that is not exactly 0, s.
        changes, changed, travel: number of changes of targets, time of the last one (s), and largest distance
            of a target from the first one (scalars).
    """

    def __init__(self, setup: Setup, sizes: Sequence[int]) -> None:
        n = len(setup.joints)
        self.setup, self.inputs = setup, dict[str, float]()
        self.latest: tuple[float, Mapping[str, tuple[float, float]]] | None = None
        self.count, self.changes, self.changed = 0, 0, -inf
        self.aims: dict[str, Aim] = {}
        self.effort, self.speed, self.chatter = np.zeros(n), np.zeros(n), np.zeros(n)
        self.saturated, self.low, self.high = np.zeros(n, int), np.zeros(n, int), np.zeros(n, int)
        self.moved, self.travel = np.full(n, -inf), 0.0
        self.first, self.last = np.empty(0), np.empty(0)
        self.lost: tuple[Cause, ...] = ()
        self._ends = np.cumsum([0, *sizes])
        self._names = [name for name, size in zip(OUTPUTS, sizes) if size]
        self._targets: dict[str, Array] = {}
        self._first: dict[str, Array] = {}  # targets
        held = self._at_start()
        self.targets = {name: target[None] for name, target in held.items()}
        self._where = {f"{TARGETS[name]}[{i + 1}]": (name, i) for name in held for i in range(len(held[name]))}
        self._time = 0.0
        self._kept, self._filled, self._stride = np.empty((2 * KEPT, 1 + len(TARGETS) + self._ends[-1])), 0, 1
        self._recent: list[Array] = []
        self._same: Mapping[str, Array] = {}
        self.rows, self._changed = io.BytesIO(), [(0, held)]
        self._at_limits = 0

    # --- input from the master ---

    def change(self, inputs: Mapping[str, float]) -> None:
        """Receive inputs that apply from the last sample on."""
        count = self.count + self.rows.tell() // (8 * int(self._ends[-1]))
        self.note(max(0, count - 1) * self.setup.step, inputs)
        held = self._changed[-1][1]
        for variable in inputs.keys() & self._where.keys():
            name, i = self._where[variable]
            held = {**held, name: held[name].copy()}
            held[name][i] = inputs[variable]
        self._changed.append((count, held))

    def note(self, t: float, inputs: Mapping[str, float]) -> None:
        """Store the inputs that changed at a time, s; ``latest`` becomes the changes of those that are not targets."""
        changed, inputs = {}, {self.setup.own.get(name, name): value for name, value in inputs.items()}
        for name in (name for name in inputs if name not in self._where):
            before = self.inputs.get(name, self.setup.starts.get(name, inputs[name]))
            if before != inputs[name]:
                changed[name] = float(before), float(inputs[name])
        if changed:
            self.latest = t, changed
        self.inputs |= inputs

    def flush(self) -> None:
        """Judge the waiting rows."""
        rows = np.frombuffer(self.rows.getvalue()).reshape(-1, self._ends[-1])
        if not len(rows):
            return
        self.rows.seek(0)
        self.rows.truncate()
        t: Array = np.arange(self.count, self.count + len(rows), dtype=np.float64) * self.setup.step
        self.judge(t, rows, self._in_effect(len(rows)))

    def _in_effect(self, count: int) -> Mapping[str, Array]:
        """Return the targets of the waiting rows; without changes, the same object as for the previous block."""
        if len(self._changed) == 1:
            return self.targets
        changed = [(max(0, k - self.count), held) for k, held in self._changed]
        lengths = np.diff([*(k for k, _ in changed), count])
        targets = {name: np.repeat([held[name] for _, held in changed], lengths, axis=0) for name in self.targets}
        self._changed = [(0, changed[-1][1])]
        self.targets = {name: held[None] for name, held in changed[-1][1].items()}
        return targets

    def _at_start(self) -> dict[str, Array]:
        """Return the targets with which the run starts."""
        known = {name: self.setup.given(group) for name, group in TARGETS.items() if name in self._names}
        sizes = dict(zip(OUTPUTS, np.diff(self._ends).tolist()))
        fit = {name: value for name, value in known.items() if len(value) == sizes[name]}
        return {name: value for name, value in fit.items() if name != "quat" or value.any()}

    # --- input from a master or a recording ---

    def judge(self, t: Array, rows: Array, targets: Mapping[str, Array]) -> None:
        """Judge N samples.

        Args:
            t: times since the first sample, s, N.
            rows: all OUTPUTS side by side, N × values.
            targets: targets in effect up to each sample, by output: N rows, or one row for all.
        """
        end = 0 if self.lost else judgeable(rows, targets)
        if end < len(rows) and not self.lost:
            what = f"beyond {MAX_VALUE:g}" if np.isfinite(rows[end]).all() else "not finite"
            self.lost = (Cause("diverged", f"a value is {what} at {t[end]:.4g} s", time=float(t[end])),)
            self.targets = {name: target[:1] for name, target in targets.items()}
        if not end:
            return
        if end < len(rows):
            t, rows, targets = t[:end], rows[:end], {name: target[:end] for name, target in targets.items()}
        rows = np.asfortranarray(rows)
        own = {name: rows[:, a:b] for name, a, b in zip(OUTPUTS, self._ends, self._ends[1:])}
        if not self.count:
            self.first = self.last = rows[0]
        start = self._change(t, targets)
        sizes = [self._aim(n, own[n], targets[n], t, start) if n in targets else t for n in TARGETS]
        self._watch(own, t)
        self._keep([t, *sizes], rows)
        self.count, self.last, self._time = self.count + len(rows), rows[-1], float(t[-1])

    def _change(self, t: Array, targets: Mapping[str, Array]) -> int:
        """Return the first row of the move to the last target; 0 if the move began in an earlier block."""
        if self.count and targets is self._same:
            return 0
        start, self._same = 0, targets
        for name, target in targets.items():
            before = self._targets.get(name, target[0])
            new = np.flatnonzero((np.diff(target, axis=0, prepend=before[None]) != 0.0).any(axis=1))
            if len(target) > 1 or len(new):
                self.changes += len(new)
                start = max(start, int(new[-1]) if len(new) else 0)
                if len(new) and not start:
                    self.changed = self._time
            self.travel = max(self.travel, float(np.abs(target - self._first.setdefault(name, target[0])).max()))
            self._targets[name] = target[-1]
        if start or not self.count:
            self.changed = float(t[max(0, start - 1)])
        return start

    def wanted(self, name: str) -> Array:
        """Return the last target of an output; empty without a target."""
        return self._targets.get(name, np.empty(0))

    def _aim(self, name: str, now: Array, target: Array, t: Array, start: int) -> Array:
        """Judge an output by its target; return the magnitudes of its errors."""
        e, size = errors(name, now, target)
        aim, fresh = self.aims.get(name), start > 0 or not self.count or self.changed == self._time
        if aim is None:
            aim = self.aims[name] = Aim()
        aim.squares += float(size @ size)
        if fresh:
            begin = max(0, start - 1)
            at = now[begin] if start or not self.count else self._of(self.last, name)
            e0, size0 = errors(name, at[None], target[-1:])
            aim.begin(self.changed, e0[0] if e0.size else np.empty(0), float(size0[0]))
        aim.add(t[start:], e[start:], size[start:])
        return size

    def _watch(self, own: Mapping[str, Array], t: Array) -> None:
        """Note efforts, speeds, chatter, and samples at limits or in saturation."""
        setup, n = self.setup, len(self.setup.joints)
        self.speed = np.maximum(self.speed, _largest(own["v"]))
        if own["tau"].shape[1] == n:
            largest = _largest(own["tau"])
            self.effort = np.maximum(self.effort, largest)
            before = own["tau"][:1] if not self.count else self._of(self.last, "tau")[None]
            with np.errstate(over="ignore"):  # infinite from efforts of 1e154 N·m on
                self.chatter += np.square(np.diff(own["tau"], axis=0, prepend=before)).sum(axis=0)
            bound = np.array(setup.limits.effort) * (1.0 - EXACT)
            if (largest >= bound).any():
                self.saturated += (np.abs(own["tau"]) >= bound).sum(axis=0)
        after = own["q"][0 if self.count else 1 :]
        low, high = setup.low + AT_LIMIT, setup.high - AT_LIMIT
        if len(after) and ((after.min(axis=0) <= low) | (after.max(axis=0) >= high)).any():
            below, above = after <= low, after >= high
            self.low, self.high = self.low + below.sum(axis=0), self.high + above.sum(axis=0)
            self._at_limits += int((below | above).any(axis=1).sum())
        for i, last in enumerate(own["v"][-1]):
            if last:
                self.moved[i] = t[-1]
            elif (moves := np.flatnonzero(own["v"][:, i])).size:
                self.moved[i] = t[moves[-1]]

    def _keep(self, head: Sequence[Array], rows: Array) -> None:
        """Keep times, errors and outputs at evenly spaced samples of the run, and all outputs of its end."""
        self._recent = [*self._recent[-1:], rows[-KEPT:].copy()]
        first = -self.count % self._stride
        while self._filled + len(range(first, len(rows), self._stride)) > len(self._kept):
            self._filled = (self._filled + 1) // 2
            self._kept[: self._filled] = self._kept[: 2 * self._filled : 2].copy()
            self._stride *= 2
            first = -self.count % self._stride
        if first < len(rows):
            chosen = rows[first :: self._stride]
            end = self._filled + len(chosen)
            columns = [part[first :: self._stride] for part in head]
            self._kept[self._filled : end] = np.column_stack([*columns, chosen])
            self._filled = end

    # --- results ---

    def until(self, t: float) -> Judge:
        """Return a judge of the samples before a time, s, at which the latest change of an input was made."""
        earlier, changes = copy(self), self.latest[1] if self.latest else {}
        earlier.inputs = {**self.inputs, **{name: before for name, (before, _) in changes.items()}}
        earlier._filled = max(1, int(np.searchsorted(self.history(), t, side="right")))
        earlier.last, earlier._time = earlier._kept[earlier._filled - 1, 1 + len(TARGETS) :], t
        return earlier

    def _of(self, rows: Array, name: str) -> Array:
        i = OUTPUTS.index(name)
        return np.asarray(rows[..., self._ends[i] : self._ends[i + 1]])

    def history(self, name: str = "") -> Array:
        """Return an output at evenly spaced samples of the whole run, N × values; without a name, the N times."""
        kept = self._kept[: self._filled]
        return self._of(kept[:, 1 + len(TARGETS) :], name) if name else kept[:, 0]

    def error_history(self, name: str) -> Array:
        """Return the magnitude of an output's error at evenly spaced samples, N values."""
        return self._kept[: self._filled, 1 + [*TARGETS].index(name)]

    def tail(self, name: str) -> Array:
        """Return an output at the kept last samples, without gaps, N × values."""
        return self._of(np.concatenate(self._recent), name)

    def end(self, name: str) -> Array:
        """Return an output at the last sample."""
        return self._of(self.last, name)

    @property
    def duration(self) -> float:
        """Time from the first to the last sample, s."""
        return self._time

    @property
    def share(self) -> Array:
        """Share of the samples at which each motor is at its effort limit."""
        return np.asarray(self.saturated / max(1, self.count))

    @property
    def late(self) -> slice:
        """Samples of the history by which a state is judged: the last quarter, or all for a moving target."""
        return slice(0 if self.moving else -(len(self.history()) // 4 + 1), None)

    @property
    def moving(self) -> bool:
        """True for a target that changes often, and still changes at the end of the run."""
        return self.changes > MANY_CHANGES and self.changed > (1.0 - OF_THE_END) * self._time

    @property
    def held(self) -> Mapping[str, float]:
        """Present values of inputs and parameters; a view, because a bag may have a million start values."""
        return ChainMap(self.inputs, self.setup.starts)  # type: ignore[arg-type]  # it is only read

    def given(self, group: str) -> Array:
        """Return the present elements of a vector of inputs or parameters."""
        return self.setup.given(group, self.held)

    def use(self) -> tuple[Array, Array]:
        """Return peak efforts and speeds as fractions of the URDF's limits; 0 without a limit."""
        return self.effort / np.array(self.setup.limits.effort), self.speed / np.array(self.setup.limits.velocity)

    def metrics(self) -> dict[str, float]:
        """Return the numbers of METRICS."""
        self.flush()
        aims, setup = self.aims, self.setup
        efforts = "tau" in self._names
        found = {
            "peak_velocity": float(self.speed.max(initial=0.0)),
            **dict.fromkeys(("peak_effort", "chatter", "saturated"), nan),
        }
        if efforts:
            found["peak_effort"] = float(self.effort.max())
            found["chatter"] = sqrt(float(self.chatter.max()) / max(1, self.count - 1))
        for name, use, limit in zip(("effort_use", "velocity_use"), self.use(), setup.limits):
            known = min(limit) < inf and (efforts or name == "velocity_use")
            found[name] = float(use.max()) if known else nan
        if efforts and min(setup.limits.effort) < inf:
            found["saturated"] = float(self.share.max())
        bounded = len(setup.given("q_min")) == len(setup.joints)
        taken = self.duration / max(1, self.count - 1)
        found["time_at_limits"] = self._at_limits * taken if bounded else nan
        if "x" in aims:
            found["final_error"] = aims["x"].last
            found["rms_error"] = sqrt(aims["x"].squares / self.count)
        if "quat" in aims:
            found["final_turn_error"] = aims["quat"].last
        if "q" in aims:
            off = np.abs(self.wanted("q") - self.end("q"))
            found["final_joint_error"] = float(off.max())
        moved = moves(aims)
        ways = [aims[name].past for name in ("x", "q") if name in moved]
        if ways:
            found["overshoot"] = ways[0]
        if moved:
            outside = [(aim.outside if name in moved else aim.strayed) - aim.began for name, aim in aims.items()]
            found["settling_time"] = inf if unsettled(aims) else max(outside) + taken  # the next sample is settled
        return found


def _largest(values: Array) -> Array:
    """Return the largest magnitude of each column."""
    return np.asarray(np.maximum(values.max(axis=0), -values.min(axis=0)))
