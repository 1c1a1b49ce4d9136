"""Settings of repeated runs, each without one of the causes of a failed run."""

from collections.abc import Mapping
from math import radians, sqrt
from typing import NamedTuple

import numpy as np

from ..plant.urdf import UNBOUNDED
from ..plant.variables import ROWS
from .cause import Cause, point_text
from .controller_causes import GAINS, payloads
from .judge import Judge
from .setup import OF_THE_CONTROLLER, Array

LONGER = 10.0  # largest additional duration of a repeated run, as a multiple of the run's duration
TURN = 6.0  # rad: if one joint target is in degrees, larger ones and whole numbers are too
STIFFER = 10.0  # factor of Kp in a run that tries the advice to raise it; divisor for the advice to lower it
USUAL = {name: start for name, *_, start, _ in ROWS if isinstance(start, float)}
SAMPLING = sorted({*OF_THE_CONTROLLER} - {"seed"})


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

    def of(self, own: Mapping[str, str]) -> "Repetition":
        """Return the repetition with other names of settings, which ``own`` has by full name."""
        full = {short: name for name, short in own.items()}
        return self._replace(settings=tuple((full.get(name, name), value) for name, value in self.settings))


def named(values: Mapping[str, Array]) -> str:
    """Return vectors with their names in words."""
    each = {name: f"{value[0]:.4g}" if np.ptp(value) == 0.0 else point_text(value) for name, value in values.items()}
    return " and ".join(f"{name} = {value}" for name, value in each.items())


def without(judge: Judge, cause: Cause) -> Repetition | None:
    """Return the repetition of a run without one of its causes; None if the cause is not one of the settings."""
    held, own = judge.held, judge.setup.controller

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
            return plan("without joint limits", wide)
        case "unstable" | "sampling" if not own:
            exact = {name: type(value)(0) for name, value in held.items() if name.partition("[")[0] in SAMPLING}
            return plan("with a continuous controller and exact sensors", exact)
        case "gain":
            return _with_gains(judge, unusual(judge) if cause.subject else _raised(judge))
        case "damping":
            return plan("with critical damping", _critical(judge))
        case "degrees":
            return plan("read as degrees", _in_radians(judge))
        case "reach" if not judge.wanted("quat").size and judge.changed <= 0.0:
            return plan("with a target in reach", _in_reach(judge, cause))
        case "time" if not judge.moving and cause.share <= LONGER * judge.duration:
            return Repetition(f"after {judge.duration + cause.share:.4g} s", longer=cause.share)
        case "time" if not judge.moving and (settings := unusual(judge, cause.subject)):
            return _with_gains(judge, settings)
    return None


def _elements(held: Mapping[str, float], group: str, value: float) -> dict[str, float]:
    """Return a value for all elements of a vector."""
    return {name: value for name in held if name.partition("[")[0] == group}


def _known_load(judge: Judge, subject: str) -> tuple[str, dict[str, float]]:
    """Return the change in words, and settings with which the controller knows a load or an external load is absent."""
    own, held, links = judge.setup.controller, judge.held, judge.setup.links
    if known := {name: value for name, value in links.items() if name.partition("[")[0] == subject}:
        return "with that of the model", known
    if subject == "payload":
        payload, believed = payloads(judge)
        if own and not payload:
            return "without it", {f"{own}payload": 0.0}
        known = {f"{own}payload_known": True, f"{own}payload": payload}
        return "with that of the plant" if believed else "if it is known", known
    if own and f"{own}{subject}[1]" in held:
        model = [name for name in held if name.partition("[")[0] == subject]
        return "with that of the plant", {f"{own}{name}": held[name] for name in model}
    return "without it", _elements(held, subject, 0.0)


def _in_radians(judge: Judge) -> dict[str, float]:
    """Return positions of all joints in rad; large and whole numbers are read as degrees."""
    turning = [i + 1 for i, unit in enumerate(judge.setup.units) if unit == "rad"]
    values = {name: judge.held.get(name, 0.0) for i in turning for name in (f"q_des[{i}]", f"q_start[{i}]")}
    return {name: radians(value) for name, value in values.items() if abs(value) > TURN or value == round(value) != 0}


def _raised(judge: Judge) -> dict[str, float]:
    """Return the largest gain of its group, or else the default one, for each proportional gain of 0."""
    raised = dict[str, float]()
    for stiff, _ in GAINS:
        values = judge.given(stiff)
        most = float(max(values, default=0.0)) or USUAL[stiff]
        raised |= {f"{stiff}[{i + 1}]": most for i, value in enumerate(values) if value == 0.0}
    return raised


def stiffer(judge: Judge, times: float) -> Repetition:
    """Return the run with gains Kp multiplied by ``times``, at the same damping ratio."""
    factors = {group: factor for pair in GAINS for group, factor in zip(pair, (times, sqrt(times)))}
    values = {group: factor * gain for group, factor in factors.items() if (gain := judge.given(group)).size}
    settings = {f"{group}[{i + 1}]": float(x) for group, value in values.items() for i, x in enumerate(value)}
    return Repetition(f"with {named(values)}", tuple(settings.items()))


def unusual(judge: Judge, stiff: str = "") -> dict[str, float]:
    """Return the default value of each gain that has another one; ``stiff`` is the proportional gain of one output."""
    pairs = [pair for pair in GAINS if stiff in ("", pair[0])]
    each = [(group, i, gain) for pair in pairs for group in pair for i, gain in enumerate(judge.given(group))]
    return {f"{group}[{i + 1}]": USUAL[group] for group, i, gain in each if gain != USUAL[group]}


def _with_gains(judge: Judge, settings: Mapping[str, float]) -> Repetition:
    """Return the run with other gains."""
    gains = dict.fromkeys(f"{name.partition('[')[0]} = {value:g}" for name, value in settings.items())
    return Repetition(f"with {' and '.join(gains)}", tuple(settings.items()))


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
