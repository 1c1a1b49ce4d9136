"""Causes of a run's failure, the root cause first."""

from collections.abc import Iterator, Sequence
from functools import partial
from math import inf, log, pi, radians, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..plant.urdf import Joint
from ..plant.variables import EXACT
from .judge import AT_LIMIT, BAND, Judge
from .sampled_loop import spectral_radius
from .setup import Array

KINDS = {
    "diverged": "a value that is not finite",
    "degrees": "a value in degrees where radians are meant",
    "reach": "the target is out of reach",
    "gain": "a gain of 0",
    "feedforward": "a target that rests, with a target velocity or acceleration",
    "sampling": "an oscillation as fast as the steps of controller or communication",
    "limit": "a joint at its position limit",
    "friction": "a joint that sticks",
    "saturation": "a motor at its effort limit",
    "load": "a load that the controller does not know",
    "damping": "too little damping",
    "singularity": "a singular pose",
    "time": "gains that are too slow for the duration",
    "drag": "damping of the joints that the controller does not know",
    "effort": "an effort beyond the URDF's limit",
    "velocity": "a speed beyond the URDF's limit",
}
"""Kinds of causes in their order; a cause may lead to those after it."""
MOST = 20  # causes in a verdict
FLOOR = 1e-4  # m, rad: a smaller error is the integrator's
MANY_CHANGES = 12  # changes of a target beyond which it counts as moving
OFTEN = 0.05  # share of samples from which on a state is a cause
UNSTABLE = 1.0 + 1e-6  # spectral radius, above rounding
NEAR_SINGULAR = 0.02  # ratio of the smallest to the largest singular value
LEAST_TURN = 2.0 * pi  # rad: a larger joint target may be in degrees
MILLIMETRES = 10.0  # m: a target farther away is probably not in metres
CREEPING = 1e-3  # fraction of its largest speed below which a joint with friction counts as stuck
EFFORT_UNITS = {"rad": "N·m", "m": "N"}  # by the joint's unit
OVERDAMPED = 5.0  # damping ratio from which on less damping is quicker
FAST = 0.25  # sign changes of a velocity in the time of a step that indicate too large a step


class Cause(NamedTuple):
    """A cause in words, and its kind, a key of KINDS.

    Attributes:
        share: share of the samples or of a limit, by which causes are ranked; 0 without one.
        joint: joint concerned, or "".
        time: time at which it was first seen, s since the first sample; None if it holds for the whole run.
        point: nearest reachable position in the root frame, m; () for other kinds.
    """

    kind: str
    text: str
    share: float = 0.0
    joint: str = ""
    time: float | None = None
    point: tuple[float, ...] = ()


def causes(judge: Judge, missed: Sequence[str], motion: str) -> tuple[Cause, ...]:
    """Return the causes, the root first.

    Args:
        judge: the judge of all samples.
        missed: outputs that are not at their targets: "x", "quat" or "q".
        motion: motion at the end of the run.
    """
    found = [*_degrees(judge), *_beyond_limits(judge)]
    ill = bool(missed) or motion == "diverging"
    if missed:
        found += [*_reach(judge, missed), *_gains(judge, missed), *_feedforward(judge, missed), *_load(judge)]
        found += [*_friction(judge, missed), *_singular(judge), *_slow(judge, missed)]
    if ill or not judge.aims:
        found += [*_at_limits(judge, missed), *_saturated(judge), *_sampled(judge)]
    if missed:
        found += _damping(judge, ["x", "quat"] if motion in ("oscillating", "diverging") else missed)
    order, motors = [*KINDS], max((cause.share for cause in found if cause.kind == "saturation"), default=0.0)
    driven = _driven(judge)

    def rank(cause: Cause) -> tuple[int, float]:
        # a joint in the way saturates motors no longer
        passing = cause.kind == "limit" and (cause.share < motors or cause.joint in driven)
        return order.index("drag" if passing else cause.kind), -cause.share

    return tuple(sorted(found, key=rank)[:MOST])


def _degrees(judge: Judge) -> Iterator[Cause]:
    setup = judge.setup
    for group in ("q_des", "q_start"):
        for i, (value, joint) in enumerate(zip(judge.given(group), setup.joints)):
            fits = setup.low[i] - AT_LIMIT <= radians(value) <= setup.high[i] + AT_LIMIT
            if setup.units[i] == "rad" and abs(value) > LEAST_TURN and fits:
                text = f"{group}[{i + 1}] = {value:g} rad: {value:g}°? That is {radians(value):.4g} rad"
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
        yield Cause("reach", text, best.distance, point=tuple(best.point.tolist()))
    elif quat.size and "quat" in missed:
        best = search(quat=quat, low=setup.low, high=setup.high, q=judge.end("q"))
        if best.angle > max(BAND * judge.aims["quat"].first, 1e-3):
            text = f"the target pose is out of reach by {best.angle:.4g} rad and {best.distance:.4g} m"
            yield Cause("reach", text, best.angle, point=tuple(best.point.tolist()))


def point_text(values: Array) -> str:
    """Return a vector as text, without rounding errors."""
    return f"({', '.join(f'{value:.4g}' for value in np.round(values, 9) + 0.0)})"


def _gains(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    for group in ("Kp_rot" if name == "quat" else "Kp" for name in missed):
        zero = [f"{group}[{i + 1}]" for i, gain in enumerate(judge.given(group)) if gain == 0.0]
        if zero:
            yield Cause("gain", f"{', '.join(zero)} = 0: the controller does not reduce this error", 1.0)


def _feedforward(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    groups = {"x": ("xd_des", "xdd_des"), "quat": ("omega_des", "alpha_des"), "q": ("v_des", "a_des")}
    for group in (group for name in missed for group in groups[name]):
        values = judge.given(group)
        if values.any() and judge.changes <= MANY_CHANGES:
            yield Cause("feedforward", f"{group} = {point_text(values)} is not 0, while the target rests", 1.0)


def _late(judge: Judge, inside: NDArray[np.bool_]) -> float:
    """Return the share of samples at which a condition holds: of the last quarter, or of all for a moving target."""
    return float(inside[0 if judge.changes > MANY_CHANGES else -(len(inside) // 4 + 1) :].mean())


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
            if counts[i] and not idle and (missed or not rests) and _late(judge, inside[:, i]) > OFTEN:
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
        if judge.share[i] > OFTEN and not beyond and _late(judge, inside[:, i]) > OFTEN:
            most = f"{bounds[i]:.4g} {EFFORT_UNITS.get(setup.units[i], '')} for {100 * judge.share[i]:.3g} %"
            payload = judge.held.get("payload")
            load = f", with the payload of {payload:g} kg" if payload else ""
            text = f"the motor of joint '{joint}' was saturated at {most} of the time{load}"
            yield Cause("saturation", text, float(judge.share[i]), joint, float(t[inside[:, i].argmax()]))


def _friction(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    setup = judge.setup
    friction, v = setup.given("friction"), np.abs(judge.end("v"))
    own = {name: joint.friction for name, joint in (setup.robot.joints if setup.robot else {}).items()}
    for i, joint in enumerate(setup.joints[: len(friction)]):
        off = abs(judge.wanted("q")[i] - judge.end("q")[i]) > FLOOR if judge.wanted("q").size else bool(missed)
        moved = max(0.0, float(judge.moved[i]))
        held = judge.duration - moved > OFTEN * judge.duration
        if friction[i] > 0.0 and off and (held or v[i] <= CREEPING * judge.speed[i]):
            size = f"its friction of {friction[i]:.4g} {'N' if setup.units[i] == 'm' else 'N·m'}"
            text = f"{size} holds it from {moved:.4g} s on" if held else f"{size} stops it short of its target"
            text += "; raise Kp" * bool(judge.aims and friction[i] <= own.get(joint, 0.0))
            share = 1.0 - moved / judge.duration if held else 0.0
            yield Cause("friction", f"joint '{joint}' sticks: {text}", share, joint, moved if held else None)


def _load(judge: Judge) -> Iterator[Cause]:
    if judge.held.get("payload") and not judge.held.get("payload_known"):
        yield Cause("load", f"the controller does not know the payload of {judge.held['payload']:g} kg", 1.0)
    joints = judge.setup.robot.joints if judge.setup.robot is not None else {}
    usual = {name: joints[name].damping if name in joints else 0.0 for name in judge.setup.joints}
    heavy = [name for name, d in zip(usual, judge.given("damping")) if d > 2.0 * usual[name]]
    each = heavy or [name for name in usual if usual[name] > 0.0]
    which = "all joints" if len(each) == len(usual) > 2 else f"joints {', '.join(map(repr, each))}"
    kind, tail, share = ("load", "", 0.4) if heavy else ("drag", " in the URDF", 0.0)
    if each:
        yield Cause(kind, f"the controller does not know the damping of {which}{tail}", share)
    for group, unit in (("tau_ext", ""), ("f_ext", " N")):
        values = judge.given(group)
        if values.any():
            yield Cause("load", f"{group} = {point_text(values)}{unit} acts, which the controller does not know", 0.5)


def _sampled(judge: Judge) -> Iterator[Cause]:
    v, setup = judge.tail("v")[-256:], judge.setup
    sampling = [setup.starts.get(name, 0.0) for name in ("control_period", "control_delay")]
    continuous = bool(judge.aims) and not any(sampling) and judge.changes <= MANY_CHANGES
    if len(v) < 16 or continuous:  # the steps of communication change nothing in a continuous law
        return
    turns = (np.sign(v[1:]) * np.sign(v[:-1]) < 0.0).mean(axis=0)
    turns[np.abs(v).mean(axis=0) <= 1e-3 * np.maximum(judge.speed, 1e-3)] = 0.0
    i = int(turns.argmax())
    if turns[i] * max(setup.step, sum(sampling)) >= FAST * setup.step:
        gains = "" if "x" in judge.aims or "q" in judge.aims else " of the controller outside"
        what = ", ".join(_sampling(judge, i)) or f"communication steps of {setup.step:g} s"
        text = f"joint '{setup.joints[i]}' reverses every {setup.step / turns[i]:.2g} s: the gains{gains} are too high"
        yield Cause("sampling", f"{text} for {what}", float(turns[i]), setup.joints[i])
    elif any(sampling):
        yield from _unstable(judge, *sampling)


def _unstable(judge: Judge, period: float, delay: float) -> Iterator[Cause]:
    """Yield a cause if the sampled loop is unstable, even while limits hold the joints."""
    loop = partial(spectral_radius, period=period, delay=delay, differences=bool(judge.setup.starts.get("v_from_q")))
    for stiff, damp in (("Kp", "Kd"), ("Kp_rot", "Kd_rot")):
        pairs = enumerate(zip(judge.given(stiff), judge.given(damp)))
        radius, i, p, d = max(((loop(*pair), i, *pair) for i, pair in pairs), default=(0.0, 0, 0.0, 0.0))
        if radius > UNSTABLE:
            gains = f"{stiff}[{i + 1}] = {p:g} s⁻² and {damp}[{i + 1}] = {d:g} s⁻¹ are too high"
            text = f"{gains} for control_period = {period:g} s and control_delay = {delay:g} s: the loop is unstable"
            yield Cause("sampling", f"{text}, an error grows {radius:.3g} times in a period", log(radius))


def _sampling(judge: Judge, i: int) -> Iterator[str]:
    """Yield the settings of a sampled controller and of the sensors of joint i."""
    starts, unit = judge.setup.starts, judge.setup.units[i]
    period, coarse = starts.get("control_period", 0.0), starts.get(f"q_resolution[{i + 1}]", 0.0)
    for name, of in (("control_period", "s"), ("control_delay", "s"), (f"q_resolution[{i + 1}]", unit)):
        if starts.get(name):
            yield f"{name} = {starts[name]:g} {of}"
    if coarse and period and starts.get("v_from_q"):
        yield f"so velocities in steps of {coarse / period:.4g} {unit}/s"
    for name, of in ((f"q_noise[{i + 1}]", unit), (f"v_noise[{i + 1}]", f"{unit}/s")):
        if starts.get(name):
            yield f"{name} = {starts[name]:g} {of}"


def _damping(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    for stiff, damp in dict.fromkeys(("Kp_rot", "Kd_rot") if name == "quat" else ("Kp", "Kd") for name in missed):
        Kp, Kd = judge.given(stiff), judge.given(damp)
        ratios = [(d / (2.0 * sqrt(p)), i, p, d) for i, (p, d) in enumerate(zip(Kp, Kd)) if p > 0.0]
        if ratios and min(ratios)[0] < 0.2:
            ratio, i, p, d = min(ratios)
            text = f"{damp}[{i + 1}] = {d:g} s⁻¹ damps {stiff}[{i + 1}] = {p:g} s⁻² too little"
            yield Cause("damping", f"{text}: critical damping is {2.0 * sqrt(p):.4g} s⁻¹", 1.0 - ratio)


def _singular(judge: Judge) -> Iterator[Cause]:
    setup, q, t = judge.setup, judge.history("q"), judge.history()
    rows = [*setup.rows, *((3, 4, 5) if judge.wanted("quat").size else ())]
    moving = {joint.leader for joint in _chain(judge)} & {*setup.joints}
    if len(rows) > len(moving):  # singular everywhere
        return
    sigma = np.linalg.svd(setup.kinematics.jacobian(setup.frame, q)[:, rows], compute_uv=False)
    ratio = sigma[:, -1] / np.maximum(sigma[:, 0], 1e-300)
    near = max(NEAR_SINGULAR, 2.0 * float(setup.starts.get("rcond", 0.0)))
    k = int(ratio.argmin())
    if _late(judge, ratio <= near) > OFTEN:
        text = f"the arm is near a singularity: its singular values have the ratio {ratio[k]:.2g} at {t[k]:.4g} s"
        yield Cause("singularity", text, 1.0 - float(ratio[k]), time=float(t[k]))


def _slow(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    """Yield a cause for each output whose error still shrinks, with the remaining time by its rate."""
    t = judge.history()
    for name in missed:
        aim = judge.aims[name]
        size = np.array(judge.error_history(name))
        k = int(np.searchsorted(t, judge.changed + 0.8 * (judge.duration - judge.changed)))
        if len(size) < 4 or k >= len(size) - 1 or not 0.0 < size[-1] < size[k] * (1.0 - 1e-6):
            continue
        rate = log(size[k] / size[-1]) / (t[-1] - t[k])
        left = log(max(size[-1] / max(BAND * aim.first, FLOOR), 1.0)) / rate
        what = {"x": "position still approaches", "quat": "orientation still approaches", "q": "joints still approach"}
        steady = bool((np.diff(size[k:]) < 0.0).all())
        if steady and left < 1000.0 * judge.duration:
            late = f"the target changed at {judge.changed:.4g} s, and " if judge.changed > 0.0 else ""
            text = f"{late}the {what[name]}, with a time constant of {1.0 / rate:.3g} s"
            stiff, damp = ("Kp_rot", "Kd_rot") if name == "quat" else ("Kp", "Kd")
            ratios = [d / (2.0 * sqrt(p)) for p, d in zip(judge.given(stiff), judge.given(damp)) if p > 0.0]
            remedy = f"raise {stiff}, or lower {damp}" if max(ratios, default=0.0) > OVERDAMPED else "raise the gains"
            yield Cause("time", f"{text}: 2 % takes about {left:.3g} s more; stop later, or {remedy}", left)
