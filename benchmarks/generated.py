"""The native engine with a right-hand side in C that CasADi generates, for comparison.

q̈(q, v) under task control is one CasADi function, made by the textbook's recursions with the robot's constants folded,
in the native engine's integrator. It has no payload, no external force and no rank check. J⁺ is Jᵀ (J Jᵀ)⁻¹, which
fails where J loses rank.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi
import numpy as np
from arms import Arm, by_own_compiler, native_cost

from twodof.export.bodies import Array, joint_tree
from twodof.export.recursions import hybrid_by_factors, hybrid_by_recursion, mass_matrix, task_frame
from twodof.plant.robot import Robot

INPUTS = ("x_des", "xd_des", "xdd_des", "Kp", "Kd", "Kn", "tau_ext")
WAYS = ("factors", "recursion")
"""To M⁻¹τ."""
FLAGS = ((), ("-O3",))

GLUE = """
#undef acceleration
%s
INTERNAL int acceleration(const Plant *plant, const double q[N_JOINTS], const double v[N_JOINTS],
                          const int slip[N_JOINTS], int rank, double a[N_JOINTS], double *margin)
{
    const double *value = plant->value;
    (void)slip, (void)rank; /* the compared robots have neither friction nor a rank that changes */
    if (margin)
        *margin = HUGE_VAL;
    const double *given[] = {q, v, %s};
    generated(given, &a, 0, 0, 0);
    return N_AXES;
}
"""
RENAMED = b"#define acceleration acceleration_of_the_engine\n"
NO_DERIVATIVES = b"void twodof_differentiate(void);\nvoid twodof_differentiate(void) {}\n"


class Symbol:
    """An SX that NumPy takes for a scalar."""

    def __init__(self, sx: Any) -> None:
        self.sx = sx

    def __neg__(self) -> Symbol:
        return Symbol(-self.sx)


def _operation(name: str, swapped: bool) -> Callable[[Symbol, Any], Any]:
    def operate(self: Symbol, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            return NotImplemented  # element by element
        pair = self.sx, getattr(other, "sx", other)
        return Symbol(getattr(operator, name)(*(reversed(pair) if swapped else pair)))

    return operate


for _name in ("add", "sub", "mul", "truediv"):
    setattr(Symbol, f"__{_name}__", _operation(_name, False))
    setattr(Symbol, f"__r{_name}__", _operation(_name, True))


def _all_free(n: int) -> tuple[Array, Array]:
    return np.ones(n), np.zeros(n)


def _vector(name: str, count: int) -> tuple[Any, Array]:
    sx = casadi.SX.sym(name, count)
    return sx, np.array([Symbol(sx[i]) for i in range(count)], dtype=object)


def right_hand_side(robot: Robot, way: str | None) -> casadi.Function:
    """Return q̈ as a function of q, v and INPUTS.

    Args:
        robot: a robot without mimic joints.
        way: the method for the effects of damping and tau_ext, a key of WAYS; None: they are 0.
    """
    constants, n, axes = joint_tree(robot), len(robot.joints), len(robot.axes)
    sizes = {"q": n, "v": n, **dict.fromkeys(INPUTS, axes), "Kn": 1, "tau_ext": n}
    vectors = {name: _vector(name, size) for name, size in sizes.items()}
    of = {name: vector for name, (_, vector) in vectors.items()}
    joint = np.array(
        [
            (q, 0.0) if slides else (Symbol(casadi.cos(q.sx)), Symbol(casadi.sin(q.sx)))
            for q, slides in zip(of["q"] + constants.c, constants.prismatic, strict=True)
        ],
        dtype=object,
    )
    rows = ["xyz".index(axis) for axis in robot.axes]
    x, _, J, drift = task_frame(constants, joint, of["v"])
    J, xd = J[rows], J[rows].dot(of["v"])
    wanted = of["xdd_des"] + of["Kd"] * (of["xd_des"] - xd) + of["Kp"] * (of["x_des"] - x[rows])
    wanted = wanted - drift[rows] + of["Kn"][0] * xd
    a = J.T.dot(hybrid_by_factors(J.dot(J.T), wanted, *_all_free(len(wanted)))[0]) - of["v"] * of["Kn"][0]
    if way is not None:
        still = np.zeros(len(robot.joints))
        effort = of["tau_ext"] - of["v"] * np.array(robot.damping)
        a = a + (
            hybrid_by_factors(mass_matrix(constants, constants.body, joint, still), effort, *_all_free(n))[0]
            if way == "factors"
            else hybrid_by_recursion(constants, constants.body, joint, still, effort, *_all_free(n))[0]
        )
    result = casadi.vertcat(*(getattr(each, "sx", each) for each in a))
    given = [sx for sx, _ in vectors.values()]
    return casadi.Function("generated", given, [casadi.cse(result)], {"live_variables": False})


def with_rival(arm: Arm, way: str | None) -> Callable[[dict[str, bytes]], None]:
    """Return a function that replaces the engine's sources by those of CasADi."""
    code = casadi.CodeGenerator("generated.c", {"with_header": False})
    code.add(right_hand_side(arm.robot, way))
    inputs = ", ".join(f"&value[{name.upper()}]" for name in INPUTS)
    glue = GLUE % (code.dump(), inputs)

    def replace(sources: dict[str, bytes]) -> None:
        sources["directional.c"] = NO_DERIVATIVES
        sources["plant.c"] = RENAMED + sources["plant.c"] + glue.encode()

    return replace


def rivals(arm: Arm, folder: Path, general: bool) -> dict[str, Callable[[], float]]:
    """Return the timed run of each build of CasADi's C, by its settings; see native_cost."""
    return {
        " ".join(filter(None, (compiler, way, *flags))): cost(arm, folder, with_rival(arm, way), flags)
        for compiler, cost in {"zig": native_cost, "cc": by_own_compiler}.items()
        for way in (WAYS if general else [None])
        for flags in FLAGS
    }
