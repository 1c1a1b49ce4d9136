"""The XML files of FMI 3.0. modelDescription.xml is made of that of FMI 2.0: elements of vectors
become arrays, or stay scalars for tools that know no arrays.

Source: FMI 3.0.2, sections 2.4 to 2.6.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence

from ..plant.variables import DISTURBANCES, Variable

INDICATORS, TIME = "event_indicators", "time"
ATTRIBUTES = {
    "guid": "instantiationToken",
    "canGetAndSetFMUstate": "canGetAndSetFMUState",
    "canSerializeFMUstate": "canSerializeFMUState",
    "providesDirectionalDerivative": "providesDirectionalDerivatives",
}
"""What has another name in 3.0; others that are not there any more are in GONE."""
GONE = ("numberOfEventIndicators", "canNotUseMemoryManagementFunctions",
        "completedIntegratorStepNotNeeded")  # fmt: skip
TERMINALS = {
    "targets": "where the robot is meant to be, or the effort of a controller",
    "joints": "positions, velocities and efforts of the joints",
    "forces": "what acts on the robot from outside",
}
TYPES = {"Real": "Float64", "Boolean": "Boolean"}


def model_description3(description: bytes, arrays: bool) -> bytes:
    """The XML text, of that of FMI 2.0; with event indicators and the time, variables in 3.0."""
    root = ET.fromstring(description)
    indicators = int(root.get("numberOfEventIndicators", ""))
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
    first = next(i for i, scalar in enumerate(scalars) if scalar.get("causality") == "parameter")
    references: dict[str, int] = {}  # of the first element; what 3.0 adds is before the parameters
    for i, name in enumerate(names):
        references.setdefault(name, i + (indicators + 1 if i >= first else 0))
    added = _added(first, indicators, arrays)
    variables = root.find("ModelVariables")
    structure = root.find("ModelStructure")
    assert variables is not None and structure is not None
    own = _variables(scalars, names, references)
    variables[:] = sorted([*own, *added], key=lambda v: int(v.get("valueReference", "")))
    structure[:] = _unknowns(structure, names, references)
    structure.extend(
        ET.Element("EventIndicator", valueReference=variable.get("valueReference", ""))
        for variable in added
        if variable.get("causality") == "local"
    )
    _annotations(root)
    return xml_text(root)


def xml_text(root: ET.Element) -> bytes:
    """As it stands in a file."""
    ET.indent(root)
    text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _name(scalar: ET.Element, arrays: bool) -> str:
    """Its own, or that of its vector: "x" of "x[1]", "der(q)" of "der(q[1])"."""
    name = scalar.get("name", "")
    before, bracket, after = name.partition("[")
    return before + after.partition("]")[2] if bracket and arrays else name


def _added(first: int, indicators: int, arrays: bool) -> list[ET.Element]:
    """Variables that 2.0 has calls for, from a value reference on."""
    local = {
        "causality": "local", "variability": "continuous", "initial": "calculated",
        "description": "change their sign where a joint meets or leaves a stop, or J⁺ its rank",
    }  # fmt: skip
    places = [(f"{INDICATORS}[{i + 1}]", first + i) for i in range(indicators)]
    if arrays:
        places = [(INDICATORS, first)]
    added = [
        ET.Element("Float64", {"name": name, "valueReference": str(place), **local})
        for name, place in places
    ]
    if arrays:
        ET.SubElement(added[0], "Dimension", start=str(indicators))
    time = ET.Element(
        "Float64", name=TIME, valueReference=str(first + indicators), causality="independent",
        variability="continuous", description="time", unit="s",
    )  # fmt: skip
    return [*added, time]


def _variables(
    scalars: Sequence[ET.Element], names: Sequence[str], references: dict[str, int]
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
        attributes["valueReference"] = str(references[name])
        attributes["description"] = _description(elements)
        if "derivative" in elements[0]:
            attributes["derivative"] = str(references[names[int(elements[0]["derivative"]) - 1]])
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
    if len(texts) == 1:
        return texts[0]
    parts = [text.split(", ") for text in texts]
    same = next(i for i, column in enumerate(zip(*parts)) if len(set(column)) > 1)
    common = ", ".join(parts[0][:same])
    owners = [", ".join(part[same:]) for part in parts]
    if len({element.get("unit") for element in elements}) > 1:
        owners = [f"{own} [{element['unit']}]" for own, element in zip(owners, elements)]
    return f"{common}: {'; '.join(owners)}"


def _unknowns(
    structure: ET.Element, names: Sequence[str], references: dict[str, int]
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
            text = " ".join(str(references[k]) for k in known)
            attributes = {"valueReference": str(references[name]), "dependencies": text}
            unknowns.append(ET.Element(tag, attributes))
    return unknowns


def _annotations(root: ET.Element) -> None:
    vendor = root.find("VendorAnnotations")
    assert vendor is not None
    root.remove(vendor)
    vendor.tag = "Annotations"
    for tool in vendor:
        tool.tag = "Annotation"
        tool.set("type", tool.attrib.pop("name"))
    root.append(vendor)


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
