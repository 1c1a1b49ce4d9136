"""Units of variables, and their definitions in a modelDescription."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Collection

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
DISPLAY = {"rad": ("deg", 180.0 / math.pi)}
"""Display units, and their number in one SI unit."""


def add_units(root: ET.Element, used: Collection[str], fmi: int) -> None:
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
