"""Checks of recordings before a fit: gravity, external efforts, locked joints, units, signs and order of efforts."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bag.recording import Recording
from ..errors import InputError
from ..files import shown
from ..plant.robot import Robot
from ..plant.variables import DISTURBANCES
from .estimate import Estimate, unexplained
from .model_tests import LEAST_NOISE
from .parameters import Parameters
from .regression import regressors
from .stretches import Array, Stretch, thinned

GRAVITY = (0.0, 0.0, -9.81)
SURE, SEPARATE = 10.0, 1e-6
"""Standard deviations above 0, and relative singular value, from which on data determine a load."""
LEAST_LOAD = 1e-3
"""Load of a joint by gravity in one direction, as part of that in others, below which it is an error of rounding."""
WRONG_UNITS = 300.0  # ratio of recorded efforts to those of the URDF's masses, above which another unit is suspected
WRONG_RANGE = 3.0  # ratio of a joint's recorded range of positions to the URDF's, above which another unit is suspected
BETTER = 0.3  # ratio of residual powers, below which one explanation of efforts is much better than another
EXPLAINED = 0.1  # part of the power of efforts that is not explained, below which the fault of a refusal is certain
UNEXPLAINED = 0.5  # part of the power of efforts in a suspect unit that is not explained, above which they are refused
MOST_TRIED = 10_000  # samples of a bag with which a correction is tried
LOCKED = 0.02  # rad or m: distance of a locked joint from its position, above which a remark names it
Fault = tuple[Array, str, str]
"""Matrix n × n that corrects efforts by multiplication from the right, text of the fault, and remedy."""


def recorded_gravity(recordings: Sequence[Recording]) -> tuple[float, ...]:
    """Return the gravity of the runs that made the bags, m/s²; raise InputError if it differs between them."""
    first, known = "", tuple[float, ...](GRAVITY)
    for recording in recordings:
        starts = recording.provenance.get("start_values") or {}
        if "gravity[1]" not in starts:
            continue
        own = tuple(float(starts.get(f"gravity[{k + 1}]", GRAVITY[k])) for k in range(3))
        if first and own != known:
            both = (f"({', '.join(map('{:g}'.format, each))}) m/s²" for each in (known, own))
            raise InputError(
                f"'{first}' and '{shown(recording.path)}' are of runs with different gravity, {' and '.join(both)}: fit"
                " them one by one"
            )
        first, known = shown(recording.path), own
    return known


def check_external(recording: Recording) -> None:
    """Refuse a bag of a run with external efforts, which its efforts do not contain."""
    run = recording.provenance
    changes = (values for _, values in run.get("input_changes", []))
    connections: Any = run.get("system", {}).get("connections", ())
    values = chain(*(each.items() for each in (run.get("start_values", {}), *changes)), zip(connections, count(1)))
    for name, value in values:
        if value and name.rpartition(".")[2].partition("[")[0] in DISTURBANCES:
            raise InputError(
                f"'{shown(recording.path)}': the run has an external effort, {name}, which a fit does not know: repeat"
                " the run without it"
            )


def moved_locks(recordings: Sequence[Recording], positions: Mapping[str, float]) -> tuple[str, ...]:
    """Return a remark for each locked joint that is elsewhere in a bag; ``positions`` are those of the locks."""
    remarks = []
    for recording in recordings:
        for joint, q in zip(recording.joints, recording.q.T):
            if joint in positions and len(q) and np.abs(q - positions[joint]).max() > LOCKED:
                remarks.append(
                    f"joint '{joint}' is locked at {positions[joint]:.4g}, but is between {q.min():.4g} and"
                    f" {q.max():.4g} in '{shown(recording.path)}': lock it where it stands, or leave its lock out"
                )
    return tuple(remarks)


def check_units(parameters: Parameters, fitted: Sequence[Stretch], recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Refuse a bag whose positions or efforts have wrong units, signs or joints; return remarks on uncertain ones."""
    remarks = []
    for bag, own in _by_bag(fitted, recordings):
        _check_positions(parameters.robot, own, bag)
        _check_recorded(parameters.robot.joints, own, bag)
        remarks += _check_efforts(parameters, own, bag, _suspicions(parameters, max(own, key=lambda each: len(each.t))))
    return tuple(remarks)


def check_signs(
    parameters: Parameters, fitted: Sequence[Stretch], recordings: Sequence[Recording], found: Estimate
) -> tuple[str, ...]:
    """Refuse a bag that a poor fit explains only with reversed efforts of one joint; return remarks on uncertain ones.

    With an unknown payload, a reversed joint can have a load of the expected sign.
    """
    least = EXPLAINED**0.5 if found.converged else 0.0
    if found.interrupted or not any(misfit.bad and misfit.part > least for misfit in found.misfits):
        return ()
    joints, turning, remarks = parameters.robot.joints, np.flatnonzero(~np.array(parameters.robot.prismatic)), []
    for bag, own in _by_bag(fitted, recordings):
        reversals = (_reversal(joints, wrong, "seem to have the wrong sign") for wrong in turning[:, None])
        remarks += _check_efforts(parameters, own, bag, reversals, BETTER)
    return tuple(remarks)


def _by_bag(fitted: Sequence[Stretch], recordings: Sequence[Recording]) -> Iterator[tuple[str, list[Stretch]]]:
    for bag, recording in enumerate(recordings):
        if own := [stretch for stretch in fitted if stretch.bag == bag]:
            yield shown(recording.path), own


def _check_positions(robot: Robot, fitted: Sequence[Stretch], bag: str) -> None:
    for i, joint in enumerate(robot.joints):
        least = min(float(each.measured[:, i].min()) for each in fitted)
        most = max(float(each.measured[:, i].max()) for each in fitted)
        low, high = robot.q_min[i], robot.q_max[i]
        if most - least > WRONG_RANGE * (high - low) > 0.0:
            unit, other = ("m", "mm") if robot.prismatic[i] else ("rad", "degrees")
            raise InputError(
                f"'{bag}': the positions of joint '{joint}' are between {least:.3g} and {most:.3g}, and its limits"
                f" {low:.3g} and {high:.3g} {unit}: they are probably in {other}; convert them, or correct the limits"
            )


def _check_recorded(joints: Sequence[str], own: Sequence[Stretch], bag: str) -> None:
    for i, joint in enumerate(joints):
        if not any(each.tau[:, i].any() for each in own):
            raise InputError(f"'{bag}': the effort of joint '{joint}' is 0 throughout: it was not recorded")


def _check_efforts(
    parameters: Parameters, own: Sequence[Stretch], bag: str, faults: Iterable[Fault], most: float = 1.0 / BETTER
) -> list[str]:
    """Refuse efforts that the free parameters explain only after the correction of a fault; return remarks.

    Friction, damping and armature are free here, because most URDFs lack them, and because they show the sign: they are
    not negative.

    Args:
        most: ratio of the residual powers with and without the correction, below which a fault is remarked.
    """
    own, remarks, recorded = thinned(own, MOST_TRIED), list[str](), np.empty(0)
    # where a position is constant, its speed is not 0 but an error of rounding
    moving = [each.moving.any(axis=0) & (np.ptp(each.measured, axis=0) > 0.0) for each in own]
    model = parameters.with_friction(np.any(moving, axis=0))
    for correction, fault, remedy in faults:
        recorded = recorded if recorded.size else unexplained(model, own)
        corrected = unexplained(model, [each._replace(tau=each.tau @ correction) for each in own])
        changed = (correction != np.eye(len(correction))).any(axis=0)
        ratio = np.median(((corrected + LEAST_NOISE**2) / (recorded + LEAST_NOISE**2))[changed])
        explained = ratio < BETTER and np.median(corrected[changed]) < EXPLAINED
        scaled = np.abs(correction[:, changed]).sum(axis=0).max() != 1.0 and np.median(recorded[changed]) > UNEXPLAINED
        if explained or scaled:
            raise InputError(f"'{bag}': the recorded efforts {fault}: {remedy}")
        if ratio <= most:
            cause = "if this is neither an error of the URDF nor an unknown load"
            remarks.append(f"'{bag}': the recorded efforts {fault}; {cause}, {remedy}")
    return remarks[:1]


def _reversal(joints: Sequence[str], wrong: NDArray[np.int64], fault: str) -> Fault:
    """Return the fault of reversed efforts of joints."""
    signs = np.where(np.isin(np.arange(len(joints)), wrong), -1.0, 1.0)
    return np.diag(signs), f"of {_named(joints, wrong)} {fault}", "reverse the efforts, or correct `gravity`"


def _suspicions(parameters: Parameters, stretch: Stretch) -> Iterator[Fault]:
    """Yield faults of the order, units and signs of efforts that differ much from those of the URDF's masses."""
    robot, values = parameters.robot, parameters.dynamics(parameters.start)
    few = stretch.part(slice(None, None, max(1, len(stretch.t) // 200)))
    Y, G = regressors(robot, few, values, np.empty(0, np.int64))
    model = Y[:, :, 0] + np.einsum("g,kgi->ki", values.gravity, G[:, :, :, 0])
    motions = zip(G[:, :, :, 0].transpose(2, 0, 1), Y[:, :, 0].T, few.v.T, few.a.T)
    signals = [np.column_stack([loads, inertia, np.sign(v), v, a]) for loads, inertia, v, a in motions]
    one = np.eye(len(robot.joints))
    best = _order(few.tau, signals)
    if len(moved := np.flatnonzero(best != np.arange(len(best)))):
        fault = f"{_named(robot.joints, moved)} seem to be those of {_named(robot.joints, best[moved])}, in this order"
        yield one[:, np.argsort(best)], f"of {fault}", "correct the order of the efforts"
    scales = np.array([_scale(values.gravity, *each) for each in zip(few.tau.T, signals)])
    theirs, ours = (np.sqrt(np.mean(each**2, axis=0)) for each in (few.tau, model))
    for slides, units in ((False, ("N·m", "N·mm", "kN·m")), (True, ("N", "mN", "kN"))):
        own = np.flatnonzero(np.array(robot.prismatic) == slides)
        joints = [robot.joints[i] for i in own]
        for wrong, factor, fault in _wrong_units(joints, np.abs(scales[own]), theirs[own], ours[own], units):
            correction = one.copy()
            correction[own[wrong], own[wrong]] = 1000.0 ** -round(np.log(factor) / np.log(1000.0))
            yield correction, fault, "convert them, or correct the masses"
    own = np.flatnonzero((scales < 0.0) & ~np.array(robot.prismatic))
    for wrong in [own, *own[:, None]] if len(own) > 1 else own[:, None]:
        yield _reversal(robot.joints, wrong, "have the opposite sign of those of the URDF's masses")


def _order(tau: Array, signals: Sequence[Array]) -> NDArray[np.int64]:
    """Return the joint whose signals explain the efforts of each joint, where other joints do so much better."""
    bases = [np.linalg.qr(each / np.maximum(np.linalg.norm(each, axis=0), 1e-300))[0] for each in signals]
    left = np.array([np.sum((tau - U @ (U.T @ tau)) ** 2, axis=0) for U in bases])  # by signals and efforts
    best = np.where(left.min(axis=0) < BETTER * np.diag(left), left.argmin(axis=0), np.arange(len(left)))
    return best if len(set(best.tolist())) == len(best) else np.arange(len(best))


def _named(joints: Sequence[str], indices: NDArray[np.int64]) -> str:
    return f"joint{'s' * (len(indices) > 1)} {', '.join(repr(joints[i]) for i in indices.tolist())}"


def _wrong_units(
    joints: Sequence[str], scales: Array, theirs: Array, ours: Array, units: tuple[str, str, str]
) -> Iterator[tuple[NDArray[np.int64], float, str]]:
    """Yield the joints, factor and text of efforts far larger or smaller than those of the URDF's masses.

    Args:
        joints: names of the joints of one kind.
        scales: ratios of recorded to expected efforts; NaN if unknown.
        theirs, ours: root mean squares of recorded and expected efforts.
        units: the right unit, and units a thousandth and a thousand times as large.
    """
    usual = float(np.exp(np.median(np.log(scales[known])))) if (known := np.isfinite(scales)).any() else 1.0
    if not 1.0 / WRONG_UNITS < usual < WRONG_UNITS:
        fault = (
            f"are {usual:.2g} times those of the URDF's masses: they are probably not in"
            f" {units[0]}, but for example in {units[1 + (usual < 1.0)]}, a factor of 1000"
        )
        yield np.arange(len(joints)), usual, fault
    high = np.flatnonzero(scales > WRONG_UNITS)  # a payload can do so to a light wrist, but not to it alone
    if len(high) == 1 and theirs[high[0]] == max(theirs.max(), ours.max()):
        fault = (
            f"of joint '{joints[high[0]]}' are {scales[high[0]]:.2g} times those of the"
            f" URDF's masses, unlike those of other joints: they are probably in {units[1]}, a factor of 1000"
        )
        yield high, float(scales[high[0]]), fault


def _scale(given: Array, tau: Array, signals: Array) -> float:
    """Return the ratio of a joint's efforts to those of the URDF's masses, beside friction, damping and armature.

    It is that of the load by gravity, or else that of inertial effects which armature does not have, and NaN if the
    data determine neither. It is negative if the inertial effects, or else the load, have the opposite sign.

    Args:
        given: gravity, m/s².
        signals: efforts of gravity of 1 m/s² along each axis and of the links' inertia, sgn v, v and a, N × 7.
    """
    strength = np.abs(signals[:, :3]).max(axis=0)
    loads = np.where(strength > LEAST_LOAD * strength.max(), signals[:, :3], 0.0)
    columns = np.column_stack([loads, signals[:, 3:]])
    size = np.linalg.norm(columns, axis=0)
    size[size == 0.0] = 1.0
    U, strengths, directions = np.linalg.svd(columns / size, full_matrices=False)
    kept = strengths > SEPARATE * strengths[0]
    inverse = directions.T / np.where(kept, strengths, np.inf)
    noise = float(np.sum((tau - U @ (U.T @ tau)) ** 2)) / max(1, len(tau) - len(size))
    found, deviation = inverse @ U.T @ tau / size, np.sqrt(noise * np.sum(inverse**2, axis=1)) / size
    alone = np.sum(directions[kept, 3] ** 2) > 1.0 - SEPARATE  # the data can tell inertia from armature
    inertia = float(found[3]) if alone and abs(found[3]) > SURE * deviation[3] else np.nan
    gravity, usual = float(np.linalg.norm(found[:3])), float(np.linalg.norm(given))
    loaded = np.abs(loads).max() > SEPARATE * np.abs(tau).max()
    # a joint that the given gravity does not load cannot show that efforts are too small
    free = np.abs(loads @ given).max() <= LEAST_LOAD * strength.max() * usual
    sure = usual and loaded and gravity > SURE * np.linalg.norm(deviation[:3]) and not (free and gravity < usual)
    scale = gravity / usual if sure else abs(inertia)
    side = inertia if np.isfinite(inertia) else 0.5 * gravity * usual + found[:3] @ given
    return float(np.copysign(scale, side))
