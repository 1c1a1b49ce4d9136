"""Derived quantities of a bag and its robot: limits, path, target and error of the end effector."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import groupby
from pathlib import Path

import numpy as np

from ..bag.provenance import KNOWN_UNTIL, robot_in
from ..bag.reader import read_bags, read_downsampled
from ..bag.recording import Recording, Verdict
from ..bounds import MAX_COMPARED_SIZE, MAX_VALUE, MIB
from ..errors import BuildError, PlotError
from ..export.closed_form import Array, Held, task_error
from ..export.urdf_source import read_text
from ..files import shown
from ..plant.urdf import UNBOUNDED, RobotError
from .linkage import Linkage, Motion, load_linkage
from .settings import settings_of

AT_LIMIT = 1e-9  # tolerance relative to a limit
NOTABLE = 1e-6  # m: smaller deviations from the closed form are integration errors
MOST = 200_000  # drawn samples of a bag
MOST_HELD = 20_000  # changes of inputs in a closed form; each takes 0.1 ms


@dataclass(frozen=True)
class JointTrack:
    """One joint's coordinate over time."""

    name: str
    unit: str  # "rad" or "m"; "" if the robot is unknown
    low: float | None  # low, high: position limits of the run, or else of the URDF; None if unknown
    high: float | None
    effort: float | None  # limit of the URDF, N·m or N; None if unknown
    # q, v, tau, target: positions, velocities, efforts, and targets in effect up to each sample, N values each; unknown
    # ones are empty
    q: Array
    v: Array
    tau: Array
    target: Array
    has_friction: bool  # whether it has friction, and the velocities are true ones, which are 0 while friction holds it

    @property
    def stuck(self) -> Array:
        """Positions at samples at which friction holds the joint, NaN at other samples, N values."""
        stops = [limit for limit in (self.low, self.high) if limit is not None]
        free = np.all([np.abs(self.q - limit) > AT_LIMIT * max(1.0, abs(limit)) for limit in stops], axis=0)
        held = (self.v == 0.0) & self.has_friction & free if self.v.size else np.zeros(len(self.q), bool)
        rests = np.pad(held, 1)
        return np.where(rests[1:-1] & (rests[:-2] | rests[2:]), self.q, np.nan)

    @property
    def at_limit(self) -> bool:
        """True for a joint that was at a limit at any sample."""
        return any(
            bool((np.abs(self.q - limit) <= AT_LIMIT * max(1.0, abs(limit))).any())
            for limit in (self.low, self.high)
            if limit is not None
        )


@dataclass(frozen=True)
class Task:
    """Target and error of the controller; m task axes."""

    axes: str
    target: Array  # target position in effect up to each sample, N × m; NaN before the first target
    error: Array  # distance from the target, m, N values; NaN before the first target
    # error of the closed form; None if the gains are unknown, or if the robot has fewer joints than the task has
    # coordinates
    closed_form: Array | None
    off: Array | None  # distance of the position from the closed form, m, N values; None without a closed form
    disturbances: tuple[str, ...]  # effects that the closed form neglects


@dataclass(frozen=True)
class Track:
    """All data of a bag for drawing."""

    recording: Recording
    settings: Mapping[str, str]  # settings of the run as text by name, e.g. {"Kp": "50 s⁻²"}; empty if unknown
    t: Array  # time since the first sample, s, N values
    joints: tuple[JointTrack, ...]
    # motion, task: motion of the links, and task; None if the robot is unknown, the task also without a target
    motion: Motion | None
    task: Task | None
    linkage: Linkage | None = None  # the robot; None if unknown

    @cached_property
    def verdict(self) -> Verdict:
        """Verdict of the run; for a third-party bag, of its samples with the given robot."""
        bag, task = self.recording, self.task
        if bag.provenance or self.linkage is None or self.motion is None:
            return bag.verdict
        x = self.motion.path[:, ["xyz".index(axis) for axis in self.linkage.axes]]
        target = np.empty((len(x), 0)) if task is None else task.target
        return bag.verdict_with(self.linkage.urdf, self.linkage.frame, self.linkage.axes, x, target)

    def skeletons(self, times: Array) -> Array:
        """Return points of the arm (root, joints, end effector) at N times, s, between samples: N × points × 3."""
        assert self.linkage is not None
        q = np.column_stack([np.interp(times, self.t, joint.q) for joint in self.joints])
        names = [joint.name for joint in self.joints]
        return self.linkage.skeletons(_of_linkage(self.recording, self.linkage, names, q))

    @property
    def name(self) -> str:
        """Name of the bag, with the robot's name in a bag of several."""
        folder, robot = robot_in(self.recording.path)
        return shown("-".join([folder.resolve().name, *filter(None, robot.split("/"))]))


def read_tracks(
    bags: Sequence[Recording | str | Path],
    *,
    urdf: str | Path | None = None,
    frame: str | None = None,
    most: int = MOST,
) -> list[Track]:
    """Read bags, or the bags in folders, and compute the drawn quantities.

    A single folder with more than ``most`` samples is downsampled without a visible change of its curves. Several bags
    are read completely, to compare them sample by sample.

    Args:
        urdf: the robot of all bags; None: the robot in each bag, if any.
        frame: the end effector's link; None: as in the run that made the bag; for third-party bags the
            URDF's "EndEffector", or the deepest link.

    Raises:
        BagError: a bag cannot be read.
        PlotError: the URDF is invalid, does not fit the bag, or there are no positions.
    """
    try:
        text = None if urdf is None else read_text(Path(urdf), None)
    except BuildError as error:
        raise PlotError(str(error)) from error
    track = partial(_track, urdf=text, source=str(urdf), frame=frame)
    if len(bags) == 1 and not isinstance(bags[0], Recording):
        return [track(read_downsampled(bags[0], most, lambda part: _lines(track(part))))]
    recordings, size = list[Recording](), 0
    for _, group in groupby(bags, key=lambda bag: id(bag) if isinstance(bag, Recording) else robot_in(Path(bag))[0]):
        given = [*group]
        paths = [bag for bag in given if not isinstance(bag, Recording)]
        recordings += read_bags(paths) if paths else [bag for bag in given if isinstance(bag, Recording)]
        size += sum(3 * bag.q.nbytes for bag in recordings[-len(paths) :]) if paths else 0
        if size > MAX_COMPARED_SIZE:
            raise PlotError(
                f"the bags have more than {MAX_COMPARED_SIZE // MIB} MiB of joint states; plot fewer of them"
            )
    return [track(recording) for recording in recordings]


def _lines(track: Track) -> list[Array]:
    """Return the curves over time other than positions and velocities, N values each."""
    lines = [joint.tau for joint in track.joints if joint.tau.size]
    if track.motion is not None:
        lines += [*track.motion.path.T]
    if track.task is not None:
        errors = (track.task.error, track.task.closed_form, track.task.off)
        lines += [line for line in errors if line is not None]
    return lines


def _track(bag: Recording, urdf: str | None, source: str, frame: str | None) -> Track:
    names = bag.joints
    if urdf is None:
        urdf, source = bag.provenance.get("urdf"), f"the URDF in '{bag.path}'"
    try:
        return _with_robot(bag, names, urdf, source, frame)
    except (KeyError, ValueError, ArithmeticError) as error:
        if not bag.provenance:
            raise
        raise PlotError(f"the run.json in '{bag.path}' does not fit its samples") from error


def _with_robot(bag: Recording, names: Sequence[str], urdf: str | None, source: str, frame: str | None) -> Track:
    run, settings = bag.provenance, settings_of(bag)
    drawn = replace(bag, q=_drawable(bag.q), v=_drawable(bag.v), tau=_drawable(bag.tau))
    if urdf is None:
        return Track(bag, settings, bag.t, _joints(drawn, names, None), None, None)
    try:
        at = run.get("frame", "") if frame is None else frame
        linkage = load_linkage(urdf, at, run.get("axes") or "xyz", names)
    except RobotError as error:
        raise PlotError(f"{source}: {error}") from error
    joints, q = _joints(drawn, names, linkage), _of_linkage(bag, linkage, names, drawn.q)
    motion, task = linkage.motion(q), None
    rooted = run or (bag.received is not None and bag.received.frame == linkage.urdf.root)
    known = bag.target.size and not np.isnan(bag.target[-1]).any()
    if rooted and known and run.get("frame", linkage.frame) == linkage.frame:
        v = _of_linkage(bag, linkage, names, drawn.v)
        task = _task(bag, linkage, joints, q, v[0], motion.path)
    return Track(bag, settings, bag.t, joints, motion, task, linkage)


def _drawable(values: Array) -> Array:
    """Return values with NaN, a gap, in place of numbers too large for the arithmetic of axes."""
    return np.where(np.isfinite(values) & (np.abs(values) > MAX_VALUE), np.nan, values)


def _joints(bag: Recording, names: Sequence[str], linkage: Linkage | None) -> tuple[JointTrack, ...]:
    n, starts = len(names), bag.provenance.get("start_values", {})
    first = bag.schedule[0][1]
    efforts, targets = bag.tau, bag.held("q_des", n)
    if not efforts.size and f"tau_cmd[{n}]" in first:  # commanded efforts of a bare plant
        efforts = bag.held("tau_cmd", n)
    joints = []
    for i, name in enumerate(names):
        unit = ""
        limits = [starts.get(f"q_min[{i + 1}]"), starts.get(f"q_max[{i + 1}]"), None]
        if linkage is not None and name in linkage.urdf.joints:
            joint = linkage.urdf.joints[name]
            unit = "m" if joint.prismatic else "rad"
            own = (joint.low, joint.high, joint.effort)
            limits = [b if a is None else a for a, b in zip(limits, own)]
        low, high, effort = (None if x is None or abs(x) >= UNBOUNDED else x for x in limits)
        q, v, tau, target = (
            values[:, i] if values.shape == bag.q.shape else np.empty(0) for values in (bag.q, bag.v, efforts, targets)
        )
        if effort is not None and first.get("limit_effort"):  # commands may exceed it; a bag's efforts do not
            tau = np.clip(tau, -effort, effort)
        has_friction = bool(first.get(f"friction[{i + 1}]")) and not bag.measured
        joints.append(JointTrack(name, unit, low, high, effort, q, v, tau, target, has_friction))
    return tuple(joints)


def _of_linkage(bag: Recording, linkage: Linkage, names: Sequence[str], values: Array) -> Array:
    """Return the columns of q or v for the linkage's joints; joints that do not move the frame have 0."""
    ordered = np.zeros((len(values), len(linkage.moving)))
    needed = {j.name if j.name in names else j.leader for j in linkage.chain}
    for j, joint in enumerate(linkage.moving):
        if joint.name in names:
            if values.shape[1:] == bag.q.shape[1:]:
                ordered[:, j] = values[:, names.index(joint.name)]
        elif joint.name in needed:
            raise PlotError(
                f"'{bag.path}' has no joint '{joint.name}', which the robot '{linkage.urdf.name}'"
                f" needs to move '{linkage.frame}'; its joints are: {', '.join(names)}"
            )
    return ordered


# --- the task ---


def _task(bag: Recording, linkage: Linkage, joints: Sequence[JointTrack], q: Array, v0: Array, path: Array) -> Task:
    axes = ["xyz".index(axis) for axis in linkage.axes]
    x, target = path[:, axes], bag.target

    def vector(values: Mapping[str, float | bool], group: str) -> tuple[float, ...]:
        return tuple(float(values[f"{group}[{i + 1}]"]) for i in range(len(axes)))

    with np.errstate(over="ignore", invalid="ignore"):
        error = np.linalg.norm(x - target, axis=1)
        if not np.isfinite(x).all() or np.isinf(error).any():
            raise ValueError("positions or targets are too large to draw")
        first = bag.schedule[0][1]
        turns = "quat_des[1]" in first
        inputs_known = bag.provenance and KNOWN_UNTIL not in bag.provenance
        dof = {joint.leader for joint in linkage.chain}
        followed = len(axes) + 3 * turns <= len(dof)  # all task rows can be followed exactly
        few = len(bag.schedule) <= MOST_HELD
        sizes = range(len(axes) if "system" in bag.provenance else 1)  # another FMU may give elements
        whole = all(f"{g}[{i + 1}]" in first for g in Held._fields for i in sizes)
        if not (inputs_known and followed and few and whole):
            return Task(linkage.axes, target, error, None, None, ())
        held = [(k, Held(*(vector(v, g) for g in Held._fields))) for k, v in bag.schedule]
        xd0 = (linkage.kinematics.jacobian(linkage.frame, q[:1])[0] @ v0)[axes]
        e = task_error(x[0], xd0, held, bag.provenance["step"], bag.steps)
        off = np.linalg.norm(x - target - e, axis=1)

    def recorded(group: str) -> list[float]:
        return [float(value) for name, value in first.items() if name.startswith(f"{group}[")]

    loads = [values for _, values in ((0, first), *bag.changes)]
    astray = bool(off.max() > NOTABLE)
    at_work = {
        "sampling": bool(first.get("control_period")),
        "joint limits": any(joint.at_limit for joint in joints),
        "effort limits": bool(first.get("limit_effort")),
        "singularities": astray and linkage.is_singular(q, float(first.get("rcond", 0.0)), turns),
        "damping": any(recorded("damping") or (j.damping for j in linkage.urdf.joints.values() if j.moves)),
        "friction": any(recorded("friction")),
        "unknown payload": bool(first.get("payload")) and not first.get("payload_known"),
        "external torque": any(values[n] for values in loads for n in values if n.startswith(("tau_ext[", "f_ext["))),
    }
    disturbances = tuple(name for name, present in at_work.items() if present)
    return Task(linkage.axes, target, error, np.linalg.norm(e, axis=1), off, disturbances)
