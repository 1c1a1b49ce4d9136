"""The XML files of FMI 3.0. modelDescription.xml is made of that of FMI 2.0: elements of vectors
become arrays, or stay scalars for tools that know no arrays.

Source: FMI 3.0.2, sections 2.4 to 2.6.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence

from ..plant.variables import DISTURBANCES, Variable
from .native import INDICATORS

ATTRIBUTES = {
    "guid": "instantiationToken",
    "canGetAndSetFMUstate": "canGetAndSetFMUState",
    "canSerializeFMUstate": "canSerializeFMUState",
    "providesDirectionalDerivative": "providesDirectionalDerivatives",
}
"""What has another name in 3.0; others that are not there any more are in GONE."""
GONE = ("numberOfEventIndicators", "canNotUseMemoryManagementFunctions",
        "completedIntegratorStepNotNeeded")  # fmt: skip
PARTS = "ModelVariables", "ModelStructure", "VendorAnnotations"
TERMINALS = {
    "targets": "where the robot is meant to be, or the effort of a controller",
    "joints": "positions, velocities and efforts of the joints",
    "forces": "what acts on the robot from outside",
}
TYPES = {"Real": "Float64", "Boolean": "Boolean"}


def model_description3(description: bytes, arrays: bool) -> bytes:
    """The XML text, of that of FMI 2.0, in which event indicators and the time are variables."""
    root = ET.fromstring(description)
    root.set("fmiVersion", "3.0")
    for element in (root, *root.findall("ModelExchange"), *root.findall("CoSimulation")):
        attributes = {ATTRIBUTES.get(k, k): v for k, v in element.items() if k not in GONE}
        if element is not root:
            attributes["providesAdjointDerivatives"] = "true"
            for files in element.findall("SourceFiles"):
                element.remove(files)
        element.attrib.clear()
        element.attrib.update(attributes)
    for simple in root.iter("SimpleType"):
        simple.tag = "Float64Type"
        simple.attrib.update(simple[0].attrib)
        simple.remove(simple[0])
    scalars = list(root.iter("ScalarVariable"))
    names = [_name(scalar, arrays) for scalar in scalars]
    references: dict[str, str] = {}  # of the first element
    for scalar, name in zip(scalars, names):
        references.setdefault(name, scalar.get("valueReference", ""))
    variables, structure, vendor = map(root.find, PARTS)
    assert variables is not None and structure is not None and vendor is not None
    variables[:] = _variables(scalars, names, references)
    structure[:] = _unknowns(structure, names, references)
    structure.extend(
        ET.Element("EventIndicator", valueReference=reference)
        for name, reference in references.items()
        if name.startswith(INDICATORS)
    )
    vendor.tag = "Annotations"
    for tool in vendor:
        tool.tag = "Annotation"
        tool.set("type", tool.attrib.pop("name"))
    root.remove(vendor)
    root.append(vendor)  # where 3.0 has it
    return xml_text(root)


def xml_text(root: ET.Element) -> bytes:
    """As it stands in a file."""
    ET.indent(root)
    text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _name(scalar: ET.Element, arrays: bool) -> str:
    """Its own, or that of its vector: "x" of "x[1]", "der(q)" of "der(q[1])"."""
    name = scalar.get("name", "")
    return re.sub(r"\[\d+\]", "", name) if arrays else name


def _variables(
    scalars: Sequence[ET.Element], names: Sequence[str], references: dict[str, str]
) -> list[ET.Element]:
    vectors: dict[str, list[int]] = {}  # places of the elements, in order
    for i, name in enumerate(names):
        vectors.setdefault(name, []).append(i)
    variables = []
    for name, places in vectors.items():
        elements = [{**scalars[i].attrib, **scalars[i][0].attrib} for i in places]
        attributes = {"name": name}
        attributes |= {
            key: value
            for key, value in elements[0].items()
            if key != "name" and all(element.get(key) == value for element in elements)
        }
        attributes["valueReference"] = references[name]
        attributes["description"] = _description(elements)
        if "derivative" in elements[0]:
            attributes["derivative"] = references[names[int(elements[0]["derivative"]) - 1]]
        if "start" in elements[0]:
            attributes["start"] = " ".join(element["start"] for element in elements)
        variable = ET.Element(TYPES[scalars[places[0]][0].tag], attributes)
        if name != scalars[places[0]].get("name"):
            ET.SubElement(variable, "Dimension", start=str(len(places)))
        variables.append(variable)
    return variables


def _description(elements: Sequence[dict[str, str]]) -> str:
    """What the vector is, and what each of its elements is, with its unit where that differs."""
    texts = [element["description"] for element in elements]
    if len({*texts}) == 1:
        return texts[0]
    parts = [text.split(", ") for text in texts]
    same = next(i for i, column in enumerate(zip(*parts)) if len(set(column)) > 1)
    common = ", ".join(parts[0][:same])
    owners = [", ".join(part[same:]) for part in parts]
    if len({element.get("unit") for element in elements}) > 1:
        owners = [f"{own} [{element['unit']}]" for own, element in zip(owners, elements)]
    return f"{common}: {'; '.join(owners)}"


def _unknowns(
    structure: ET.Element, names: Sequence[str], references: dict[str, str]
) -> list[ET.Element]:
    unknowns: list[ET.Element] = []
    for tag, group in (
        ("Output", "Outputs"),
        ("ContinuousStateDerivative", "Derivatives"),
        ("InitialUnknown", "InitialUnknowns"),
    ):
        dependencies: dict[str, dict[str, None]] = {}
        for unknown in structure.iterfind(f"{group}/Unknown"):
            known = dependencies.setdefault(names[int(unknown.get("index", "")) - 1], {})
            places = unknown.get("dependencies", "").split()
            known.update(dict.fromkeys(names[int(place) - 1] for place in places))
        for name, known in dependencies.items():
            text = " ".join(references[k] for k in known)
            attributes = {"valueReference": references[name], "dependencies": text}
            unknowns.append(ET.Element(tag, attributes))
    return unknowns


def build_description(identifier: str, units: Sequence[str]) -> bytes:
    """The text of sources/buildDescription.xml: what a tool compiles."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    build = ET.SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    files = ET.SubElement(build, "SourceFileSet", language="C99")
    for name in units:
        ET.SubElement(files, "SourceFile", name=name)
    ET.SubElement(build, "Library", name="m")
    return xml_text(root)


def terminals_and_icons(table: Sequence[Variable], arrays: bool) -> bytes:
    """The text of terminalsAndIcons.xml: how the icon lies, and what belongs together in a plug."""
    targets = {v.group for v in table if v.group.endswith(("_des", "_cmd"))}
    terminals = {"targets": targets, "joints": {"q", "v", "tau"}, "forces": set(DISTURBANCES)}
    root = ET.Element("fmiTerminalsAndIcons", fmiVersion="3.0")
    graphic = ET.SubElement(root, "GraphicalRepresentation")
    place = {"x1": "-15", "y1": "-10", "x2": "15", "y2": "10"}  # as wide as high as the icon is
    ET.SubElement(graphic, "CoordinateSystem", place, suggestedScalingFactorTo_mm="1")
    ET.SubElement(graphic, "Icon", place)
    parent = ET.SubElement(root, "Terminals")
    for name, members in terminals.items():
        terminal = ET.SubElement(
            parent, "Terminal", name=name, matchingRule="bus", description=TERMINALS[name]
        )
        names = (v.group if arrays else v.name for v in table if v.group in members)
        for member in dict.fromkeys(names):
            ET.SubElement(
                terminal, "TerminalMemberVariable", variableName=member, memberName=member,
                variableKind="signal",
            )  # fmt: skip
    return xml_text(root)
