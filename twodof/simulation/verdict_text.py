"""A verdict in words."""

from collections.abc import Mapping
from math import inf

import numpy as np

from .aim import SMALLEST_MOVE
from .cause import FLOOR, SMALL, Cause, point_text
from .controller_causes import STILL, controller_prefix, payloads
from .judge import AT_LIMIT, Judge

WHOLE = 0.995  # part of an error that is printed as the whole
MANY = 1.0  # overshoot, a fraction of the way, from which on its distance is printed
RUNAWAY = ("diverged", "unstable")  # kinds whose consequences say nothing
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
    **dict.fromkeys(("tau_ext", "friction", "damping", "q_resolution", "q_noise", "v_noise"), ""),
}
"""Settings that the verdict of a run that failed names if they are not 0; units without those of gains and joints."""


def lines_of(
    judge: Judge, outcome: str, motion: str, numbers: Mapping[str, float], why: tuple[Cause, ...]
) -> tuple[str, ...]:
    """Return the lines of a verdict; the first has the outcome and the first cause."""
    off = ", ".join(_distances(judge, numbers))
    head = f"{outcome}: {off}" if off else f"{outcome}, {motion} at the end"
    causes = _grouped(why, len(judge.setup.joints))
    if why and not why[0].noted:
        but = {"reached": "; but ", "followed": "; but "}.get(outcome, "; ")
        head += f"{but}{causes[0].text}"
    elif outcome.startswith("not"):
        head += "; no cause is found in the samples"
    also = [f"also {cause.text}" for cause in causes[1:] if not cause.noted]
    notes = [f"note: {cause.text}" for cause in causes if cause.noted and why[0].kind not in RUNAWAY]
    settings = _settings(judge) if outcome.startswith("not") else ""
    lines = [
        head,
        *also,
        *notes,
        _response(judge, outcome, motion, numbers, why),
        _peaks(judge, why, outcome),
        settings,
    ]
    return tuple(filter(None, lines))


def _grouped(why: tuple[Cause, ...], count: int) -> list[Cause]:
    """Return the worst cause of each kind with the joints, of ``count``, of its others, and all causes without one.

    A joint that sticks has a time, and one that creeps none.
    """
    grouped: list[Cause] = []
    for cause in why:
        key = cause.kind, cause.noted, cause.time is None
        same = [other for other in why if other.joint and (other.kind, other.noted, other.time is None) == key]
        if cause not in same:
            grouped.append(cause)
        elif cause is same[0]:
            joints = dict.fromkeys(other.joint for other in same if other.joint != cause.joint)
            names = ", ".join(f"'{joint}'" for joint in joints)  # a joint may stand at both of its limits
            names = "all other joints" if len(joints) == count - 1 > 1 else names
            grouped.append(cause._replace(text=cause.text + f"; likewise {names}" * bool(names)))
    several = len([cause for cause in grouped if not cause.noted]) > 1
    first = {cause.tried: cause for cause in reversed(grouped)}
    return [cause._replace(text=_with_part(cause, several, first[cause.tried] is cause)) for cause in grouped]


def _with_part(cause: Cause, several: bool, new: bool) -> str:
    """Return a cause's text, before its remedy with the errors without it, or else with its part in the error.

    The part is only printed of one of several causes, and if it is known and less than all of the error; the errors,
    if they are new.
    """
    part = cause.tried if new else ""
    if (
        not cause.tried
        and several
        and cause.part is not None
        and cause.kind != "reach"
        and SMALL <= abs(cause.part) < WHOLE
    ):
        percent = f"{100.0 * abs(cause.part):.2g} %"
        part = f"{percent} of the error" if cause.part > 0.0 else f"it reduces the error by {percent}"
    text, *remedy = cause.text.split("; ", 1)
    return "; ".join([f"{text} ({part})" if part else text, *remedy])


def _settings(judge: Judge) -> str:
    """Return the settings of the controller that are not 0 in words."""
    texts = []
    own = controller_prefix(judge)
    real, model = payloads(judge)
    believed = {f"{own}payload": " kg"} if model not in (0.0, real) else {}
    for name, unit in {**CONTROLLER, **believed, **dict.fromkeys(SWITCHES, "")}.items():
        values = judge.given(name) if f"{name}[1]" in judge.held else np.array([float(judge.held.get(name, 0.0))])
        if values.any():
            value = f"{values[0]:.4g}" if np.ptp(values) == 0.0 else point_text(values)
            texts.append(f"{name} = {'true' if name in SWITCHES else value + unit}")
    return f"with {', '.join(texts)}" if texts else ""


def _distances(judge: Judge, numbers: Mapping[str, float]) -> list[str]:
    """Return the errors at the end in words."""
    texts = []
    if "final_error" in numbers:
        target = point_text(judge.wanted("x"))
        texts.append(f"{numbers['final_error']:.3g} m from the target {target} m")
    if "final_turn_error" in numbers:
        texts.append(f"{numbers['final_turn_error']:.3g} rad from the target orientation")
    if "final_joint_error" in numbers:
        far, joint = worst_joint(judge)
        texts.append(f"joint errors of up to {far} ('{joint}')")
    return texts


def worst_joint(judge: Judge) -> tuple[str, str]:
    """Return the largest error of a joint at the end, with its unit, and the joint."""
    off = np.abs(judge.wanted("q") - judge.end("q"))
    worst = int(off.argmax())
    return f"{off[worst]:.3g} {judge.setup.units[worst]}".strip(), judge.setup.joints[worst]


def _response(judge: Judge, outcome: str, motion: str, numbers: Mapping[str, float], why: tuple[Cause, ...]) -> str:
    """Return settling, overshoot, RMS error and motion in words."""
    parts, settling = [], numbers.get("settling_time")
    if outcome in ("reached", "not reached") and settling is not None:
        moves = {name: aim for name, aim in judge.aims.items() if aim.first >= FLOOR} or judge.aims
        firsts = [f"{aim.first:.3g} {unit_of_error(judge, name)}" for name, aim in moves.items()]
        late = f"not within 2 % of the initial error of {' and '.join(firsts)}"
        late += ", farther from the target than at the start" * any(aim.last > aim.first for aim in moves.values())
        moved = [ERRORS[name] for name, aim in judge.aims.items() if aim.first >= SMALLEST_MOVE]
        only = f"{' and '.join(moved)} within 2 % only from {settling:.4g} s on"
        within = only if outcome == "not reached" else f"within 2 % after {settling:.4g} s"
        parts.append(late if settling == inf else within)
        if "overshoot" in numbers and (numbers["overshoot"] or outcome == "reached"):
            past = numbers["overshoot"]
            name, aim = next(iter(judge.aims.items()))
            far = f"the target is passed by {past * aim.first:.3g} {unit_of_error(judge, name)}"
            parts.append(f"overshoot {100.0 * past:.3g} %" if past < MANY else far)
    elif outcome == "not reached":
        parts.append("the run starts at its target")
    if "rms_error" in numbers:
        parts.append(f"RMS error {numbers['rms_error']:.3g} m")
    if not parts and outcome == "no target":
        return ""
    rings = ""
    if "frequency" in numbers and not {"unstable", "sampling"} & {cause.kind for cause in why[:1]}:
        grows = " with a growing amplitude" * bool(motion == "oscillating" and numbers["damping"] < 0.0)
        rings = f" at {numbers['frequency']:.4g} Hz{grows}, damping ratio {numbers['damping']:.3g}"
    end = motion + rings if motion in ("oscillating", "diverging") else _rest(judge, outcome) or motion
    return ", ".join([*parts, f"{end} at the end"])


def unit_of_error(judge: Judge, name: str) -> str:
    """Return the unit of an output's error; joints of both kinds have none."""
    units = {*judge.setup.units} if name == "q" else {"m" if name == "x" else "rad"}
    return units.pop() or "rad" if len(units) == 1 else "rad or m"


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
