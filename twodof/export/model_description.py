"""modelDescription.xml of either flavour, from the variable table. FMI 2.0.4, section 2.2."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Collection, Sequence

from ..plant.robot import Robot
from ..plant.urdf import UNBOUNDED
from ..plant.variables import (
    CONTROLS,
    DISTURBANCES,
    NO_RANGE,
    RANGES,
    Control,
    Range,
    Variable,
    count_event_indicators,
)
from ..version import __version__
from .compiler import UNITS
from .flavours import Flavour
from .model_description3 import xml_text
from .options import FmuOptions

DIMENSIONS: dict[str, dict[str, int]] = {
    "m": {"m": 1},
    "m/s": {"m": 1, "s": -1},
    "m/s2": {"m": 1, "s": -2},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "N.m": {"kg": 1, "m": 2, "s": -2},
    "s": {"s": 1},
    "1/s": {"s": -1},
    "1/s2": {"s": -2},
    "rad/s2": {"rad": 1, "s": -2},
    "kg": {"kg": 1},
}
"""Exponents of the SI base units; all factors are 1."""

QUANTITIES = {
    "m": "Length",
    "m/s": "Velocity",
    "m/s2": "Acceleration",
    "rad": "Angle",
    "rad/s": "AngularVelocity",
    "rad/s2": "AngularAcceleration",
    "N": "Force",
    "N.m": "Torque",
    "s": "Time",
    "kg": "Mass",
}
"""What is measured in a unit, by the names of Modelica's standard library; gains are none."""
DISPLAY = {"rad": ("deg", 180.0 / math.pi)}
"""Units for people, and how many of them are one."""

LOG_CATEGORIES = {
    "logStatusWarning": "Warnings",
    "logStatusDiscard": "Refused steps",
    "logStatusError": "Refused calls",
    "logStatusFatal": "Failures that end the instance",
    "logAll": "All messages",
}
DEFAULT_STOP_TIME, DEFAULT_STEP = 5.0, 0.01
VENDOR = "twodof"
AUTHOR = "the twodof developers"

CAPABILITIES = {
    "canGetAndSetFMUstate": "true",
    "canSerializeFMUstate": "true",
    "canNotUseMemoryManagementFunctions": "true",
}
STATES = ("q", "v")
SMALL = ("rtol", "atol", "max_step")
"""Whose start is their size."""
EFFORTS = ("tau", "tau_cmd", "tau_ext")
START = ("q_start", "q_min", "q_max")
"""What q depends on at the start."""
IMPACT = (*START, "v_start", "payload", "payload_com", "rigid_stops")
"""What v depends on at the start, where it may be into a stop."""


def model_description(
    options: FmuOptions, robot: Robot, table: Sequence[Variable], flavour: Flavour, guid: str
) -> bytes:
    """The XML text.

    Args:
        options: with the model's name and control law.
        robot, table: the robot and its variables, by value reference.
        flavour: says which interfaces there are, and what they can do.
        guid: as it shall stand in the file; "" while it is being computed.
    """
    law = CONTROLS[options.control]
    root = ET.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=options.name,
        guid=guid,
        description=f"Robot '{robot.name}' with {len(robot.joints)} joints under"
        f" {law.title.format(frame=robot.frame)}",
        version=__version__,
        author=AUTHOR,
        copyright=f"Copyright (c) {AUTHOR}; of the robot's description, its author's",
        license="BSD-3-Clause",
        generationTool=f"{VENDOR} {__version__}",
        variableNamingConvention="structured",
    )
    interfaces = {"CoSimulation": {"canHandleVariableCommunicationStepSize": "true"}}
    needs = {"needsExecutionTool": "true"}
    if flavour.native:
        indicators = count_event_indicators(robot, options.control)
        root.set("numberOfEventIndicators", str(indicators))
        interfaces = {"ModelExchange": {"completedIntegratorStepNotNeeded": "true"}, **interfaces}
        needs = {"needsExecutionTool": "false", "providesDirectionalDerivative": "true"}
    for interface, own in interfaces.items():
        attributes = {"modelIdentifier": options.name, **CAPABILITIES, **needs, **own}
        element = ET.SubElement(root, interface, attributes)
        if flavour.native:
            files = ET.SubElement(element, "SourceFiles")
            for name in UNITS:
                ET.SubElement(files, "File", name=name)
    used = {variable.unit for variable in table}
    _units(root, used)
    _types(root, used)
    categories = ET.SubElement(root, "LogCategories")
    for category, description in LOG_CATEGORIES.items():
        ET.SubElement(categories, "Category", name=category, description=description)
    times = {
        "startTime": "0.0",
        "stopTime": repr(DEFAULT_STOP_TIME),
        "stepSize": repr(DEFAULT_STEP),
    }
    ET.SubElement(root, "DefaultExperiment", times)
    _vendor_annotation(root, robot, options.control)
    _variables(root, robot, table, flavour.native)
    _structure(root, robot, table, law)
    return xml_text(root)


def _units(root: ET.Element, used: Collection[str]) -> None:
    definitions = ET.SubElement(root, "UnitDefinitions")
    for name, exponents in DIMENSIONS.items():
        if name in used:
            unit = ET.SubElement(definitions, "Unit", name=name)
            base = {key: str(exponent) for key, exponent in exponents.items()}
            ET.SubElement(unit, "BaseUnit", {**base, "factor": "1"})
            if name in DISPLAY:
                display, factor = DISPLAY[name]
                ET.SubElement(unit, "DisplayUnit", name=display, factor=repr(factor))


def _types(root: ET.Element, used: Collection[str]) -> None:
    definitions = ET.SubElement(root, "TypeDefinitions")
    for unit, quantity in QUANTITIES.items():
        if unit in used:
            simple = ET.SubElement(definitions, "SimpleType", name=quantity)
            real = ET.SubElement(simple, "Real", quantity=quantity, unit=unit)
            if unit in DISPLAY:
                real.set("displayUnit", DISPLAY[unit][0])


def _vendor_annotation(root: ET.Element, robot: Robot, control: str) -> None:
    """What a logger needs to know beyond variable names."""
    tool = ET.SubElement(ET.SubElement(root, "VendorAnnotations"), "Tool", name=VENDOR)
    task = ET.SubElement(
        tool, "Robot", name=robot.name, root=robot.root, frame=robot.frame, axes=robot.axes,
        control=control,
    )  # fmt: skip
    for joint, prismatic in zip(robot.joints, robot.prismatic, strict=True):
        ET.SubElement(task, "Joint", name=joint, type="prismatic" if prismatic else "revolute")


def _range(robot: Robot, variable: Variable) -> Range:
    """Of values: the URDF's limits of a joint's position, else what the FMU refuses to leave."""
    if variable.group == "q" and variable.index is not None:
        limits = robot.q_min[variable.index], robot.q_max[variable.index]
        low, high = (side if abs(side) < UNBOUNDED else math.inf * side for side in limits)
        return Range(low, high, "")
    return RANGES.get(variable.group, NO_RANGE)


def _nominal(robot: Robot, variable: Variable) -> float:
    """The size of values, 1 where there is no better one to be known."""
    if variable.group in SMALL:
        return float(variable.start or 1.0)
    if variable.group in EFFORTS and variable.index is not None:
        effort = robot.effort[variable.index]
        return effort if 0.0 < effort < math.inf else 1.0
    return 1.0


def _variables(root: ET.Element, robot: Robot, table: Sequence[Variable], exchanges: bool) -> None:
    variables = ET.SubElement(root, "ModelVariables")
    at = {(variable.group, variable.index): i for i, variable in enumerate(table, start=1)}
    for reference, variable in enumerate(table):
        state = exchanges and variable.group in STATES
        attributes = {
            "name": variable.name,
            "valueReference": str(reference),
            "description": variable.description,
            "causality": variable.causality,
            "variability": "fixed" if variable.causality == "parameter" else "continuous",
        }
        if variable.causality in ("output", "local"):
            attributes["initial"] = "approx" if state else "calculated"
        elif variable.causality == "parameter":
            attributes["initial"] = "exact"
        scalar = ET.SubElement(variables, "ScalarVariable", attributes)
        typed = ET.SubElement(scalar, variable.type)
        if variable.unit:
            typed.set("unit", variable.unit)
        if variable.unit in QUANTITIES:
            typed.set("declaredType", QUANTITIES[variable.unit])
        within = _range(robot, variable)
        _size(typed, within, _nominal(robot, variable))
        start = variable.start
        if state:  # FMI allows these two of an FMU for co-simulation alone neither
            start = table[at[f"{variable.group}_start", variable.index] - 1].start or 0.0
            start = min(max(start, within.low), within.high)
            typed.set("reinit", "true")
        if start is not None:
            boolean = variable.type == "Boolean"
            typed.set("start", str(start).lower() if boolean else repr(start))
        if variable.derivative_of:
            typed.set("derivative", str(at[variable.derivative_of, variable.index]))


def _size(typed: ET.Element, within: Range, nominal: float) -> None:
    for name, value, default in (
        ("min", within.low, -math.inf), ("max", within.high, math.inf), ("nominal", nominal, 1.0),
    ):  # fmt: skip
        if value != default:
            typed.set(name, repr(value))


def _structure(root: ET.Element, robot: Robot, table: Sequence[Variable], control: Control) -> None:
    moves = robot.moves_frame()
    inputs = (*control.inputs, *DISTURBANCES)
    law = ("gravity", *control.parameters, "limit_effort")
    own, frame, every = "that joint's", "those of joints that move the frame", "all"
    during = {
        "q": (("q",), own), "v": (("v",), own), "der_q": (("v",), own),
        "x": (("q",), frame), "quat": (("q",), frame),
        "xd": (STATES, frame), "omega": (STATES, frame),
        "tau": ((*STATES, *control.inputs), every), "der_v": ((*STATES, *inputs), every),
    }  # fmt: skip
    at_the_start = {
        "q": (START, own), "x": (START, frame), "quat": (START, frame),
        **dict.fromkeys(("v", "xd", "omega", "der_q"), (IMPACT, every)),
        "tau": ((*IMPACT, *law, *control.inputs), every),
        "der_v": ((*IMPACT, *law, *inputs), every),
    }  # fmt: skip
    if control.commands == "effort":
        during["tau"] = (control.inputs, own)
        at_the_start["tau"] = (("limit_effort", *control.inputs), own)

    def known(unknown: Variable, groups: Sequence[str], whose: str) -> str:
        """1-based indices of variables that an unknown depends on."""
        return " ".join(
            str(i)
            for i, variable in enumerate(table, start=1)
            if variable.group in groups
            and (whose != own or variable.index in (unknown.index, None))
            and (whose != frame or (variable.index is not None and moves[variable.index]))
        )

    structure = ET.SubElement(root, "ModelStructure")
    outputs = ET.SubElement(structure, "Outputs")
    derivatives = ET.SubElement(structure, "Derivatives")
    initial = ET.SubElement(structure, "InitialUnknowns")
    for i, variable in enumerate(table, start=1):
        if variable.group in during:
            kind = outputs if variable.causality == "output" else derivatives
            for parent, rule in ((kind, during), (initial, at_the_start)):
                dependencies = known(variable, *rule[variable.group])
                ET.SubElement(parent, "Unknown", index=str(i), dependencies=dependencies)
