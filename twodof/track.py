"""What a bag and its robot say about a run: limits, the end effector's path, target and error."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import ChainMap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from math import ceil, inf, isfinite
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from .bag import Run, read_bag
from .closed_form import Held, task_error
from .errors import PlotError
from .files import read_file, shown
from .plant import UNBOUNDED, Robot, RobotError, load_robot

Array = NDArray[np.float64]
Schedule = list[tuple[int, Mapping[str, Any]]]
"""Communication points, ascending from 0, and values of inputs and parameters from each on."""

DEFAULT_FRAME = "EndEffector"
TIME_TOLERANCE = 1e-9  # as the master's, of a communication step
AT_LIMIT = 1e-9  # of a limit's size
NOTABLE = 1e-6  # m off the closed form: what is less is the integrator's
LOOKS = 2000  # for singularities, along the way
MAX_URDF = 8 * 1024**2
MOST_LOST = 10  # times as many samples as there are
UNITS = {
    "x_des": "m", "xd_des": "m/s", "xdd_des": "m/s²", "Kp": "s⁻²", "Kd": "s⁻¹", "Kn": "s⁻¹",
    "gravity": "m/s²", "max_step": "s",
}  # fmt: skip
"""Units of variables, where they do not depend on the joint."""
TOLD = {
    "x_des": "", "xd_des": "0 m/s", "xdd_des": "0 m/s²", "Kp": "", "Kd": "", "Kn": "0 s⁻¹",
    "tau_ext": "0", "limit_effort": "false", "step": "", "FMU": "",
}  # fmt: skip
"""Settings that a figure tells, and the values that go without saying."""


@dataclass(frozen=True)
class Joint:
    """One joint's coordinate over time.

    Attributes:
        name: the joint's name.
        unit: "rad" or "m"; "" where no robot tells which.
        low, high: limits of the run, or else of the URDF; None where there is none or it is not
            known.
        q, v: positions and velocities, N values each; v is empty where the bag has none.
    """

    name: str
    unit: str
    low: float | None
    high: float | None
    q: Array
    v: Array

    @property
    def at_limit(self) -> bool:
        """Whether it has been at one of its limits."""
        found = [limit for limit in (self.low, self.high) if limit is not None]
        return any(
            bool((np.abs(self.q - limit) <= AT_LIMIT * max(1.0, abs(limit))).any())
            for limit in found
        )


@dataclass(frozen=True)
class Reach:
    """The circle that a planar arm cannot leave: centre (3 values) and radius, m, and its normal.

    ``normal`` is 0, 1 or 2 for the root's x, y or z.
    """

    centre: Array
    radius: float
    normal: int


@dataclass(frozen=True)
class Motion:
    """What the robot's geometry makes of the joints' motion; points in the root frame, m.

    Attributes:
        robot: the robot's name.
        frame, root: the end effector's link, and the link that points are expressed in.
        path: the end effector's, N × 3.
        start, end: the arm at the first and the last sample: root, joints and end effector, × 3.
        reach: None where the arm does not move in a plane of two of the root's axes.
    """

    robot: str
    frame: str
    root: str
    path: Array
    start: Array
    end: Array
    reach: Reach | None


@dataclass(frozen=True)
class Task:
    """What the controller was told and how well it did; m task axes.

    Attributes:
        axes: the task axes, of "xyz".
        target: position in effect up to each sample, N × m.
        error: distance from the target, m, N values.
        closed_form: the same for the closed form; None where the gains are not known.
        departure: the largest distance between the two positions, m; None likewise.
        disturbances: what was at work that the closed form does not have.
    """

    axes: str
    target: Array
    error: Array
    closed_form: Array | None
    departure: float | None
    disturbances: tuple[str, ...]


@dataclass(frozen=True)
class Track:
    """All that is drawn of one bag.

    Attributes:
        run: the bag.
        settings: how it was made, as text by name, e.g. {"Kp": "50 s⁻²"}; empty if unknown.
        t: time since the first sample, s, N values.
        joints: in the bag's order.
        motion: None where the robot is not known.
        task: None where the target or the robot is not known.
    """

    run: Run
    settings: Mapping[str, str]
    t: Array
    joints: tuple[Joint, ...]
    motion: Motion | None
    task: Task | None

    @property
    def name(self) -> str:
        """The bag's name."""
        return shown(self.run.path.resolve().name)


def read_tracks(
    bags: Sequence[Run | str | Path],
    *,
    urdf: str | Path | None = None,
    frame: str | None = None,
) -> list[Track]:
    """Read bags and compute what there is to draw.

    Args:
        bags: bags, or their folders.
        urdf: the robot of all of them; None: the one that each bag carries, if any.
        frame: the end effector's link; None: as in the run that made the bag, and for bags from
            elsewhere the URDF's "EndEffector", or the link behind most joints.

    Raises:
        BagError: a bag cannot be read.
        PlotError: the URDF is at fault, does not fit the bag, or there are no positions.
    """
    text = None if urdf is None else _read_urdf(Path(urdf))
    runs = [bag if isinstance(bag, Run) else read_bag(bag) for bag in bags]
    return [_track(run, text, str(urdf), frame) for run in runs]


def _read_urdf(path: Path) -> str:
    try:
        return read_file(path, MAX_URDF).decode("utf-8")
    except OSError as error:
        raise PlotError(f"cannot read the URDF '{path}': {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise PlotError(f"the URDF '{path}' is not UTF-8 text") from error


def _track(run: Run, urdf: str | None, source: str, frame: str | None) -> Track:
    names = run.joints or tuple(f"joint {i + 1}" for i in range(run.q.shape[1]))
    if not run.q.size or run.q.shape[1] != len(names):
        raise PlotError(f"'{run.path}' has {run.q.shape[1]} positions for {len(names)} joints")
    if urdf is None:
        urdf, source = run.provenance.get("urdf"), f"the URDF in '{run.path}'"
    try:
        return _with_robot(run, names, urdf, source, frame)
    except (KeyError, ValueError, ArithmeticError) as error:
        if not run.provenance:
            raise
        raise PlotError(f"the run.json in '{run.path}' does not fit its samples") from error


def _with_robot(
    run: Run, names: Sequence[str], urdf: str | None, source: str, frame: str | None
) -> Track:
    made = run.provenance
    schedule = _schedule(run)
    robot = None
    if urdf is not None:
        try:
            robot = _load(urdf, frame or made.get("frame") or "", made.get("axes") or "xyz")
        except RobotError as error:
            raise PlotError(f"{source}: {error}") from error
    joints = _joints(run, names, robot)
    motion = task = None
    if robot is not None:
        q = _in_robot_order(run, robot, names, run.q)
        motion = _motion(robot, q)
        if "x_des[1]" in schedule[0][1] and made.get("axes") and made["frame"] == robot.frame:
            v = _in_robot_order(run, robot, names, run.v)
            task = _task(run, robot, q, v[0], motion.path, schedule)
            disturbances = _disturbances(robot, q, joints, task, schedule)
            task = replace(task, disturbances=disturbances)
    return Track(run, _settings(run, schedule), run.t, joints, motion, task)


# --- the robot ---


def _load(urdf: str, frame: str, axes: str) -> Robot:
    """The robot, of which the picture needs geometry, limits and damping alone.

    So masses are all made alike and mimic joints move on their own, as they do in a bag; a URDF
    is not refused for them.
    """
    try:
        if "<!DOCTYPE" in urdf:
            raise ValueError
        tree = ET.fromstring(urdf)
    except (ET.ParseError, ValueError):
        return load_robot(urdf, frame, axes)  # which says what is wrong
    for link in tree.findall("link"):
        for part in list(link):
            link.remove(part)
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "mass", value="1")
        ET.SubElement(inertial, "inertia", ixx="1", iyy="1", izz="1", ixy="0", ixz="0", iyz="0")
    for joint in tree.findall("joint"):
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
    text = ET.tostring(tree, encoding="unicode")
    links = [link.get("name", "") for link in tree.findall("link")]
    if frame or DEFAULT_FRAME in links:
        return load_robot(text, frame or DEFAULT_FRAME, axes)
    moved = [
        child.get("link", "")
        for joint in tree.findall("joint")
        if joint.get("type") != "fixed" and (child := joint.find("child")) is not None
    ]
    robot = load_robot(text, moved[0] if moved else "", axes)
    bodies = {i: f for i, f in enumerate(robot.model.frames) if f.type == pin.FrameType.BODY}
    last = max(bodies, key=lambda i: (len(robot.model.supports[bodies[i].parentJoint]), i))
    return replace(robot, frame=bodies[last].name, frame_id=last)


def _joints(run: Run, names: Sequence[str], robot: Robot | None) -> tuple[Joint, ...]:
    starts = run.provenance.get("start_values", {})
    joints = []
    for i, name in enumerate(names):
        unit = ""
        low, high = starts.get(f"q_min[{i + 1}]"), starts.get(f"q_max[{i + 1}]")
        if robot is not None and name in robot.joints:
            j = robot.joints.index(name)
            unit = "m" if robot.prismatic[j] else "rad"
            low = robot.q_min[j] if low is None else low
            high = robot.q_max[j] if high is None else high
        joints.append(
            Joint(
                name,
                unit,
                None if low is None or low <= -UNBOUNDED else low,
                None if high is None or high >= UNBOUNDED else high,
                run.q[:, i],
                run.v[:, i] if run.v.shape == run.q.shape else np.empty(0),
            )
        )
    return tuple(joints)


def _in_robot_order(run: Run, robot: Robot, names: Sequence[str], values: Array) -> Array:
    """Columns of a bag's q or v for the robot's joints; 0 for those that do not move the frame.

    Raises:
        PlotError: a joint that moves the frame is not in the bag.
    """
    ordered = np.zeros((len(values), len(robot.joints)))
    for j, (name, needed) in enumerate(zip(robot.joints, robot.moves_frame())):
        if name in names:
            if values.shape == run.q.shape:
                ordered[:, j] = values[:, names.index(name)]
        elif needed:
            raise PlotError(
                f"'{run.path}' has no joint '{name}', which the robot '{robot.name}' needs to"
                f" move '{robot.frame}'; its joints are: {', '.join(names)}"
            )
    return ordered


def _motion(robot: Robot, q: Array) -> Motion:
    return Motion(
        robot=robot.name,
        frame=robot.frame,
        root=robot.root,
        path=_path(robot, q),
        start=_skeleton(robot, q[0]),
        end=_skeleton(robot, q[-1]),
        reach=_reach(robot),
    )


def _path(robot: Robot, q: Array) -> Array:
    """Positions of the frame in the root frame, N × 3, m; q is N × joints.

    For all samples at once, as a call of Pinocchio for each takes ten times as long. A joint turns
    a point p about its axis a by Rodrigues' formula, p + sin(q) a × p + (1 - cos(q)) a × (a × p).
    """
    model = robot.model
    path = np.tile(model.frames[robot.frame_id].placement.translation, (len(q), 1))
    for i in reversed(_chain(robot)[1:]):
        joint, placement = model.joints[i], model.jointPlacements[i]
        slide, axis = np.reshape(joint.createData().S, (2, 3))
        across, moved = pin.skew(axis).T, q[:, joint.idx_q, None]
        turned = path @ across
        path += np.sin(moved) * turned + (1.0 - np.cos(moved)) * (turned @ across) + moved * slide
        path = path @ placement.rotation.T + placement.translation
    return path


def _chain(robot: Robot) -> list[int]:
    """Pinocchio's indices of the root, 0, and of the joints that move the frame."""
    return list(robot.model.supports[robot.model.frames[robot.frame_id].parentJoint])


def _skeleton(robot: Robot, q: Array) -> Array:
    """Origins of the root, of the joints that move the frame, and of the frame; × 3."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    points = [data.oMi[i].translation for i in _chain(robot)]
    return np.array([*points, data.oMf[robot.frame_id].translation])


def _velocity(robot: Robot, q: Array, v: Array) -> Array:
    """Velocity of the frame in the root frame, m/s, 3 values."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q, v)
    aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    velocity: Array = pin.getFrameVelocity(robot.model, data, robot.frame_id, aligned).linear
    return velocity


def _reach(robot: Robot) -> Reach | None:
    """The circle, where all joints turn about one of the root's axes.

    Distances between neighbouring joints do not change, so no point is farther than their sum; in
    a plane the stretched arm is that long. For arms in space the sum would be too large.
    """
    model, joints = robot.model, _chain(robot)[1:]
    data = model.createData()
    pin.computeJointJacobians(model, data, np.zeros(model.nq))
    jacobian = np.reshape(data.J, (6, -1))
    turns = np.abs([jacobian[3:, i - 1] for i in joints])  # 0 for prismatic joints
    normal = int(np.argmax(turns[0]))
    if (turns[:, normal] < 1.0 - 1e-9).any():
        return None
    points = _skeleton(robot, np.zeros(model.nq))[1:]
    links = np.delete(np.diff(points, axis=0), normal, axis=1)
    return Reach(points[0], float(np.linalg.norm(links, axis=1).sum()), normal)


# --- the task ---


def _schedule(run: Run) -> Schedule:
    """The inputs and parameters that held, each from its communication point on."""
    made = run.provenance
    starts = made.get("start_values", {})
    changes = made.get("input_changes", [])
    if not all(map(isfinite, chain(*(v.values() for v in (starts, *(c for _, c in changes)))))):
        raise ValueError("values are not finite")
    schedule: Schedule = [(0, ChainMap({}, starts))]
    changed: dict[str, Any] = {}
    for time, values in changes:
        steps = (time - made["start_time"]) / made["step"]
        k = max(0, ceil(steps - TIME_TOLERANCE))
        changed = {**changed, **values}
        if k == schedule[-1][0]:
            schedule.pop()
        schedule.append((k, ChainMap(changed, starts)))
    last = _steps(run)[-1] if made else 0
    return [(k, values) for k, values in schedule if k < last or k == 0]


def _steps(run: Run) -> NDArray[np.int64]:
    """Number of communication steps before each sample; a recovered bag may have gaps."""
    step = run.provenance["step"]
    least = run.t[-1] / (MOST_LOST * len(run.t))
    if not (0.0 < step < inf and least <= step):
        raise ValueError(f"samples are not steps of {step} s apart")
    steps: NDArray[np.int64] = np.rint(run.t / step).astype(np.int64)
    return steps


def _task(run: Run, robot: Robot, q: Array, v0: Array, path: Array, schedule: Schedule) -> Task:
    axes = ["xyz".index(axis) for axis in robot.axes]
    x, steps = path[:, axes], _steps(run)

    def vector(values: Mapping[str, Any], group: str) -> tuple[float, ...]:
        return tuple(float(values[f"{group}[{i + 1}]"]) for i in range(len(axes)))

    begins = np.array([k for k, _ in schedule])
    targets = np.array([vector(values, "x_des") for _, values in schedule])
    # at its own communication point a change has not been at work yet
    target = targets[np.maximum(np.searchsorted(begins, steps) - 1, 0)]
    closed_form = departure = None
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.linalg.norm(x - target, axis=1)
        if not np.isfinite(error).all():
            raise ValueError("positions or targets are beyond all bounds")
        if all(f"{group}[1]" in schedule[0][1] for group in Held._fields):
            held = [(k, Held(*(vector(values, g) for g in Held._fields))) for k, values in schedule]
            step, xd0 = run.provenance["step"], _velocity(robot, q[0], v0)[axes]
            e = task_error(x[0].tolist(), xd0.tolist(), held, step, int(steps[-1]))[steps]
            closed_form = np.linalg.norm(e, axis=1)
            departure = float(np.linalg.norm(x - target - e, axis=1).max())
    return Task(
        axes=robot.axes,
        target=target,
        error=error,
        closed_form=closed_form,
        departure=departure,
        disturbances=(),
    )


def _disturbances(
    robot: Robot, q: Array, joints: Sequence[Joint], task: Task, schedule: Schedule
) -> tuple[str, ...]:
    """What moves, brakes or stops the arm and is not in the closed form."""
    first = schedule[0][1]
    astray = task.departure is not None and task.departure > NOTABLE
    external = [name for name in first if name.startswith("tau_ext[")]
    found = {
        "joint limits": any(joint.at_limit for joint in joints),
        "effort limits": bool(first.get("limit_effort")),
        "singularities": astray and _is_singular(robot, q, float(first.get("rcond", 0.0))),
        "damping": any(robot.damping),
        "external torque": any(values[name] for _, values in schedule for name in external),
    }
    return tuple(name for name, present in found.items() if present)


def _is_singular(robot: Robot, q: Array, rcond: float) -> bool:
    """Whether the arm has been where it cannot follow any command: σ_min ≤ rcond·σ_max of J."""
    data = robot.model.createData()
    aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    axes = ["xyz".index(axis) for axis in robot.axes]
    for row in q[:: ceil(len(q) / LOOKS)]:
        jacobian = pin.computeFrameJacobian(robot.model, data, row, robot.frame_id, aligned)
        sigma = np.linalg.svd(np.reshape(jacobian, (6, -1))[axes], compute_uv=False)
        if len(sigma) < len(axes) or sigma[-1] <= rcond * sigma[0]:
            return True
    return False


def _settings(run: Run, schedule: Schedule) -> dict[str, str]:
    """What the run was told, vectors and scalars by group."""
    made = run.provenance
    if not made:
        return {}
    settings = {
        "FMU": made["fmu"]["file"],
        "robot": made["robot"],
        "step": f"{1e3 * made['step']:g} ms",
    }
    first = schedule[0][1]
    given = {name for _, values in made["input_changes"] for name in values}
    varied = {_group(n) for n in given if any(values[n] != first[n] for _, values in schedule[1:])}
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


# --- words ---


def number(value: float) -> str:
    """Six digits, with the minus sign of typography; the largest double means none."""
    if abs(value) >= UNBOUNDED:
        return "none"
    return f"{value + 0.0:.6g}".replace("-", "\N{MINUS SIGN}")  # + 0.0: no negative zero


def labels(tracks: Sequence[Track]) -> list[str]:
    """What tells each track from the others: up to three settings, or else the bag's name."""
    every = list(dict.fromkeys(key for track in tracks for key in track.settings))
    differing = [key for key in every if len({track.settings.get(key) for track in tracks}) > 1]
    told = [
        ", ".join(_setting(key, track.settings[key]) for key in differing if key in track.settings)
        for track in tracks
    ]
    clear = 0 < len(differing) <= 3 and all(told) and len(set(told)) == len(told)
    if clear and max(map(len, told)) <= 80:
        return told
    names = [track.name for track in tracks]
    return names if len(set(names)) == len(names) else [shown(track.run.path) for track in tracks]


def common_settings(tracks: Sequence[Track]) -> str:
    """What tracks have in common and a reader wants to know."""
    told = []
    for key, silent in TOLD.items():
        values = {track.settings.get(key, silent) for track in tracks}
        if len(values) == 1 and values != {silent}:
            told.append(_setting(key, values.pop()))
    if len(tracks) == 1 and tracks[0].motion:  # else it is the title
        told.append(f"bag {tracks[0].name}")
    return ", ".join(told)


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


def summary(track: Track) -> dict[str, str]:
    """The main numbers of a run in words, by what they are."""
    made = {
        key: track.settings[key] for key in ("FMU", "step", "x_des", "Kp", "Kd") if track.settings
    }
    stopped = [joint.name for joint in track.joints if joint.at_limit]
    rows = {
        "bag": track.name,
        "robot": track.motion.robot if track.motion else "",
        "end effector": track.motion.frame if track.motion else "",
        "duration": f"{number(float(track.t[-1]))} s, {len(track.t)} samples",
        **made,
        "at a limit": ", ".join(stopped) or "no joint",
    }
    if track.task:
        rows["result"] = outcome(track)
    return rows
