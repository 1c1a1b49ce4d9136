"""Result of a fit: a table, facts for other programs, and the files of its folder."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import refusing, temporary_folder
from ..notebook import card
from ..version import __version__
from .estimate import Misfit
from .prediction import WINDOW


class FittedParameter(NamedTuple):
    """A free parameter before and after a fit.

    Attributes:
        name: name of the parameter, as in patterns.
        unit: FMI unit name, or "".
        before, after: values before and after the fit.
        deviation: standard deviation of the fitted value.
        low, high: 95 % interval.
        known: whether the data determine the value; if not, it keeps its value.
    """

    name: str
    unit: str
    before: float
    after: float
    deviation: float
    low: float
    high: float
    known: bool


@dataclass(frozen=True, repr=False)
class Fit:
    """A fitted robot; ``print`` shows its table.

    Attributes:
        urdf: name of the URDF's file.
        fitted_urdf: text of the URDF with fitted numbers.
        joints: names of the robot's n joints.
        units: "rad" or "m" of each joint.
        parameters: the free parameters.
        unseen: parameters that form each direction that the data do not determine.
        misfits: test of the model at each joint.
        noise: standard deviation of the efforts' residuals at each joint, N·m or N.
        delay: time from a recorded effort to its action, s, and its standard deviation.
        deviation_before, deviation: root mean square of simulated minus measured positions of each joint in the
            held-out stretches, rad or m, before and after the fit; empty if no stretch is long enough.
        settings: fitted values that a URDF cannot store, and its gravity, by variable of the FMU.
        covariance: covariance of the parameters, in their order.
        converged: False if the solution still moved when its steps ended.
        jumps: time of the largest jump, s, by joints whose effort jumps between samples.
    """

    urdf: str
    fitted_urdf: bytes
    joints: tuple[str, ...]
    units: tuple[str, ...]
    parameters: tuple[FittedParameter, ...]
    unseen: tuple[str, ...]
    misfits: tuple[Misfit, ...]
    noise: tuple[float, ...]
    delay: tuple[float, float]
    deviation_before: tuple[float, ...]
    deviation: tuple[float, ...]
    settings: Mapping[str, tuple[float, ...]]
    covariance: NDArray[np.float64]
    converged: bool
    jumps: Mapping[str, float]

    @property
    def explains(self) -> bool:
        """True if the residuals at all joints are noise, and the efforts do not jump between samples."""
        return not self.jumps and not any(misfit.bad for misfit in self.misfits)

    @property
    def rows(self) -> list[tuple[str, str, str, str, str]]:
        """Cells of the table: name, before, after, 95 % interval, unit."""
        rows = [("parameter", "before", "after", "95 % interval", "unit")]
        for p in self.parameters:
            interval = f"{p.low:.4g} … {p.high:.4g}" if p.known else "not seen"
            rows.append((p.name, f"{p.before:.4g}", f"{p.after:.4g}", interval, p.unit))
        return rows

    @property
    def remarks(self) -> list[str]:
        """Warnings and results, one line each."""
        lines = []
        if not self.converged:
            lines.append("the fit has not converged: free fewer parameters, or record more motion")
        for joint, t in self.jumps.items():
            lines.append(
                f"the effort of joint '{joint}' jumps between samples, most at {t:.4g} s: its course there is"
                " unknown, and the intervals are too narrow; record at a higher rate, or a smoother motion"
            )
        groups = {parameter.name.partition(":")[0] for parameter in self.parameters}
        if "gain" in groups and "mass" not in groups:
            lines.append("gains are right only if the URDF's masses are: free 'mass:*' too, or weigh the robot")
        if self.unseen:
            lines.append(f"the data do not determine: {'; '.join(self.unseen)}")
        if bad := [misfit for misfit in self.misfits if misfit.bad]:
            worst = max(bad, key=lambda misfit: misfit.part)
            unit = "N·m" if self.units[worst.joint] == "rad" else "N"
            lines.append(
                f"the model does not explain these data, least at joint '{self.joints[worst.joint]}': slow residuals"
                f" of {worst.rms:.3g} {unit}, {100 * worst.part:.2g} % of its effort, have {worst.ratio:.3g} times the"
                " variance of fast ones; free more parameters, or look for what the URDF does not have"
            )
        if abs(self.delay[0]) > 5.0 * self.delay[1]:
            side = "after" if self.delay[0] > 0.0 else "before"
            lines.append(f"efforts act {1e3 * abs(self.delay[0]):.3g} ms {side} their stamps")
        for joint, unit, before, after in zip(self.joints, self.units, self.deviation_before, self.deviation):
            lines.append(
                f"held out: in windows of {WINDOW:g} s the simulated position of joint '{joint}' differs by"
                f" {after:.3g} {unit} (rms), before the fit by {before:.3g} {unit}"
            )
        return lines

    def __str__(self) -> str:
        widths = [max(map(len, column)) for column in zip(*self.rows)]
        table = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in self.rows]
        return "\n".join([*table, *self.remarks])

    def __repr__(self) -> str:
        return f"<Fit of {len(self.parameters)} parameters of {self.urdf}>"

    def _repr_html_(self) -> str:
        facts = {row[0]: " ".join((*row[1:3], f"({row[3]})", row[4])) for row in self.rows[1:]}
        return card(f"Fit of {self.urdf}", facts | dict.fromkeys(self.remarks, ""))

    @property
    def facts(self) -> dict[str, object]:
        """Facts for other programs, in SI units; null for numbers that are not finite."""
        return {
            "kind": "fit",
            "urdf": self.urdf,
            "version": __version__,
            "parameters": [p._asdict() for p in self.parameters],
            "unseen": self.unseen,
            "explains": self.explains,
            "converged": self.converged,
            "jumps": dict(self.jumps),
            "misfits": [m._asdict() | {"joint": self.joints[m.joint], "bad": m.bad} for m in self.misfits],
            "noise": dict(zip(self.joints, self.noise)),
            "delay": {"value": self.delay[0], "deviation": self.delay[1]},
            "held_out": {
                "before": dict(zip(self.joints, map(_finite, self.deviation_before))),
                "after": dict(zip(self.joints, map(_finite, self.deviation))),
            },
            "settings": dict(self.settings),
            "remarks": self.remarks,
        }

    def save(self, folder: str | Path) -> Path:
        """Write robot.urdf and fit.json into a new folder, completely or not at all; return its path.

        Raises:
            InputError: the folder exists or cannot be written.
        """
        path = check_folder(folder)
        with refusing(InputError, f"write '{path}'"):
            path.parent.mkdir(parents=True, exist_ok=True)
            with temporary_folder(path.parent) as draft:
                inside = draft / "fitted"
                inside.mkdir()
                (inside / "robot.urdf").write_bytes(self.fitted_urdf)
                (inside / "fit.json").write_text(json.dumps(self.facts, indent=2, allow_nan=False) + "\n", "utf-8")
                inside.rename(path)
        return path


def check_folder(folder: str | Path) -> Path:
    """Return the path of a new output folder; raise InputError if the path exists."""
    path = Path(folder)
    if os.path.lexists(path):
        raise InputError(f"'{path}' exists, and is not replaced: remove it, or give another `output`")
    return path


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
