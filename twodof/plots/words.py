"""Text summaries of runs, for figures and the command line."""

from collections.abc import Sequence

import numpy as np

from ..files import shown
from .settings import number
from .track import Track

TOLD = {
    "x_des": "",
    "q_des": "",
    "tau_cmd": "",
    "xd_des": "0 m/s",
    "xdd_des": "0 m/s²",
    "quat_des": "",
    "omega_des": "0 rad/s",
    "alpha_des": "0 rad/s²",
    "Kp": "",
    "Kd": "",
    "Kp_rot": "",
    "Kd_rot": "",
    "Kn": "0 s⁻¹",
    "tau_ext": "0",
    "f_ext": "0 N",
    "payload": "0 kg",
    "limit_effort": "false",
    "step": "",
    "FMU": "",
}
"""Settings that a figure shows, and the default values that it omits."""


def labels(tracks: Sequence[Track]) -> list[str]:
    """Return a distinguishing label for each track: up to three settings, or else the bag's name."""
    every = list(dict.fromkeys(key for track in tracks for key in track.settings))
    differing = [key for key in every if len({track.settings.get(key) for track in tracks}) > 1]
    words = [
        ", ".join(_setting(key, track.settings[key]) for key in differing if key in track.settings) for track in tracks
    ]
    clear = 0 < len(differing) <= 3 and all(words) and len(set(words)) == len(words)
    if clear and max(map(len, words)) <= 80:
        return words
    names = [track.name for track in tracks]
    paths = [shown(track.recording.path) for track in tracks]
    return names if len({*names}) == len(names) else paths


def common_settings(tracks: Sequence[Track]) -> str:
    """Return relevant settings that all tracks share."""
    words = []
    for key, silent in TOLD.items():
        values = {track.settings.get(key, silent) for track in tracks}
        if len(values) == 1 and values != {silent}:
            words.append(_setting(key, values.pop()))
    if len(tracks) == 1 and tracks[0].motion:  # otherwise the title has it
        words.append(f"bag {tracks[0].name}")
    return ", ".join(words)


def _setting(key: str, text: str) -> str:
    if key in ("FMU", "robot"):
        return text
    return f"{key} {text}" if key == "step" or text == "varied" else f"{key} = {text}"


def outcome(track: Track) -> list[str]:
    """Return the lines of a run's verdict, and a line on its deviation from the closed form."""
    task = track.task
    if task is None or task.off is None:
        return [*track.verdict.lines]
    return [*track.verdict.lines, f"at most {task.off.max():.1g} m from the closed form"]


def difference(first: Track, other: Track) -> str:
    """Return the largest joint difference of two runs in their common time, as text; "" without common joints.

    Positions of the second run are interpolated linearly at the times of the first.
    """
    both = first.t <= other.t[-1]
    t, positions = first.t[both], {joint.name: joint.q for joint in other.joints}
    found = []
    for joint in first.joints:
        if joint.name in positions and len(t):
            with np.errstate(invalid="ignore"):  # difference of two infinities
                off = np.abs(joint.q[both] - np.interp(t, other.t, positions[joint.name]))
            if (lost := ~np.isfinite(off)).any():
                lost_at = f"{joint.name} is not finite at {number(t[lost.argmax()])} s"
                return f"cannot be compared with '{first.name}': {lost_at}"
            found.append((joint, off))
    if not found:
        return ""
    joint, off = max(found, key=lambda each: float(each[1].max()))
    size, rms = (f"{value:.3g} {joint.unit}".strip() for value in (off.max(), np.sqrt(np.mean(off**2))))
    where = f"{joint.name} at {number(t[off.argmax()])} s"
    return f"at most {size} from '{first.name}', {where}; RMS {rms}"


def summary(track: Track, first: Track | None = None) -> dict[str, str]:
    """Return the main numbers of a run by name, and its difference from the first."""
    shown = ("FMU", "step", "x_des", "quat_des", "q_des", "tau_cmd", "Kp", "Kd")
    stopped = [joint.name for joint in track.joints if joint.at_limit]
    rows = {
        "bag": track.name,
        "robot": track.motion.robot if track.motion else "",
        "end effector": track.motion.frame if track.motion else "",
        "duration": f"{number(float(track.t[-1]))} s, {track.recording.count} samples",
        **{key: track.settings[key] for key in shown if key in track.settings},
        "at a limit": ", ".join(stopped) or "no joint",
    }
    rows["verdict"] = "\n".join(outcome(track))
    if first is not None:
        rows["difference"] = difference(first, track)
    return rows
