"""Order of the causes of a failed run, by the errors of repeated runs without each of them."""

from collections.abc import Callable, Iterator, Sequence
from math import inf, isfinite

import numpy as np

from ..plant.variables import EXACT
from .cause import FLOOR, FOLLOWING, SMALL, Cause, point_text
from .controller_causes import damping, feedforward, load
from .judge import Judge
from .outcome import errors_at_the_end, missed_outputs, success
from .remedies import SAMPLING, STIFFER, Repetition, named, stiffer, unusual, without
from .verdict_text import ADVICE, HALF, NEXT, dropped, unit_of_error, worst_joint

LITTLE = 0.1  # part of the error; if each cause removes less, their order is kept
WHOLE = 0.9  # part of the error whose removal explains all consequences


Repeat = Callable[[Sequence[Repetition]], Sequence[Judge | str]]
"""A function that runs an experiment again for each argument; a text is the reason why a run has no judge, or ""."""
CausesOf = Callable[[Judge], Sequence[Cause]]
"""A function that returns the causes of a repeated run."""


def by_removal(
    judge: Judge, missed: Sequence[str], why: Sequence[Cause], repeat: Repeat, causes_of: CausesOf
) -> tuple[tuple[Cause, ...], str]:
    """Return the causes of a failed run by the errors of the run without each of them, the smallest first.

    A cause that changes nothing is left out, and one that reduces the error is noted. If no cause alone changes
    anything, the order is kept. Then follow causes of the error in the run without the first cause. The second result
    is the errors of the run without all causes in words, or "".

    Args:
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
    if _most(tried) < HALF:
        seen = {cause.tried for cause in tried}
        gains = trials.tried([*_gains(judge)])
        tried += [cause for cause in gains if (cause.removes or 0.0) >= LITTLE and cause.tried not in seen]
    most = _most(tried)
    if most >= LITTLE or any(map(_is_open, tried)):
        counted = [
            cause._replace(noted=_is_noted(cause, tried, most))
            for cause in tried
            if cause.removes is None or abs(cause.removes) >= SMALL
        ]
        tried = sorted(counted, key=lambda cause: _rank(cause, max(0.0, 1.0 - most)))
    elif both := next((some for some in (tried, tried + others) if trials.without_all(some) >= LITTLE), None):
        tried = [
            c._replace(noted=_is_beyond(c, both) or (c.noted and c.removes is None)) for c in both
        ]  # they act together
        tried.sort(key=lambda cause: _rank(cause, 0.0))
    root = trials.result(tried[0]) if tried else None
    if root is None:
        return tuple(tried), ""
    left = {(c.kind, c.joint, c.subject): c for c in causes_of(root) if not c.noted}
    known = [(cause.kind, cause.joint, cause.subject) for cause in tried]
    beyond = [_is_beyond(cause, tried) for cause in tried]
    tried = [
        c._replace(noted=c.noted and (key not in left or same), tried="" if same else c.tried)
        for c, key, same in zip(tried, known, beyond)
    ]  # it acts without the first
    rest = [cause for key, cause in left.items() if key not in known]
    rest = [cause._replace(text=f"{NEXT}: {ADVICE.sub(dropped, cause.text)}", part=None) for cause in rest[:1]]
    return (*trials.advised(tried), *rest), trials.together(tried)


class _Trials:
    """Repetitions of a run that missed outputs, and their results."""

    def __init__(self, judge: Judge, missed: Sequence[str], repeat: Repeat) -> None:
        self._judge, self._missed, self._repeat = judge, missed, repeat
        self._plans: dict[str, Repetition] = {}
        self._results: dict[Repetition, Judge] = {}
        self._reasons: dict[Repetition, str] = {}  # of runs without a result

    def tried(self, causes: Sequence[Cause]) -> list[Cause]:
        """Return causes with the results of the runs without them, as far as there are some."""
        plans = {cause.text: plan for cause in causes if (plan := without(self._judge, cause)) is not None}
        self._plans |= plans
        self._run([*dict.fromkeys(plans.values())])
        return [self._with_result(cause) for cause in causes]

    def _run(self, plans: Sequence[Repetition]) -> None:
        """Run plans that have no result yet."""
        new = [plan for plan in plans if plan not in self._results and plan not in self._reasons]
        for plan, result in zip(new, self._repeat([plan.of(self._judge.setup.own) for plan in new])):
            if isinstance(result, str):
                self._reasons[plan] = result
            elif isfinite(self._size(result)):
                self._results[plan] = result

    def _with_result(self, cause: Cause) -> Cause:
        if (result := self.result(cause)) is None:
            reason = self._reasons.get(self._plans[cause.text]) if cause.text in self._plans else ""
            return cause._replace(tried=f"not tested: {reason}") if reason else cause
        tried = f"{self._plans[cause.text].words}: {self._errors(result)}"
        return cause._replace(tried=tried, removes=1.0 - self._size(result) / self._size(self._judge))

    def result(self, cause: Cause) -> Judge | None:
        """Return the judge of the run without a cause; None if there is none."""
        plan = self._plans.get(cause.text)
        return None if plan is None else self._results.get(plan)

    def without_all(self, tried: Sequence[Cause]) -> float:
        """Return the part of the error that is absent in the run without all causes."""
        result = self._without([self._plans[cause.text] for cause in tried if cause.removes is not None])
        return 0.0 if result is None else 1.0 - self._size(result) / self._size(self._judge)

    def _without(self, plans: Sequence[Repetition]) -> Judge | None:
        """Return the judge of a run with the settings of several plans; None for one plan, or if it failed."""
        if len({*plans}) < 2:
            return None
        settings = dict(pair for plan in reversed(plans) for pair in plan.settings)
        whole = Repetition("", tuple(settings.items()), max(plan.longer for plan in plans))
        self._run([whole])
        return self._results.get(whole)

    def together(self, tried: Sequence[Cause]) -> str:
        """Return the errors of the run without all causes in words, if there are several."""
        each = [*dict.fromkeys(self._plans[c.text] for c in tried if c.removes is not None and not c.noted)]
        result = self._without(each)
        both = "both causes" if len(each) == 2 else "all of these causes"
        return "" if result is None else f"without {both}: {self._errors(result)}"

    def advised(self, tried: Sequence[Cause]) -> list[Cause]:
        """Return the causes, with advice to change gains only in the first one, and only if it helps in a run.

        The advice then has the errors of that run.
        """
        first, *others = tried
        plain = [cause._replace(text=ADVICE.sub(dropped, cause.text)) for cause in others]
        if (advice := ADVICE.search(first.text)) is None:
            return [first, *plain]
        self._run([plan := stiffer(self._judge, STIFFER if advice[1].startswith("raise") else 1.0 / STIFFER)])
        if (result := self._results.get(plan)) is None:
            return [first, *plain]
        beyond = any((use > 1.0 + EXACT).any() for use in result.use())
        peaks = ", with peaks beyond the URDF's limits" * beyond
        sized = f"; {advice[1]} ({plan.words}: {self._errors(result)}{peaks}){advice[2]}"
        helps = self._size(result) < HALF * self._size(self._judge)
        return [first._replace(text=first.text.replace(advice[0], sized if helps else dropped(advice))), *plain]

    def _size(self, result: Judge) -> float:
        """Return the sum of the RMS errors at the end of a run, relative to the largest errors of the first one."""
        largest = {name: max(float(self._judge.error_history(name).max()), FLOOR) for name in self._missed}
        return sum(_rms(result, name) / largest[name] for name in self._missed)

    def _errors(self, result: Judge) -> str:
        """Return the errors of the missed outputs at the end of a repeated run in words, and whether it succeeds."""
        text = " and ".join(self._error(result, name) for name in self._missed)
        still = "still not " if missed_outputs(result) else ""
        return f"{text if text.startswith('RMS') else f'error {text}'}, {still}{success(result)}"

    def _error(self, result: Judge, name: str) -> str:
        """Return an error in words: at the end, or the RMS if only one of the two is smaller than in the first run."""
        runs, unit = (result, self._judge), unit_of_error(result, name)
        (last, before), (rms, rms_before) = [run.aims[name].last for run in runs], [_rms(run, name) for run in runs]
        if (last < before) != (rms < rms_before):
            if not unit:
                return f"an RMS error {rms / rms_before:.3g} times as large"
            return f"RMS error {rms:.3g} {unit} instead of {rms_before:.3g} {unit}"
        if name != "q":
            return f"{last:.3g} {unit}"
        errors, before_each = (np.abs(run.wanted("q") - run.end("q")) for run in runs)
        most, i = worst_joint(result)[0], int((before_each - errors).argmax())
        if errors.max() <= (1.0 - LITTLE) * before_each.max() or i == errors.argmax():
            return most
        joints, units = result.setup.joints, result.setup.units
        return f"{most} of joint '{joints[int(errors.argmax())]}', {errors[i]:.3g} {units[i]} of joint '{joints[i]}'"


def _rms(judge: Judge, name: str) -> float:
    """Return the RMS error of an output at the end of a run, m or rad."""
    return float(np.sqrt(np.mean(errors_at_the_end(judge, name) ** 2)))


def _most(tried: Sequence[Cause]) -> float:
    """Return the largest part of the error that a cause removes."""
    return max((cause.removes for cause in tried if cause.removes is not None), default=0.0)


def _is_noted(cause: Cause, tried: Sequence[Cause], most: float) -> bool:
    """Return whether a cause reduces the error, or follows from another one."""
    if cause.removes is not None and cause.removes < 0.0:
        return True
    kinds = {other.kind for other in tried}
    led = cause.kind in FOLLOWING or (cause.kind == "reach" and "degrees" in kinds)
    return (
        _is_beyond(cause, tried)
        or (led and most > WHOLE and cause.removes != most)
        or (cause.noted and cause.removes is None)
    )


def _is_beyond(cause: Cause, tried: Sequence[Cause]) -> bool:
    """Return whether a joint is at a limit because its target is beyond it."""
    return cause.kind == "limit" and any(c.kind in ("reach", "degrees") and c.joint == cause.joint for c in tried)


def _is_open(cause: Cause) -> bool:
    """Return whether a cause could not be tried, and does not follow from others."""
    return cause.removes is None and not cause.noted and cause.kind not in FOLLOWING


def _rank(cause: Cause, left: float) -> float:
    """Return the sort key of a cause: what it removes, or if it was not tried, what no other cause removes."""
    if cause.noted:
        return inf
    untried = left if _is_open(cause) else 0.0
    return -round(untried if cause.removes is None else cause.removes, 1)


def _others(judge: Judge, missed: Sequence[str], why: Sequence[Cause]) -> list[Cause]:
    """Return further possible causes in the settings, which the balance of forces at the end does not show."""
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


def _gains(judge: Judge) -> Iterator[Cause]:
    """Yield gains that differ from the default ones as a cause."""
    if values := {
        group: judge.given(group) for group in dict.fromkeys(name.partition("[")[0] for name in unusual(judge))
    }:
        yield Cause("gain", f"the gains are {named(values)}", subject="usual")
