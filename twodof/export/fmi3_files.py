"""XML files of FMI 3.0 besides modelDescription.xml. FMI 3.0.2, sections 2.5 and 2.6."""

import xml.etree.ElementTree as ET
from collections.abc import Sequence

from ..plant.variables import DISTURBANCES, Variable

TERMINALS = {
    "targets": "targets of the robot, or efforts of a controller",
    "joints": "positions, velocities and efforts of the joints",
    "forces": "external forces and torques on the robot",
}


def xml_text(root: ET.Element) -> bytes:
    """Return an XML element as the text of a file."""
    ET.indent(root)
    text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def build_description(identifier: str, units: Sequence[str]) -> bytes:
    """Return the text of sources/buildDescription.xml, which lists the sources to compile."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    build = ET.SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    files = ET.SubElement(build, "SourceFileSet", language="C99")
    for name in units:
        ET.SubElement(files, "SourceFile", name=name)
    ET.SubElement(build, "Library", name="m")
    return xml_text(root)


def terminals_and_icons(table: Sequence[Variable], arrays: bool) -> bytes:
    """Return the text of terminalsAndIcons.xml: the icon's extent and the terminals."""
    targets = {v.group for v in table if v.group.endswith(("_des", "_cmd"))}
    terminals = {"targets": targets, "joints": {"q", "v", "tau"}, "forces": set(DISTURBANCES)}
    root = ET.Element("fmiTerminalsAndIcons", fmiVersion="3.0")
    graphic = ET.SubElement(root, "GraphicalRepresentation")
    extent = {"x1": "-15", "y1": "-10", "x2": "15", "y2": "10"}  # the aspect ratio of the icon
    ET.SubElement(graphic, "CoordinateSystem", extent, suggestedScalingFactorTo_mm="1")
    ET.SubElement(graphic, "Icon", extent)
    parent = ET.SubElement(root, "Terminals")
    for name, members in terminals.items():
        terminal = ET.SubElement(parent, "Terminal", name=name, matchingRule="bus", description=TERMINALS[name])
        names = (v.group if arrays else v.name for v in table if v.group in members)
        for member in dict.fromkeys(names):
            ET.SubElement(
                terminal, "TerminalMemberVariable", variableName=member, memberName=member, variableKind="signal"
            )
    return xml_text(root)
