"""Causes of a run's failure in the controller: its gains, its sampling, and what it does not know."""

from collections.abc import Iterator, Sequence
from functools import partial
from math import log, sqrt

import numpy as np

from .cause import FLOOR, MANY_CHANGES, Cause, point_text
from .judge import BAND, Judge
from .sampled_loop import spectral_radius, stable_gains

UNSTABLE = 1.0 + 1e-6  # spectral radius, above rounding
OVERDAMPED = 5.0  # damping ratio from which on less damping is quicker
FAST = 0.25  # sign changes of a velocity in the time of a step that indicate too large a step
DRAG = 0.02  # effort of damping, relative to the largest effort in the last quarter, that counts


def _gain(judge: Judge, group: str, i: int) -> str:
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
        zero = list(dict.fromkeys(_gain(judge, group, i) for i, gain in enumerate(values) if gain == 0.0))
        if zero:
            text = f"{', '.join(zero)} = 0: the controller does not reduce the error of the {error}; raise the gain"
            yield Cause("gain", text, 1.0)


def feedforward(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    """Yield target velocities and accelerations that are not 0, while the target rests."""
    groups = {"x": ("xd_des", "xdd_des"), "quat": ("omega_des", "alpha_des"), "q": ("v_des", "a_des")}
    for group in (group for name in missed for group in groups[name]):
        values = judge.given(group)
        if values.any() and judge.changes <= MANY_CHANGES:
            yield Cause("feedforward", f"{group} = {point_text(values)} is not 0, while the target rests", 1.0)


def load(judge: Judge) -> Iterator[Cause]:
    """Yield loads, and the damping of joints, that the controller does not know."""
    payload, switch = judge.held.get("payload"), "payload_known"
    own = next((name for name in judge.setup.starts if name.endswith(f".{switch}")), switch).removesuffix(switch)
    if payload and not (judge.held.get(switch) and judge.held.get(f"{own}payload") == payload):
        remedy = f"set {own}{switch}=true" + f" and {own}payload={payload:g}" * bool(own)
        yield Cause("load", f"the controller does not know the payload of {payload:g} kg; {remedy}", 1.0)
    joints = judge.setup.robot.joints if judge.setup.robot is not None else {}
    usual = {name: joints[name].damping if name in joints else 0.0 for name in judge.setup.joints}
    heavy = [name for name, d in zip(usual, judge.given("damping")) if d > 2.0 * usual[name]]
    each = heavy or [name for name in usual if usual[name] > 0.0]
    names = "of any joint" if len(each) == len(usual) > 2 else f"of joints {', '.join(map(repr, each))}"
    kind, tail, share = ("load", "", 0.4) if heavy else ("drag", " in the URDF", 0.0)
    if each and (heavy or _drags(judge)):
        yield Cause(kind, f"the controller does not know the damping {names}{tail}", share)
    for group, unit in (("tau_ext", ""), ("f_ext", " N")):
        values = judge.given(group)
        if values.any():
            yield Cause("load", f"the controller does not know {group} = {point_text(values)}{unit}", 0.5)


def _drags(judge: Judge) -> bool:
    """Return whether the damping of a joint needs a part of the efforts in the last quarter of the run."""
    v, tau, damping = *(np.abs(judge.history(name)[judge.late]) for name in ("v", "tau")), judge.given("damping")
    known = v.shape[1] == tau.shape[1] == len(damping)
    return known and bool((v * damping).max(initial=0.0) > DRAG * tau.max(initial=0.0))


def sampled(judge: Judge) -> Iterator[Cause]:
    """Yield sampled loops that are unstable, or else a joint that reverses as fast as the steps."""
    v, setup = judge.tail("v")[-256:], judge.setup
    sampling = [setup.starts.get(name, 0.0) for name in ("control_period", "control_delay")]
    continuous = bool(judge.aims) and not any(sampling) and judge.changes <= MANY_CHANGES
    if len(v) < 16 or continuous:  # the steps of communication change nothing in a continuous law
        return
    if any(sampling) and (found := [*_unstable(judge, *sampling)]):
        yield from found
        return
    turns = (np.sign(v[1:]) * np.sign(v[:-1]) < 0.0).mean(axis=0)
    turns[np.abs(v).mean(axis=0) <= 1e-3 * np.maximum(judge.speed, 1e-3)] = 0.0
    i = int(turns.argmax())
    if turns[i] * max(setup.step, sum(sampling)) >= FAST * setup.step:
        stiff = next((group for group in ("Kp", "Kd") if judge.given(group).any()), "")
        gains = f"the gains ({stiff} up to {judge.given(stiff).max():g})" if stiff else "the gains"
        gains = gains if judge.aims else "the gains of the controller outside"
        what = ", ".join(_sampling(judge, i)) or f"communication steps of {setup.step:g} s"
        text = f"joint '{setup.joints[i]}' reverses every {setup.step / turns[i]:.2g} s: {gains} are too high"
        yield Cause("sampling", f"{text} for {what}", float(turns[i]), setup.joints[i])


def _unstable(judge: Judge, period: float, delay: float) -> Iterator[Cause]:
    """Yield a cause if the sampled loop is unstable, even while limits hold the joints."""
    differences = bool(judge.setup.starts.get("v_from_q"))
    loop = partial(spectral_radius, period=period, delay=delay, differences=differences)
    for stiff, damp in (("Kp", "Kd"), ("Kp_rot", "Kd_rot")):
        pairs = enumerate(zip(judge.given(stiff), judge.given(damp)))
        radius, i, p, d = max(((loop(*pair), i, *pair) for i, pair in pairs), default=(0.0, 0, 0.0, 0.0))
        if radius > UNSTABLE:
            names = [_gain(judge, group, i) for group in (stiff, damp)]
            gains = f"{names[0]} = {p:g} s⁻² and {names[1]} = {d:g} s⁻¹ are too high"
            late = f" and control_delay = {delay:g} s" * bool(delay)
            text = f"{gains} for control_period = {period:g} s{late}: the loop is unstable"
            text += f", an error doubles in {period * log(2.0) / log(radius):.2g} s"
            below = stable_gains(p, d, period, delay, differences=differences)
            best = f"it is stable below {stiff} = {below[0]:.3g} with {damp} = {below[1]:.3g}"
            text += f"; at the same damping ratio {best}" * any(below)
            yield Cause("unstable", text, log(radius))


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


def damping(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
    """Yield gains with a small damping ratio."""
    for stiff, damp in dict.fromkeys(("Kp_rot", "Kd_rot") if name == "quat" else ("Kp", "Kd") for name in missed):
        Kp, Kd = judge.given(stiff), judge.given(damp)
        ratios = [(d / (2.0 * sqrt(p)), i, p, d) for i, (p, d) in enumerate(zip(Kp, Kd)) if p > 0.0]
        if ratios and min(ratios)[0] < 0.2:
            ratio, i, p, d = min(ratios)
            names = [_gain(judge, group, i) for group in (damp, stiff)]
            text = f"{names[0]} = {d:g} s⁻¹ damps {names[1]} = {p:g} s⁻² too little"
            yield Cause("damping", f"{text}: critical damping is {2.0 * sqrt(p):.4g} s⁻¹", 1.0 - ratio)


def slow(judge: Judge, missed: Sequence[str]) -> Iterator[Cause]:
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
            yield Cause("time", f"{text}: 2 % takes about {left:.3g} s more; {remedy}, or stop later", left)
