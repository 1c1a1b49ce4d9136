"""Check an untrusted modelDescription.xml before FMPy reads it."""

import codecs
import io
import math
import re
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import fmpy
import lxml.etree
from fmpy.model_description import ModelDescription

from ..bounds import MAX_DIMENSIONS, MAX_DISPLAY_UNITS, MAX_ELEMENTS, MAX_NAME, MAX_NAMES

SCHEMAS = {"1": "fmi1/fmiModelDescription", "2": "fmi2/fmi2ModelDescription", "3": "fmi3/fmi3ModelDescription"}
"""Schema files in FMPy, by the major version of FMI."""
TRUE = ("true", "1")
NUMBERS: dict[str, Callable[[str], float]] = {"Real": float, "Integer": int, "Boolean": TRUE.__contains__}
"""Supported types of variables, and functions that parse their start values."""
TIMES = {"startTime": 0.0, "stopTime": math.inf, "stepSize": 1.0}  # times of a default experiment, and their defaults
SCALED = {"deg", "degree", "°", "deg/s", "rpm", "mm", "mm/s", "cm", "N.mm"}
"""Unit names that are known not to be SI units, even if the description does not define them."""
RELATIVE = "relativeQuantity"
OF_TYPES = (RELATIVE, "quantity", "unit", "displayUnit", "min", "max", "nominal")
"""Attributes that a variable inherits from its declared type: FMI 2.0.4, section 2.2.7."""
PART = r"""([A-Za-z_]\w*|'([\w!#$%&()*+,\-./:;<>=?@\[\]^{}|~ ]|\\['"?\\abfnrtv])+')(\[\d+(,\d+)*\])?"""
CONVENTIONS = {
    "flat": re.compile(r"[^\r\n\t]*"),
    "structured": re.compile(rf"{PART}(\.{PART})*|der\({PART}(\.{PART})*(,\d+)?\)", re.ASCII),
}
"""Names that a naming convention allows: FMI 2.0.5, section 2.2.9."""


def is_plain_xml(xml: bytes) -> bool:
    """Return whether XML declares no entities, in an encoding with an ASCII declaration."""
    text = xml.removeprefix(codecs.BOM_UTF8).lstrip()
    declared = re.match(rb"""<\?xml[^>]*?encoding\s*=\s*["']([^"']*)""", text)
    encoding = declared[1].lower() if declared else b"utf-8"
    ascii_based = re.fullmatch(rb"utf-8|us-ascii|iso-8859-\d+|windows-125\d", encoding)
    entities = re.search(rb"<!\s*(DOCTYPE|ENTITY)", text)
    return bool(text[:1] == b"<" and b"\0" not in text and ascii_based and not entities)


def read_description(root: ET.Element, xml: bytes, **more: bool) -> ModelDescription:
    """Check a modelDescription.xml; return FMPy's model description with the attributes that FMPy leaves out.

    Raises:
        Exception: the description is not valid; the type depends on the library that finds the fault.
    """
    if "fmiVersion" not in root.attrib:
        raise ValueError("it states no fmiVersion")
    check_description(root, xml)
    alone = io.BytesIO()  # FMPy would also read sources/buildDescription.xml of any size
    with zipfile.ZipFile(alone, "w") as archive:
        archive.writestr("modelDescription.xml", xml)
    description = fmpy.read_model_description(alone, validate=True, **more)
    _complete(description, root)
    return description


def _complete(description: ModelDescription, root: ET.Element) -> None:
    """Add the attributes of variables that FMPy leaves out: relativeQuantity, ranges, and those of declared types."""
    variables = [(v.get("name"), each) for v in root.iterfind("ModelVariables/*") for each in (v, *v)]
    whole = {name: each for name, each in variables if each.tag.startswith("UInt")}
    stated = {name: each.get(RELATIVE) in TRUE for name, each in variables if RELATIVE in each.attrib}
    for variable in description.modelVariables:
        variable.relativeQuantity = stated.get(variable.name)
        if variable.name in whole:
            variable.min, variable.max = map(whole[variable.name].get, ("min", "max"))
        if (declared := variable.declaredType) is not None:
            for name in OF_TYPES:
                if getattr(variable, name) is None:
                    setattr(variable, name, getattr(declared, name))


def check_description(root: ET.Element, xml: bytes) -> None:
    """Check the sizes of texts and arrays, and the schema.

    FMPy also checks the schema, but on a parsed tree, for which libxml2 takes quadratic time in the number of errors.

    Raises:
        ValueError: a text or an array is too large.
        lxml.etree.XMLSyntaxError: the schema does not allow the text.
    """
    _check_texts(root)
    _check_arrays(root)
    if name := SCHEMAS.get(root.get("fmiVersion", "").partition(".")[0]):  # FMPy refuses other versions
        schema = lxml.etree.XMLSchema(file=Path(fmpy.__file__).parent / "schema" / f"{name}.xsd")
        lxml.etree.fromstring(xml, lxml.etree.XMLParser(schema=schema))


def problems_of_names(root: ET.Element) -> list[str]:
    """Return the names of variables that the naming convention forbids; FMPy takes milliseconds for each name."""
    kind = "structured" if root.get("variableNamingConvention") == "structured" else "flat"
    names = [v.get("name", "") for path in ("*", "*/Alias") for v in root.iterfind(f"ModelVariables/{path}")]
    wrong = [name for name in names if not CONVENTIONS[kind].fullmatch(name)]
    return [f'"{name}" is no legal variable name for the naming convention "{kind}".' for name in wrong]


def problems_of_times(root: ET.Element) -> list[str]:
    """Return the faults of the default experiment."""
    times = getattr(root.find("DefaultExperiment"), "attrib", {})
    start, stop, step = (float(times.get(f"{key}", end)) for key, end in TIMES.items())
    wrong = [] if stop >= start else [f"DefaultExperiment: its stop time {stop:g} s is before its start at {start:g} s"]
    return wrong + ([] if 0.0 < step < math.inf else [f"DefaultExperiment: its step of {step:g} s is not > 0"])


def _check_texts(root: ET.Element) -> None:
    """Raise ValueError for long texts that are copied for each use, and for many display units."""
    for path in ("UnitDefinitions//*", "TypeDefinitions//*", "ModelVariables//*"):
        for each in root.iterfind(path):
            for key, text in _shared_texts(each):
                if len(text) > MAX_NAME:
                    raise ValueError(f"{key} '{text:.40}'… of a <{each.tag}> has more than {MAX_NAME} characters")
            if len(each.findall("DisplayUnit")) > MAX_DISPLAY_UNITS:
                raise ValueError(f"unit '{each.get('name')}' has more than {MAX_DISPLAY_UNITS} display units")


def _shared_texts(each: ET.Element) -> Iterator[tuple[str, str]]:
    """Yield texts that are copied for each use of a type or unit, or for each element of an array.

    They do not include descriptions, which are cut elsewhere, and the start value of a scalar String.
    """
    array = each.find("Dimension") is not None
    for key, text in each.items():
        if key == "start" and array:
            yield from ((key, word) for word in text.split())
        elif key != "description" and each.tag != "Start" and (each.tag, key) != ("String", "start"):
            yield key, text
    yield from (("start", start.get("value", "")) for start in each.findall("Start") if array)


def _check_arrays(root: ET.Element) -> None:
    """Raise ValueError for invalid sizes and too many elements, including aliases."""
    sizes = {v.get("valueReference"): v.get("start") for v in root.iterfind("ModelVariables/*")}
    room, letters = MAX_ELEMENTS, MAX_NAMES
    for variable in root.iterfind("ModelVariables/*"):
        names = [each.get("name", "") for each in (variable, *variable.iterfind("Alias"))]
        name, dimensions = names[0], variable.findall("Dimension")
        texts = [d.get("start") or sizes.get(d.get("valueReference")) or "" for d in dimensions]
        if len(texts) > MAX_DIMENSIONS:
            raise ValueError(f"variable '{name}' has more than {MAX_DIMENSIONS} dimensions")
        if not all(re.fullmatch(r"\s*[0-9]{1,18}\s*", text) for text in texts):
            raise ValueError(f"variable '{name}' has a dimension whose size is unknown")
        elements = math.prod(max(1, int(text)) for text in texts)
        room -= elements * len(names) if dimensions else len(names) - 1
        letters -= elements * sum(map(len, names)) if dimensions else 0
        if room < 0:
            raise ValueError(f"with variable '{name}' its arrays have more than {MAX_ELEMENTS} elements")
        if letters < 0:
            much = f"the names of its arrays' elements have more than {MAX_NAMES} characters"
            raise ValueError(f"with variable '{name:.40}' {much}")
