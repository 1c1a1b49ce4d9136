"""What a bag and its robot say about a run: limits, the end effector's path, target and error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..bag.provenance import KNOWN_UNTIL, robot_in
from ..bag.reader import read_bag, read_outline
from ..bag.recording import Recording, Schedule
from ..errors import BuildError, PlotError
from ..export.urdf_source import read_text
from ..files import shown
from ..plant.urdf import UNBOUNDED, RobotError
from .closed_form import Array, Held, task_error
from .robot import Motion, Robot, is_singular, load_robot, motion_of

AT_LIMIT = 1e-9  # of a limit's size
NOTABLE = 1e-6  # m off the closed form: what is less is the integrator's
MOST = 200_000  # samples of a bag that are drawn
UNITS = {
    "x_des": "m", "xd_des": "m/s", "xdd_des": "m/s²", "Kp": "s⁻²", "Kd": "s⁻¹", "Kn": "s⁻¹",
    "omega_des": "rad/s", "alpha_des": "rad/s²", "Kp_rot": "s⁻²", "Kd_rot": "s⁻¹",
    "gravity": "m/s²", "max_step": "s", "payload": "kg", "payload_com": "m", "f_ext": "N",
}  # fmt: skip
"""Units of variables, where they do not depend on the joint."""


@dataclass(frozen=True)
class JointTrack:
    """One joint's coordinate over time.

    Attributes:
        name: the joint's name.
        unit: "rad" or "m"; "" where no robot tells which.
        low, high: limits of the run, or else of the URDF; None where there is none or it is not
            known.
        effort: limit of the URDF, N·m or N; None likewise.
        q, v, tau: positions, velocities and efforts, N values each; v and tau are empty where they
            are not known.
    """

    name: str
    unit: str
    low: float | None
    high: float | None
    effort: float | None
    q: Array
    v: Array
    tau: Array

    @property
    def at_limit(self) -> bool:
        """Whether it has been at one of its limits."""
        return any(
            bool((np.abs(self.q - limit) <= AT_LIMIT * max(1.0, abs(limit))).any())
            for limit in (self.low, self.high)
            if limit is not None
        )


@dataclass(frozen=True)
class Task:
    """What the controller was told and how well it did; m task axes.

    Attributes:
        axes: the task axes, of "xyz".
        target: position in effect up to each sample, N × m; not a number where none was known yet.
        error: distance from the target, m, N values; likewise.
        closed_form: the same for the closed form; None where the gains are not known.
        off: distance between the two positions, m, N values; None likewise.
        disturbances: what was at work that the closed form does not have.
    """

    axes: str
    target: Array
    error: Array
    closed_form: Array | None
    off: Array | None
    disturbances: tuple[str, ...]

    @property
    def departure(self) -> float | None:
        """The most that it is off the closed form, m."""
        return None if self.off is None else float(self.off.max())


@dataclass(frozen=True)
class Track:
    """All that is drawn of one bag.

    Attributes:
        recording: the bag.
        settings: how it was made, as text by name, e.g. {"Kp": "50 s⁻²"}; empty if unknown.
        t: time since the first sample, s, N values.
        joints: in the bag's order.
        motion: None where the robot is not known.
        task: None where the target or the robot is not known.
    """

    recording: Recording
    settings: Mapping[str, str]
    t: Array
    joints: tuple[JointTrack, ...]
    motion: Motion | None
    task: Task | None

    @property
    def name(self) -> str:
        """The bag's name, with that of one of its robots."""
        folder, robot = robot_in(self.recording.path)
        return shown("-".join([folder.resolve().name, *filter(None, robot.split("/"))]))


def read_tracks(
    bags: Sequence[Recording | str | Path],
    *,
    urdf: str | Path | None = None,
    frame: str | None = None,
    most: int = MOST,
) -> list[Track]:
    """Read bags and compute what there is to draw.

    Of a bag alone, given by its folder, that has more than ``most`` samples, those are read with
    which all lines over time look as with all samples; several are compared sample by sample.

    Args:
        bags: bags, or their folders.
        urdf: the robot of all of them; None: the one that each bag carries, if any.
        frame: the end effector's link; None: as in the run that made the bag, and for bags from
            elsewhere the URDF's "EndEffector", or the link behind most joints.
        most: samples.

    Raises:
        BagError: a bag cannot be read.
        PlotError: the URDF is at fault, does not fit the bag, or there are no positions.
    """
    text = None if urdf is None else _read_urdf(Path(urdf))

    def track(bag: Recording) -> Track:
        return _track(bag, text, str(urdf), frame)

    if len(bags) == 1 and not isinstance(bags[0], Recording):
        return [track(read_outline(bags[0], most, lambda part: _lines(track(part))))]
    return [track(bag if isinstance(bag, Recording) else read_bag(bag)) for bag in bags]


def _lines(track: Track) -> list[Array]:
    """What is drawn over time beside positions and velocities, N values each."""
    lines = [joint.tau for joint in track.joints if joint.tau.size]
    if track.motion is not None:
        lines += [*track.motion.path.T]
    if track.task is not None:
        found = (track.task.error, track.task.closed_form, track.task.off)
        lines += [line for line in found if line is not None]
    return lines


def _read_urdf(path: Path) -> str:
    try:
        return read_text(path, None)
    except BuildError as error:
        raise PlotError(str(error)) from error


def _track(bag: Recording, urdf: str | None, source: str, frame: str | None) -> Track:
    names = bag.joints or tuple(f"joint {i + 1}" for i in range(bag.q.shape[1]))
    if not bag.q.size or bag.q.shape[1] != len(names):
        raise PlotError(f"'{bag.path}' has {bag.q.shape[1]} positions for {len(names)} joints")
    if urdf is None:
        urdf, source = bag.provenance.get("urdf"), f"the URDF in '{bag.path}'"
    try:
        return _with_robot(bag, names, urdf, source, frame)
    except (KeyError, ValueError, ArithmeticError) as error:
        if not bag.provenance:
            raise
        raise PlotError(f"the run.json in '{bag.path}' does not fit its samples") from error


def _with_robot(
    bag: Recording, names: Sequence[str], urdf: str | None, source: str, frame: str | None
) -> Track:
    run = bag.provenance
    robot = None
    if urdf is not None:
        try:
            at = run.get("frame", "") if frame is None else frame
            robot = load_robot(urdf, at, run.get("axes") or "xyz", names)
        except RobotError as error:
            raise PlotError(f"{source}: {error}") from error
    joints = _joints(bag, names, robot)
    motion = task = None
    if robot is not None:
        q = _in_robot_order(bag, robot, names, bag.q)
        motion = motion_of(robot, q)
        if run.get("frame", robot.frame) == robot.frame and _has_target(bag, robot):
            v = _in_robot_order(bag, robot, names, bag.v)
            task = _task(bag, robot, joints, q, v[0], motion.path)
    return Track(bag, _settings(bag), bag.t, joints, motion, task)


def _joints(bag: Recording, names: Sequence[str], robot: Robot | None) -> tuple[JointTrack, ...]:
    starts = bag.provenance.get("start_values", {})
    joints = []
    efforts = _efforts(bag)
    limited = bool(bag.provenance) and bool(bag.schedule[0][1].get("limit_effort"))
    for i, name in enumerate(names):
        unit, effort = "", None
        low, high = starts.get(f"q_min[{i + 1}]"), starts.get(f"q_max[{i + 1}]")
        if robot is not None and name in robot.urdf.joints:
            joint = robot.urdf.joints[name]
            unit = "m" if joint.prismatic else "rad"
            low = joint.low if low is None else low
            high = joint.high if high is None else high
            effort = joint.effort if joint.effort < UNBOUNDED else None
        low = None if low is None or low <= -UNBOUNDED else low
        high = None if high is None or high >= UNBOUNDED else high
        v = bag.v[:, i] if bag.v.shape == bag.q.shape else np.empty(0)
        tau = efforts[:, i] if efforts.shape == bag.q.shape else np.empty(0)
        if limited and effort is not None:  # of commands; efforts in a bag are within it
            tau = np.clip(tau, -effort, effort)
        joints.append(JointTrack(name, unit, low, high, effort, bag.q[:, i], v, tau))
    return tuple(joints)


def _efforts(bag: Recording) -> Array:
    """Those of the bag; of a bare plant, what it was told to apply, N × n; N × 0 where unknown."""
    n = len(bag.joints)
    if bag.tau.size or not bag.provenance or f"tau_cmd[{n}]" not in bag.schedule[0][1]:
        return bag.tau
    return bag.held("tau_cmd", n)


def _in_robot_order(bag: Recording, robot: Robot, names: Sequence[str], values: Array) -> Array:
    """Columns of a bag's q or v for the robot's joints; 0 for those that do not move the frame.

    Raises:
        PlotError: a joint that moves the frame is not in the bag.
    """
    ordered = np.zeros((len(values), len(robot.moving)))
    needed = {j.name if j.name in names else j.leader for j in robot.chain}
    for j, joint in enumerate(robot.moving):
        if joint.name in names:
            if values.shape == bag.q.shape:
                ordered[:, j] = values[:, names.index(joint.name)]
        elif joint.name in needed:
            raise PlotError(
                f"'{bag.path}' has no joint '{joint.name}', which the robot '{robot.urdf.name}'"
                f" needs to move '{robot.frame}'; its joints are: {', '.join(names)}"
            )
    return ordered


# --- the task ---


def _has_target(bag: Recording, robot: Robot) -> bool:
    """Whether the target is known, at the end at least, in the robot's root frame."""
    if not bag.target.size or np.isnan(bag.target[-1]).any():
        return False
    return bool(bag.provenance) or (bag.heard is not None and bag.heard.frame == robot.urdf.root)


def _task(
    bag: Recording, robot: Robot, joints: Sequence[JointTrack], q: Array, v0: Array, path: Array
) -> Task:
    axes = ["xyz".index(axis) for axis in robot.axes]
    x, target = path[:, axes], bag.target

    def vector(values: Mapping[str, Any], group: str) -> tuple[float, ...]:
        return tuple(float(values[f"{group}[{i + 1}]"]) for i in range(len(axes)))

    closed_form = off = None
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.linalg.norm(x - target, axis=1)
        if not np.isfinite(x).all() or np.isinf(error).any():
            raise ValueError("positions or targets are beyond all bounds")
        inputs_known = bag.provenance and KNOWN_UNTIL not in bag.provenance
        if inputs_known and all(f"{g}[1]" in bag.schedule[0][1] for g in Held._fields):
            held = [(k, Held(*(vector(v, g) for g in Held._fields))) for k, v in bag.schedule]
            xd0 = (robot.kinematics.jacobian(robot.frame, q[:1])[0] @ v0)[axes]
            e = task_error(x[0], xd0, held, bag.provenance["step"], bag.steps)
            closed_form = np.linalg.norm(e, axis=1)
            off = np.linalg.norm(x - target - e, axis=1)
    astray = off is not None and bool(off.max() > NOTABLE)
    disturbances = _disturbances(bag.schedule, robot, joints, q, astray)
    return Task(robot.axes, target, error, closed_form, off, disturbances)


def _disturbances(
    schedule: Schedule, robot: Robot, joints: Sequence[JointTrack], q: Array, astray: bool
) -> tuple[str, ...]:
    """What moves, brakes or stops the arm and is not in the closed form, which it is off or not."""
    first = schedule[0][1]
    external = [name for name in first if name.startswith(("tau_ext[", "f_ext["))]
    at_work = {
        "joint limits": any(joint.at_limit for joint in joints),
        "effort limits": bool(first.get("limit_effort")),
        "singularities": astray
        and is_singular(robot, q, float(first.get("rcond", 0.0)), "quat_des[1]" in first),
        "damping": any(joint.damping for joint in robot.urdf.joints.values() if joint.moves),
        "unknown payload": bool(first.get("payload")) and not first.get("payload_known"),
        "external torque": any(values[name] for _, values in schedule for name in external),
    }
    return tuple(name for name, present in at_work.items() if present)


def _settings(bag: Recording) -> dict[str, str]:
    """What the run was told, vectors and scalars by group."""
    run = bag.provenance
    if not run:
        return {}
    step = f"{1e3 * run['step']:g} ms"
    settings = {"FMU": run["fmu"]["file"], "robot": run["robot"], "step": step}
    (_, first), *later = bag.schedule
    given = {name for _, values in run["input_changes"] for name in values}
    varied = {_group(n) for n in given if any(values[n] != first[n] for _, values in later)}
    groups: dict[str, list[Any]] = {}
    for name, value in first.items():
        groups.setdefault(_group(name), []).append(value)
    for group, values in groups.items():
        unit = f" {UNITS[group]}" if group in UNITS else ""
        settings[group] = "varied" if group in varied else _text(values) + unit
    return settings


def _group(name: str) -> str:
    return name.partition("[")[0]


def _text(values: Sequence[Any]) -> str:
    """One value where all are equal, as gains often are, else all of them."""
    texts = [str(v).lower() if isinstance(v, bool) else number(v) for v in values]
    return texts[0] if len(set(texts)) == 1 else f"({', '.join(texts)})"


def number(value: float) -> str:
    """Six digits, with the minus sign of typography; the largest double means none."""
    if abs(value) >= UNBOUNDED:
        return "none"
    return f"{value + 0.0:.6g}".replace("-", "\N{MINUS SIGN}")  # + 0.0: no negative zero
