"""Result of a fit: a table, facts for other programs, and the files of its folder."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, PlotError
from ..files import refusing, temporary_folder
from ..notebook import card
from ..version import __version__
from .curves import Curve, Table
from .model_tests import ERRORS, Hold, Misfit, Suspect
from .prediction import WINDOW

MOST_NAMES = 6  # largest number of parameters that the page names in its verdict
UNEXPLAINED = 0.01
"""Slow residuals that are not noise, as a fraction of the efforts, above which the model does not explain the data."""
FRAGILE = 3.0
"""Change of a value by an error that the data cannot show, in standard deviations, above which a remark names it."""
ALIKE = 100.0  # ratio of the probabilities of two errors, below which the data do not tell one from the other
MOST_COMBINATIONS = 5  # largest number of combinations that the summary lists


class FittedParameter(NamedTuple):
    """A free parameter before and after a fit.

    Attributes:
        name, unit: name of the parameter, as in patterns, and FMI unit name, or "".
        before, after: values before and after the fit.
        deviation, low, high: standard deviation and 95 % interval of the fitted value.
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
        bags: paths of the bags.
        fitted_urdf: text of the URDF with fitted numbers.
        joints, units: names of the robot's n joints, and "rad" or "m" of each.
        parameters: the free parameters.
        unseen: parameters that form each direction that the data do not determine.
        misfits: test of the model at each joint.
        suspects: errors of the setup that the residuals show, for which the intervals are wider.
        holds: rests of joints under a load that is larger than their friction.
        doubts: remarks on locked joints that are elsewhere in the bags, and on efforts that may be wrong.
        fragile: largest change of each parameter, in standard deviations, by constant errors of efforts that the data
            cannot show.
        noise: standard deviation of the efforts' residuals at each joint, N·m or N.
        delay: time from a recorded effort to its action, s, and its standard deviation.
        deviation_before, deviation: root mean square of simulated minus measured positions of each joint in the
            held-out stretches, rad or m, before and after the fit; empty if no stretch is long enough.
        settings: fitted values that a URDF cannot store, and its gravity, by variable of the FMU.
        covariance: covariance of the parameters, in their order.
        converged: False if the solution still moved when its steps ended; no parameter is known then.
        interrupted: True if Ctrl-C ended the fit.
        jumps: for each joint whose effort jumps between samples, the time of the largest jump, s.
        curves: efforts and positions as measured, and as the model gives them.
    """

    urdf: str
    bags: tuple[str, ...]
    fitted_urdf: bytes
    joints: tuple[str, ...]
    units: tuple[str, ...]
    parameters: tuple[FittedParameter, ...]
    unseen: tuple[str, ...]
    misfits: tuple[Misfit, ...]
    suspects: tuple[Suspect, ...]
    holds: tuple[Hold, ...]
    doubts: tuple[str, ...]
    fragile: Mapping[str, float]
    noise: tuple[float, ...]
    delay: tuple[float, float]
    deviation_before: tuple[float, ...]
    deviation: tuple[float, ...]
    settings: Mapping[str, tuple[float, ...]]
    covariance: NDArray[np.float64]
    converged: bool
    interrupted: bool
    jumps: Mapping[str, float]
    curves: tuple[Curve, ...]

    @property
    def explains(self) -> bool:
        """True if the fit has converged, the residuals are noise, and the efforts do not jump between samples."""
        bad = self.jumps or self.suspects or self.holds or any(misfit.bad for misfit in self.misfits)
        return self.converged and not bad

    @property
    def rows(self) -> list[tuple[str, str, str, str, str]]:
        """Cells of the table: name, before, after, 95 % interval, unit."""
        rows = [("parameter", "before", "after", "95 % interval", "unit")]
        for p in self.parameters:
            after, interval = f"{p.after:.4g}", "not determined" if self.converged else "not known"
            if p.known:
                after, low, high = (_rounded(value, p.deviation) for value in (p.after, p.low, p.high))
                interval = f"{low} … {high}"
            rows.append((p.name, f"{p.before:.4g}", after, interval, p.unit))
        return rows

    @property
    def remarks(self) -> list[str]:
        """Verdict, warnings and results, one line each."""
        lines = [*self._warnings]
        if self.unseen:
            short = sorted(self.unseen, key=len)[:MOST_COMBINATIONS]
            more = len(self.unseen) - len(short)
            rest = f"; fit.json lists {more} more combinations" if more else ""
            lines.append(f"the data do not determine: {'; '.join(short)}{rest}")
        for joint, unit, before, after in zip(self.joints, self.units, self.deviation_before, self.deviation):
            lines.append(
                f"held out: in windows of {WINDOW:g} s the simulated position of joint '{joint}' differs by"
                f" {after:.3g} {unit} (rms), before the fit by {before:.3g} {unit}"
            )
        return lines

    @property
    def _warnings(self) -> list[str]:
        lines = []
        if self.interrupted:
            missing = "no motion was predicted" if self.converged else "the values are not final, and have no intervals"
            lines.append(f"the fit was interrupted: {missing}")
        elif not self.converged:
            lines.append(
                "the fit has not converged, and no value is known: free fewer parameters, or record more motion"
            )
        if bad := [misfit for misfit in self.misfits if misfit.bad]:
            lines.append(self._verdict(max(bad, key=lambda misfit: misfit.part)))
        if self.suspects:
            lines.append(self._suspicion())
        lines += map(self._rest, self.holds)
        for name, t in self.jumps.items():
            lines.append(
                f"the effort of joint '{name}' jumps between samples, most at {t:.4g} s: its values between them are"
                " unknown, and the intervals are too narrow; record at a higher rate, or a smoother motion"
            )
        if not lines:
            lines.append("the model explains these data: its residuals are noise")
        lines += self.doubts
        groups = {parameter.name.partition(":")[0] for parameter in self.parameters}
        if "gain" in groups and "mass" not in groups:
            lines.append(
                "a fitted gain is right only if the URDF's masses are right: also free 'mass:*', or weigh the robot"
            )
        if moved := [name for name, most in self.fragile.items() if most > FRAGILE]:
            lines.append(
                f"constant errors of efforts could move {', '.join(moved)} by {max(self.fragile.values()):.2g} standard"
                " deviations, and be too small to show in these data: free 'bias:*' if there may be such errors"
            )
        if abs(self.delay[0]) > 5.0 * self.delay[1]:
            side = "after" if self.delay[0] > 0.0 else "before"
            lines.append(f"efforts act {1e3 * abs(self.delay[0]):.3g} ms {side} their stamps")
        return lines

    def _verdict(self, worst: Misfit) -> str:
        """Return the line on a model whose residuals are not noise, worst at one joint."""
        joint, unit = self.joints[worst.joint], self._effort_unit(worst.joint)
        narrow = ", and the intervals are too narrow" * (not self.suspects)
        verdict = f"explains these data only roughly{narrow}, worst"
        if worst.part > UNEXPLAINED:
            verdict = "does not explain these data, worst"
        return (
            f"the model {verdict} at joint '{joint}': slow residuals of {worst.rms:.3g} {unit},"
            f" {100 * worst.part:.2g} % of its effort, have {worst.ratio:.3g} times the variance of fast ones; free"
            " more parameters, or look for what the URDF does not have"
        )

    def _rest(self, hold: Hold) -> str:
        return (
            f"joint '{self.joints[hold.joint]}' rests at {hold.t:.4g} s under {hold.excess:.3g}"
            f" {self._effort_unit(hold.joint)} more than its friction holds: friction at rest is higher than in motion,"
            " a brake holds the joint, or the model lacks a load"
        )

    def _suspicion(self) -> str:
        """Return the line on the errors that the residuals show most."""
        most = ALIKE * self.suspects[0].probability
        # a filter is tested in slow rows alone, so that other errors look more probable
        alike = [each for each in self.suspects if each.probability <= most or each.name == "filter"]
        found = []
        for name, size, _ in alike:
            group, _, joint = name.partition(":")
            i = self.joints.index(joint) if joint else 0
            words = {
                "unit": self.units[i] if joint else "rad",
                "effort": self._effort_unit(i),
                # the coordinate of a gain is its logarithm
                "percent": 100.0 * (math.expm1(min(size, 99.0)) if "gain" in group else size),
                "filtered": "efforts" if size > 0.0 else "positions",
                "ms": 1e3 * math.sqrt(2.0 * abs(size)),
                "shift": 1e3 * size,
            }
            found.append(ERRORS[group].format(name=name, joint=joint, size=size, **words))
        return (
            f"the residuals look like {', or '.join(found)}; if it is the cause, correct it: the intervals include its"
            " effect, but not that of a wrong mass or centre of a link that is not free, which can look the same"
        )

    def _effort_unit(self, joint: int) -> str:
        return "N·m" if self.units[joint] == "rad" else "N"

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
            "bags": self.bags,
            "version": __version__,
            "parameters": [p._asdict() for p in self.parameters],
            "unseen": self.unseen,
            "explains": self.explains,
            "converged": self.converged,
            "interrupted": self.interrupted,
            "jumps": dict(self.jumps),
            "misfits": [m._asdict() | {"joint": self.joints[m.joint], "bad": m.bad} for m in self.misfits],
            "suspects": [suspect._asdict() for suspect in self.suspects],
            "holds": [hold._asdict() | {"joint": self.joints[hold.joint]} for hold in self.holds],
            "fragile": dict(self.fragile),
            "noise": dict(zip(self.joints, self.noise)),
            "delay": {"value": self.delay[0], "deviation": self.delay[1]},
            "held_out": {
                "before": dict(zip(self.joints, map(_finite, self.deviation_before))),
                "after": dict(zip(self.joints, map(_finite, self.deviation))),
            },
            "settings": dict(self.settings),
            "remarks": self.remarks,
        }

    def page(self) -> bytes:
        """Return a self-contained HTML page: verdict, tables, and curves as measured and as modelled.

        Raises:
            PlotError: the extra 'view' is missing.
        """
        from .fit_page import fit_page  # matplotlib takes a third of a second to import

        head, *rows = self.rows
        seen, other = ([row for row, p in zip(rows, self.parameters) if p.known is known] for known in (True, False))
        lines = self._warnings
        tables: dict[str, Table] = {f"{len(seen)} of {len(rows)} parameters are determined": [head, *seen]}
        if other:
            names = ", ".join(name for name, *_ in other) if len(other) <= MOST_NAMES else f"{len(other)} parameters"
            if self.converged:
                lines.append(f"the data do not determine {names}")
            caption = "Not determined: these parameters stay near the URDF's" if self.converged else "Not final"
            tables[caption] = [row[:3] for row in (head, *other)]
        if self.unseen:
            tables["Only together: what the data do not determine"] = [("combination",), *zip(self.unseen)]
        if self.deviation:
            worst = int(np.argmax(self.deviation))  # the first NaN, if there is one
            _, _, _, after, before = self._joint_rows[1 + worst]
            lines.append(
                f"held out: simulated positions are off by at most {after} (rms, '{self.joints[worst]}'),"
                f" before the fit {before}"
            )
        tables["Joints: residuals, and simulated positions (rms)"] = self._joint_rows
        settings = [f"{name} = {', '.join(map(repr, values))}" for name, values in self.settings.items()]
        facts = {"bags": "\n".join(self.bags), "settings of a build": "\n".join(settings or ["none"])}
        facts |= {"curves": "long ones are drawn through the extremes of samples", "made by": f"twodof {__version__}"}
        return fit_page(f"Fit of {self.urdf}", lines, tables, facts, dict(zip(self.joints, self.units)), self.curves)

    @property
    def _joint_rows(self) -> list[tuple[str, ...]]:
        head = "joint", "noise of the effort", "slow residuals", "off, held out", "before"
        rows: list[tuple[str, ...]] = [head if self.deviation else head[:3]]
        for i, (joint, unit) in enumerate(zip(self.joints, self.units)):
            part = f"{100 * self.misfits[i].part:.2g} % of the effort" + ", not noise" * self.misfits[i].bad
            off = [each[i] for each in (self.deviation, self.deviation_before) if each]
            held = [f"{rms:.3g} {unit}" if math.isfinite(rms) else "∞: the simulation fails" for rms in off]
            rows.append((joint, f"{self.noise[i]:.3g} {self._effort_unit(i)}", part, *held))
        return rows

    def save(self, folder: str | Path) -> Path:
        """Write robot.urdf, fit.json and fit.html into a new folder, completely or not at all; return its path.

        Without the extra 'view' there is no fit.html.

        Raises:
            InputError: the folder exists or cannot be written.
        """
        path = check_folder(folder)
        contents = {
            "robot.urdf": self.fitted_urdf,
            "fit.json": f"{json.dumps(self.facts, indent=2, allow_nan=False)}\n".encode(),
        }
        with suppress(PlotError):
            contents["fit.html"] = self.page()
        with refusing(InputError, f"write '{path}'"):
            path.parent.mkdir(parents=True, exist_ok=True)
            with temporary_folder(path.parent) as draft:
                inside = draft / "fitted"
                inside.mkdir()
                for name, content in contents.items():
                    (inside / name).write_bytes(content)
                inside.rename(path)
        return path


def check_folder(folder: str | Path) -> Path:
    """Return the path of a new output folder; raise InputError if the path exists."""
    path = Path(folder)
    if os.path.lexists(path):
        raise InputError(f"'{path}' exists, and is not replaced: remove it, or give another `output`")
    return path


def _rounded(value: float, deviation: float) -> str:
    """Return a value with as many decimals as its standard deviation has up to its second significant digit."""
    decimals = 1 - math.floor(math.log10(deviation)) if deviation > 0.0 else -1
    return f"{round(value, decimals) + 0.0:.{decimals}f}" if 0 <= decimals <= 9 else f"{value:.4g}"


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
