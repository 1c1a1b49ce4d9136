"""A verdict in words."""

import re
from collections.abc import Mapping, Sequence
from math import inf

import numpy as np

from .aim import moves, unsettled
from .cause import FLOOR, MOTION, MOVING, SMALL, Cause, point_text
from .controller_causes import STILL, payloads
from .judge import AT_LIMIT, Judge
from .outcome import SUCCESS, errors_at_the_end, missed_outputs

PASSING = 2.0  # ratio of the largest of the last errors to the last one, from which on it is printed
HALF = 0.5  # part of the error; if the first cause removes less, it does not explain the failure
SUCCESSES = tuple(f", {word}" for word in SUCCESS)  # ends of the errors of a run that does not fail
WHOLE = 0.995  # parts above this fraction of the error are not printed: they balance each other
NEXT = "seen when the run is repeated without the first cause"
ADVICE = re.compile(r"; (raise Kp|raise the gains|lower the gains)(, or |(?=$|;))")
"""Advice without a size; a repeated run may have shown that it helps."""
MANY = 1.0  # overshoot, as a fraction of the distance, from which on it is printed as a distance
PLAIN = ("reach", "degrees", *MOTION)  # kinds whose texts have no error of their joint
RUNAWAY = ("diverged", "unstable")  # kinds of a first cause after which notes are not printed
NEAR = 0.5  # part of a limit from which on a peak is printed for a run that failed
ERRORS = {"x": "position", "quat": "orientation", "q": "joints"}
SWITCHES = ("payload_known", "limit_effort", "v_from_q")
CONTROLLER = {
    "Kp": "",
    "Kd": "",
    "Kp_rot": "",
    "Kd_rot": "",
    "control_period": " s",
    "control_delay": " s",
    "payload": " kg",
    "f_ext": " N",
    "xd_des": " m/s",
    "xdd_des": " m/s²",
    **dict.fromkeys(("tau_ext", "friction", "damping", "armature", "q_resolution", "q_noise", "v_noise"), ""),
}
"""Settings that a verdict with a cause names if they are not 0; units without those of gains and joints."""


def lines_of(
    judge: Judge, outcome: str, motion: str, numbers: Mapping[str, float], why: tuple[Cause, ...], together: str
) -> tuple[str, ...]:
    """Return the lines of a verdict; the first has the outcome and the first cause.

    Args:
        together: errors of the run without all causes in words, or "".
    """
    missed = missed_outputs(judge)
    off = ", ".join(_distances(judge, numbers, missed))
    head = f"{outcome}: {off}" if off else f"{outcome}, {motion} at the end"
    worst = worst_joint(judge)[1] if "final_joint_error" in numbers else ""
    parts = _parts(why)
    left = {**parts}  # all forces of a kind have one part, which is printed once
    causes = [_completed(judge, cause, worst, left) for cause in _grouped(why, len(judge.setup.joints), worst)]
    if why and not why[0].noted:
        but = {"reached": "; but ", "followed": "; but "}.get(outcome, "; ")
        first = why[0].removes
        if first is not None and first < HALF and together.endswith(SUCCESSES):
            but, together = f"{but}several causes act together ({together}), first: ", ""
        head += f"{but}{causes[0].text}"
    elif outcome.startswith("not"):
        head += "; no cause is found in the samples"
    also = [f"also {cause.text}" for cause in causes[1:] if not cause.noted]
    notes = [
        f"note: {ADVICE.sub(dropped, cause.text)}" for cause in causes if cause.noted and why[0].kind not in RUNAWAY
    ]
    settings = _settings(judge) if why else ""
    lines = [
        head,
        *(text for text in also if NEXT not in text),
        together,
        *(text for text in also if NEXT in text),
        *notes,
        *(f"note: {line}" for line in judge.setup.unjudged),
        "" if any(cause.kind == "reach" for cause in why) else _remainder(parts),  # its distance is printed
        _response(judge, outcome, motion, numbers, missed, why),
        _peaks(judge, why, outcome),
        settings,
    ]
    return tuple(filter(None, lines))


def dropped(advice: re.Match[str]) -> str:
    """Return the text that replaces advice that a repeated run disproves."""
    return "; " if advice[2] else ""


def _grouped(why: tuple[Cause, ...], count: int, worst: str) -> list[Cause]:
    """Merge causes of one kind at several of ``count`` joints; causes without a joint stay as they are.

    The text is that of the joint with the worst error, or else the first one. Joints that stick (with a time) and
    joints that creep are different kinds. The same errors of a repeated run are printed once.
    """
    grouped: list[Cause] = []
    for cause in why:
        key = cause.kind, cause.noted, cause.time is None
        same = [other for other in why if other.joint and (other.kind, other.noted, other.time is None) == key]
        if cause not in same:
            grouped.append(cause)
        elif cause is same[0]:
            lead = next((other for other in same if other.joint == worst), cause)
            joints = dict.fromkeys(other.joint for other in same if other.joint != lead.joint)
            names = ", ".join(f"'{joint}'" for joint in joints)  # a joint may stand at both of its limits
            names = "all other joints" if len(joints) == count - 1 > 1 else names
            text, *remedy = lead.text.split("; ", 1)
            grouped.append(lead._replace(text="; ".join([text + f", likewise {names}" * bool(names), *remedy])))
    first = {cause.tried: cause for cause in reversed(grouped)}
    return [c if not c.tried or first[c.tried] is c else c._replace(tried="", part=None) for c in grouped]


def _parts(why: tuple[Cause, ...]) -> dict[str, float]:
    """Return the parts of the error to print, by kind or input, if there are several causes and none exceeds the error.

    After repetitions it is empty, because the errors of the repetitions are printed instead.
    """
    if any(cause.tried for cause in why):
        return {}
    parts = {_of(cause): cause.part for cause in why if cause.part is not None and cause.kind != "reach"}
    several = len({_of(cause) for cause in why if not cause.noted}) > 1
    shown = {key: part for key, part in parts.items() if abs(part) >= SMALL}
    return shown if several and max(map(abs, shown.values()), default=WHOLE) < WHOLE else {}


def _of(cause: Cause) -> str:
    """Return the key of a cause's part in the error: the kind of force, the input, or "motion"."""
    return "motion" if cause.kind in MOVING else cause.subject or cause.kind


def _completed(judge: Judge, cause: Cause, worst: str, parts: dict[str, float]) -> Cause:
    """Return a cause with its numbers in parentheses before its remedy.

    They are the errors without the cause, or its part in the error, and its joint's error if another joint's is larger.
    """
    facts, part = [], parts.pop(_of(cause), None) if cause.part is not None else None
    if cause.joint and worst and cause.joint != worst and not cause.noted and cause.kind not in PLAIN:
        own = judge.setup.joints.index(cause.joint)
        off = abs(judge.wanted("q")[own] - judge.end("q")[own])
        facts.append(f"its own error is {off:.3g} {judge.setup.units[own]}".strip())
    if cause.tried:
        facts += ["it reduces the error"] * (cause.noted and (cause.removes or 0.0) < 0.0)
        facts.append(cause.tried)
    elif cause.part is not None and part is not None:
        percent = f"{100.0 * abs(part):.2g} %"
        facts.append(f"{percent} of the error" if part > 0.0 else f"it reduces the error by {percent}")
    elif cause.part is not None and cause.part <= -SMALL and cause.noted:
        facts.append("it reduces the error")
    text, *remedy = cause.text.split("; ", 1)
    return cause._replace(text="; ".join([f"{text} ({', '.join(facts)})" if facts else text, *remedy]))


def _remainder(parts: Mapping[str, float]) -> str:
    """Return the part of the error that no printed percentage has, in words."""
    rest = 1.0 - sum(parts.values())
    if not parts or abs(rest) < SMALL:
        return ""
    size = f"{float(f'{100.0 * abs(rest):.2g}'):g} %"
    return f"everything else: {size} of the error" if rest > 0.0 else f"everything else reduces the error by {size}"


def _settings(judge: Judge) -> str:
    """Return the settings of the controller that are not 0 in words."""
    texts = []
    own = judge.setup.controller
    real, model = payloads(judge)
    believed = {f"{own}payload": " kg"} if model not in (0.0, real) else {}
    for name, unit in {**CONTROLLER, **believed, **dict.fromkeys(SWITCHES, "")}.items():
        values = judge.given(name) if f"{name}[1]" in judge.held else np.array([float(judge.held.get(name, 0.0))])
        if values.any():
            value = f"{values[0]:.4g}" if np.ptp(values) == 0.0 else point_text(values)
            texts.append(f"{name} = {'true' if name in SWITCHES else value + unit}")
    return f"with {', '.join(texts)}" if texts else ""


def _distances(judge: Judge, numbers: Mapping[str, float], missed: Sequence[str]) -> list[str]:
    """Return the errors at the end in words, those of missed outputs first."""
    texts = {}
    if "final_error" in numbers:
        target = point_text(judge.wanted("x"))
        texts["x"] = f"{numbers['final_error']:.3g} m from the target {target} m"
    if "final_turn_error" in numbers:
        texts["quat"] = f"{numbers['final_turn_error']:.3g} rad from the target orientation"
    if "final_joint_error" in numbers:
        far, joint = worst_joint(judge)
        texts["q"] = f"joint errors of up to {far} ('{joint}')"
    return [texts[name] for name in sorted(texts, key=lambda name: name not in missed)]


def worst_joint(judge: Judge) -> tuple[str, str]:
    """Return the largest error of a joint at the end, with its unit, and the joint."""
    off = np.abs(judge.wanted("q") - judge.end("q"))
    worst = int(off.argmax())
    return f"{off[worst]:.3g} {judge.setup.units[worst]}".strip(), judge.setup.joints[worst]


def _response(
    judge: Judge, outcome: str, motion: str, numbers: Mapping[str, float], missed: Sequence[str], why: tuple[Cause, ...]
) -> str:
    """Return settling, overshoot, RMS error and motion in words."""
    parts, settling = [], numbers.get("settling_time")
    if outcome in ("reached", "not reached") and settling is not None:
        moved = {name: aim for name, aim in judge.aims.items() if name in moves(judge.aims)}
        late = {name: aim for name, aim in judge.aims.items() if name in unsettled(judge.aims)}
        units = {name: unit_of_error(judge, name) for name in judge.aims}
        grown = [
            f"the error of the {ERRORS[name]} grew"
            + f" from {aim.first:.3g} {units[name]} to {aim.last:.3g} {units[name]}" * bool(units[name])
            for name, aim in late.items()
            if aim.last > aim.first
        ]
        firsts = " and ".join(
            f"{aim.first:.3g} {units[name]}" + " over all joints" * (name == "q" and len(judge.setup.joints) > 1)
            for name, aim in late.items()
            if units[name]
        )
        away = ", ".join(grown) or "not within 2 % of the initial error" + f" of {firsts}" * bool(firsts)
        only = f"{' and '.join(ERRORS[name] for name in moved)} within 2 % only from {settling:.4g} s on"
        within = only if outcome == "not reached" else f"within 2 % after {settling:.4g} s"
        parts.append(away if settling == inf else within)
        ends = {name: float(errors_at_the_end(judge, name).max(initial=0.0)) for name in moved}
        parts += [
            f"errors of the {ERRORS[name]} of up to {most:.3g} {units[name]} in the last tenth of the run"
            for name, most in ends.items()
            if most > PASSING * max(moved[name].last, FLOOR) and units[name] and outcome == "not reached"
        ]
        if "overshoot" in numbers and (numbers["overshoot"] or outcome == "reached"):
            past = numbers["overshoot"]
            name, aim = next(iter(judge.aims.items()))
            unit = unit_of_error(judge, name)
            size = f"{past * aim.first:.3g} {unit}" if unit else f"{past:.3g} times the initial error"
            parts.append(f"overshoot {100.0 * past:.3g} %" if past < MANY else f"the target is passed by {size}")
    elif outcome == "not reached":
        parts.append("the run starts at its target")
    if "rms_error" in numbers and (not missed or "x" in missed):
        parts.append(f"RMS error {numbers['rms_error']:.3g} m")
    if not parts and outcome == "no target":
        return ""
    rings = ""
    if "frequency" in numbers and not {"unstable", "sampling"} & {cause.kind for cause in why[:1]}:
        grows = " with a growing amplitude" * bool(motion == "oscillating" and numbers["damping"] < 0.0)
        rings = f" at {numbers['frequency']:.4g} Hz{grows}, damping ratio {numbers['damping']:.3g}"
    if not judge.speed.any() and outcome.startswith("not"):
        return ", ".join([*parts, "no joint ever moved"])
    end = motion + rings if motion in ("oscillating", "diverging") else _rest(judge, outcome) or motion
    return ", ".join([*parts, f"{end} at the end"])


def unit_of_error(judge: Judge, name: str) -> str:
    """Return the unit of an output's error; "" for joints of both kinds, whose errors have no common size."""
    units = {*judge.setup.units} if name == "q" else {"m" if name == "x" else "rad"}
    return units.pop() or "rad" if len(units) == 1 else ""


def _rest(judge: Judge, outcome: str) -> str:
    """Return joints at their limits, or the one that still moves, at the end of a run that failed, in words."""
    setup, q, v = judge.setup, judge.end("q"), np.abs(judge.end("v"))
    i = int(v.argmax())
    if not outcome.startswith("not"):
        return ""
    if v[i] > STILL * max(float(judge.speed.max()), FLOOR):
        return f"joint '{setup.joints[i]}' still moving at {v[i]:.3g} {setup.units[i] or 'rad'}/s"
    at = np.minimum(np.abs(q - setup.low), np.abs(q - setup.high)) <= AT_LIMIT
    names = ", ".join(f"'{name}'" for name, stopped in zip(setup.joints, at) if stopped)
    return f"at rest with {names} at {'a limit' if at.sum() == 1 else 'their limits'}" if names else ""


def _peaks(judge: Judge, why: tuple[Cause, ...], outcome: str) -> str:
    """Return the peaks in words, as fractions of the URDF's limits; the causes have those beyond."""
    texts, named = [], {cause.kind for cause in why}
    least = NEAR if outcome.startswith("not") else 0.0
    for kinds, what, use in zip(({"effort", "saturation"}, {"velocity"}), ("effort", "speed"), judge.use()):
        if use.max(initial=0.0) > least and not kinds & named:
            worst = int(use.argmax())
            texts.append(f"peak {what} {100.0 * use[worst]:.3g} % of the limit of joint '{judge.setup.joints[worst]}'")
    return ", ".join(texts)
