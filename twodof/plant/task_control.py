"""Operational-space control by resolved acceleration.

    a_cmd = xdd_des + Kd ∘ (xd_des − J v) + Kp ∘ (x_des − x)
    α_cmd = alpha_des + Kd_rot ∘ (omega_des − ω) + Kp_rot ∘ log(R_des Rᵀ)      with an orientation
    q̈_cmd = J⁺ (a_cmd − J̇ v) − Kn (I − J⁺J) v
          = J⁺ (a_cmd − J̇ v + Kn J v) − Kn v

x, R and J are position, orientation and Jacobian of the task frame, LOCAL_WORLD_ALIGNED. J has the rows of the task
axes, with an orientation three of the angular velocity ω too; J⁺ drops singular values up to rcond·σ_max.

Source: Luh, Walker & Paul, "Resolved-acceleration control of mechanical manipulators",
IEEE TAC 25(3), 1980; the damped self-motion is that of Khatib, IEEE J-RA 3(1), 1987.
"""

from operator import mul

import numpy as np

from .control_law import ControlledPlant
from .equations import Array, Law, Ratios
from .orientation import rotation_error
from .pseudo_inverse import apply_pseudo_inverse, singular_ratios


def command(plant: ControlledPlant) -> tuple[Law, Ratios]:
    """Return q̈_cmd as a function of the state with inputs held, and the singular values of the task Jacobian."""
    observe = plant.known.observe
    axes = ["xyz".index(axis) for axis in plant.robot.axes]
    law = list(zip(axes, plant.xd_des, plant.xdd_des, plant.Kp, plant.Kd))
    axis_targets = list(zip(axes, plant.x_des))
    quat_des = plant.quat_des if plant.control == "pose" else None
    if quat_des is not None:
        turn = (plant.omega_des, plant.alpha_des, plant.Kp_rot, plant.Kd_rot)
        law.extend(zip((3, 4, 5), *turn))
    Kn, rcond = plant.Kn, plant.rcond

    def commanded_acceleration(q: Array, v: Array, rank: int | None) -> tuple[list[float], int, float]:
        x, jacobian, drift = observe(q, v)
        velocity = v.tolist()
        errors = [x_des - x[axis] for axis, x_des in axis_targets]
        if quat_des is not None:
            errors += rotation_error(quat_des, plant.known.rotation)
        rows, command = [], []
        for (axis, xd_des, xdd_des, Kp, Kd), error in zip(law, errors):
            row = jacobian[axis]
            xd = sum(map(mul, row, velocity))
            rows.append(row)
            command.append(xdd_des + Kd * (xd_des - xd) + Kp * error - drift[axis] + Kn * xd)
        qdd, rank, margin = apply_pseudo_inverse(rows, command, rcond, rank)
        return [a - Kn * vi for a, vi in zip(qdd, velocity)] if Kn else qdd, rank, margin

    def ratios(q: Array) -> list[float]:
        jacobian = observe(q, np.zeros(len(q)))[1]
        return singular_ratios([jacobian[row[0]] for row in law])

    return commanded_acceleration, ratios
