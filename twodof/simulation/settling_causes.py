"""Causes of an error that still moves: gains that are too slow, a late change of an input, late or coarse efforts."""

from collections.abc import Iterator, Mapping, Sequence
from math import inf, log, sqrt

import numpy as np

from .aim import BAND
from .cause import FLOOR, Cause
from .controller_causes import OF_ERROR, PERIODS, decay, gain_name, late_by, loops, rate_of, sensors_of
from .judge import OF_THE_END, Judge

SWINGING = 0.7  # damping ratio below which a shrinking error will grow again


def slow(judge: Judge, missed: Sequence[str], static: Mapping[str, float]) -> Iterator[Cause]:
    """Yield a cause for each output whose error still shrinks, with the remaining time by its rate.

    Args:
        missed: outputs that are not at their targets.
        static: magnitude of the error to which an output tends, as far as it is known.
    """
    for name in missed:
        rate, aim = rate_of(judge, name), judge.aims[name]
        stiff, damp = ("Kp_rot", "Kd_rot") if name == "quat" else ("Kp", "Kd")
        pairs = [(p, d) for p, d in zip(judge.given(stiff), judge.given(damp)) if p > 0.0]
        ratios = [d / (2.0 * sqrt(p)) for p, d in pairs]
        if min(ratios, default=1.0) < SWINGING:  # an error passes 0 and grows again
            rate = min(rate, *(0.5 * d for _, d in pairs))
        rate = min(rate, _slowest(judge, name)) if rate else 0.0
        band = max(BAND * aim.first, FLOOR)
        left = log(max(aim.last / band, 1.0)) / rate if rate else 0.0
        rest = OF_THE_END * (judge.duration - judge.changed)  # the last part of the longer run is in the band
        left = (left + rest) / (1.0 - OF_THE_END)
        what = {"x": "the position still approaches its target", "quat": "the orientation still approaches its target"}
        what["q"] = "the joints still approach their targets"
        raised, approaches = stiff, what[name]
        if name == "q" and (i := _alone(judge)) is not None:
            approaches, raised = (
                f"joint '{judge.setup.joints[i]}' still approaches its target",
                gain_name(judge, stiff, i),
            )
            damp = gain_name(judge, damp, i)
        if rate and left < 1000.0 * judge.duration:
            late = f"the target changed at {judge.changed:.4g} s, and " if judge.changed > 0.0 else ""
            text = f"{late}{approaches}, with a time constant of {1.0 / rate:.3g} s"
            remedy = f"raise {raised}, or lower {damp}" if max(ratios, default=0.0) > 1.0 else "raise the gains"
            if static.get(name, 0.0) > band:
                text += ", and other causes keep an error"
            else:
                text += f": within 2 % after about {left:.3g} s more"
                remedy += ", or stop later"
            yield Cause("time", f"{text}; {remedy}", left, subject=stiff)


def _alone(judge: Judge) -> int | None:
    """Return the index of the joint that has nearly all of the error; None if several have a part in it."""
    e = np.abs(judge.wanted("q") - judge.end("q"))
    others = np.delete(e, int(e.argmax()))
    return int(e.argmax()) if others.size and others.max() < OF_ERROR * e.max() else None


def _slowest(judge: Judge, name: str) -> float:
    """Return the slowest rate of the continuous loops of an output, 1/s, in directions that have an error."""
    group = "Kp_rot" if name == "quat" else "Kp"
    off = np.ones(len(judge.given(group)), bool)
    if name != "quat" and len(e := np.abs(judge.wanted(name) - judge.end(name))) == len(off):
        off = e >= OF_ERROR * e.max()
    own = [loop for loop in loops(judge, 1.0, 0.0) if loop.stiff == group]
    return min((decay(loop) for loop in own if off[loop.i]), default=inf)


def unsettled(judge: Judge, moving: float, static: Mapping[str, float]) -> Iterator[Cause]:
    """Yield the reason of an error that neither decays steadily nor lacks damping.

    Args:
        moving: part of the error that is motion.
        static: magnitude of the error to which an output tends, as far as it is known.
    """
    rates = [decay(loop) for loop in loops(judge, 1.0, 0.0) if loop.Kp > 0.0 and loop.Kd > 0.0]
    left, i = late_by(judge, min(rates, default=inf)), _worst(judge)
    sensors = ", ".join(sensors_of(judge, i))
    settings = " and ".join(f"{name} = {judge.setup.starts[name]:g} s" for name in PERIODS if judge.held.get(name))
    if left > 0.0 and moving > 0.5:
        rests = any(rest > max(BAND * judge.aims[name].first, FLOOR) for name, rest in static.items())
        text = f": with these gains it is within 2 % after about {left:.3g} s more; raise the gains, or stop later"
        text = ", and other causes keep an error; stop later to see them" if rests else text
        yield Cause("time", f"the motion has not settled{text}", left)
    elif sensors:
        text = f"joint '{judge.setup.joints[i]}' is measured with {sensors}"
        off = abs(judge.wanted("q")[i] - judge.end("q")[i]) if judge.wanted("q").size else inf
        seen = off > judge.setup.starts.get(f"q_resolution[{i + 1}]", 0.0)
        what = (
            "the efforts of the controller are wrong by that" if seen else "the controller does not see smaller errors"
        )
        yield Cause("sampling", f"{text}: {what}", 0.5)
    elif settings:
        text = f"the motion does not settle with {settings}: the efforts of the controller are too late"
        yield Cause("sampling", f"{text}; reduce {'them' if ' and ' in settings else 'it'}", 0.5)


def _worst(judge: Judge) -> int:
    """Return the index of the joint with the largest error, else of the fastest one."""
    if judge.wanted("q").size:
        return int(np.abs(judge.wanted("q") - judge.end("q")).argmax())
    return int(judge.speed.argmax())


def late_change(judge: Judge) -> Iterator[Cause]:
    """Yield a change of an input, after which the time was too short for its error to decay."""
    rates = [decay(loop) for loop in loops(judge, 1.0, 0.0) if loop.Kp > 0.0 and loop.Kd > 0.0]
    if judge.latest is None or judge.latest[0] <= judge.changed or judge.moving:
        return
    t, changes = judge.latest
    needed = log(1.0 / BAND) / min(rates, default=1e-9)
    if judge.duration - t < needed:
        name, (before, after) = max(changes.items(), key=lambda change: abs(change[1][1] - change[1][0]))
        text = f"{name} changed from {before:.4g} to {after:.4g} at {t:.4g} s"
        text += f", and an error needs about {needed:.3g} s to decay to 2 %"
        yield Cause("time", f"{text}; stop later", needed)
