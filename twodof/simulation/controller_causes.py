"""Causes of a run's failure in the controller: its gains, its sampling, and what it does not know."""

from collections.abc import Iterator, Sequence
from math import log, sqrt
from typing import NamedTuple

import numpy as np

from .aim import BAND
from .cause import EFFORT_UNITS, FLOOR, Cause, point_text
from .judge import AT_LIMIT, Judge
from .sampled_loop import quickest_gains, spectral_radius, stable_gains
from .setup import Array

UNSTABLE = 1.0 + 1e-6  # spectral radius, above rounding
SLIGHT = 1e-4  # torque, relative to the largest effort, below which a load does not count
LEVER = 1.0  # m: of a force at the end effector
PERIODS = ("control_period", "control_delay")
WEAK = 0.2  # damping ratio below which damping is too small
FADING = 0.7  # ratio of mean speeds, of the second to the first half of the last samples, that shows a decay
FAST = 0.25  # sign changes of a velocity in the time of a step that indicate too large a step
GAINS = (("Kp", "Kd"), ("Kp_rot", "Kd_rot"))
SPOILT = 0.5  # fraction of a continuous controller's decay rate below which the sampling is a cause
STILL = 1e-3  # fraction of the largest speed below which a joint is at rest
OF_ERROR = 0.1  # part of the largest element of an error from which on an element counts
GRAVITY = 9.81  # m/s²
DRAG = 0.02  # effort of damping, relative to the joint's largest effort in the last quarter, that counts


def gain_name(judge: Judge, group: str, i: int) -> str:
    """Return the name of element i of a gain, and its direction or joint, unless all elements are equal."""
    values = judge.given(group)
    if len(values) > 1 and not np.ptp(values):
        return group
    axes, joints = judge.setup.axes if "x" in judge.aims else "", judge.setup.joints
    each = [f"about {axis}" for axis in "xyz"] if group.endswith("_rot") else [f"along {axis}" for axis in axes]
    each = each or [f"of joint '{joint}'" for joint in joints]
    return f"{group}[{i + 1}] ({each[i]})" if len(each) == len(values) else f"{group}[{i + 1}]"


def gains(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    """Yield gains of 0 that act on an error."""
    for name in missed:
        group, error = ("Kp_rot", "orientation") if name == "quat" else ("Kp", "position" if name == "x" else "joints")
        values = judge.given(group)
        off = np.ones(len(values), bool)  # an orientation's error has no elements in the samples
        if name != "quat" and len(e := np.abs(judge.wanted(name) - judge.end(name))) == len(values):
            off = e >= OF_ERROR * e.max()
        zero = list(
            dict.fromkeys(gain_name(judge, group, i) for i, gain in enumerate(values) if gain == 0.0 and off[i])
        )
        if zero:
            text = f"{', '.join(zero)} = 0: the controller does not reduce the error of the {error}; raise the gain"
            yield Cause("gain", text, 1.0)


def feedforward(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    """Yield target velocities and accelerations that are not 0 while the target rests, and 0 while it moves."""
    groups = {"x": ("xd_des", "xdd_des"), "quat": ("omega_des", "alpha_des"), "q": ("v_des", "a_des")}
    for group in (group for name in missed for group in groups[name]):
        values = judge.given(group)
        if values.any() and not judge.moving:
            text = f"{group} = {point_text(values)} is not 0, while the target rests; set it to 0"
            yield Cause("feedforward", text, 1.0, subject=group)
    for stiff, damp, group in (
        ("Kp", "Kd", groups["q" if "q" in missed else "x"][0]),
        ("Kp_rot", "Kd_rot", "omega_des"),
    ):
        of = "quat" if stiff == "Kp_rot" else "q" if "q" in missed else "x"
        lags = [d / p for p, d in zip(judge.given(stiff), judge.given(damp)) if p > 0.0]
        still = not judge.given(group).any() and f"{group}[1]" not in judge.inputs
        if of in missed and judge.moving and still and lags:
            text = f"the target moves, and {group} is 0: the lag is {damp}/{stiff} = {max(lags):.3g} s"
            yield Cause("time", f"{text}; set {group}, raise {stiff} or lower {damp}", 0.5)


def load(judge: Judge, slight: float = SLIGHT) -> Iterator[Cause]:
    """Yield loads, and the damping of joints, that the controller does not know.

    Args:
        slight: torque, relative to the largest effort, below which a load does not count.
    """
    switch, (payload, believed) = "payload_known", payloads(judge)
    own = judge.setup.controller
    if payload and believed != payload and (share := _share(judge, abs(payload - believed) * GRAVITY * LEVER)) > slight:
        text = f"the controller does not know the payload of {payload:g} kg; set {own}{switch}=true"
        text += f" and {own}payload={payload:g}" * bool(own)
        if believed:
            text = f"the controller assumes a payload of {believed:g} kg, the plant has {payload:g} kg"
            text += f"; set {own}payload={payload:g}"
        yield Cause("load", text, share, subject="payload")
    elif believed and not payload:
        text = f"the controller assumes a payload of {believed:g} kg, which the plant does not have; set {own}payload=0"
        yield Cause("load", text, _share(judge, believed * GRAVITY * LEVER), subject="payload")
    for name in ("gravity", "payload_com", "armature"):
        real, model = judge.given(name), judge.given(own + name)
        if own and len(real) == len(model) and (real != model).any():
            text = f"the controller's model has {name} = {point_text(model)}, the plant {name} = {point_text(real)}"
            yield Cause("load", f"{text}; set {own}{name} to that of the plant", 1.0, subject=name)
    links = judge.setup.links
    for group in dict.fromkeys(n.partition("[")[0] for n, start in links.items() if judge.held.get(n, start) != start):
        elements = [name for name in links if name.partition("[")[0] == group]
        vectors = [np.array([values[name] for name in elements]) for values in (judge.held, links)]
        now, before = (f"{vector[0]:.4g}" if len(vector) == 1 else point_text(vector) for vector in vectors)
        yield Cause("load", f"the controller does not know {group} = {now}: its model has {before}", 1.0, subject=group)
    joints = judge.setup.robot.joints if judge.setup.robot is not None else {}
    usual = {name: joints[name].damping if name in joints else 0.0 for name in judge.setup.joints}
    drags = [_share(judge, d * speed) for d, speed in zip(judge.given("damping"), judge.speed)]
    given = zip(usual, judge.given("damping"), drags)
    heavy = [name for name, d, share in given if d > 2.0 * usual[name] and share > slight]
    each = heavy or [name for name in usual if usual[name] > 0.0]
    names = "of any joint" if len(each) == len(usual) > 2 else f"of joints {', '.join(map(repr, each))}"
    kind, tail, share = ("load", "", max(drags)) if heavy else ("drag", " in the URDF", 0.0)
    if each and (heavy or _drags(judge)):
        yield Cause(kind, f"the controller does not know the damping {names}{tail}", share, subject="damping")
    force, torque = judge.given("f_ext"), judge.given("tau_ext")
    for group, values, text in (("tau_ext", torque, _torques(judge, torque)), ("f_ext", force, _force(force))):
        share = _share(judge, np.abs(values).max(initial=0.0) * (LEVER if group == "f_ext" else 1.0))
        if share > slight:
            yield Cause("load", f"the controller does not know {text}; raise Kp", share, subject=group)


def _force(values: Array) -> str:
    return f"f_ext = {point_text(values)} N"


def _torques(judge: Judge, values: Array) -> str:
    """Return the external torques that are not 0 in words, the largest three with their joints."""
    own = sorted(np.flatnonzero(values), key=lambda i: -abs(values[i]))
    units = [EFFORT_UNITS.get(unit, "") for unit in judge.setup.units]
    texts = [
        f"tau_ext[{i + 1}] (of joint '{judge.setup.joints[i]}') = {values[i]:.4g} {units[i]}".rstrip() for i in own[:3]
    ]
    return ", ".join(texts) + f" and {len(own) - 3} more" * (len(own) > 3)


def payloads(judge: Judge) -> tuple[float, float]:
    """Return the payload of the plant and that of the controller's model, kg."""
    believed = judge.held.get(f"{judge.setup.controller}payload", 0.0) if judge.held.get("payload_known") else 0.0
    return float(judge.held.get("payload") or 0.0), float(believed)


def _share(judge: Judge, torque: float) -> float:
    """Return the ratio of a torque, N·m, to the largest effort; 1 without efforts."""
    most = float(judge.effort.max(initial=0.0))
    return torque / most if most else float(torque > 0.0)


def _drags(judge: Judge) -> bool:
    """Return whether damping needs a part of the late effort of a joint with an error."""
    v, tau, damping = *(np.abs(judge.history(name)[judge.late]) for name in ("v", "tau")), judge.given("damping")
    if not v.shape[1] == tau.shape[1] == len(damping):
        return False
    targets, off = judge.wanted("q"), np.ones(len(damping))
    if targets.size:
        off = np.abs(targets - judge.end("q"))
    drags = (v * damping).max(axis=0, initial=0.0) > DRAG * tau.max(axis=0, initial=0.0)
    return bool((drags & (off >= OF_ERROR * off.max())).any())


def sampled(judge: Judge) -> Iterator[Cause]:
    """Yield sampled loops that are unstable, or else a joint that reverses as fast as the steps."""
    v, setup = judge.tail("v")[-256:], judge.setup
    sampling = [setup.starts.get(name, 0.0) for name in PERIODS]
    if judge.setup.controller:  # the controller is a component, and acts at communication points
        sampling[0] = max(sampling[0], setup.step)
    continuous = bool(judge.aims) and not any(sampling) and not judge.moving and judge.given("Kp").size > 0
    if len(v) < 16 or continuous:  # communication steps have no effect on a continuous law
        return
    if any(sampling) and (found := [*_unstable(judge, *sampling)]):
        yield from found
        return
    turns = (np.sign(v[1:]) * np.sign(v[:-1]) < 0.0).mean(axis=0)
    turns[np.abs(v).mean(axis=0) <= 1e-3 * np.maximum(judge.speed, 1e-3)] = 0.0
    before, after = (np.abs(half).mean(axis=0) for half in (v[: len(v) // 2], v[len(v) // 2 :]))
    turns[(after < FADING * before) & bool(judge.aims)] = 0.0
    i = int(turns.argmax())
    if turns[i] * max(setup.step, sum(sampling)) >= FAST * setup.step:
        gains = f"the gains{_fastest(judge, *sampling)}"
        gains = gains if judge.aims else "the gains of the controller outside"
        period = [f"{name} = {setup.starts[name]:g} s" for name in PERIODS if setup.starts.get(name)]
        what = " and ".join(period) or f"communication steps of {setup.step:g} s"
        sensors = ", ".join(sensors_of(judge, i))
        text = f"joint '{setup.joints[i]}' reverses every {setup.step / turns[i]:.2g} s: "
        text += f"{sensors}: too much for {gains} at {what}" if sensors else f"{gains} are too high for {what}"
        text += "; lower the gains" + ", or take finer sensors" * bool(sensors)
        yield Cause("sampling", text, float(turns[i]), setup.joints[i])


class _Loop(NamedTuple):
    """A sampled loop: its spectral radius, the names of its gains, the index of their elements and their values."""

    radius: float
    stiff: str
    damp: str
    i: int
    Kp: float
    Kd: float


def loops(judge: Judge, period: float, delay: float) -> Iterator[_Loop]:
    """Yield the loops of a sampled controller; that of the self-motion has no Kp, and moves only redundant arms."""
    setup, differences = judge.setup, bool(judge.setup.starts.get("v_from_q"))
    redundant = len(setup.rows) + (3 if judge.wanted("quat").size else 0) < len(setup.joints)
    each = [(stiff, damp, judge.given(stiff), judge.given(damp)) for stiff, damp in GAINS]
    if redundant and "x" in judge.aims and "Kn" in judge.held:
        each.append(("", "Kn", np.zeros(1), np.array([judge.held["Kn"]])))
    for stiff, damp, Kp, Kd in each:
        for i, (p, d) in enumerate(zip(Kp, Kd)):
            yield _Loop(spectral_radius(p, d, period, delay, differences=differences), stiff, damp, i, p, d)


def _fastest(judge: Judge, period: float, delay: float) -> str:
    """Return the gains of the least stable sampled loop in parentheses; without a period, the largest gain."""
    if not period:
        stiff = next((group for group in ("Kp", "Kd") if judge.given(group).any()), "")
        return f" ({stiff} up to {judge.given(stiff).max():g})" if stiff else ""
    loop = max(loops(judge, period, delay), default=None)
    return f" ({', '.join(_named(judge, loop))})" if loop is not None else ""


def _named(judge: Judge, loop: _Loop, units: Sequence[str] = ("", "")) -> list[str]:
    """Return the gains of a loop with their names and values."""
    names = [gain_name(judge, name, loop.i) for name in (loop.stiff, loop.damp)] if loop.stiff else ["", loop.damp]
    return [f"{name} = {value:.6g}{unit}" for name, value, unit in zip(names, (loop.Kp, loop.Kd), units) if name]


def _unstable(judge: Judge, period: float, delay: float) -> Iterator[Cause]:
    """Yield the worst loop of each kind that is unstable, even while limits hold the joints, or hardly decays."""
    every = [*loops(judge, period, delay)]
    for group, output in (("Kp", "q" if "q" in judge.aims else "x"), ("Kp_rot", "quat"), ("", "")):
        loop = max((loop for loop in every if loop.stiff == group), default=None)
        if loop is not None and loop.Kd < WEAK * 2.0 * sqrt(loop.Kp) and late_by(judge, decay(loop)) > judge.duration:
            continue  # the loop lacks damping at any period
        if loop is None or (judge.held.get("payload") and (_rests(judge) or rate_of(judge, output) > 0.0)):
            continue  # a load lowers the true gains
        rate = -log(max(loop.radius, 1e-300)) / period
        if loop.radius > UNSTABLE:
            state = f"the loop{'' if group else ' of the self-motion'} is unstable, "
            state += f"{'an error' if group else 'it'} doubles in {-log(2.0) / rate:.2g} s"
        elif group and rate < SPOILT * decay(loop) and log(1.0 / BAND) > rate * (judge.duration - judge.changed):
            left = log(1.0 / BAND) / max(rate, 1e-9)
            state = f"the loop is close to unstable, an error takes {left:.2g} s to decay to 2 %"
            state = state if rate > 1e-6 else "the loop is at its limit of stability, errors do not decay"
        else:
            continue
        gains, are = " and ".join(_named(judge, loop, (" s⁻²", " s⁻¹"))), "are" if group else "is"
        late = f" and control_delay = {delay:g} s" * bool(delay)
        own = judge.setup.starts.get("control_period") == period
        step = f"control_period = {period:g} s" if own else f"communication steps of {period:g} s"
        text = f"{gains} {are} too high for {step}{late}: {state}"
        yield Cause("unstable", text + _better(judge, loop, period, delay), -rate)


def _better(judge: Judge, loop: _Loop, period: float, delay: float) -> str:
    """Return the largest stable gains, if the present ones are not, and those whose errors decay the quickest."""
    differences = bool(judge.setup.starts.get("v_from_q"))
    find = (stable_gains, quickest_gains)
    most, best = (each(loop.Kp, loop.Kd, period, delay, differences=differences) for each in find)
    if not any(most):
        return ""
    below, quick = (
        [f"{name} = {value:.3g}" for name, value in zip((loop.stiff, loop.damp), pair) if name] for pair in (most, best)
    )
    stable = f"stable below {' with '.join(below)}, and " if loop.radius > UNSTABLE else ""
    return f"; {'at the same damping ratio ' * bool(loop.stiff)}it is {stable}quickest with {' and '.join(quick)}"


def _rests(judge: Judge) -> bool:
    """Return whether the joints rest late in the run, away from their limits."""
    setup, q, v = judge.setup, judge.end("q"), np.abs(judge.history("v")[judge.late])
    inside = (np.minimum(q - setup.low, setup.high - q) > AT_LIMIT).all()
    return bool(inside and v.max(initial=0.0) <= STILL * max(float(judge.speed.max()), FLOOR))


def decay(loop: _Loop) -> float:
    """Return the slowest rate of decay of the loop of a continuous controller, 1/s."""
    return float(-np.roots([1.0, loop.Kd, loop.Kp]).real.max())


def sensors_of(judge: Judge, i: int) -> Iterator[str]:
    """Yield the settings of the sensors of joint i."""
    starts, unit = judge.setup.starts, judge.setup.units[i]
    period, coarse = starts.get("control_period", 0.0), starts.get(f"q_resolution[{i + 1}]", 0.0)
    if coarse:
        yield f"q_resolution[{i + 1}] = {coarse:g} {unit}"
    if coarse and period and starts.get("v_from_q"):
        yield f"so velocities in steps of {coarse / period:.4g} {unit}/s"
    for name, of in ((f"q_noise[{i + 1}]", unit), (f"v_noise[{i + 1}]", f"{unit}/s")):
        if starts.get(name):
            yield f"{name} = {starts[name]:g} {of}"
    if (noise := starts.get(f"q_noise[{i + 1}]")) and period and starts.get("v_from_q"):
        yield f"so velocities with a noise of {sqrt(2.0) * noise / period:.4g} {unit}/s"


def damping(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    """Yield gains with a small damping ratio."""
    for stiff, damp in dict.fromkeys(("Kp_rot", "Kd_rot") if name == "quat" else ("Kp", "Kd") for name in missed):
        Kp, Kd = judge.given(stiff), judge.given(damp)
        ratios = [(d / (2.0 * sqrt(p)), i, p, d) for i, (p, d) in enumerate(zip(Kp, Kd)) if p > 0.0]
        if ratios and min(ratios)[0] < WEAK:
            ratio, i, p, d = min(ratios)
            names = [gain_name(judge, group, i) for group in (damp, stiff)]
            text = f"{names[0]} = {d:g} s⁻¹ damps {names[1]} = {p:g} s⁻² too little"
            yield Cause("damping", f"{text}: critical damping is {2.0 * sqrt(p):.4g} s⁻¹", 1.0 - ratio)


def late_by(judge: Judge, rate: float) -> float:
    """Return the additional time, s, in which an error with a rate of decay, 1/s, would reach 2 %."""
    return log(1.0 / BAND) / max(rate, 1e-9) - (judge.duration - judge.changed)


def rate_of(judge: Judge, name: str) -> float:
    """Return the rate, 1/s, at which an output's error shrinks steadily at the end of the run; else 0."""
    if name not in judge.aims:
        return 0.0
    t, size = judge.history(), np.array(judge.error_history(name))
    k = int(np.searchsorted(t, judge.changed + 0.8 * (judge.duration - judge.changed)))
    if len(size) < 4 or k >= len(size) - 1 or not t[-1] > t[k] or not 0.0 < size[-1] < size[k] * (1.0 - 1e-6):
        return 0.0
    return log(size[k] / size[-1]) / (t[-1] - t[k]) if (np.diff(size[k:]) < 0.0).all() else 0.0
