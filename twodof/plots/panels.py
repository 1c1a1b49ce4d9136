"""Contents of a run's panels for any renderer: lines over time, limits and ranges."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from math import ceil, floor, inf, log10
from typing import NamedTuple

import numpy as np

from ..errors import PlotError, choice
from ..export.closed_form import Array
from .settings import number
from .strokes import ALARM, PALE, SMALLEST_ERROR, SMALLEST_RANGE, LineStyle, Stroke
from .track import JointTrack, Track

KINDS = {"q": "Position", "v": "Velocity", "tau": "Effort", "error": "Distance from the target"}
UNITS = {"q": ("rad", "m"), "v": ("rad/s", "m/s"), "tau": ("N·m", "N")}  # units of rotating and of sliding joints
SMALLEST_EFFORT = 1e-6  # N·m, N: smaller changes are shown as rest
SMALLEST_PART = 1e-4  # fraction of a value, so that ticks with six digits differ
CURVE, THIN, THICK = 1.4, 0.9, 4.0  # line widths of curves, of limits and targets, and of closed forms behind curves
SEEN_IN = {"limit": "q", "friction": "q", "saturation": "tau"}
MARKS = {"limit": "at its limit", "friction": "sticks", "saturation": "saturated"}
"""Panels in which causes are marked at their first occurrence, and the names of the marks."""
SETTLED = "within 2 % from here on"
TARGET, HELD = "thin dashes: target", "grey band: held by friction"
LineStyles = Mapping[tuple[int, str], LineStyle]
"""Styles of each track's joints; the joint "" has the style of the track itself."""


class Panel(NamedTuple):
    """One quantity over time."""

    kind: str  # quantity, one of KINDS
    joint: str  # name of the joint; "" for the error
    unit: str  # unit; "rad or m" if the robot is unknown
    # curves of each track, which have a kind; behind them targets, limits, and the closed form of the error if it is in
    # the range
    strokes: tuple[Stroke, ...]
    note: str  # limits in words, or the note that an error is below the range
    range: tuple[float, float]  # range of the axis, which contains the curves and nearby limits


def title(tracks: Sequence[Track]) -> str:
    """Return the names of the robots, or of the bags if robots are unknown."""
    robots = dict.fromkeys(t.motion.robot for t in tracks if t.motion and t.motion.robot)
    return ", ".join(robots or dict.fromkeys(track.name for track in tracks))


def joint_names(tracks: Sequence[Track]) -> list[str]:
    """Return the names of all joints of all tracks, each once."""
    return list(dict.fromkeys(joint.name for track in tracks for joint in track.joints))


def with_joints(tracks: Sequence[Track], names: Sequence[str]) -> list[Track]:
    """Return the tracks with the named joints only, in that order."""
    known = joint_names(tracks)
    for name in names:
        if name not in known:
            raise PlotError(f"no joint '{name}'{choice(name, known)}")
    chosen = ([joint for joint in track.joints if joint.name in names] for track in tracks)
    ordered = (sorted(joints, key=lambda joint: names.index(joint.name)) for joints in chosen)
    return [replace(track, joints=tuple(joints)) for track, joints in zip(tracks, ordered)]


def duration(tracks: Sequence[Track]) -> float:
    """Return the length of the time axis, s."""
    return max(float(track.t[-1]) for track in tracks) or 1.0


def panels_of(tracks: Sequence[Track], line_styles: LineStyles) -> list[Panel]:
    """Return the panels of each joint for the known KINDS, then the panel of the error, if it is known."""
    joints = [joint for track in tracks for joint in track.joints]
    kinds = [kind for kind in UNITS if any(getattr(joint, kind).size for joint in joints)]
    names = joint_names(tracks)
    panels = [_joint_panel(kind, name, tracks, line_styles) for name in names for kind in kinds]
    error = _error_panel(tracks, line_styles)
    return [*panels, error] if error else panels


def _joint_panel(kind: str, name: str, tracks: Sequence[Track], line_styles: LineStyles) -> Panel:
    own = [(i, t, joint) for i, t in enumerate(tracks) for joint in t.joints if joint.name == name]
    curves, targets, lines, limits, words = [], [], [], [], []
    for i, track, joint in own:
        line = line_styles[i, name]
        values = getattr(joint, kind)
        if not values.size:
            continue
        curves.append(_curve(line.label, i, track.t, values, line, joint=name, kind=kind))
        if kind == "q" and joint.target.size:
            thin = LineStyle("target", line.colour, (3, 2))
            targets.append(_curve("target", i, track.t, joint.target, thin, THIN, 1.95, joint=name))
        if kind == "q" and np.isfinite(joint.stuck).any():
            wide = LineStyle(HELD, PALE, ())
            targets.append(_curve(wide.label, i, track.t, joint.stuck, wide, THICK, 1.85, joint=name))
        targets += _events(i, kind, joint, track)
        own_limits = _limits(kind, joint)
        for limit in own_limits:
            ends, level = np.array([0.0, duration(tracks)]), np.array([limit, limit])
            dashed = LineStyle("limit", line.colour, (7, 2, 1.5, 2))
            lines.append(_curve("limit", i, ends, level, dashed, THIN, 1.9, joint=name))
        limits += own_limits
        words.append(_note(own_limits))
    smallest = SMALLEST_EFFORT if kind == "tau" else SMALLEST_RANGE
    finite = [stroke.y[np.isfinite(stroke.y)] for stroke in (*curves, *targets)]
    values = np.concatenate([y for y in finite if y.size] or [np.zeros(1)])
    low, high = float(values.min()), float(values.max())
    short = max(smallest, SMALLEST_PART * max(abs(low), abs(high))) - (high - low)
    low, high = low - 0.5 * max(0.0, short), high + 0.5 * max(0.0, short)
    near = [x for x in limits if abs(2 * x - low - high) < 1.8 * (high - low)]
    low, high = min([low, *near]), max([high, *near])
    pad = 0.06 * (high - low)
    turning, sliding = UNITS[kind]
    unit = {"rad": turning, "m": sliding}.get(own[0][2].unit, f"{turning} or {sliding}")
    note = "; ".join(filter(None, dict.fromkeys(words)))
    return Panel(kind, name, unit, (*lines, *targets, *curves), note, (low - pad, high + pad))


def _events(track: int, kind: str, joint: JointTrack, of: Track) -> list[Stroke]:
    """Return marks in a joint's panel at the times at which causes of the verdict were first seen."""
    found = []
    for cause in of.verdict.causes:
        if cause.joint == joint.name and cause.time is not None and SEEN_IN.get(cause.kind) == kind:
            k = min(int(np.searchsorted(of.t, cause.time)), len(of.t) - 1)
            at, value = of.t[k : k + 1], getattr(joint, kind)[k : k + 1]
            found.append(Stroke(MARKS[cause.kind], track, at, value, ALARM, 0.0, mark="v", depth=6.0, joint=joint.name))
    return found


def _curve(
    label: str,
    track: int,
    t: Array,
    y: Array,
    line: LineStyle,
    width: float = CURVE,
    depth: float = 2.0,
    *,
    joint: str = "",
    kind: str = "",
) -> Stroke:
    mark = "." * (len(t) == 1)
    return Stroke(label, track, t, y, line.colour, width, line.dashes, mark, depth, joint=joint, kind=kind)


def _limits(kind: str, joint: JointTrack) -> list[float]:
    pair = (joint.low, joint.high) if kind == "q" else ()
    if kind == "tau" and joint.effort is not None:
        pair = (-joint.effort, joint.effort)
    return [limit for limit in pair if limit is not None]


def _note(limits: Sequence[float]) -> str:
    texts = [number(float(f"{limit:.3g}")) for limit in limits]
    if len(limits) == 2 and limits[1] == -limits[0]:
        return f"limits ±{texts[1]}"
    return f"limit{'s' * (len(texts) - 1)} {', '.join(texts)}" if texts else ""


def _error_panel(tracks: Sequence[Track], line_styles: LineStyles) -> Panel | None:
    """Return the distance from the target over whole decades, with the closed form; None without a target."""
    tasks = [(i, track.t, track.task) for i, track in enumerate(tracks) if track.task]
    if not tasks:
        return None
    error = np.concatenate([task.error for _, _, task in tasks])
    low = floor(log10(max(float(error.min()), SMALLEST_ERROR)))
    high = max(low + 1, ceil(log10(max(float(error.max()), SMALLEST_ERROR))))
    note = "" if error.max() >= 10.0**low else f"less than {10.0**low:g} m throughout"
    disturbances = dict.fromkeys(chain(*(task.disturbances for _, _, task in tasks)))
    name = "closed form" + (f" without {', '.join(disturbances)}" if disturbances else "")
    exact = LineStyle("\n".join(textwrap.wrap(name, 36)), PALE, ())
    strokes = [
        _curve(exact.label, i, t, task.closed_form, exact, THICK, 1.5)
        for i, t, task in tasks
        if task.closed_form is not None and task.closed_form.max() >= 10.0**low
    ]
    for i, t, task in tasks:
        settling = tracks[i].verdict.numbers.get("settling_time", inf)
        if 0.0 < settling < inf:
            k = min(int(np.searchsorted(t, settling)), len(t) - 1)
            at, dot = t[k : k + 1], task.error[k : k + 1]
            strokes.append(Stroke(SETTLED, i, at, dot, line_styles[i, ""].colour, 0.0, mark="v", depth=6.0))
        strokes.append(_curve(line_styles[i, ""].label, i, t, task.error, line_styles[i, ""], kind="error"))
    return Panel("error", "", "m", tuple(strokes), note, (10.0**low, 10.0**high))
