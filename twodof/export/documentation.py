"""Documentation folder of the FMU: equations, variables, provenance, requirements and licences."""

import hashlib
import html
import importlib.metadata
from collections.abc import Sequence
from string import Template

from ..files import data_file
from ..plant.robot import Robot
from ..plant.variables import CONTROLS, Variable
from ..version import __version__
from .flavours import Files, Flavour
from .fmu_options import FmuOptions

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
NO_DEPENDENCIES = b"None: the binaries need the C library and its mathematics only.\n"
"""Text about dependencies of a native FMU."""


def documentation(
    options: FmuOptions, robot: Robot, table: Sequence[Variable], flavour: Flavour, guid: str, urdf: str
) -> Files:
    """Return the files of the folder by their path in the FMU, which includes the URDF's text."""
    frame = html.escape(robot.frame)
    rows = []
    for v in table:
        cells = v.name, v.causality, v.unit, "" if v.start is None else v.start, v.description
        rows.append("".join(["<tr>", *(f"<td>{html.escape(str(c))}</td>" for c in cells), "</tr>"]))
    page = Template(_shipped("documentation.html").decode()).substitute(
        name=options.name,
        robot=html.escape(robot.name),
        frame=frame,
        axes=", ".join(robot.axes),
        control=CONTROLS[options.control].title.format(frame=frame),
        law=LAWS[options.control].replace("$frame", frame),
        root=html.escape(robot.root),
        variables="\n".join(rows),
        fmi=flavour.fmi,
        kinds="co-simulation and Model Exchange" if flavour.native else "co-simulation",
        limitations="" if flavour.native else _shipped("limitations.html").decode(),
        version=__version__,
        guid=guid,
        urdf_digest=hashlib.sha256(urdf.encode()).hexdigest(),
    )
    files = {"index.html": page.encode(), "licenses/license.txt": data_file("LICENSE").read_bytes()}
    if flavour.native:
        files["externalDependencies.txt"] = NO_DEPENDENCIES
    else:
        files["externalDependencies.txt"] = _shipped("externalDependencies.txt")
        theirs = importlib.metadata.files("pythonfmu") or []
        licence = next(file for file in theirs if file.name.upper().startswith("LICEN"))
        files["licenses/pythonfmu.txt"] = licence.read_binary()
    return {f"documentation/{name}": content for name, content in files.items()}


def _shipped(name: str) -> bytes:
    return data_file("fmu_src", name).read_bytes()
