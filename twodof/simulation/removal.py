"""Order of the causes of a failed run, by the errors of repeated runs without each of them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf, isfinite, radians, sqrt
from typing import NamedTuple

import numpy as np

from ..plant.urdf import UNBOUNDED
from ..plant.variables import ROWS
from .cause import FLOOR, FOLLOWING, SMALL, Cause, point_text
from .controller_causes import GAINS, controller_prefix, damping, feedforward, load, payloads
from .judge import OF_THE_END, Judge
from .setup import OF_THE_CONTROLLER
from .verdict_text import worst_joint

LITTLE = 0.1  # part of the error; causes that remove less, each for itself, keep their order
LONGER = 10.0  # a run is repeated for at most this many times its duration more
HALF = 0.5  # part of the error; if no cause removes as much, all other settings are tried
WHOLE = 0.9  # part of the error whose removal explains all consequences
TURN = 6.0  # rad: larger joint targets are in degrees, if one is
SAMPLING = sorted({*OF_THE_CONTROLLER} - {"payload_known", "seed"})


class Repetition(NamedTuple):
    """A repetition of a run with other settings.

    Attributes:
        words: the difference in words.
        settings: names and values of inputs and parameters, held during the whole run.
        longer: additional duration, s.
    """

    words: str
    settings: tuple[tuple[str, float], ...] = ()
    longer: float = 0.0


Repeat = Callable[[Sequence[Repetition]], Sequence[Judge | None]]
"""A function that runs an experiment again for each argument; a judge is None if its run failed or is too long."""
CausesOf = Callable[[Judge], Sequence[Cause]]
"""A function that returns the causes of a repeated run."""


def by_removal(
    judge: Judge, missed: Sequence[str], why: Sequence[Cause], repeat: Repeat, causes_of: CausesOf
) -> tuple[Cause, ...]:
    """Return the causes of a failed run, that without which the run has the smallest errors first.

    Causes have the errors of the run without them. One that changes nothing is left out, and one that reduces the
    error is noted; but if no cause alone changes anything, they keep their order. What keeps an error in the run
    without the first cause follows.

    Args:
        judge: the judge of the run.
        missed: outputs that are not at their targets.
        why: causes, the root first.
        repeat: function that repeats the run.
        causes_of: function that returns the causes of a repeated run.
    """
    trials = _Trials(judge, missed, repeat)
    tried, others = trials.tried(why), list[Cause]()
    if _most(tried) < HALF:
        others = trials.tried(_others(judge, missed, why))
        tried += [cause for cause in others if (cause.removes or 0.0) >= LITTLE]
    most = _most(tried)
    if most >= LITTLE or any(map(_is_open, tried)):
        counted = [
            cause._replace(noted=_is_noted(cause, tried, most))
            for cause in tried
            if cause.removes is None or abs(cause.removes) >= SMALL
        ]
        tried = sorted(counted, key=lambda cause: _rank(cause, max(0.0, 1.0 - most)))
    elif both := next((some for some in (tried, tried + others) if trials.without_all(some) >= LITTLE), None):
        tried = [cause._replace(noted=cause.noted and not cause.tried) for cause in both]  # only together they keep it
        tried.sort(key=lambda cause: _rank(cause, 0.0))
    root = trials.without(tried[0]) if tried else None
    if root is None:
        return tuple(tried)
    known = {(cause.kind, cause.joint, cause.subject) for cause in tried}
    rest = [c for c in causes_of(root) if not c.noted and (c.kind, c.joint, c.subject) not in known]
    rest = [cause._replace(text=f"without the first cause: {cause.text}", part=None) for cause in rest[:1]]
    return *trials.together(tried), *rest


class _Trials:
    """Repetitions of a run that missed outputs, and their results."""

    def __init__(self, judge: Judge, missed: Sequence[str], repeat: Repeat) -> None:
        self._judge, self._missed, self._repeat = judge, missed, repeat
        self._plans: dict[str, Repetition] = {}
        self._results: dict[Repetition, Judge] = {}

    def tried(self, causes: Sequence[Cause]) -> list[Cause]:
        """Return causes with the results of the runs without them, as far as there are some."""
        plans = {cause.text: plan for cause in causes if (plan := _without(self._judge, cause)) is not None}
        new = [plan for plan in dict.fromkeys(plans.values()) if plan not in self._results]
        self._plans |= plans
        for plan, result in zip(new, self._repeat(new)):
            if result is not None and isfinite(self._size(result)):
                self._results[plan] = result
        return [self._with_result(cause) for cause in causes]

    def _with_result(self, cause: Cause) -> Cause:
        if (result := self.without(cause)) is None:
            return cause
        tried = f"{self._plans[cause.text].words}: {_errors(result, self._missed)}"
        return cause._replace(tried=tried, removes=1.0 - self._size(result) / self._size(self._judge))

    def without(self, cause: Cause) -> Judge | None:
        """Return the judge of the run without a cause; None if there is none."""
        plan = self._plans.get(cause.text)
        return None if plan is None else self._results.get(plan)

    def without_all(self, tried: Sequence[Cause]) -> float:
        """Return the part of the error that the run without all causes has not."""
        result = self._without([self._plans[cause.text] for cause in tried if cause.tried])
        return 0.0 if result is None else 1.0 - self._size(result) / self._size(self._judge)

    def _without(self, plans: Sequence[Repetition]) -> Judge | None:
        """Return the judge of a run with the settings of several plans; None for one plan, or if it failed."""
        if len({*plans}) < 2:
            return None
        settings = dict(pair for plan in reversed(plans) for pair in plan.settings)
        whole = Repetition("", tuple(settings.items()), max(plan.longer for plan in plans))
        if whole not in self._results and (result := self._repeat([whole])[0]) is not None:
            self._results[whole] = result
        return self._results.get(whole)

    def together(self, tried: list[Cause]) -> list[Cause]:
        """Return the causes, the last of several with the errors of the run without all of them."""
        each = [*dict.fromkeys(self._plans[cause.text] for cause in tried if cause.tried and not cause.noted)]
        if (result := self._without(each)) is None:
            return tried
        words = f"; without {'both' if len(each) == 2 else 'all'}: {_errors(result, self._missed)}"
        last = [cause.tried != "" and self._plans[cause.text] == each[-1] for cause in tried]
        return [cause._replace(tried=cause.tried + words) if own else cause for cause, own in zip(tried, last)]

    def _size(self, result: Judge) -> float:
        """Return the sum of the RMS errors at the end of a run, relative to the largest errors of the first one."""
        late = result.history() >= result.changed + (1.0 - OF_THE_END) * (result.duration - result.changed)
        with np.errstate(over="ignore", invalid="ignore"):  # a repetition may diverge
            rms = {name: float(np.sqrt(np.mean(result.error_history(name)[late] ** 2))) for name in self._missed}
        largest = {name: max(float(self._judge.error_history(name).max()), FLOOR) for name in self._missed}
        return sum(rms[name] / largest[name] for name in self._missed)


def _most(tried: Sequence[Cause]) -> float:
    """Return the largest part of the error that a cause removes."""
    return max((cause.removes for cause in tried if cause.removes is not None), default=0.0)


def _is_noted(cause: Cause, tried: Sequence[Cause], most: float) -> bool:
    """Return whether a cause reduces the error, or follows from another one."""
    if cause.removes is not None and cause.removes < 0.0:
        return True
    kinds = {other.kind for other in tried}
    led = cause.kind in FOLLOWING or (cause.kind == "reach" and "degrees" in kinds)
    beyond = cause.kind == "limit" and any(c.kind in ("reach", "degrees") and c.joint == cause.joint for c in tried)
    return beyond or (led and most > WHOLE and cause.removes != most) or (cause.noted and cause.removes is None)


def _is_open(cause: Cause) -> bool:
    """Return whether a cause could not be tried, and does not follow from others."""
    return cause.removes is None and not cause.noted and cause.kind not in FOLLOWING


def _rank(cause: Cause, left: float) -> float:
    """Return the place of a cause by what it removes, or of one that was not tried, by what no other cause removes."""
    if cause.noted:
        return inf
    untried = left if _is_open(cause) else 0.0
    return -round(untried if cause.removes is None else cause.removes, 1)


def _errors(result: Judge, missed: Sequence[str]) -> str:
    """Return the errors of the missed outputs at the end in words."""
    texts = []
    for name in missed:
        unit = "m" if name == "x" else "rad"
        texts.append(worst_joint(result)[0] if name == "q" else f"{result.aims[name].last:.3g} {unit}")
    return " and ".join(texts)


def _others(judge: Judge, missed: Sequence[str], why: Sequence[Cause]) -> list[Cause]:
    """Return settings as causes that the balance of forces at the end does not show, beside those known."""
    known = {(cause.kind, cause.subject) for cause in why}
    found = [
        *load(judge, 0.0),
        *feedforward(judge, missed),
        *damping(judge, missed),
        *_friction(judge),
        *_sampling(judge),
    ]
    return [cause for cause in found if (cause.kind, cause.subject) not in known]


def _friction(judge: Judge) -> Iterator[Cause]:
    if judge.given("friction").any():
        yield Cause("friction", f"the joints have the friction {point_text(judge.given('friction'))}; raise Kp")


def _sampling(judge: Judge) -> Iterator[Cause]:
    """Yield the settings of a sampled controller as a cause."""
    values = {group: judge.given(group) if f"{group}[1]" in judge.held else judge.held.get(group) for group in SAMPLING}
    named = [f"{group} = {np.max(np.asarray(value)):g}" for group, value in values.items() if np.any(np.asarray(value))]
    if named:
        yield Cause("sampling", f"the controller acts with {', '.join(named)}")


def _without(judge: Judge, cause: Cause) -> Repetition | None:
    """Return the repetition of a run without one of its causes; None if the cause is not one of the settings."""
    held, own = judge.held, controller_prefix(judge)

    def plan(words: str, settings: Mapping[str, float]) -> Repetition | None:
        starts, inputs = judge.setup.starts, judge.inputs
        changes = [name in inputs or starts.get(name, value) != value for name, value in settings.items()]
        return Repetition(words, tuple(settings.items())) if any(changes) else None

    match cause.kind:
        case "friction":
            return plan("without friction", _elements(held, "friction", 0.0))
        case "feedforward" | "drag":
            return plan("without it", _elements(held, cause.subject, 0.0))
        case "load":
            return plan(*_known_load(judge, cause.subject))
        case "saturation":
            return plan("without this limit", {"limit_effort": False})
        case "limit":
            wide = _elements(held, "q_min", -UNBOUNDED) | _elements(held, "q_max", UNBOUNDED)
            return plan("without limits of the joints", wide)
        case "unstable" | "sampling" if not own:
            exact = {name: type(value)(0) for name, value in held.items() if name.partition("[")[0] in SAMPLING}
            return plan("with a continuous controller and exact sensors", exact)
        case "gain":
            raised = _raised(judge)
            gains = dict.fromkeys(f"{name.partition('[')[0]} = {value:g}" for name, value in raised.items())
            return plan(f"with {' and '.join(gains)}", raised)
        case "damping":
            return plan("with critical damping", _critical(judge))
        case "degrees":
            return plan("read as degrees", _in_radians(judge, cause.joint))
        case "reach" if not judge.wanted("quat").size and judge.changed <= 0.0:
            return plan("with a target in reach", _in_reach(judge, cause))
        case "time" if not judge.moving and cause.share <= LONGER * judge.duration:
            return Repetition(f"after {judge.duration + cause.share:.4g} s", longer=cause.share)
    return None


def _elements(held: Mapping[str, float], group: str, value: float) -> dict[str, float]:
    """Return a value for all elements of a vector."""
    return {name: value for name in held if name.partition("[")[0] == group}


def _known_load(judge: Judge, subject: str) -> tuple[str, dict[str, float]]:
    """Return settings with which the controller knows a load, or without an external load, in words first."""
    own, held = controller_prefix(judge), judge.held
    if subject == "payload":
        payload, _ = payloads(judge)
        known = {f"{own}payload_known": True, f"{own}payload": payload}
        return ("if it is known", known) if payload or not own else ("without it", {f"{own}payload": 0.0})
    if own and f"{own}{subject}[1]" in held:
        model = [name for name in held if name.partition("[")[0] == subject]
        return "with that of the plant", {f"{own}{name}": held[name] for name in model}
    return "without it", _elements(held, subject, 0.0)


def _in_radians(judge: Judge, joint: str) -> dict[str, float]:
    """Return large positions of a joint, read as degrees, in rad."""
    i = judge.setup.joints.index(joint)
    values = {f"{group}[{i + 1}]": judge.held.get(f"{group}[{i + 1}]", 0.0) for group in ("q_des", "q_start")}
    return {name: radians(value) for name, value in values.items() if abs(value) > TURN}


def _raised(judge: Judge) -> dict[str, float]:
    """Return the largest gain of its group, or else the usual one, for each proportional gain of 0."""
    usual = {name: start for name, *_, start, _ in ROWS if isinstance(start, float)}
    raised = dict[str, float]()
    for stiff, _ in GAINS:
        values = judge.given(stiff)
        most = float(max(values, default=0.0)) or usual[stiff]
        raised |= {f"{stiff}[{i + 1}]": most for i, value in enumerate(values) if value == 0.0}
    return raised


def _critical(judge: Judge) -> dict[str, float]:
    """Return damping gains that are at least critical."""
    return {
        f"{damp}[{i + 1}]": max(d, 2.0 * sqrt(p))
        for stiff, damp in GAINS
        for i, (p, d) in enumerate(zip(judge.given(stiff), judge.given(damp)))
    }


def _in_reach(judge: Judge, cause: Cause) -> dict[str, float]:
    """Return the nearest target that the robot can reach."""
    setup = judge.setup
    if cause.point:
        return {f"x_des[{i + 1}]": cause.point[row] for i, row in enumerate(setup.rows)}
    i = setup.joints.index(cause.joint)
    return {f"q_des[{i + 1}]": float(np.clip(judge.wanted("q")[i], setup.low[i], setup.high[i]))}
