"""What is told of tracks in words and numbers: beside figures, and on the command line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..files import shown
from .settings import number
from .track import Track

TOLD = {
    "x_des": "", "q_des": "", "tau_cmd": "", "xd_des": "0 m/s", "xdd_des": "0 m/s²",
    "quat_des": "", "omega_des": "0 rad/s", "alpha_des": "0 rad/s²",
    "Kp": "", "Kd": "", "Kp_rot": "", "Kd_rot": "", "Kn": "0 s⁻¹",
    "tau_ext": "0", "f_ext": "0 N", "payload": "0 kg", "limit_effort": "false", "step": "",
    "FMU": "",
}  # fmt: skip
"""Settings that a figure tells, and the values that go without saying."""


def labels(tracks: Sequence[Track]) -> list[str]:
    """What tells each track from the others: up to three settings, or else the bag's name."""
    every = list(dict.fromkeys(key for track in tracks for key in track.settings))
    differing = [key for key in every if len({track.settings.get(key) for track in tracks}) > 1]
    words = [
        ", ".join(_setting(key, track.settings[key]) for key in differing if key in track.settings)
        for track in tracks
    ]
    clear = 0 < len(differing) <= 3 and all(words) and len(set(words)) == len(words)
    if clear and max(map(len, words)) <= 80:
        return words
    names = [track.name for track in tracks]
    if len(set(names)) < len(names):
        return [shown(track.recording.path) for track in tracks]
    return names


def common_settings(tracks: Sequence[Track]) -> str:
    """What tracks have in common and a reader wants to know."""
    words = []
    for key, silent in TOLD.items():
        values = {track.settings.get(key, silent) for track in tracks}
        if len(values) == 1 and values != {silent}:
            words.append(_setting(key, values.pop()))
    if len(tracks) == 1 and tracks[0].motion:  # else it is the title
        words.append(f"bag {tracks[0].name}")
    return ", ".join(words)


def _setting(key: str, text: str) -> str:
    if key in ("FMU", "robot"):
        return text
    return f"{key} {text}" if key == "step" or text == "varied" else f"{key} = {text}"


def outcome(track: Track) -> str:
    """How near the end effector came to its target and to the closed form; "" if not known."""
    if track.task is None:
        return ""
    text = f"{track.task.error[-1]:.3g} m from its target at the end"
    if track.task.departure is not None:
        text += f"; at most {track.task.departure:.1g} m off the closed form"
    return text


def difference(first: Track, other: Track) -> str:
    """How far the joints of a run are from those of another, while both last; "" if none is theirs.

    Positions of the other are interpolated linearly to the times of the first.
    """
    both = first.t <= other.t[-1]
    places = {joint.name: joint.q for joint in other.joints}
    worst = ""
    most = -1.0
    for joint in first.joints:
        if joint.name in places and both.any():
            with np.errstate(invalid="ignore"):  # of two infinities
                off = np.abs(joint.q[both] - np.interp(first.t[both], other.t, places[joint.name]))
            lost = ~np.isfinite(off)
            if lost.any():
                at = float(first.t[both][lost.argmax()])
                lost_at = f"{joint.name} is not finite at {number(at)} s"
                return f"cannot be told from '{first.name}': {lost_at}"
            if off.max() > most:
                most, at = float(off.max()), float(first.t[both][off.argmax()])
                spread = float(np.sqrt(np.mean(off**2)))
                where = f"at most, {joint.name} at {number(at)} s; RMS {spread:.3g}"
                size = f"{most:.3g} {joint.unit}".strip()
                worst = f"{size} off '{first.name}' {where}"
    return worst


def summary(track: Track, first: Track | None = None) -> dict[str, str]:
    """The main numbers of a run in words, by what they are; and how far it is off the first."""
    settings = {
        key: track.settings[key]
        for key in ("FMU", "step", "x_des", "quat_des", "q_des", "tau_cmd", "Kp", "Kd")
        if key in track.settings
    }
    stopped = [joint.name for joint in track.joints if joint.at_limit]
    rows = {
        "bag": track.name,
        "robot": track.motion.robot if track.motion else "",
        "end effector": track.motion.frame if track.motion else "",
        "duration": f"{number(float(track.t[-1]))} s, {track.recording.count} samples",
        **settings,
        "at a limit": ", ".join(stopped) or "no joint",
    }
    if track.task:
        rows["result"] = outcome(track)
    if first is not None:
        rows["difference"] = difference(first, track)
    return rows
