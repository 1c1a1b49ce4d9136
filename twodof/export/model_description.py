"""Write modelDescription.xml of either flavour and version from the variable table.

In FMI 3.0, vectors are arrays, or scalars for tools without arrays. Sources: FMI 2.0.4, section 2.2; FMI 3.0.2, section
2.4.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import cast

from ..plant.robot import Robot
from ..plant.urdf import UNBOUNDED
from ..plant.variables import CONTROLS, NO_RANGE, RANGES, Range, Value, Variable, count_event_indicators
from ..version import __version__
from .compiler import UNITS as COMPILED
from .flavours import Flavour
from .fmi3_files import xml_text
from .fmu_options import FmuOptions
from .model_structure import STATES, add_structure

LOG_CATEGORIES = {
    "logStatusWarning": "Warnings",
    "logStatusDiscard": "Refused steps",
    "logStatusError": "Refused calls",
    "logStatusFatal": "Failures that end the instance",
    "logAll": "All messages",
}
VENDOR = "twodof"
AUTHOR = "the twodof developers"

FMI3_TYPES = {"Real": "Float64", "Integer": "Int32"}  # types of FMI 3.0 whose names differ from those of FMI 2.0
SCALAR = ("name", "valueReference", "description", "causality", "variability", "initial")
"""Attributes of ScalarVariable in FMI 2.0; all others belong to its type."""
SMALL = ("rtol", "atol", "max_step")  # variables whose start value is their nominal value
EFFORTS = ("tau", "tau_cmd", "tau_ext")
UNITS: dict[str, tuple[str, dict[str, int]]] = {
    "m": ("Length", {"m": 1}),
    "m/s": ("Velocity", {"m": 1, "s": -1}),
    "m/s2": ("Acceleration", {"m": 1, "s": -2}),
    "rad": ("Angle", {"rad": 1}),
    "rad/s": ("AngularVelocity", {"rad": 1, "s": -1}),
    "rad/s2": ("AngularAcceleration", {"rad": 1, "s": -2}),
    "N": ("Force", {"kg": 1, "m": 1, "s": -2}),
    "N.m": ("Torque", {"kg": 1, "m": 2, "s": -2}),
    "s": ("Time", {"s": 1}),
    "kg": ("Mass", {"kg": 1}),
    "kg.m2": ("MomentOfInertia", {"kg": 1, "m": 2}),
    "N.s/m": ("TranslationalDampingConstant", {"kg": 1, "s": -1}),
    "N.m.s/rad": ("RotationalDampingConstant", {"kg": 1, "m": 2, "s": -1, "rad": -1}),
    "1/s": ("", {"s": -1}),
    "1/s2": ("", {"s": -2}),
}
"""Quantity by the names of Modelica's standard library, and exponents of the SI base units, by unit. All factors are 1.
Gains have no quantity.
"""
DISPLAY = {"rad": ("deg", 180.0 / math.pi)}  # display units, and their number in one SI unit


def model_description(
    options: FmuOptions, robot: Robot, table: Sequence[Variable], flavour: Flavour, guid: str
) -> bytes:
    """Return the XML text of variables given by ``engine_variables``; the GUID may still be ""."""
    fmi, law = flavour.fmi, CONTROLS[options.control]
    names = [replace(v, index=None).name if flavour.arrays else v.name for v in table]
    reference = {name: str(i) for i, name in enumerate(dict.fromkeys(names), start=1)}
    table, names = [v for v in table if v.shown], [name for name, v in zip(names, table) if v.shown]
    references = [reference[name] for name in names]
    index = reference if fmi == 3 else {name: str(i) for i, name in enumerate(names, start=1)}
    indexes = [index[name] for name in names]
    attributes = {
        "fmiVersion": f"{fmi}.0",
        "modelName": options.name,
        "guid" if fmi == 2 else "instantiationToken": guid,
        "description": ("Controller of robot" if options.part == "controller" else "Robot")
        + f" '{robot.name}' with {len(robot.joints)} joints"
        + (": " if options.part == "controller" else " under ")
        + law.title.format(frame=robot.frame),
        "version": __version__,
        "author": AUTHOR,
        "copyright": f"Copyright (c) {AUTHOR}; of the robot's description, its author's",
        "license": "BSD-3-Clause",
        "generationTool": f"{VENDOR} {__version__}",
        "variableNamingConvention": "structured",
    }
    if flavour.native and fmi == 2:
        indicators = 0 if options.part == "controller" else count_event_indicators(robot, options.control)
        attributes["numberOfEventIndicators"] = str(indicators)
    root = ET.Element("fmiModelDescription", attributes)
    _interfaces(root, options.name, flavour, options.clocked)
    _add_units(root, {variable.unit for variable in table}, fmi)
    categories = ET.SubElement(root, "LogCategories")
    for category, description in LOG_CATEGORIES.items():
        ET.SubElement(categories, "Category", name=category, description=description)
    ET.SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="5.0", stepSize="0.01")
    if fmi == 2:
        annotations = ET.SubElement(root, "VendorAnnotations")
        _describe(ET.SubElement(annotations, "Tool", name=VENDOR), robot, options.control)
    _variables(root, robot, table, names, references, flavour)
    if options.clocked:
        _clock(root, table, len(reference) + 1)
    add_structure(root, robot, table, indexes, law, fmi)
    if fmi == 3:
        annotations = ET.SubElement(root, "Annotations")
        _describe(ET.SubElement(annotations, "Annotation", type=VENDOR), robot, options.control)
    return xml_text(root)


def _add_units(root: ET.Element, used: Collection[str], fmi: int) -> None:
    """Add the definitions of the used units, and a type for each quantity, to a modelDescription."""
    definitions = ET.SubElement(root, "UnitDefinitions")
    for name, (_, exponents) in UNITS.items():
        if name in used:
            unit = ET.SubElement(definitions, "Unit", name=name)
            base = {key: str(exponent) for key, exponent in exponents.items()}
            ET.SubElement(unit, "BaseUnit", {**base, "factor": "1"})
            if name in DISPLAY:
                display, factor = DISPLAY[name]
                ET.SubElement(unit, "DisplayUnit", name=display, factor=repr(factor))
    definitions = ET.SubElement(root, "TypeDefinitions")
    for name, (quantity, _) in UNITS.items():
        if name in used and quantity:
            attributes = {"quantity": quantity, "unit": name}
            if name in DISPLAY:
                attributes["displayUnit"] = DISPLAY[name][0]
            if fmi == 2:
                ET.SubElement(ET.SubElement(definitions, "SimpleType", name=quantity), "Real", attributes)
            else:
                ET.SubElement(definitions, "Float64Type", {"name": quantity, **attributes})


def _interfaces(root: ET.Element, identifier: str, flavour: Flavour, clocked: bool) -> None:
    two, native = flavour.fmi == 2, flavour.native
    state = "FMUstate" if two else "FMUState"
    flags = {f"canGetAndSet{state}": True, f"canSerialize{state}": True}
    if two:
        flags["canNotUseMemoryManagementFunctions"] = True
    flags["needsExecutionTool"] = not native
    if native:
        flags["providesDirectionalDerivative" if two else "providesDirectionalDerivatives"] = True
    own = {"CoSimulation": {"canHandleVariableCommunicationStepSize": True}}
    if clocked:
        own["CoSimulation"]["hasEventMode"] = True
    if native:
        own = {"ModelExchange": {}, **own}
    for interface, more in own.items():
        every = {**flags, **more}
        if not two:
            every["providesAdjointDerivatives"] = True
            if interface == "ModelExchange":
                every["needsCompletedIntegratorStep"] = True  # the default in FMI 2.0
        attributes = {name: str(flag).lower() for name, flag in every.items()}
        element = ET.SubElement(root, interface, {"modelIdentifier": identifier, **attributes})
        if two and native:
            files = ET.SubElement(element, "SourceFiles")
            for name in COMPILED:
                ET.SubElement(files, "File", name=name)


def _describe(tool: ET.Element, robot: Robot, control: str) -> None:
    """Add the vendor annotation, with facts for the logger that variable names do not give."""
    task = ET.SubElement(
        tool, "Robot", name=robot.name, root=robot.root, frame=robot.frame, axes=robot.axes, control=control
    )
    for joint, prismatic in zip(robot.joints, robot.prismatic, strict=True):
        ET.SubElement(task, "Joint", name=joint, type="prismatic" if prismatic else "revolute")


def _range(robot: Robot, variable: Variable) -> Range:
    """Return the range of values: for q the URDF's position limits, for others the range that the FMU accepts."""
    if variable.group == "q" and variable.index is not None:
        limits = robot.q_min[variable.index], robot.q_max[variable.index]
        low, high = (side if abs(side) < UNBOUNDED else math.inf * side for side in limits)
        return Range(low, high, "")
    return RANGES.get(variable.group, NO_RANGE)


def _nominal(robot: Robot, variable: Variable) -> float:
    """Return the nominal value; 1 if no better one is known."""
    if variable.group in SMALL:
        return float(variable.start or 1.0)
    if variable.group in EFFORTS and variable.index is not None:
        effort = robot.effort[variable.index]
        return effort if 0.0 < effort < math.inf else 1.0
    return 1.0


def _variables(
    root: ET.Element,
    robot: Robot,
    table: Sequence[Variable],
    names: Sequence[str],
    references: Sequence[str],
    flavour: Flavour,
) -> None:
    variables = ET.SubElement(root, "ModelVariables")
    row_of = {(variable.group, variable.index): i for i, variable in enumerate(table)}
    vectors: dict[str, list[int]] = {}  # indices of the elements; a scalar has one
    for i, name in enumerate(names):
        vectors.setdefault(name, []).append(i)
    for name, indices in vectors.items():
        first, elements = table[indices[0]], []
        for i in indices:
            group, index, start = table[i].group, table[i].index, table[i].start
            if group in STATES and table[i].causality == "output":
                start = table[row_of[f"{group}_start", index]].start
            attributes = _attributes(robot, table[i], start, flavour.native)
            elements.append({"valueReference": str(i), **attributes})
        shared = set.intersection(*(set(element.items()) for element in elements))
        attributes = {"name": name} | {k: v for k, v in elements[0].items() if (k, v) in shared}
        attributes["valueReference"] = references[indices[0]]
        attributes["description"] = _description(elements)
        if first.derivative_of:
            attributes["derivative"] = references[row_of[first.derivative_of, first.index]]
        if "start" in elements[0]:
            attributes["start"] = " ".join(element["start"] for element in elements)
        if flavour.fmi == 2:
            own = {key: attributes.pop(key) for key in SCALAR if key in attributes}
            ET.SubElement(ET.SubElement(variables, "ScalarVariable", own), first.type, attributes)
            continue
        element = ET.SubElement(variables, FMI3_TYPES.get(first.type, first.type), attributes)
        if name != first.name:
            for size in (len(indices) // first.columns, first.columns) if first.columns else (len(indices),):
                ET.SubElement(element, "Dimension", start=str(size))


def _clock(root: ET.Element, table: Sequence[Variable], reference: int) -> None:
    """Add the input clock, whose interval is the parameter control_period. FMI 3.0.2, sections 2.2.8 and 2.4.7.5."""
    period = next(variable.start for variable in table if variable.name == "control_period")
    attributes = {
        "name": "control_clock",
        "valueReference": str(reference),
        "description": "ticks at each sampling time of the controller, from the start time on",
        "causality": "input",
        "variability": "discrete",
        "intervalVariability": "fixed",
        "intervalDecimal": repr(period),
    }
    ET.SubElement(cast(ET.Element, root.find("ModelVariables")), "Clock", attributes)


def _attributes(robot: Robot, variable: Variable, start: Value | None, exchanges: bool) -> dict[str, str]:
    """Return the attributes of a scalar, or of an element of a vector."""
    attributes = {
        "description": variable.description,
        "causality": variable.causality,
        "variability": "fixed" if variable.causality == "parameter" else "continuous",
    }
    state = variable.group in STATES and variable.causality == "output"
    if variable.causality in ("output", "local"):
        attributes["initial"] = "approx" if state else "calculated"
    elif variable.causality == "parameter":
        attributes["initial"] = "exact"
    if variable.unit:
        attributes["unit"] = variable.unit
    if variable.unit and (quantity := UNITS[variable.unit][0]):
        attributes["declaredType"] = quantity
    within = _range(robot, variable)
    for key, value, default in (
        ("min", within.low, -math.inf),
        ("max", within.high, math.inf),
        ("nominal", _nominal(robot, variable), 1.0),
    ):
        if value != default:
            attributes[key] = repr(value)
    if state:
        start = min(max(start or 0.0, within.low), within.high)
        attributes |= {"reinit": "true"} if exchanges else {}
    if start is not None:
        attributes["start"] = str(start).lower() if isinstance(start, bool) else repr(start)
    return attributes


def _description(elements: Sequence[dict[str, str]]) -> str:
    """Return a description of the vector and its elements, with each element's unit if units differ."""
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
