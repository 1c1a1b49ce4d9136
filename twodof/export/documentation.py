"""Documentation folder of the FMU: equations, variables, provenance, requirements and licences."""

import ast
import hashlib
import html
import importlib.metadata
import inspect
from collections.abc import Sequence
from string import Template
from types import ModuleType
from typing import cast

from ..files import data_file
from ..plant.plant import LAWS
from ..plant.robot import Robot
from ..plant.variables import CONTROLS, Variable
from ..version import __version__
from .flavours import Files, Flavour
from .fmu_options import FmuOptions

NO_DEPENDENCIES = b"None: the binaries need the C library and its mathematics only.\n"
"""Text about the dependencies of a native FMU."""


def documentation(
    options: FmuOptions, robot: Robot, table: Sequence[Variable], flavour: Flavour, guid: str, urdf: str
) -> Files:
    """Return the files of the folder by their path in the FMU, which includes the URDF's text."""
    frame = html.escape(robot.frame)
    source = inspect.getsource(cast(ModuleType, LAWS[options.control]))
    law = ast.get_docstring(ast.parse(source))  # PYTHONOPTIMIZE=2 leaves out __doc__
    rows = []
    for v in table:
        cells = v.name, v.causality, v.unit, "" if v.start is None else v.start, v.description
        rows.append("".join(["<tr>", *(f"<td>{html.escape(str(c))}</td>" for c in cells), "</tr>"]))
    index = page(
        "documentation.html",
        options.name,
        robot=html.escape(robot.name),
        frame=frame,
        axes=", ".join(robot.axes),
        controller="outside" if options.control == "effort" else "inside",
        plant="outside" if options.part == "controller" else "inside",
        control=CONTROLS[options.control].title.format(frame=frame),
        law=html.escape(str(law)),
        root=html.escape(robot.root),
        variables="\n".join(rows),
        fmi=flavour.fmi,
        kinds="co-simulation and Model Exchange" if flavour.native else "co-simulation",
        limitations="" if flavour.native else _shipped("limitations.html"),
        version=__version__,
        guid=guid,
        urdf_digest=hashlib.sha256(urdf.encode()).hexdigest(),
    )
    files = {"index.html": index, "licenses/license.txt": data_file("LICENSE").read_bytes()}
    if flavour.native:
        files["externalDependencies.txt"] = NO_DEPENDENCIES
    else:
        files["externalDependencies.txt"] = _shipped("externalDependencies.txt").encode()
        theirs = importlib.metadata.files("pythonfmu") or []
        licence = next(file for file in theirs if file.name.upper().startswith("LICEN"))
        files["licenses/pythonfmu.txt"] = licence.read_binary()
    return {f"documentation/{name}": content for name, content in files.items()}


def page(body: str, name: str, *, controller: str = "inside", plant: str = "inside", **values: object) -> bytes:
    """Return a page of documentation: a shipped body with the picture of controller and plant, in the common frame.

    Args:
        body: file name of the body, a template of values, HTML.
        name: the page's title.
        controller, plant: "inside" or "outside" of the documented FMU or system.
        values: values of the body.
    """
    loop = Template(_shipped("loop.html")).substitute(controller=controller, plant=plant)
    filled = Template(_shipped(body)).substitute(values, name=name, loop=loop)
    return Template(_shipped("frame.html")).substitute(name=name, body=filled).encode()


def _shipped(name: str) -> str:
    return data_file("fmu_src", name).read_text("utf-8")
