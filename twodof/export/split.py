"""Build a system of a plant and its controller: an SSP 1.0 file of two FMUs, their connections and values.

Source: System Structure and Parameterization 1.0, Modelica Association, 2019.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import replace
from html import escape
from typing import NamedTuple

from ..plant.variables import CONTROLS
from ..version import __version__
from .composition import compose, fmi_version
from .documentation import page
from .flavours import Files
from .fmi3_files import xml_text
from .fmu_options import FmuOptions
from .model_description import FMI3_TYPES
from .model_structure import SENSORS
from .references import parameter_set

SSP = "http://ssp-standard.org/SSP1/SystemStructure"
SSC, SSD = f"{{{SSP}Common}}", f"{{{SSP}Description}}"
WIRES = (
    ("plant", "q", "controller", "q"),
    ("plant", "v", "controller", "v"),
    ("controller", "tau_cmd", "plant", "tau_cmd"),
)
"""Connections: component and group of the start, and those of the end."""
PLACES, WIDTH, HEIGHT = {"controller": 0, "plant": 60}, 40, 20
"""Left edges of the components in a diagram, and their size, mm."""


class Row(NamedTuple):
    """A variable's causality, its type in SSP 1.0, and its start value as text."""

    causality: str
    type: str
    start: str | None

    @classmethod
    def of(cls, variable: ET.Element) -> "Row":
        """Return the row of a variable in a model description of FMI 2.0, where its type is a child element, or 3.0."""
        typed = next(iter(variable), variable)
        kind = next((two for two, three in FMI3_TYPES.items() if three == typed.tag), typed.tag)
        return cls(variable.get("causality", ""), kind, typed.get("start"))


def system_files(options: FmuOptions) -> tuple[Files, Mapping[str, Files]]:
    """Return the files of an SSP except its FMUs, and the files of each FMU by its path in the SSP.

    The plant has the start values of the robot. The controller has those of the control law, its sampling and sensors.
    Common start values are set in both. Vectors of FMI 3.0 are scalars, because SSP 1.0 has no arrays.
    """
    law = CONTROLS[options.control]
    of_law = {*law.inputs, *law.parameters, *SENSORS, "control_period", "control_delay"}
    of_plant = {name: value for name, value in options.settings.items() if name.partition("[")[0] not in of_law}
    fmi = fmi_version(options)
    options = replace(options, native=True, fmi=fmi, arrays=fmi == 2)
    parts = {
        "plant": replace(
            options,
            part="all",
            control="effort",
            outputs=(*options.outputs, *law.outputs),
            name=f"{options.name}_plant",
            settings={"rigid_stops": law.rigid_stops, **of_plant},
        ),
        "controller": replace(options, part="controller", outputs=(), name=f"{options.name}_controller"),
    }
    fmus, tables = {}, {}
    for name, part in parts.items():
        _, files, finish = compose(part)
        fmus[f"resources/{name}.fmu"] = {**files, **finish()}
        rows = ET.fromstring(files["modelDescription.xml"]).iterfind("ModelVariables/*")
        tables[name] = {v.get("name", ""): Row.of(v) for v in rows}
    return {
        "SystemStructure.ssd": _structure(options.name, tables),
        "documentation/index.html": _page(options, len([*_wires(tables)]) // len(WIRES)),
        **{f"resources/{name}.ssv": _values(name, table) for name, table in tables.items()},
    }, fmus


def _structure(title: str, tables: Mapping[str, Mapping[str, Row]]) -> bytes:
    """Return the text of SystemStructure.ssd.

    Only the connectors that a connection or an observer needs are listed, because some importers connect unconnected
    inputs to wrong sources, or refuse connectors of the system.
    """
    root = ET.Element(f"{SSD}SystemStructureDescription", version="1.0", name=title)
    root.set("generationTool", f"twodof {__version__}")
    system = ET.SubElement(root, f"{SSD}System", name=title)
    wires = [*_wires(tables)]
    elements = ET.SubElement(system, f"{SSD}Elements")
    for part, table in tables.items():
        component = ET.SubElement(elements, f"{SSD}Component", name=part, source=f"resources/{part}.fmu")
        component.set("type", "application/x-fmu-sharedlibrary")
        connectors = ET.SubElement(component, f"{SSD}Connectors")
        driven = {name for _, _, end, name in wires if end == part}
        for name, variable in table.items():
            if name in driven or variable.causality == "output":
                connector = ET.SubElement(connectors, f"{SSD}Connector", name=name, kind=variable.causality)
                ET.SubElement(connector, f"{SSC}{variable.type}")
        left = str(PLACES[part])
        ET.SubElement(component, f"{SSD}ElementGeometry", x1=left, y1="0", x2=str(PLACES[part] + WIDTH), y2=str(HEIGHT))
        bindings = ET.SubElement(component, f"{SSD}ParameterBindings")
        ET.SubElement(bindings, f"{SSD}ParameterBinding", source=f"resources/{part}.ssv")
    connections = ET.SubElement(system, f"{SSD}Connections")
    for start, own, end, other in wires:
        ends = dict(startElement=start, startConnector=own, endElement=end, endConnector=other)
        ET.SubElement(connections, f"{SSD}Connection", ends)
    ET.SubElement(root, f"{SSD}DefaultExperiment", startTime="0.0", stopTime="5.0")
    ET.register_namespace("ssc", SSC[1:-1])
    ET.register_namespace("ssd", SSD[1:-1])
    return xml_text(root)


def _wires(tables: Mapping[str, Mapping[str, Row]]) -> Iterator[tuple[str, str, str, str]]:
    """Yield the connections: component and variable of the start, and those of the end."""
    for start, group, end, other in WIRES:
        for name in tables[start]:
            if name.partition("[")[0] == group:
                yield start, name, end, name.replace(group, other)


def _page(options: FmuOptions, joints: int) -> bytes:
    """Return the system's documentation, with a picture of its components and their connections."""
    control = escape(CONTROLS[options.control].title.format(frame=options.frame or "the last link"))
    rows = [f"<tr><td>{start}.{own}</td><td>{end}.{other}</td></tr>" for start, own, end, other in WIRES]
    wires = "\n".join(rows)
    return page("system.html", escape(options.name), joints=joints, control=control, wires=wires, version=__version__)


def _values(name: str, table: Mapping[str, Row]) -> bytes:
    """Return the parameter set of a component: the start values of its parameters and inputs."""
    own = {key: v for key, v in table.items() if v.causality in ("parameter", "input")}
    return parameter_set(name, ((key, v.type, v.start) for key, v in own.items() if v.start is not None))
