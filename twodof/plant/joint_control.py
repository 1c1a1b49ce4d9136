"""Joint-space control: inverse dynamics with a PD law for each joint.

    q̈_cmd = a_des + Kd ∘ (v_des − v) + Kp ∘ (q_des − q)

Source: Siciliano, Sciavicco, Villani & Oriolo, "Robotics", 2009, section 8.5.2.
"""

from math import inf

from .control_law import ControlledPlant
from .equations import Array, Law, Ratios


def command(plant: ControlledPlant) -> tuple[Law, Ratios]:
    """Return q̈_cmd (n values) as a function of the state, with inputs held; this law has no J⁺."""
    law = list(zip(plant.a_des, plant.v_des, plant.q_des, plant.Kd, plant.Kp))

    def commanded_acceleration(q: Array, v: Array, rank: int | None) -> tuple[list[float], int, float]:
        state = zip(law, q.tolist(), v.tolist())
        given = [a + Kd * (vd - vi) + Kp * (qd - qi) for (a, vd, qd, Kd, Kp), qi, vi in state]
        return given, rank or 0, inf

    return commanded_acceleration, lambda q: []
