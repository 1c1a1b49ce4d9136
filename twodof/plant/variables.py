"""The one table of FMI variables, from which the slave and both flavours' XML are made.

Names are FMI structured names with 1-based indices; a variable's place in the table is its
value reference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .robot import Robot

Value = float | bool


@dataclass(frozen=True)
class Variable:
    """One scalar variable of the FMU.

    Attributes:
        group: the vector's name and the plant's attribute, e.g. "x_des"; ``index`` its 0-based
            element, None for a scalar.
        causality: "input", "output" or "parameter" (all parameters are fixed).
        unit: FMI unit name, "" where there is none.
        start: start value; None for outputs.
        description: one line.
    """

    group: str
    index: int | None
    causality: str
    unit: str
    start: Value | None
    description: str

    @property
    def name(self) -> str:
        """FMI name, e.g. "x_des[1]"."""
        return self.group if self.index is None else f"{self.group}[{self.index + 1}]"

    @property
    def type(self) -> str:
        """FMI type of the variable."""
        return "Boolean" if isinstance(self.start, bool) else "Real"


def variable_table(robot: Robot, starts: Mapping[str, Value | tuple[float, ...]]) -> list[Variable]:
    """The variables of a robot's FMU, in value-reference order.

    Args:
        robot: the robot; n joints and m task axes give the vectors' lengths.
        starts: start values that differ from the defaults, by group; needs "x_des" (m values)
            and "q_start" (n values), which have no default that suits every robot.
    """
    n, m = len(robot.joints), len(robot.axes)
    position = ["m" if prismatic else "rad" for prismatic in robot.prismatic]
    velocity = ["m/s" if prismatic else "rad/s" for prismatic in robot.prismatic]
    effort = ["N" if prismatic else "N.m" for prismatic in robot.prismatic]
    joint = [f"joint {name}" for name in robot.joints]
    axis = [f"{robot.frame}, axis {letter}" for letter in robot.axes]
    default: dict[str, Value | tuple[float, ...]] = {
        "xd_des": (0.0,) * m,
        "xdd_des": (0.0,) * m,
        "Kp": (50.0,) * m,
        "Kd": (40.0,) * m,
        "tau_ext": (0.0,) * n,
        "Kn": 10.0 if n > m else 0.0,
        "v_start": (0.0,) * n,
        "q_min": robot.q_min,
        "q_max": robot.q_max,
        "gravity": (0.0, 0.0, -9.81),
        "rcond": 0.01,
        "rtol": 1e-3,
        "atol": 1e-6,
        "max_step": 1e-3,
        "limit_effort": False,
    }
    default.update(starts)
    table: list[Variable] = []

    def vector(group: str, causality: str, units: list[str], text: str, of: list[str]) -> None:
        start = default.get(group)
        for i, (unit, owner) in enumerate(zip(units, of, strict=True)):
            value = start[i] if isinstance(start, tuple) else None
            table.append(Variable(group, i, causality, unit, value, f"{text}, {owner}"))

    def scalar(group: str, causality: str, unit: str, text: str) -> None:
        start = default[group]
        assert not isinstance(start, tuple)
        table.append(Variable(group, None, causality, unit, start, text))

    vector("x_des", "input", ["m"] * m, "target position", axis)
    vector("xd_des", "input", ["m/s"] * m, "target velocity", axis)
    vector("xdd_des", "input", ["m/s2"] * m, "target acceleration", axis)
    vector("Kp", "input", ["1/s2"] * m, "proportional gain", axis)
    vector("Kd", "input", ["1/s"] * m, "derivative gain", axis)
    vector("tau_ext", "input", effort, "external effort", joint)
    scalar("Kn", "input", "1/s", "damping of the motion that does not move the end effector")
    vector("q", "output", position, "position", joint)
    vector("v", "output", velocity, "velocity", joint)
    vector("x", "output", ["m"] * m, "position", axis)
    vector("tau", "output", effort, "control effort applied", joint)
    vector("q_start", "parameter", position, "position at the start", joint)
    vector("v_start", "parameter", velocity, "velocity at the start", joint)
    vector("q_min", "parameter", position, "lower limit", joint)
    vector("q_max", "parameter", position, "upper limit", joint)
    root = [f"axis {letter} of {robot.root}" for letter in "xyz"]
    vector("gravity", "parameter", ["m/s2"] * 3, "gravity", root)
    scalar("rcond", "parameter", "", "singular values up to rcond times the largest are dropped")
    scalar("rtol", "parameter", "", "relative tolerance of the integrator")
    scalar("atol", "parameter", "", "absolute tolerance of the integrator")
    scalar("max_step", "parameter", "s", "largest step of the integrator")
    scalar("limit_effort", "parameter", "", "limit the control effort to the URDF's effort limits")
    return table
