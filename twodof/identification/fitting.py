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
from ..export.urdf_source import end_effector, last_links, lock_joints, locked_positions, read_text
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
from .recording_checks import GRAVITY, check_external, check_signs, check_units, moved_locks, recorded_gravity
from .stretches import Array, jumps, stretches

if TYPE_CHECKING:
    from typing_extensions import Unpack

POSITIVE = ("friction", "damping", "armature", "payload", "mass")


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
    recorded = recorded_gravity(recordings)
    gravity = recorded if gravity is None else tuple(map(float, gravity))
    controller = _controller(model, gravity, options, settings or {})
    given, recordings = recordings, [with_efforts(each, controller) for each in recordings]
    parameters = model.parameters(gravity)
    fitted, held = stretches(recordings, model.robot)
    doubts = check_units(parameters, fitted, recordings)
    finished = _counter(progress, PASSES + 2 * len(held))
    found = estimate(parameters, fitted, finished)
    models = [(parameters.dynamics(parameters.given), 0.0), (parameters.dynamics(found.values), found.delay[0])]
    try:
        doubts += check_signs(parameters, fitted, recordings, found)
        compared = compare(model.robot, models, fitted, [] if found.interrupted else held, finished)
    except KeyboardInterrupt:
        found = found._replace(interrupted=True)
        compared = compare(model.robot, models, fitted, [], finished)
    given = [raw if raw.tau.size else each for raw, each in zip(given, recordings)]
    result = _result(model, parameters, found, compared, given, doubts, options.get("lock") or {})
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
        check_external(recordings[-1])
        size += sum(values.nbytes for values in (recordings[-1].q, recordings[-1].v, recordings[-1].tau))
        if size > MAX_SAMPLES:
            raise InputError(f"the bags to '{bag}' have over {MAX_SAMPLES // MIB} MiB of joint states; give fewer")
    if not recordings:
        raise InputError("a fit needs a bag")
    for a, b in combinations(recordings, 2):
        if np.array_equal(a.t, b.t) and np.array_equal(a.q, b.q):
            raise InputError(f"'{b.path}' has the motion of '{a.path}', which would count twice; leave one out")
    return recordings


def _result(
    model: Model,
    parameters: Parameters,
    found: Estimate,
    compared: Comparison,
    recordings: Sequence[Recording],
    doubts: tuple[str, ...],
    locks: Mapping[str, float],
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
        doubts=doubts + moved_locks(recordings, locked_positions(model.urdf, locks)),
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
