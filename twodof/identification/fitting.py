"""Fit of a robot's physical parameters to bags of its motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations, count
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypedDict

import numpy as np

from ..bag.reader import read_bags
from ..bag.recording import Recording
from ..bag.records import ReadBudget
from ..bounds import MAX_SAMPLES, MIB
from ..errors import InputError
from ..export.fmu_options import FmuOptions
from ..export.urdf_source import end_effector, last_links, lock_joints, read_text
from ..files import shown
from ..plant.robot import Robot, load_robot
from ..plant.urdf import RobotError, Urdf, read_urdf
from ..signatures import with_keywords_of
from .commanded import with_efforts
from .curves import Comparison, compare
from .estimate import NORMAL_95, PASSES, Estimate, estimate
from .fit_result import Fit, FittedParameter, check_folder
from .fitted_urdf import fitted_urdf
from .parameters import Dynamics, Parameters
from .regression import regressors
from .stretches import Array, Stretch, jumps, stretches

if TYPE_CHECKING:
    from typing_extensions import Unpack

SURE, SEPARATE = 10.0, 1e-6
"""Standard deviations above 0, and relative singular value, from which on data determine a load."""
LEAST_LOAD = 1e-3
"""Load of a joint by gravity in one direction, as part of that in others, below which it is an error of rounding."""
WRONG_UNITS = 300.0  # ratio of recorded efforts to those of the URDF's masses, above which another unit is suspected
WRONG_RANGE = 3.0  # ratio of a joint's recorded range of positions to the URDF's, above which another unit is suspected
POSITIVE = ("friction", "damping", "armature", "payload", "mass")
GRAVITY = (0.0, 0.0, -9.81)


class ModelOptions(TypedDict, total=False):
    """Keywords of ``read_model``."""

    frame: str | None
    lock: Mapping[str, float] | None
    gravity: Sequence[float] | None


class Model(NamedTuple):
    """A robot with free parameters, before a fit."""

    path: Path
    text: str
    urdf: Urdf
    locked: Urdf
    """``urdf`` with its locked joints fixed."""
    robot: Robot
    """Dynamics of ``locked``."""
    patterns: Sequence[str]

    def parameters(self, gravity: Sequence[float]) -> Parameters:
        """Return the free parameters, with the gravity in m/s²."""
        return Parameters(self.locked, self.robot, self.patterns, gravity)


def read_model(
    urdf: str | Path,
    free: str | Sequence[str],
    *,
    frame: str | None = None,
    lock: Mapping[str, float] | None = None,
    gravity: Sequence[float] | None = None,
) -> Model:
    """Read a robot whose parameters matching ``free`` are free; the other arguments are those of ``fit``."""
    if gravity is not None and not (np.shape(gravity) == (3,) and np.isfinite(gravity).all()):
        raise InputError(f"`gravity` {', '.join(map(str, gravity))} is not three finite numbers")
    path, patterns = Path(urdf), [free] if isinstance(free, str) else free
    text = read_text(path, None)
    try:
        fixed = lock_joints(text, lock or {})
        locked = read_urdf(fixed)
        needs_frame = any("payload" in pattern for pattern in patterns)
        end = end_effector(locked, frame) if frame or needs_frame else [*last_links(locked), locked.root][0]
        return Model(path, text, read_urdf(text), locked, load_robot(fixed, end, "xyz"), patterns)
    except RobotError as error:
        raise InputError(f"{path.name}: {error}") from error


@with_keywords_of(read_model)
def fit(
    urdf: str | Path,
    bags: str | Path | Sequence[str | Path],
    free: str | Sequence[str],
    *,
    output: str | Path | None = None,
    settings: Mapping[str, object] | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[ModelOptions],
) -> Fit:
    """Fit parameters of a robot to bags of its motion, with positions and efforts of its joints.

    The last fifth of each bag is held out: it is predicted, but not used by the fit. Ctrl-C after the first step ends
    the fit with its best values so far, and with the property ``interrupted``.

    Args:
        urdf: the URDF or xacro file with the initial values.
        bags: bags of any writer, with JointStates.
        free: names or shell patterns of the free parameters: ``friction[1]``, ``damping[1]``, ``armature[1]``,
            ``offset:JOINT``, ``gain:JOINT``, ``bias:JOINT``, ``mass:LINK``, ``com:LINK``, ``inertia:LINK``,
            ``payload``, ``payload_com``, ``gravity``.
        settings: gains of joint control, Kp and Kd, and other settings of a build, for bags with commands and without
            efforts; None: their commands are efforts.
        output: new folder for robot.urdf, fit.json and fit.html; None: nothing is written.
        frame: link of the payload; None: "EndEffector", or the only last link.
        lock: positions, rad or m, at which joints are fixed, by name or shell pattern.
        gravity: m/s² in the root frame; None: that of the bag's run, else (0, 0, −9.81).
        progress: called with the numbers of finished and of all steps.

    Raises:
        InputError: a bag does not fit the robot, is too short, or has values that are not finite; or a pattern
            matches no parameter.
        BuildError: the URDF cannot be read.
        BagError: a bag cannot be read.
    """
    if output is not None:
        check_folder(output)
    model, gravity = read_model(urdf, free, **options), options.get("gravity")
    recordings = _recordings(bags)
    gravity = _recorded_gravity(recordings) if gravity is None else tuple(map(float, gravity))
    controller = _controller(model, gravity, options, settings or {})
    given, recordings = recordings, [with_efforts(each, controller) for each in recordings]
    parameters = model.parameters(gravity)
    fitted, held = stretches(recordings, model.robot)
    _check_all_units(parameters, fitted, recordings)
    finished = _counter(progress, PASSES + 2 * len(held))
    found = estimate(parameters, fitted, finished)
    models = [(parameters.dynamics(parameters.given), 0.0), (parameters.dynamics(found.values), found.delay[0])]
    try:
        compared = compare(model.robot, models, fitted, [] if found.interrupted else held, finished)
    except KeyboardInterrupt:
        found = found._replace(interrupted=True)
        compared = compare(model.robot, models, fitted, [], finished)
    given = [raw if raw.tau.size else each for raw, each in zip(given, recordings)]
    result = _result(model, parameters, found, compared, given)
    if output is not None:
        result.save(output)
    return result


def _controller(
    model: Model, gravity: Sequence[float], options: ModelOptions, settings: Mapping[str, object]
) -> FmuOptions:
    """Return options of the FMU whose law made the efforts of a bag with commands."""
    x, y, z = gravity
    control, lock = "joint" if settings else "effort", options.get("lock") or {}
    own = dict(meshes=False, frame=model.robot.frame, lock=lock, gravity=(x, y, z), control=control, settings=settings)
    return FmuOptions(model.path, **own)  # type: ignore[arg-type]


def _counter(progress: Callable[[int, int], None] | None, total: int) -> Callable[[], None]:
    """Return a function that counts a finished step and reports it."""
    steps = count()

    def finished() -> None:
        if progress:
            progress(next(steps), total)

    finished()
    return finished


def _recordings(bags: str | Path | Sequence[str | Path]) -> list[Recording]:
    """Return the recordings of bags; raise InputError if there are none, one counts twice, or they are too large."""
    budget, recordings, size = ReadBudget(), list[Recording](), 0
    for bag in [bags] if isinstance(bags, str | Path) else bags:
        recordings += read_bags([bag], budget)
        size += sum(values.nbytes for values in (recordings[-1].q, recordings[-1].v, recordings[-1].tau))
        if size > MAX_SAMPLES:
            raise InputError(f"the bags to '{bag}' have over {MAX_SAMPLES // MIB} MiB of joint states; give fewer")
    if not recordings:
        raise InputError("a fit needs a bag")
    for a, b in combinations(recordings, 2):
        if np.array_equal(a.t, b.t) and np.array_equal(a.q, b.q):
            raise InputError(f"'{b.path}' has the motion of '{a.path}', which would count twice; leave one out")
    return recordings


def _recorded_gravity(recordings: Sequence[Recording]) -> tuple[float, ...]:
    """Return the gravity of the run that made the first bag, m/s²."""
    starts = recordings[0].provenance.get("start_values") or {}
    return tuple(float(starts.get(f"gravity[{k + 1}]", GRAVITY[k])) for k in range(3))


def _check_all_units(parameters: Parameters, fitted: Sequence[Stretch], recordings: Sequence[Recording]) -> None:
    """Check the units of each bag that is fitted."""
    for bag, recording in enumerate(recordings):
        if own := [stretch for stretch in fitted if stretch.bag == bag]:
            _check_units(parameters, own, shown(recording.path))


def _check_units(parameters: Parameters, fitted: Sequence[Stretch], bag: str) -> None:
    """Refuse positions of a bag far beyond the URDF's range, and efforts that differ much from those of its masses."""
    robot = parameters.robot
    for i, joint in enumerate(robot.joints):
        least = min(float(each.measured[:, i].min()) for each in fitted)
        most = max(float(each.measured[:, i].max()) for each in fitted)
        low, high = robot.q_min[i], robot.q_max[i]
        if not robot.prismatic[i] and most - least > WRONG_RANGE * (high - low) > 0.0:
            raise InputError(
                f"'{bag}': the positions of joint '{joint}' are between {least:.3g} and {most:.3g}, and its limits"
                f" {low:.3g} and {high:.3g} rad: they are probably in degrees; convert them, or correct the limits"
            )
    values = parameters.dynamics(parameters.start)
    stretch = max(fitted, key=lambda each: len(each.t))
    few = stretch.part(slice(None, None, max(1, len(stretch.t) // 200)))
    Y, G = regressors(robot, few, values, np.empty(0, np.int64))
    model = Y[:, :, 0] + np.einsum("g,kgi->ki", values.gravity, G[:, :, :, 0])
    for joint, effort in zip(robot.joints, few.tau.T):
        if not effort.any():
            raise InputError(f"'{bag}': the effort of joint '{joint}' is 0 throughout: it was not recorded")
    turning = ~np.array(robot.prismatic)
    own = zip(few.tau.T, G[:, :, :, 0].transpose(2, 0, 1), Y[:, :, 0].T, few.v.T, few.a.T)
    scales = np.array([_gravity_of(values.gravity, *each) for each in own])[turning]
    scales /= np.linalg.norm(values.gravity) or np.nan
    theirs, ours = (np.sqrt(np.mean(each**2, axis=0))[turning] for each in (few.tau, model))
    usual = np.exp(np.median(np.log(scales[known]))) if (known := np.isfinite(scales)).any() else 1.0
    if not 1.0 / WRONG_UNITS < usual < WRONG_UNITS:
        raise InputError(
            f"'{bag}': the recorded efforts are {usual:.2g} times those of the URDF's masses: they are probably not in"
            " N·m, but for example in N·mm, a factor of 1000; convert them, or correct the masses"
        )
    high = np.flatnonzero(scales > WRONG_UNITS).tolist()  # a payload can do so to a light wrist, but not to it alone
    if len(high) == 1 and theirs[high[0]] == max(theirs.max(), ours.max()):
        joint = np.array(robot.joints)[turning][high[0]]
        raise InputError(
            f"'{bag}': the recorded efforts of joint '{joint}' are {scales[high[0]]:.2g} times those of the URDF's"
            " masses, unlike those of other joints: they are probably in N·mm, a factor of 1000; convert them, or"
            " correct the masses"
        )


def _gravity_of(given: Array, tau: Array, loads: Array, inertia: Array, v: Array, a: Array) -> float:
    """Return the gravity that explains a joint's efforts beside inertia, friction, damping and armature, m/s².

    NaN if the data do not determine it, as for a joint without load. ``loads`` are efforts of gravity of 1 m/s² along
    each axis, N × 3.
    """
    strength = np.abs(loads).max(axis=0)
    loads = np.where(strength > LEAST_LOAD * strength.max(), loads, 0.0)
    columns = np.column_stack([loads, inertia, np.sign(v), v, a])
    size = np.linalg.norm(columns, axis=0)
    size[size == 0.0] = 1.0
    U, strengths, directions = np.linalg.svd(columns / size, full_matrices=False)
    inverse = directions.T / np.where(strengths > SEPARATE * strengths[0], strengths, np.inf)
    noise = float(np.sum((tau - U @ (U.T @ tau)) ** 2)) / max(1, len(tau) - len(size))
    found, deviation = (inverse @ U.T @ tau / size)[:3], np.sqrt(noise * np.sum(inverse**2, axis=1))[:3] / size[:3]
    gravity = float(np.linalg.norm(found))
    loaded = np.abs(loads).max() > SEPARATE * np.abs(tau).max()
    # a joint that the given gravity does not load cannot show that efforts are too small
    free = np.abs(loads @ given).max() <= LEAST_LOAD * strength.max() * np.linalg.norm(given)
    sure = loaded and gravity > SURE * np.linalg.norm(deviation) and not (free and gravity < np.linalg.norm(given))
    return gravity if sure else np.nan


def _result(
    model: Model, parameters: Parameters, found: Estimate, compared: Comparison, recordings: Sequence[Recording]
) -> Fit:
    robot = model.robot
    return Fit(
        urdf=shown(model.path.name),
        bags=tuple(shown(recording.path) for recording in recordings),
        fitted_urdf=fitted_urdf(model.text, model.urdf, parameters, found.values),
        joints=robot.joints,
        units=tuple("m" if prismatic else "rad" for prismatic in robot.prismatic),
        parameters=tuple(_parameters(parameters, found)),
        unseen=tuple(_unseen(parameters, found)),
        misfits=found.misfits,
        suspects=found.suspects,
        holds=found.holds,
        fragile=dict(zip(parameters.names, found.fragile.tolist())),
        noise=tuple(found.noise.tolist()),
        delay=found.delay,
        deviation_before=compared.deviations[0],
        deviation=compared.deviations[1],
        settings=_settings(parameters, parameters.dynamics(found.values), found),
        covariance=found.covariance,
        converged=found.converged,
        interrupted=found.interrupted,
        jumps=jumps(recordings, robot),
        curves=compared.curves,
    )


def _parameters(parameters: Parameters, found: Estimate) -> list[FittedParameter]:
    before, after = (parameters.reported(v).tolist() for v in (parameters.given, found.values))
    listed = []
    for k, (name, unit) in enumerate(zip(parameters.names, parameters.units)):
        sd = float(np.sqrt(found.covariance[k, k]))
        low, high = after[k] - NORMAL_95 * sd, after[k] + NORMAL_95 * sd
        if name.partition(":")[0].partition("[")[0] in POSITIVE:
            low = max(0.0, low)
        known = bool(found.known[k])
        listed.append(FittedParameter(name, unit, before[k], after[k], sd, low, high, known))
    return listed


def _unseen(parameters: Parameters, found: Estimate) -> list[str]:
    """Return the names of the coordinates that form each direction that the data do not determine."""
    names = parameters.coordinate_names
    lines = []
    for direction in found.unseen:
        largest = float(np.abs(direction).max())
        part = [name for name, each in zip(names, direction) if abs(each) > 0.3 * largest]
        lines.append(" with ".join(dict.fromkeys(part)))
    return sorted(set(lines))


def _settings(parameters: Parameters, after: Dynamics, found: Estimate) -> dict[str, tuple[float, ...]]:
    """Return the fitted values that a URDF cannot store, and its gravity, as settings of a build."""
    groups = {free.group for free in parameters.free}
    settings: dict[str, Array] = {}
    if "armature" in groups:
        settings["armature"] = after.armature
    if "payload" in groups:
        settings["payload"] = found.values.payload
    if "payload_com" in groups:
        settings["payload_com"] = found.values.payload_com
    if "gravity" in groups or after.gravity.tolist() != [*GRAVITY]:
        settings["gravity"] = after.gravity
    return {name: tuple(float(f"{value:.9g}") for value in values) for name, values in settings.items()}
