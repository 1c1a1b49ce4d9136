"""Causes of a run's failure, the root cause first."""

from collections.abc import Iterator, Sequence
from functools import partial
from math import inf, pi, radians

import numpy as np

from ..plant.urdf import Joint
from ..plant.variables import EXACT
from .cause import FLOOR, KINDS, MANY_CHANGES, Cause, point_text
from .controller_causes import DRAG, damping, feedforward, gains, load, sampled, slow, vanishing
from .judge import AT_LIMIT, BAND, Judge

MOST = 20  # causes in a verdict
OFTEN = 0.05  # share of samples from which on a state is a cause
NEAR_SINGULAR = 0.02  # ratio of the smallest to the largest singular value
LEAST_TURN = 2.0 * pi  # rad: a larger joint target may be in degrees
MILLIMETRES = 10.0  # m: a target farther away is probably not in metres
CREEPING = 1e-3  # fraction of its largest speed below which a joint with friction counts as stuck
MOTION = ("effort", "velocity")  # kinds that show what the motion needs, and do not cause it
GROWN = 3.5  # logarithm of the growth of an unstable loop in a run that shows
SHIFTED = 0.3  # ratio of the extremes of an error to both sides, below which it is shifted
STEADY = ("feedforward", "friction", "load")  # kinds that shift the error about which a motion swings
BEFORE_TIME = ("diverged", "degrees", "time")  # kinds that precede others if the errors vanish as the gains let them
FOLLOWING = ("limit", "saturation", "singularity")  # kinds that targets out of reach and unstable loops lead to
BEFORE_REACH = ("diverged", "degrees", "gain", "feedforward", "unstable", "load", "friction")
# Kinds that precede a target out of reach by less than half of the error at the end.
EXPLAINED = 0.1  # deviation of the error at the end from the distance out of reach that explains it, relative
EFFORT_UNITS = {"rad": "N·m", "m": "N"}  # by the joint's unit


def causes(judge: Judge, missed: Sequence[str], motion: str) -> tuple[Cause, ...]:
    """Return the causes, the root first.

    Args:
        judge: the judge of all samples.
        missed: outputs that are not at their targets: "x", "quat" or "q".
        motion: motion at the end of the run.
    """
    found, rests = [*_degrees(judge), *_beyond_limits(judge)], judge.changes <= MANY_CHANGES
    fades = rests and vanishing(judge, missed)  # errors from a target that rests
    ill = bool(missed) or motion == "diverging"
    if missed:
        found += [*_reach(judge, missed), *gains(judge, missed), *feedforward(judge, missed), *load(judge)]
        loaded = any(cause.kind == "load" for cause in found)
        sticking = [*_friction(judge, missed, loaded)]  # then the rate of an error tells nothing, unless it is nominal
        found += [*sticking, *_singular(judge), *(slow(judge, missed) if fades or (rests and not sticking) else ())]
    if ill or not judge.aims:
        found += [*_at_limits(judge, missed), *_saturated(judge), *sampled(judge)]
    if missed:
        found += damping(judge, ["x", "quat"] if motion in ("oscillating", "diverging") else missed)
    order, motors = [*KINDS], max((cause.share for cause in found if cause.kind == "saturation"), default=0.0)
    driven = _driven(judge)

    def passing(cause: Cause) -> bool:  # a joint in the way saturates motors no longer
        return cause.kind == "limit" and (cause.share < motors or cause.joint in driven)

    near = any(cause.point and _excess(judge, cause) > cause.share for cause in found)
    swings = any(cause.kind == "damping" for cause in found) and all(_swings(judge, name) for name in missed)
    pushed = any(cause.kind == "load" and cause.share > DRAG for cause in found)  # perhaps to a limit

    def rank(cause: Cause) -> tuple[bool, int, bool, float]:
        grows = cause.kind == "unstable" and cause.share * judge.duration > GROWN
        late = (near and cause.kind not in BEFORE_REACH) or (fades and not grows and cause.kind not in BEFORE_TIME)
        late |= swings and cause.kind in STEADY
        kind = "drag" if passing(cause) else "load" if pushed and cause.kind == "limit" else cause.kind
        return late, order.index(kind), cause.kind == "limit", -cause.share

    if not found:
        return ()
    root, *others = sorted(found, key=rank)[:MOST]
    root = root._replace(noted=bool(missed) and root.kind in MOTION)  # a peak makes no error
    led = [cause for cause in others if passing(cause) or _leads(root, cause, judge)]
    since = min((cause.time for cause in led if cause.time is not None), default=inf)
    led += [cause for cause in others if cause.kind == "singularity" and (cause.time or 0.0) >= since]
    return root, *(cause._replace(noted=cause in led or cause.kind in MOTION) for cause in others)


def _leads(root: Cause, cause: Cause, judge: Judge) -> bool:
    """Return whether the root leads to another cause; a target out of reach does if it explains the whole error."""
    if root.kind == "reach" and not root.point:
        return cause.kind == "limit" and cause.joint == root.joint
    if root.kind == "reach":
        return cause.kind in FOLLOWING and _excess(judge, root) <= EXPLAINED * root.share
    return cause.kind in FOLLOWING and root.kind in ("degrees", "unstable", "sampling")


def _excess(judge: Judge, reach: Cause) -> float:
    """Return by how much the error at the end exceeds the distance, or the angle, by which a target is out of reach."""
    gap = np.linalg.norm(judge.wanted("x") - np.array(reach.point)[judge.setup.rows])
    return judge.aims["x" if np.isclose(gap, reach.share) else "quat"].last - reach.share


def _swings(judge: Judge, name: str) -> bool:
    """Return whether an error passes zero to and fro in the second half of the move, hardly shifted to one side."""
    half = judge.history() >= 0.5 * (judge.changed + judge.duration)
    size = judge.error_history(name)[half]
    if name == "quat" or not len(size):  # an angle has no sign
        return len(size) > 0 and bool(size.min() < SHIFTED * size.max())
    e = judge.wanted(name) - judge.history(name)[half]
    along = e @ e[int(size.argmax())]
    return bool(along.min() < -SHIFTED * along.max())


def _degrees(judge: Judge) -> Iterator[Cause]:
    setup = judge.setup
    for group in ("q_des", "q_start"):
        for i, (value, joint) in enumerate(zip(judge.given(group), setup.joints)):
            fits = setup.low[i] - AT_LIMIT <= radians(value) <= setup.high[i] + AT_LIMIT
            way = value if group == "q_start" else value - judge.first[i]  # that of a continuous joint may be short
            if setup.units[i] == "rad" and min(abs(value), abs(way)) > LEAST_TURN and fits:
                text = f"{group}[{i + 1}] = {value:g} rad: {value:g}°? {value:g}° is {radians(value):.4g} rad"
                yield Cause("degrees", text, 1.0, joint)


def _beyond_limits(judge: Judge) -> Iterator[Cause]:
    setup = judge.setup
    speeds = {unit: f"{unit}/s" for unit in setup.units}
    kinds = ("effort", "effort", judge.effort, EFFORT_UNITS), ("velocity", "speed", judge.speed, speeds)
    for (kind, what, peaks, units), bounds, use in zip(kinds, setup.limits, judge.use()):
        for joint, unit, peak, limit, share in zip(setup.joints, setup.units, peaks, bounds, use):
            if share > 1.0 + EXACT:
                of = units.get(unit, "")
                beyond = f"beyond the URDF's limit of {limit:.4g} {of}"
                text = f"joint '{joint}' has a peak {what} of {peak:.4g} {of}, {beyond}"
                yield Cause(kind, text, float(share), joint)


def _reach(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    setup = judge.setup
    known = {cause.joint for cause in _degrees(judge)}
    for joint, unit, wanted, low, high in zip(setup.joints, setup.units, judge.wanted("q"), setup.low, setup.high):
        by, limit = (low - wanted, low) if wanted < low else (wanted - high, high)
        if by > AT_LIMIT and joint not in known:
            text = f"the target {wanted:.4g} {unit} of joint '{joint}' is out of reach by {by:.4g} {unit}"
            degrees = "; is it in degrees?" if unit == "rad" and abs(wanted) > LEAST_TURN else ""
            yield Cause("reach", f"{text}: its limit is {limit:.4g} {unit}{degrees}", float(by), joint)
    robot, target, quat = setup.robot, judge.wanted("x"), judge.wanted("quat")
    if robot is None or setup.frame not in robot.links or not target.size or not {"x", "quat"} & {*missed}:
        return
    from ..geometry.reach import nearest  # SciPy takes half a second to import

    axes, size = setup.rows, max(BAND * judge.aims["x"].first, FLOOR)
    search = partial(nearest, setup.kinematics, setup.frame, axes=axes, target=target)
    best = search(quat=np.empty(0), low=setup.low, high=setup.high, q=judge.end("q"))
    if best.distance > size:
        free = np.full(len(setup.joints), inf)
        text = f"the target is out of reach by {best.distance:.4g} m"
        near = (best.q <= setup.low + 1e-6) | (best.q >= setup.high - 1e-6)
        if near.any():
            wide = search(quat=np.empty(0), low=-free, high=free, q=best.q)
            stops = ", ".join(f"'{name}'" for name, at in zip(setup.joints, near) if at)
            text += f" within the joint limits ({stops})" if wide.distance < size else ""
        if np.abs(target).max() > MILLIMETRES and np.linalg.norm(0.001 * target - best.point[axes]) < best.distance:
            text += "; is it in millimetres?"
        text += f"; the nearest reachable point is {point_text(best.point[axes])} m"
        gap = float(np.linalg.norm(judge.end("x") - best.point[axes]))
        text += f", {gap:.4g} m from the end effector" * (gap > size)
        yield Cause("reach", text, best.distance, point=tuple(best.point.tolist()))
    elif quat.size:
        best = search(quat=quat, low=setup.low, high=setup.high, q=judge.end("q"))
        if best.distance > size or best.angle > max(BAND * judge.aims["quat"].first, 1e-3):
            text = f"the target pose is out of reach by {best.angle:.4g} rad and {best.distance:.4g} m"
            share = best.distance if best.distance > size else best.angle
            yield Cause("reach", text, share, point=tuple(best.point.tolist()))


def _at_limits(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    setup, q, t = judge.setup, judge.history("q"), judge.history()
    taken = judge.duration / max(1, judge.count - 1)
    moving = {joint.leader for joint in _chain(judge)} or {*setup.joints}
    first = judge.first[: len(setup.joints)]
    for side, bound, counts in (("lower", setup.low, judge.low), ("upper", setup.high, judge.high)):
        inside = np.abs(q - bound) <= AT_LIMIT
        for i, (joint, unit) in enumerate(zip(setup.joints, setup.units)):
            rests = abs(first[i] - bound[i]) <= AT_LIMIT and counts[i] >= judge.count - 1
            idle = (judge.wanted("q").size and abs(judge.wanted("q")[i] - bound[i]) <= AT_LIMIT) or joint not in moving
            if counts[i] and not idle and (missed or not rests) and inside[judge.late, i].mean() > OFTEN:
                held = f"for {counts[i] * taken:.4g} s of {judge.duration:.4g} s"
                text = f"joint '{joint}' stood at its {side} limit {bound[i]:.4g} {unit} {held}"
                yield Cause("limit", text, counts[i] / judge.count, joint, float(t[inside[:, i].argmax()]))


def _driven(judge: Judge) -> set[str]:
    """Return the joints that the controller pulls away from the nearer limit at the end: another cause drives them."""
    setup, q = judge.setup, judge.end("q")
    pull = judge.wanted("q") - q if judge.wanted("q").size else np.zeros(len(q))
    if _chain(judge) and not judge.wanted("quat").size:
        jacobian = setup.kinematics.jacobian(setup.frame, q[None])[0, setup.rows]
        pull = np.linalg.pinv(jacobian, NEAR_SINGULAR) @ (judge.wanted("x") - judge.end("x"))
    above = np.abs(q - setup.high) < np.abs(q - setup.low)
    return {joint for joint, away in zip(setup.joints, np.where(above, pull < 0.0, pull > 0.0)) if away}


def _idle(judge: Judge) -> set[str]:
    """Return the joints that do not move the end effector towards a target, at the end."""
    setup = judge.setup
    if not _chain(judge):
        return set()
    rows = [*setup.rows, *((3, 4, 5) if judge.wanted("quat").size else ())]
    lengths = np.linalg.norm(setup.kinematics.jacobian(setup.frame, judge.end("q")[None])[0, rows], axis=0)
    return {joint for joint, length in zip(setup.joints, lengths) if length <= 1e-6 * lengths.max()}


def _chain(judge: Judge) -> list[Joint]:
    """Return the joints that move the end effector; empty if they are unknown."""
    robot, frame = judge.setup.robot, judge.setup.frame
    return [] if robot is None or frame not in robot.links or "x" not in judge.aims else robot.chain(frame)


def _saturated(judge: Judge) -> Iterator[Cause]:
    setup, tau, t = judge.setup, np.abs(judge.history("tau")), judge.history()
    if tau.shape[1] != len(setup.joints):
        return
    bounds = np.array(setup.limits.effort)
    inside = tau >= bounds * (1.0 - EXACT)
    for i, joint in enumerate(setup.joints):
        beyond = judge.effort[i] > bounds[i] * (1.0 + EXACT)
        if judge.share[i] > OFTEN and not beyond and inside[judge.late, i].mean() > OFTEN:
            most = f"{bounds[i]:.4g} {EFFORT_UNITS.get(setup.units[i], '')} for {100 * judge.share[i]:.3g} %"
            payload = judge.held.get("payload")
            load = f", with the payload of {payload:g} kg" if payload else ""
            text = f"the motor of joint '{joint}' was saturated at {most} of the time{load}"
            yield Cause("saturation", text, float(judge.share[i]), joint, float(t[inside[:, i].argmax()]))


def _friction(judge: Judge, missed: Sequence[str], loaded: bool) -> Iterator[Cause]:
    """Yield joints that stick; small friction also holds a joint where an unknown load balances the controller."""
    setup, tau = judge.setup, np.abs(judge.history("tau")[judge.late])
    friction, v = setup.given("friction"), np.abs(judge.end("v"))
    q, driven = judge.end("q"), _driven(judge)
    at_limit = np.minimum(np.abs(q - setup.low), np.abs(q - setup.high)) <= AT_LIMIT
    idle = _idle(judge)
    pressed = {i for i, joint in enumerate(setup.joints) if at_limit[i] and joint not in driven}
    for i, joint in enumerate(setup.joints[: len(friction)]):
        off = abs(judge.wanted("q")[i] - judge.end("q")[i]) > FLOOR if judge.wanted("q").size else bool(missed)
        moved = max(0.0, float(judge.moved[i]))
        held = judge.duration - moved > OFTEN * judge.duration
        least = DRAG * tau[:, i].max() if loaded and tau.shape[1] > i else 0.0
        off = off and joint not in idle
        if friction[i] > least and off and i not in pressed and (held or v[i] <= CREEPING * judge.speed[i]):
            size = f"its friction of {friction[i]:.4g} {'N' if setup.units[i] == 'm' else 'N·m'}"
            text = f"{size} holds it from {moved:.4g} s on" if held else f"{size} stops it short of its target"
            text += "; raise Kp" * bool(judge.aims)
            share = 1.0 - moved / judge.duration if held else 0.0
            yield Cause("friction", f"joint '{joint}' sticks: {text}", share, joint, moved if held else None)


def _singular(judge: Judge) -> Iterator[Cause]:
    setup, q, t = judge.setup, judge.history("q"), judge.history()
    rows = [*setup.rows, *((3, 4, 5) if judge.wanted("quat").size else ())]
    moving = {joint.leader for joint in _chain(judge)} & {*setup.joints}
    if not 0 < len(rows) <= len(moving):  # without an end effector, or singular everywhere
        return
    sigma = np.linalg.svd(setup.kinematics.jacobian(setup.frame, q)[:, rows], compute_uv=False)
    ratio = sigma[:, -1] / np.maximum(sigma[:, 0], 1e-300)
    near = max(NEAR_SINGULAR, 2.0 * float(setup.starts.get("rcond", 0.0)))
    late, at = ratio[judge.late], t[judge.late]
    k = int(late.argmin())
    if np.mean(late <= near) > OFTEN:
        text = f"the arm is near a singularity: its singular values have the ratio {late[k]:.2g} at {at[k]:.4g} s"
        yield Cause("singularity", text, 1.0 - float(late[k]), time=float(at[k]))
