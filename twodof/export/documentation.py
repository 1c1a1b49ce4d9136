"""The FMU's documentation/ folder: equations, variables, provenance, needs and licences."""

from __future__ import annotations

import hashlib
import html
import importlib.metadata
from collections.abc import Sequence
from string import Template

from ..files import data_file
from ..plant.robot import Robot
from ..plant.variables import CONTROLS, Variable
from ..version import __version__
from .arm_page import LivePart
from .flavours import Files, Flavour
from .options import FmuOptions

LAWS = {
    "task": """x, J    position and Jacobian of $frame, rows of the task axes, LOCAL_WORLD_ALIGNED
a_cmd = xdd_des + Kd ∘ (xd_des − J v) + Kp ∘ (x_des − x)          task-space PD
q̈_cmd = J⁺ (a_cmd − J̇ v) − Kn (I − J⁺J) v     J⁺ drops singular values up to rcond·σ_max
τ     = M(q) q̈_cmd + h(q, v)                   inverse dynamics""",
    "pose": """x, R    position and orientation of $frame; J its Jacobian, LOCAL_WORLD_ALIGNED:
        rows of the task axes, and three of the angular velocity ω
a_cmd = xdd_des + Kd ∘ (xd_des − J v) + Kp ∘ (x_des − x)          task-space PD
α_cmd = alpha_des + Kd_rot ∘ (omega_des − ω) + Kp_rot ∘ log(R_des Rᵀ)
q̈_cmd = J⁺ ((a_cmd, α_cmd) − J̇ v) − Kn (I − J⁺J) v   J⁺ drops singular values up to rcond·σ_max
τ     = M(q) q̈_cmd + h(q, v)                   inverse dynamics""",
    "joint": """q̈_cmd = a_des + Kd ∘ (v_des − v) + Kp ∘ (q_des − q)               joint-space PD
τ     = M(q) q̈_cmd + h(q, v)                   inverse dynamics""",
    "effort": "τ     = tau_cmd",
}
"""The equations of the control laws."""


def documentation(
    options: FmuOptions, robot: Robot, table: Sequence[Variable], flavour: Flavour,
    guid: str, urdf: str, live: LivePart,
) -> Files:  # fmt: skip
    """Files of the folder by their path in the FMU.

    Args:
        options, robot, table, guid: as of the model description.
        flavour: says what the FMU depends on, cannot do, and whose code it contains.
        urdf: text of resources/robot.urdf.
        live: the arm itself, or nothing.
    """
    frame = html.escape(robot.frame)
    rows = "\n".join(
        "<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in _row(variable)) + "</tr>"
        for variable in table
    )
    template = data_file("fmu_src", "documentation.html").read_text("utf-8")
    page = Template(template).substitute(
        head=live.head,
        live=live.body,
        name=options.name,
        robot=html.escape(robot.name),
        frame=frame,
        axes=", ".join(robot.axes),
        control=CONTROLS[options.control].title.format(frame=frame),
        law=LAWS[options.control].replace("$frame", frame),
        root=html.escape(robot.root),
        variables=rows,
        kinds="co-simulation and Model Exchange" if flavour.exchanges else "co-simulation",
        limitations=flavour.limitations,
        version=__version__,
        guid=guid,
        urdf_digest=hashlib.sha256(urdf.encode()).hexdigest(),
    )
    return {
        "documentation/index.html": page.encode(),
        "documentation/externalDependencies.txt": flavour.dependencies,
        "documentation/licenses/license.txt": data_file("LICENSE").read_bytes(),
        **{
            f"documentation/licenses/{distribution}.txt": _licence_of(distribution)
            for distribution in flavour.licences
        },
    }


def _row(variable: Variable) -> tuple[str, str, str, str, str]:
    start = "" if variable.start is None else str(variable.start)
    return variable.name, variable.causality, variable.unit, start, variable.description


def _licence_of(distribution: str) -> bytes:
    files = importlib.metadata.files(distribution) or []
    return next(f for f in files if f.name.upper().startswith("LICEN")).read_binary()
