"""The FMU's documentation/ folder: equations, variables, provenance, needs and licences."""

from __future__ import annotations

import hashlib
import html
import importlib.metadata
from collections.abc import Sequence
from pathlib import Path
from string import Template

from .plant import Robot, Variable


def documentation(
    robot: Robot,
    table: Sequence[Variable],
    *,
    name: str,
    guid: str,
    version: str,
    urdf: str,
    templates: Path,
    licence: Path,
) -> dict[str, bytes]:
    """Files of the folder by their path in the FMU.

    Args:
        robot, table: the robot and its variables.
        name, guid, version: of the model description.
        urdf: text of resources/robot.urdf.
        templates: folder of documentation.html and externalDependencies.txt.
        licence: this package's licence.
    """
    rows = "\n".join(
        "<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in _row(variable)) + "</tr>"
        for variable in table
    )
    page = Template((templates / "documentation.html").read_text("utf-8")).substitute(
        name=name,
        robot=html.escape(robot.name),
        frame=html.escape(robot.frame),
        axes=", ".join(robot.axes),
        root=html.escape(robot.root),
        variables=rows,
        version=version,
        guid=guid,
        urdf_digest=hashlib.sha256(urdf.encode()).hexdigest(),
    )
    return {
        "documentation/index.html": page.encode(),
        "documentation/externalDependencies.txt": (
            templates / "externalDependencies.txt"
        ).read_bytes(),
        "documentation/licenses/license.txt": licence.read_bytes(),
        "documentation/licenses/pythonfmu.txt": _licence_of("pythonfmu"),
    }


def _row(variable: Variable) -> tuple[str, str, str, str, str]:
    start = "" if variable.start is None else str(variable.start)
    return variable.name, variable.causality, variable.unit, start, variable.description


def _licence_of(distribution: str) -> bytes:
    files = importlib.metadata.files(distribution) or []
    return next(f for f in files if f.name.upper().startswith("LICEN")).read_binary()
