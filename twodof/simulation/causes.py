"""Causes of a run's failure, the root cause first."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from math import inf, pi, radians
from operator import itemgetter

import numpy as np
from numpy.typing import ArrayLike

from ..plant.urdf import Joint
from ..plant.variables import EXACT, GAINS
from .aim import BAND
from .cause import EFFORT_UNITS, FLOOR, FOLLOWING, KINDS, MOTION, MOVING, SMALL, Cause, point_text
from .controller_causes import damping, feedforward, gains, load, sampled
from .judge import AT_LIMIT, Judge
from .settling_causes import late_change, slow, unsettled

MOST = 20  # causes in a verdict
OFTEN = 0.05  # share of samples from which on a state is a cause
NEAR_SINGULAR = 0.02  # ratio of the smallest to the largest singular value
LEAST_TURN = 2.0 * pi  # rad: a larger joint target may be in degrees
TURNS_ON_PURPOSE = 6.0 * pi  # rad: a joint without limits may turn this far, if it reaches its target
MILLIMETRES = 10.0  # m: a target farther away is probably not in metres
CREEPING = 1e-3  # fraction of its largest speed below which a joint with friction counts as stuck
GROWN = 3.5  # logarithm of the growth from which on an unstable loop shows in a run
LASTING = 0.5  # part of the error due to motion, below which the error does not approach 0
TOGETHER = 2.0  # ratio of distances from which on position and orientation are out of reach only together
EXPLAINED = 0.1  # part of an error that a target out of reach may leave to its consequences


def causes(judge: Judge, missed: Sequence[str], motion: str) -> tuple[Cause, ...]:
    """Return the causes, the root first.

    Args:
        missed: outputs that are not at their targets: "x", "quat" or "q".
        motion: motion at the end of the run.
    """
    parts: Mapping[tuple[str, str], float] = {}
    static: Mapping[str, float] = {}
    rests = not judge.moving
    found = [*_degrees(judge, missed), *_beyond_limits(judge)]
    if missed:
        from .balance import parts_of_error  # SciPy takes half a second to import

        parts, static = parts_of_error(judge, missed)
        found += [*_reach(judge, missed), *gains(judge, missed), *feedforward(judge, missed), *load(judge)]
        sticking = [*_friction(judge, missed, parts)]  # the rate of an error needs parts if joints stick
        reach = max((cause.share for cause in found if cause.kind == "reach"), default=0.0)
        static = {name: max(size, reach) for name, size in static.items()}
        changed = [*late_change(judge)] if _explains(judge, missed) else []
        approaching = slow(judge, missed, static) if rests and not changed and (parts or not sticking) else ()
        found += [*sticking, *_singular(judge), *changed, *approaching]
    if missed or motion == "diverging" or not judge.aims:
        found += [*_at_limits(judge, missed), *_saturated(judge), *sampled(judge)]
    if missed:
        found += damping(judge, ["x", "quat"] if motion in ("oscillating", "diverging") else missed)
    restless = max(_weight("time", "", parts), abs(parts.get(("sampling", ""), 0.0)))
    if rests and restless > LASTING and not any(cause.kind in MOVING for cause in found):
        found += unsettled(judge, parts.get(("motion", ""), 0.0), static)
    ranked = _by_parts(judge, missed, found, parts) if parts else _by_kinds(judge, found) if found else []
    if not ranked:
        return ()
    root, *others = ranked[:MOST]
    return root._replace(noted=bool(missed) and root.kind in MOTION), *others  # a peak does not cause an error


def _explains(judge: Judge, missed: Sequence[str]) -> bool:
    """Return whether most of the error before the latest change of inputs was due to these inputs."""
    if judge.latest is None or not missed:
        return False
    from .balance import parts_of_error  # SciPy takes half a second to import

    t, changes = judge.latest
    groups = {name.partition("[")[0] for name, (old, new) in changes.items() if abs(new - old) >= LASTING * abs(old)}
    parts = parts_of_error(judge.until(t), missed).of
    kinds = {"friction": ("friction", ""), **dict.fromkeys(GAINS, ("gain", ""))}
    each = [kinds.get(group, (kind, group)) for group in groups for kind in ("load", "feedforward")]
    return any(_weight(kind, subject, parts) >= LASTING for kind, subject in each)


def _weight(kind: str, subject: str, parts: Mapping[tuple[str, str], float]) -> float:
    """Return the part of the error due to a kind of cause: of all joints for a force, of the motion for a gain."""
    if kind in MOVING:
        return parts.get(("motion", ""), 0.0) + parts.get(("sampling", ""), 0.0)
    if kind in ("friction", "limit", "saturation"):
        return sum(part for (of, _), part in parts.items() if of == kind)
    return parts.get(("load", "damping") if kind == "drag" else (kind, subject), 0.0)


def _by_parts(
    judge: Judge, missed: Sequence[str], found: Sequence[Cause], parts: Mapping[tuple[str, str], float]
) -> list[Cause]:
    """Return the causes by their parts in the error, without small ones; forces that reduce the error are noted."""
    beyond = max((cause.part or 0.0 for cause in found if cause.kind == "reach"), default=0.0)
    limits = _weight("limit", "", parts)
    bounds = limits + _weight("singularity", "", parts)
    loads = [_weight("load", cause.subject, parts) for cause in found if cause.kind == "load"]
    grown = bool(missed) and all(judge.aims[name].last > judge.aims[name].first for name in missed)
    thrown = grown and min(loads, default=0.0) <= -LASTING and max(loads) < LASTING  # it grows in a longer run

    def weight(cause: Cause) -> float:
        if cause.kind == "reach":
            return cause.part or 0.0
        own = _weight(cause.kind, cause.subject, parts)
        at_limit = bounds >= LASTING and abs(limits + own) < LASTING
        if cause.kind == "load" and own <= -LASTING and (thrown or at_limit):
            return max(bounds, _weight("time", "", parts)) + LASTING  # it moved the arm there, and now pulls it away
        if cause.kind in ("unstable", "sampling"):
            net = bounds + min(0.0, parts.get(("sampling", ""), 0.0))  # a stop also balances wrong efforts
            left = net - beyond if beyond > SMALL else bounds
            return max(own, left if left > EXPLAINED else 0.0, _weight("saturation", "", parts))
        if cause.kind == "singularity" and beyond > SMALL:
            return min(own, beyond)
        led = beyond > SMALL and cause.kind == "limit"
        return own if not led else min(own, bounds - beyond) if bounds - beyond > EXPLAINED else 0.0

    ranked = []
    for cause in found:
        if cause.kind == "time" and (thrown or _weight("time", "", parts) < LASTING):
            continue  # the error does not approach 0
        grows = cause.kind == "unstable" and cause.share * judge.duration > GROWN
        first, most = grows or cause.kind in ("diverged", "degrees"), weight(cause)
        measured = most if cause.kind == "reach" else _weight(cause.kind, cause.subject, parts)
        own = parts.get((cause.kind, cause.joint), most) if cause.joint else most
        reduces = most <= -SMALL and cause.kind not in MOVING
        opposed = reduces or (cause.kind in FOLLOWING and most < SMALL and abs(own) >= SMALL)
        if first or cause.kind in MOTION or opposed or (most >= SMALL and abs(own) >= SMALL):
            after = inf if cause.kind in MOTION or opposed else -round(most, 1)
            after = -inf if cause.kind == "reach" and most >= LASTING else after
            known = cause.kind not in MOTION and not first and most == measured  # and not a value for the order alone
            cause = cause._replace(noted=opposed or cause.kind in MOTION, part=most if known else None)
            ranked.append(((not first, after, [*KINDS].index(cause.kind), -own, -cause.share), cause))
    causes = [cause for _, cause in sorted(ranked, key=itemgetter(0))]
    root = causes[0].kind if causes else ""
    led = ("singularity",) if root == "reach" else FOLLOWING if root in ("degrees", "unstable", "sampling") else ()
    return [cause._replace(noted=cause.noted or cause.kind in led) for cause in causes]


def _by_kinds(judge: Judge, found: Sequence[Cause]) -> list[Cause]:
    """Return the causes in the order of their kinds, for runs whose forces are unknown."""
    motors, driven = max((cause.share for cause in found if cause.kind == "saturation"), default=0.0), _driven(judge)

    def passing(cause: Cause) -> bool:  # a joint at its limit no longer saturates motors
        return cause.kind == "limit" and (cause.share < motors or cause.joint in driven)

    causes = sorted(found, key=lambda each: ([*KINDS].index("drag" if passing(each) else each.kind), -each.share))
    leads = bool(causes) and causes[0].kind in ("reach", "degrees", "unstable", "sampling")
    noted = [passing(each) or each.kind in MOTION or (leads and each.kind in FOLLOWING) for each in causes]
    return [cause._replace(noted=is_noted) for cause, is_noted in zip(causes, noted)]


def _degrees(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    setup, least = judge.setup, LEAST_TURN if missed else TURNS_ON_PURPOSE
    for group in ("q_des", "q_start"):
        for i, (value, joint) in enumerate(zip(judge.given(group), setup.joints)):
            fits = setup.low[i] - AT_LIMIT <= radians(value) <= setup.high[i] + AT_LIMIT
            way = value if group == "q_start" else value - judge.first[i]  # that of a continuous joint may be short
            if setup.units[i] == "rad" and min(abs(value), abs(way)) > least and fits:
                meant = f"did you mean {value:g}°, which is {radians(value):.5g} rad?"
                text = f"{group}[{i + 1}] is {value:g} rad; {meant}"
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
    known = {cause.joint for cause in _degrees(judge, missed)}
    for joint, unit, wanted, low, high in zip(setup.joints, setup.units, judge.wanted("q"), setup.low, setup.high):
        by, limit = (low - wanted, low) if wanted < low else (wanted - high, high)
        if by > AT_LIMIT and joint not in known:
            text = f"the target {wanted:.4g} {unit} of joint '{joint}' is out of reach by {by:.4g} {unit}"
            degrees = "; is it in degrees?" if unit == "rad" and abs(wanted) > LEAST_TURN else ""
            part = _part_of(judge, missed, "q", by)
            yield Cause("reach", f"{text}: its limit is {limit:.4g} {unit}{degrees}", float(by), joint, part=part)
    robot, target, quat = setup.robot, judge.wanted("x"), judge.wanted("quat")
    if robot is None or setup.frame not in robot.links or not target.size or not {"x", "quat"} & {*missed}:
        return
    from ..geometry.reach import nearest  # SciPy takes half a second to import

    axes, size = setup.rows, max(BAND * judge.aims["x"].first, FLOOR)
    search = partial(nearest, setup.kinematics, setup.frame, axes=axes, target=target)
    best = search(quat=np.empty(0), low=setup.low, high=setup.high, q=judge.end("q"))
    gap = float(np.linalg.norm(judge.end("x") - best.point[axes]))
    pose = search(quat=quat, low=setup.low, high=setup.high, q=judge.end("q")) if quat.size and gap > size else None
    if best.distance > size and (pose is None or pose.distance < TOGETHER * best.distance):
        free = np.full(len(setup.joints), inf)
        text = f"the target is out of reach by {best.distance:.4g} m"
        near = (best.q <= setup.low + 1e-6) | (best.q >= setup.high - 1e-6)
        if near.any():
            wide = search(quat=np.empty(0), low=-free, high=free, q=best.q)
            stops = ", ".join(f"'{name}'" for name, at in zip(setup.joints, near) if at)
            text += f" within the joint limits ({stops})" if wide.distance < size else ""
        text += f"; the nearest reachable point is {point_text(best.point[axes])} m"
        text += f", {gap:.4g} m from the end effector" * (gap > size)
        if np.abs(target).max() > MILLIMETRES and np.linalg.norm(0.001 * target - best.point[axes]) < best.distance:
            text += "; is the target in millimetres?"
        part = _part_of(judge, missed, "x", target - best.point[axes])
        yield Cause("reach", text, best.distance, point=tuple(best.point.tolist()), part=part)
    elif quat.size:
        best = pose or search(quat=quat, low=setup.low, high=setup.high, q=judge.end("q"))
        if best.distance > size or best.angle > max(BAND * judge.aims["quat"].first, 1e-3):
            text = f"the target pose is out of reach by {best.angle:.4g} rad and {best.distance:.4g} m"
            share = best.distance if best.distance > size else best.angle
            both = _part_of(judge, missed, "x", target - best.point[axes]), _part_of(judge, missed, "quat", best.angle)
            yield Cause("reach", text, share, point=tuple(best.point.tolist()), part=max(both))


def _part_of(judge: Judge, missed: Sequence[str], name: str, gap: ArrayLike) -> float:
    """Return the ratio of a gap, a vector or an angle, to the error of a missed output late in the run."""
    if name not in missed:
        return 0.0
    size = np.sqrt(np.mean(np.square(judge.error_history(name)[judge.late])))
    return float(np.linalg.norm(gap) / max(size, FLOOR))


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
    """Return the joints that the controller pulls away from the nearer limit at the end: another cause holds them."""
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
            remedy = "reduce the payload" if payload else "lower the gains"
            text = f"the motor of joint '{joint}' was saturated at {most} of the time{load}; {remedy}"
            yield Cause("saturation", text, float(judge.share[i]), joint, float(t[inside[:, i].argmax()]))


def _friction(judge: Judge, missed: Sequence[str], parts: Mapping[tuple[str, str], float]) -> Iterator[Cause]:
    """Yield joints that stick, or whose friction has a part in the error."""
    setup = judge.setup
    friction, v = setup.given("friction"), np.abs(judge.end("v"))
    q, driven = judge.end("q"), _driven(judge)
    at_limit = np.minimum(np.abs(q - setup.low), np.abs(q - setup.high)) <= AT_LIMIT
    idle = _idle(judge)
    pressed = {i for i, joint in enumerate(setup.joints) if at_limit[i] and joint not in driven}
    for i, joint in enumerate(setup.joints[: len(friction)]):
        off = abs(judge.wanted("q")[i] - judge.end("q")[i]) > FLOOR if judge.wanted("q").size else bool(missed)
        moved = max(0.0, float(judge.moved[i]))
        held = judge.duration - moved > OFTEN * judge.duration
        off = off and joint not in idle and i not in pressed and (held or v[i] <= CREEPING * judge.speed[i])
        if friction[i] and (abs(parts.get(("friction", joint), 0.0)) >= SMALL if parts else off):
            size = f"its friction of {friction[i]:.4g} {'N' if setup.units[i] == 'm' else 'N·m'}"
            creeps = not held and v[i] > CREEPING * judge.speed[i]
            stops = "slows it down" if creeps else "stops it short of its target"
            holds = f"holds it from {moved:.4g} s on" if moved else "holds it during the whole run"
            text = f"{size} {holds if held else stops}"
            text += "; raise Kp" * (bool(judge.aims) and (not parts or _weight("friction", "", parts) > 0.0))
            share = 1.0 - moved / judge.duration if held else 0.0
            state = "creeps" if creeps else "sticks"
            yield Cause("friction", f"joint '{joint}' {state}: {text}", share, joint, moved if held else None)


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
        text = f"the arm is near a singularity: σ_min/σ_max of its Jacobian is {late[k]:.2g} at {at[k]:.4g} s"
        yield Cause("singularity", text, 1.0 - float(late[k]), time=float(at[k]))
