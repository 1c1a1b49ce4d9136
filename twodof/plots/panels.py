"""What the panels of a run hold, whoever draws them: curves over time, limits, ranges and looks."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain
from math import ceil, floor, log10
from typing import Any, NamedTuple

import numpy as np

from ..bag.outline import extremes
from ..errors import PlotError
from .closed_form import Array
from .scales import COLOURS, SMALLEST_EFFORT, SMALLEST_ERROR, SMALLEST_PART, SMALLEST_RANGE
from .track import JointTrack, Track, number
from .words import labels

KINDS = {"q": "Position", "v": "Velocity", "tau": "Effort"}
UNITS = {"q": ("rad", "m"), "v": ("rad/s", "m/s"), "tau": ("N·m", "N")}
"""Of joints that turn and of those that slide."""
DASHES = ((), (5, 1.5), (7, 1.5, 1, 1.5), (1.5, 1))
"""On and off, in widths of the line. With the colours, whose number this does not divide, 28
curves look different."""
CHUNKS = 1000
"""Parts of a long line over time that each keep their extremes; panels are fewer pixels wide."""


class Look(NamedTuple):
    """What tells a curve from the others: a colour and one of DASHES."""

    label: str
    colour: str
    dashes: tuple[float, ...]


class Curve(NamedTuple):
    """Values y over times t, s, of the track of that number."""

    track: int
    t: Array
    y: Array


class Panel(NamedTuple):
    """One quantity over time.

    Attributes:
        kind: of KINDS, or "error", the distance from the target.
        joint: its name; "" of the error.
        unit: "rad or m" where no robot tells which.
        curves: of each track that has it.
        limits: values that it is held between, ascending.
        told: limits, or what ``closed_forms`` leave out, in words; of an error that is below the
            range, that it is.
        range: that shows the curves, and the limits that are near.
        closed_forms: what the error is in closed form, where it is in the range.
    """

    kind: str
    joint: str
    unit: str
    curves: tuple[Curve, ...]
    limits: tuple[float, ...]
    told: str
    range: tuple[float, float]
    closed_forms: tuple[Curve, ...] = ()


def looks(names: Iterable[str]) -> list[Look]:
    """A look for each name."""
    return [
        Look(name, COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)])
        for i, name in enumerate(names)
    ]


def track_looks(tracks: Sequence[Track]) -> list[Look]:
    """A look for each track, named by what tells it from the others."""
    return looks(labels(tracks))


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


def joint_panels(tracks: Sequence[Track]) -> list[Panel]:
    """Of each joint in turn: those of KINDS that any joint has."""
    found = [(i, track.t, joint) for i, track in enumerate(tracks) for joint in track.joints]
    kinds = [kind for kind in KINDS if any(getattr(joint, kind).size for _, _, joint in found)]
    return [
        _joint_panel(kind, [each for each in found if each[2].name == name])
        for name in joint_names(tracks)
        for kind in kinds
    ]


def _joint_panel(kind: str, found: Sequence[tuple[int, Array, JointTrack]]) -> Panel:
    joints = [joint for _, _, joint in found]
    turning, sliding = UNITS[kind]
    unit = {"rad": turning, "m": sliding}.get(joints[0].unit, f"{turning} or {sliding}")
    curves = [Curve(i, t, getattr(joint, kind)) for i, t, joint in found]
    shown = tuple(curve for curve in curves if curve.y.size)
    pairs = list(dict.fromkeys(_limits(kind, joint) for joint in joints))
    limits = sorted({limit for limit in chain(*pairs) if limit is not None})
    low, high = _range(
        [curve.y for curve in shown], SMALLEST_EFFORT if kind == "tau" else SMALLEST_RANGE
    )
    near = [x for x in limits if abs(2 * x - low - high) < 1.8 * (high - low)]
    low, high = min([low, *near]), max([high, *near])
    pad = 0.06 * (high - low)
    told = "; ".join(filter(None, (_told(*pair) for pair in pairs)))
    return Panel(kind, joints[0].name, unit, shown, tuple(limits), told, (low - pad, high + pad))


def _limits(kind: str, joint: JointTrack) -> tuple[float | None, float | None]:
    if kind == "q":
        return joint.low, joint.high
    if kind == "tau" and joint.effort is not None:
        return -joint.effort, joint.effort
    return None, None


def _told(low: float | None, high: float | None) -> str:
    found = [number(float(f"{limit:.3g}")) for limit in (low, high) if limit is not None]
    if low is not None and high == -low:
        return f"limits ±{found[1]}"
    return f"limit{'s' * (len(found) - 1)} {', '.join(found)}" if found else ""


def _range(values: Sequence[Array], smallest: float) -> tuple[float, float]:
    """Smallest and largest value, at least so far apart."""
    found = [y[np.isfinite(y)] for y in values]
    found = [y for y in found if y.size]
    low = min((float(y.min()) for y in found), default=0.0)
    high = max((float(y.max()) for y in found), default=0.0)
    smallest = max(smallest, SMALLEST_PART * max(abs(low), abs(high)))
    short = max(0.0, smallest - (high - low))
    return low - 0.5 * short, high + 0.5 * short


def error_panel(tracks: Sequence[Track]) -> Panel | None:
    """Distance from the target, and what it is in closed form; whole decades for an axis that is
    logarithmic. None where no target is known.
    """
    tasks = [(i, track.t, track.task) for i, track in enumerate(tracks) if track.task]
    if not tasks:
        return None
    error = np.concatenate([task.error for _, _, task in tasks])
    low = floor(log10(max(float(error.min()), SMALLEST_ERROR)))
    high = max(low + 1, ceil(log10(max(float(error.max()), SMALLEST_ERROR))))
    disturbances = dict.fromkeys(chain(*(task.disturbances for _, _, task in tasks)))
    exact = [Curve(i, t, k.closed_form) for i, t, k in tasks if k.closed_form is not None]
    shown = tuple(curve for curve in exact if curve.y.max() >= 10.0**low)
    told = "" if error.max() >= 10.0**low else f"less than {10.0**low:g} m throughout"
    if shown:
        told = "closed form" + (f" without {', '.join(disturbances)}" if disturbances else "")
    return Panel(
        "error", "", "m", tuple(Curve(i, t, task.error) for i, t, task in tasks), (),
        "\n".join(textwrap.wrap(told, 36)), (10.0**low, 10.0**high), shown,
    )  # fmt: skip


def outline(values: Array) -> Any:
    """Indices of the samples with which a line over time looks as it does with all of them.

    Of each of CHUNKS parts the first, last, smallest and largest.
    """
    n = len(values)
    if n <= 4 * CHUNKS:
        return slice(None)
    return extremes(np.arange(n) // ceil(n / CHUNKS), [values])


def close_outline(values: Array, most: int) -> Any:
    """So many at most, with which it does so from near by too, so that a jump is one.

    Of parts as short as may be the same four, and both sides of the greatest rise and fall.
    """
    n, size = len(values), 1
    kept: Any = slice(None)
    with np.errstate(all="ignore"):  # between infinities
        rise = np.diff(values)
    while n > most:
        size = max(2 * size, 2 * n // most)
        lines = [values, np.append(rise, np.nan), np.append(np.nan, rise)]
        kept = extremes(np.arange(len(values)) // size, lines)
        n = len(kept)
    return kept
