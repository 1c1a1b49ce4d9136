"""Assertions about a run; a failure names time, joint, value and bound, and writes a plot.

A run is a bag: its folder, or its ``Recording``. The plot is an HTML file in the report's folder, which is an option of
the plugin; without this option there is no plot.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn
from zlib import crc32

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..bag.recording import Recording

    Array = NDArray[np.float64]

REPORT: list[Path] = []  # the report's folder, if any; the plugin appends it
NO_MOVE = 1e-3  # m, rad: smaller initial errors are alike in the choice of the error that a failure shows
EXACT = 1e-9  # tolerance relative to a limit, for a joint at its stop


def assert_settles(run: Recording | str | Path, *, within: float) -> None:
    """Assert that a run settles: from some time on, its error stays within 2 % of the initial error.

    An output that starts at its target must stay within 1e-3 m or rad of it.

    Args:
        run: the run, which must have a reachable target.
        within: longest settling time since the last change of the target, s.

    Raises:
        AssertionError: the run does not settle, settles later, or has no target.
        BagError: the bag cannot be read.
    """
    __tracebackhide__ = True
    bag = _recording(run)
    verdict = bag.verdict
    settling = verdict.numbers.get("settling_time")
    if settling is None or not bag.errors():  # an untrusted bag may have a verdict without a target
        _fail(bag, f"the run cannot settle: {verdict if settling is None else 'the bag has no target'}", [])
    if not settling <= within:
        took = f"settles after {settling:.4g} s" if settling < float("inf") else "does not settle"
        what, error, k = _latest_error(bag, within)
        text = f"the run {took}, but must settle within {within:g} s; at {bag.t[k]:.6g} s {what} is {error[k]:.3g}"
        _fail(bag, f"{text}; {verdict}", [error], what.removeprefix("its "))


def _latest_error(bag: Recording, within: float) -> tuple[str, Array, int]:
    """Return name, magnitudes and settling sample of the error that is largest relative to its first value."""
    import numpy as np

    found: list[tuple[float, str, Array, int]] = []
    for name, (target, size) in bag.errors().items():
        began = int(np.flatnonzero(np.append(True, np.diff(target, axis=0).any(axis=1)))[-1])
        k = min(int(bag.t.searchsorted(bag.t[began] + within)), len(size) - 1)
        what = "its angle from the target orientation" if name == "quat" else "its error"
        found.append((size[k:].max() / max(size[began], NO_MOVE), what, size, k))
    return max(found, key=lambda each: each[0])[1:]


def assert_within_limits(run: Recording | str | Path) -> None:
    """Assert that all joints stay within their limits of position, velocity and effort.

    Position limits are the run's or the URDF's, the others the URDF's. Efforts are checked if the bag has them.

    Raises:
        AssertionError: a joint exceeds a limit, or no limit is known.
        BagError: the bag cannot be read.
    """
    import numpy as np

    __tracebackhide__ = True
    bag = _recording(run)
    setup = bag.setup
    effort, velocity = np.array(setup.limits.effort), np.array(setup.limits.velocity)
    checked = {
        "q": (bag.q, setup.low, setup.high),
        "v": (bag.v, -velocity, velocity),
        "tau": (bag.tau, -effort, effort),
    }
    checked = {name: row for name, row in checked.items() if row[0].shape == bag.q.shape}
    if not any(np.isfinite(bounds).any() for _, *bounds in checked.values()):
        _fail(bag, f"no limit is known of its {', '.join(checked)}: name a robot with limits, and log efforts", [])
    for name, (values, low, high) in checked.items():
        beyond = np.maximum(low - values, values - high) > EXACT * np.maximum(1.0, np.abs(values))
        beyond |= ~np.isfinite(values)
        if beyond.any():
            k, i = np.argwhere(beyond)[0]
            bound = high[i] if values[k, i] > high[i] else low[i]
            ends = [np.full(len(bag.t), end[i]) for end in (low, high) if np.isfinite(end[i])]
            text = (
                f"{name} of joint '{bag.joints[i]}' is {values[k, i]:.6g} at {bag.t[k]:.6g} s, its limit is {bound:.6g}"
            )
            _fail(bag, text, [values[:, i], *ends], f"{name} of {bag.joints[i]}")


def assert_equal(run: Recording | str | Path, reference: Recording | str | Path, *, within: float) -> None:
    """Assert that a run has the positions and velocities of a reference, sample by sample.

    Args:
        run, reference: the runs, with equal joints and times.
        within: largest deviation of a value, in rad, m, rad/s or m/s.

    Raises:
        AssertionError: joints, times or values differ.
        BagError: a bag cannot be read.
    """
    import numpy as np

    __tracebackhide__ = True
    bag, other = _recording(run), _recording(reference)
    if bag.joints != other.joints:
        _fail(bag, f"the joints are {', '.join(bag.joints)}, those of the reference {', '.join(other.joints)}", [])
    if len(bag.t) != len(other.t) or not np.array_equal(bag.t, other.t):
        spans = (f"{len(each.t)} samples in {each.t[-1]:.6g} s" for each in (bag, other))
        _fail(bag, "the run has {}, and its reference {}".format(*spans), [])
    for name in ("q", "v"):
        values, expected = getattr(bag, name), getattr(other, name)
        if values.shape != expected.shape:
            _fail(bag, f"{name} is missing in the run or in its reference '{other.path}'", [])
        off = np.abs(values - expected)
        if not (off <= within).all():
            k, i = np.argwhere(~(off <= within))[0]
            text = f"{name} of joint '{bag.joints[i]}' is {values[k, i]:.9g} instead of {expected[k, i]:.9g}"
            text += f" at {bag.t[k]:.6g} s; the bound is {within:g}, the largest deviation {off.max():.3g}"
            _fail(bag, text, [values[:, i], expected[:, i]], f"{name} of {bag.joints[i]}")


def _recording(run: Recording | str | Path) -> Recording:
    from ..bag.reader import read_bag

    return read_bag(run) if isinstance(run, str | Path) else run


def _fail(bag: Recording, text: str, curves: Sequence[Array], label: str = "") -> NoReturn:
    """Raise the assertion's error, with the plot's path."""
    __tracebackhide__ = True
    if REPORT and curves:
        from ..notebook import card, picture

        test = os.environ.get("PYTEST_CURRENT_TEST", "run").rpartition(" ")[0] or "run"
        name = re.sub(r"[^\w.-]+", "_", test)
        short = name if len(name) <= 100 else f"{name[:90]}_{crc32(test.encode()):08x}"
        path = REPORT[-1] / f"{short}.html"
        plot = picture(((bag.t, curve) for curve in curves), "t in s", label)
        page = f'<!DOCTYPE html><meta charset="utf-8">{card(test, {"bag": bag.path, "failure": text}, plot)}'
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)  # it may be a link to any file
        with path.open("x", encoding="utf-8") as file:
            file.write(page)
        text += f"\nplot: {path}"
    raise AssertionError(f"'{bag.path}': {text}")
