"""A verdict in words."""

from collections.abc import Mapping
from math import inf

import numpy as np

from .cause import FLOOR, Cause, point_text
from .judge import AT_LIMIT, Judge

STILL = 1e-3  # fraction of the largest speed below which a joint is at rest
MANY = 10.0  # overshoot from which on a multiple is printed, and no percentage
UNITS = {"x": "m"}  # of errors, rad for the others
SWITCHES = ("payload_known", "limit_effort")
CONTROLLER = {
    "Kp": "",
    "Kd": "",
    "Kp_rot": "",
    "Kd_rot": "",
    "control_period": " s",
    "control_delay": " s",
    "payload": " kg",
}
"""Settings that the verdict of a run that failed names if they are not 0, and their units, without those of gains."""


def lines_of(
    judge: Judge, outcome: str, motion: str, numbers: Mapping[str, float], why: tuple[Cause, ...]
) -> tuple[str, ...]:
    """Return the lines of a verdict; the first has the outcome and the first cause."""
    off = ", ".join(_distances(judge, numbers))
    head = f"{outcome}: {off}" if off else f"{outcome}, {motion} at the end"
    if why:
        but = {"reached": "; but ", "followed": "; but "}.get(outcome, "; ")
        head += f"{but}{why[0].text}"
    elif outcome.startswith("not"):
        head += "; no cause is seen in the samples"
    settings = _settings(judge) if outcome.startswith("not") else ""
    lines = [head, *_also(why), _response(judge, outcome, motion, numbers), _peaks(judge, why), settings]
    return tuple(filter(None, lines))


def _also(why: tuple[Cause, ...]) -> list[str]:
    """Return lines for the causes after the first, and then notes of consequences.

    A line has the worst cause of a kind, and the joints of the others.
    """
    lines = []
    for noted, word in ((False, "also"), (True, "note:")):
        part = [cause for cause in why if cause.noted is noted]
        kinds = {cause.kind: [other for other in part if other.kind == cause.kind] for cause in part}
        for worst, *others in kinds.values():
            joints = dict.fromkeys(cause.joint for cause in others if cause.joint not in ("", worst.joint))
            names = ", ".join(f"'{joint}'" for joint in joints)  # a joint may stand at both of its limits
            parts = [f"{word} {worst.text}"] * (worst is not why[0]) + [f"likewise {names}"] * bool(names)
            lines += ["; ".join(parts), *(f"{word} {cause.text}" for cause in others if not cause.joint)]
    return lines


def _settings(judge: Judge) -> str:
    """Return the settings of the controller that are not 0 in words."""
    texts = []
    for name, unit in {**CONTROLLER, **dict.fromkeys(SWITCHES, "")}.items():
        values = judge.given(name) if f"{name}[1]" in judge.held else np.array([float(judge.held.get(name, 0.0))])
        if values.any():
            value = f"{values[0]:.4g}" if np.ptp(values) == 0.0 else point_text(values)
            texts.append(f"{name} = {'true' if name in SWITCHES else value + unit}")
    return f"with {', '.join(texts)}" if texts else ""


def _distances(judge: Judge, numbers: Mapping[str, float]) -> list[str]:
    """Return the errors at the end in words."""
    texts, setup = [], judge.setup
    if "final_error" in numbers:
        target = point_text(judge.wanted("x"))
        texts.append(f"{numbers['final_error']:.3g} m from the target {target} m")
    if "final_turn_error" in numbers:
        texts.append(f"{numbers['final_turn_error']:.3g} rad from the target orientation")
    if "final_joint_error" in numbers:
        off = np.abs(judge.wanted("q") - judge.end("q"))
        worst = int(off.argmax())
        far = f"{off[worst]:.3g} {setup.units[worst]}".strip()
        texts.append(f"joints at most {far} from their targets, '{setup.joints[worst]}'")
    return texts


def _response(judge: Judge, outcome: str, motion: str, numbers: Mapping[str, float]) -> str:
    """Return settling, overshoot, RMS error and motion in words."""
    parts, settling = [], numbers.get("settling_time")
    if outcome in ("reached", "not reached") and settling is not None:
        firsts = [f"{aim.first:.3g} {UNITS.get(name, 'rad')}" for name, aim in judge.aims.items()]
        late = f"not within 2 % of the first error of {' and '.join(firsts)}"
        parts.append(late if settling == inf else f"within 2 % after {settling:.4g} s")
        if "overshoot" in numbers:
            past = numbers["overshoot"]
            parts.append(f"overshoot {100.0 * past:.3g} %" if past < MANY else f"overshoot {past:,.0f} times the way")
    if "rms_error" in numbers:
        parts.append(f"RMS error {numbers['rms_error']:.3g} m")
    if not parts and outcome == "no target":
        return ""
    rings = (
        f" at {numbers['frequency']:.4g} Hz, damping ratio {numbers['damping']:.3g}" if "frequency" in numbers else ""
    )
    end = motion + rings if motion in ("oscillating", "diverging") else _rest(judge, outcome) or motion
    return ", ".join([*parts, f"{end} at the end"])


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


def _peaks(judge: Judge, why: tuple[Cause, ...]) -> str:
    """Return the peaks in words, as fractions of the URDF's limits; the causes have those beyond."""
    texts, beyond = [], {cause.kind for cause in why}
    for kind, what, use in zip(("effort", "velocity"), ("effort", "speed"), judge.use()):
        if use.max(initial=0.0) > 0.0 and kind not in beyond:
            worst = int(use.argmax())
            texts.append(f"peak {what} {100.0 * use[worst]:.3g} % of the limit of joint '{judge.setup.joints[worst]}'")
    return ", ".join(texts)
