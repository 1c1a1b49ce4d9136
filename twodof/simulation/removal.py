"""Order of the causes of a failed run, by the errors of repeated runs without each of them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf, radians, sqrt
from typing import NamedTuple

import numpy as np

from ..plant.urdf import UNBOUNDED
from ..plant.variables import ROWS
from .cause import FLOOR, FOLLOWING, SMALL, Cause
from .controller_causes import GAINS, controller_prefix, payloads
from .judge import OF_THE_END, Judge
from .setup import OF_THE_CONTROLLER

LITTLE = 0.1  # part of the error; causes that remove less, each for itself, keep their order
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
    if all(cause.noted or cause.kind in FOLLOWING for cause in why):
        why = [*why, *_sampling(judge)]
    plans = {cause.text: plan for cause in why if (plan := _without(judge, cause)) is not None}
    each = [*dict.fromkeys(plans.values())]
    results = {plan: result for plan, result in zip(each, repeat(each)) if result is not None}
    tried = [_tried(cause, judge, missed, plans.get(cause.text), results) for cause in why]
    most = max((cause.removes for cause in tried if cause.removes is not None), default=0.0)
    if most >= LITTLE or any(map(_is_open, tried)):
        left = max(0.0, 1.0 - most)
        counted = [_counted(cause, most) for cause in tried if cause.removes is None or abs(cause.removes) >= SMALL]
        tried = sorted(counted, key=lambda cause: _rank(cause, left))
    root = plans.get(tried[0].text) if tried else None
    if root is None or root not in results:
        return tuple(tried)
    known = {(cause.kind, cause.joint, cause.subject) for cause in tried}
    rest = [c for c in causes_of(results[root]) if not c.noted and (c.kind, c.joint, c.subject) not in known]
    return *tried, *(cause._replace(text=f"{root.words}, {cause.text}", part=None) for cause in rest[:1])


def _tried(
    cause: Cause, judge: Judge, missed: Sequence[str], plan: Repetition | None, results: Mapping[Repetition, Judge]
) -> Cause:
    """Return a cause with the result of the run without it, if there is one."""
    if plan is None or plan not in results:
        return cause
    removes = 1.0 - _size(results[plan], judge, missed) / _size(judge, judge, missed)
    return cause._replace(tried=f"{plan.words}: {_errors(results[plan], missed)}", removes=removes)


def _counted(cause: Cause, most: float) -> Cause:
    """Return a cause that is noted if it reduces the error, or follows from one that explains all of the error."""
    reduces = cause.removes is not None and cause.removes < 0.0
    follows = cause.removes is None and (cause.noted or (cause.kind in FOLLOWING and most > WHOLE))
    return cause._replace(noted=reduces or follows)


def _is_open(cause: Cause) -> bool:
    """Return whether a cause could not be tried, and does not follow from others."""
    return cause.removes is None and not cause.noted and cause.kind not in FOLLOWING


def _rank(cause: Cause, left: float) -> float:
    """Return the place of a cause by what it removes, else by its part, else by what no other cause removes."""
    if cause.noted:
        return inf
    untried = cause.part if cause.part is not None else left if _is_open(cause) else 0.0
    return -round(untried if cause.removes is None else cause.removes, 1)


def _size(result: Judge, of: Judge, missed: Sequence[str]) -> float:
    """Return the sum of the RMS errors at the end of a run, relative to the largest errors of another."""
    late = result.history() >= result.changed + (1.0 - OF_THE_END) * (result.duration - result.changed)
    rms = {name: sqrt(float(np.mean(np.square(result.error_history(name)[late])))) for name in missed}
    return sum(rms[name] / max(float(of.error_history(name).max()), FLOOR) for name in missed)


def _errors(result: Judge, missed: Sequence[str]) -> str:
    """Return the errors of the missed outputs at the end in words."""
    texts = []
    for name in missed:
        size, unit = result.aims[name].last, "m" if name == "x" else "rad"
        if name == "q":
            off = np.abs(result.wanted(name) - result.end(name))
            size, unit = float(off.max()), result.setup.units[int(off.argmax())]
        texts.append(f"{size:.3g} {unit}".strip())
    return " and ".join(texts)


def _sampling(judge: Judge) -> Iterator[Cause]:
    """Yield the settings of a sampled controller as a cause, for runs in which only consequences are seen."""
    values = {group: judge.given(group) if f"{group}[1]" in judge.held else judge.held.get(group) for group in SAMPLING}
    named = [f"{group} = {np.max(np.asarray(value)):g}" for group, value in values.items() if np.any(np.asarray(value))]
    if named:
        yield Cause("sampling", f"the controller acts with {', '.join(named)}", noted=True)


def _without(judge: Judge, cause: Cause) -> Repetition | None:
    """Return the repetition of a run without one of its causes; None if the cause is not one of the settings."""
    held, own = judge.held, controller_prefix(judge)

    def plan(words: str, settings: Mapping[str, float]) -> Repetition | None:
        changed = tuple((name, value) for name, value in settings.items() if held.get(name, value) != value)
        return Repetition(words, changed) if changed else None

    match cause.kind:
        case "friction":
            return plan("without friction", _elements(held, "friction", 0.0))
        case "feedforward" | "drag":
            return plan("without it", _elements(held, cause.subject, 0.0))
        case "load":
            return plan("without it", _known_load(judge, cause.subject))
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
            large = {name: value for name, value in held.items() if name.startswith(("q_des[", "q_start["))}
            return plan("read as degrees", {name: radians(value) for name, value in large.items() if abs(value) > TURN})
        case "reach" if not judge.wanted("quat").size and not judge.moving:
            return plan("with a target in reach", _in_reach(judge, cause))
        case "time" if not judge.moving:
            return Repetition(f"at {judge.duration + cause.share:.4g} s", longer=cause.share)
    return None


def _elements(held: Mapping[str, float], group: str, value: float) -> dict[str, float]:
    """Return a value for all elements of a vector."""
    return {name: value for name in held if name.partition("[")[0] == group}


def _known_load(judge: Judge, subject: str) -> dict[str, float]:
    """Return settings with which the controller knows a load, or without an external load."""
    own, held = controller_prefix(judge), judge.held
    if subject == "payload":
        payload, _ = payloads(judge)
        known = {f"{own}payload_known": True, f"{own}payload": payload}
        return known if payload or not own else {f"{own}payload": 0.0}
    if own and f"{own}{subject}[1]" in held:
        return {f"{own}{name}": held[name] for name in held if name.partition("[")[0] == subject}
    return _elements(held, subject, 0.0)


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
    inside = np.clip(judge.wanted("q"), setup.low, setup.high)
    return {f"q_des[{i + 1}]": float(value) for i, value in enumerate(inside)}
