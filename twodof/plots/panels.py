"""What the panels of a run hold, whoever draws them: strokes over time, limits and ranges."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from math import ceil, floor, log10
from typing import NamedTuple

import numpy as np

from ..errors import PlotError
from .closed_form import Array
from .settings import number
from .strokes import (
    PALE,
    SMALLEST_EFFORT,
    SMALLEST_ERROR,
    SMALLEST_PART,
    SMALLEST_RANGE,
    Look,
    Stroke,
)
from .track import JointTrack, Track

KINDS = {"q": "Position", "v": "Velocity", "tau": "Effort"}
UNITS = {"q": ("rad", "m"), "v": ("rad/s", "m/s"), "tau": ("N·m", "N")}
"""Of joints that turn and of those that slide."""
CURVE, THIN, THICK = 1.4, 0.9, 4.0
"""Widths: of curves, of limits and targets, of closed forms behind curves."""
TARGET = "thin dashes: target"
Looks = Mapping[tuple[int, str], Look]
"""Of each track's joints, and of the track itself, whose joint is ""."""


class Panel(NamedTuple):
    """One quantity over time.

    Attributes:
        kind: of KINDS, or "error", the distance from the target.
        joint: its name; "" of the error.
        unit: "rad or m" where no robot tells which.
        strokes: curves of each track that has it, which have a kind; behind them targets, limits,
            and what the error is in closed form, where that is in the range.
        note: limits in words; of an error that is below the range, that it is.
        range: that shows the curves, and the limits that are near.
    """

    kind: str
    joint: str
    unit: str
    strokes: tuple[Stroke, ...]
    note: str
    range: tuple[float, float]


def title(tracks: Sequence[Track]) -> str:
    """The robots, or where they are not known the bags."""
    robots = dict.fromkeys(t.motion.robot for t in tracks if t.motion and t.motion.robot)
    return ", ".join(robots or dict.fromkeys(track.name for track in tracks))


def joint_names(tracks: Sequence[Track]) -> list[str]:
    """Of all joints of all tracks, each once."""
    return list(dict.fromkeys(joint.name for track in tracks for joint in track.joints))


def with_joints(tracks: Sequence[Track], names: Sequence[str]) -> list[Track]:
    """The tracks with those joints alone, in that order.

    Raises:
        PlotError: no track has a joint of such a name.
    """
    known = joint_names(tracks)
    for name in names:
        if name not in known:
            raise PlotError(f"no joint '{name}'; there are: {', '.join(known)}")
    chosen = ([joint for joint in track.joints if joint.name in names] for track in tracks)
    ordered = (sorted(joints, key=lambda joint: names.index(joint.name)) for joints in chosen)
    return [replace(track, joints=tuple(joints)) for track, joints in zip(tracks, ordered)]


def duration(tracks: Sequence[Track]) -> float:
    """Of the time axis, s."""
    return max(float(track.t[-1]) for track in tracks) or 1.0


def joint_panels(tracks: Sequence[Track], looks: Looks) -> list[Panel]:
    """Of each joint in turn: those of KINDS that any joint has."""
    joints = [joint for track in tracks for joint in track.joints]
    kinds = [kind for kind in KINDS if any(getattr(joint, kind).size for joint in joints)]
    return [
        _joint_panel(kind, name, tracks, looks) for name in joint_names(tracks) for kind in kinds
    ]


def _joint_panel(kind: str, name: str, tracks: Sequence[Track], looks: Looks) -> Panel:
    own = [(i, t, joint) for i, t in enumerate(tracks) for joint in t.joints if joint.name == name]
    curves, targets, lines, limits, words = [], [], [], [], []
    for i, track, joint in own:
        look = looks[i, name]
        values = getattr(joint, kind)
        if not values.size:
            continue
        curves.append(_curve(look.label, i, track.t, values, look, joint=name, kind=kind))
        if kind == "q" and joint.target.size:
            thin = Look("target", look.colour, (3, 2))
            targets.append(_curve("target", i, track.t, joint.target, thin, THIN, 1.95, joint=name))
        pair = _limits(kind, joint)
        for limit in pair:
            if limit is not None:
                limits.append(limit)
                ends, level = np.array([0.0, duration(tracks)]), np.array([limit, limit])
                dashed = Look("limit", look.colour, (7, 2, 1.5, 2))
                lines.append(_curve("limit", i, ends, level, dashed, THIN, 1.9, joint=name))
        words.append(_note(*pair))
    smallest = SMALLEST_EFFORT if kind == "tau" else SMALLEST_RANGE
    low, high = _range([stroke.y for stroke in (*curves, *targets)], smallest)
    near = [x for x in limits if abs(2 * x - low - high) < 1.8 * (high - low)]
    low, high = min([low, *near]), max([high, *near])
    pad = 0.06 * (high - low)
    turning, sliding = UNITS[kind]
    unit = {"rad": turning, "m": sliding}.get(own[0][2].unit, f"{turning} or {sliding}")
    note = "; ".join(filter(None, dict.fromkeys(words)))
    return Panel(kind, name, unit, (*lines, *targets, *curves), note, (low - pad, high + pad))


def _curve(
    label: str, track: int, t: Array, y: Array, look: Look, width: float = CURVE,
    depth: float = 2.0, *, joint: str = "", kind: str = "",
) -> Stroke:  # fmt: skip
    mark = "." * (len(t) == 1)
    return Stroke(
        label, track, t, y, look.colour, width, look.dashes, mark, depth, joint=joint, kind=kind
    )


def _limits(kind: str, joint: JointTrack) -> tuple[float | None, float | None]:
    if kind == "q":
        return joint.low, joint.high
    if kind == "tau" and joint.effort is not None:
        return -joint.effort, joint.effort
    return None, None


def _note(low: float | None, high: float | None) -> str:
    limits = [number(float(f"{limit:.3g}")) for limit in (low, high) if limit is not None]
    if low is not None and high == -low:
        return f"limits ±{limits[1]}"
    return f"limit{'s' * (len(limits) - 1)} {', '.join(limits)}" if limits else ""


def _range(values: Sequence[Array], smallest: float) -> tuple[float, float]:
    """Smallest and largest value, at least so far apart."""
    finite = np.concatenate([y[np.isfinite(y)] for y in values] or [np.empty(0)])
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    smallest = max(smallest, SMALLEST_PART * max(abs(low), abs(high)))
    short = max(0.0, smallest - (high - low))
    return low - 0.5 * short, high + 0.5 * short


def error_panel(tracks: Sequence[Track], looks: Looks) -> Panel | None:
    """Distance from the target, and what it is in closed form; whole decades for an axis that is
    logarithmic. None where no target is known.
    """
    tasks = [(i, track.t, track.task) for i, track in enumerate(tracks) if track.task]
    if not tasks:
        return None
    error = np.concatenate([task.error for _, _, task in tasks])
    low = floor(log10(max(float(error.min()), SMALLEST_ERROR)))
    high = max(low + 1, ceil(log10(max(float(error.max()), SMALLEST_ERROR))))
    note = "" if error.max() >= 10.0**low else f"less than {10.0**low:g} m throughout"
    disturbances = dict.fromkeys(chain(*(task.disturbances for _, _, task in tasks)))
    name = "closed form" + (f" without {', '.join(disturbances)}" if disturbances else "")
    exact = Look("\n".join(textwrap.wrap(name, 36)), PALE, ())
    strokes = [
        _curve(exact.label, i, t, task.closed_form, exact, THICK, 1.5)
        for i, t, task in tasks
        if task.closed_form is not None and task.closed_form.max() >= 10.0**low
    ]
    for i, t, task in tasks:
        strokes.append(_curve(looks[i, ""].label, i, t, task.error, looks[i, ""], kind="error"))
    return Panel("error", "", "m", tuple(strokes), note, (10.0**low, 10.0**high))
