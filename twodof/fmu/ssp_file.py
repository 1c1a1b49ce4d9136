"""Read an SSP 1.0 file: the tree of its systems, and the values of parameter bindings.

Source: System Structure and Parameterization 1.0, Modelica Association, 2019.
"""

from __future__ import annotations

import math
import posixpath
import zipfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree as ET

import fmpy.ssp
import lxml.etree
from fmpy.model_description import DefaultExperiment

from ..bounds import MAX_COMPONENTS, MAX_DESCRIPTION, MAX_FMUS, MAX_NAME, MIB
from ..errors import ZIP_ERRORS, FmuError
from ..files import check_archive, read_member
from .validation import NUMBERS, SCALED, TRUE, is_plain_xml

STRUCTURE = "SystemStructure.ssd"
SCHEMAS = Path(fmpy.ssp.__file__).parent / "schema"
SSC, SSD, SSM, SSV = (
    f"{{http://ssp-standard.org/SSP1/SystemStructure{name}}}"
    for name in ("Common", "Description", "ParameterMapping", "ParameterValues")
)
"""Namespaces in the notation of ElementTree."""
FMU_TYPES = ("application/x-fmu-sharedlibrary", "")
EXPONENTS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


class Unit(NamedTuple):
    """A unit: its name and, if it is defined, exponents of base units, factor and offset."""

    name: str = ""
    exponents: tuple[int, ...] | None = None
    factor: float = 1.0
    offset: float = 0.0

    @property
    def is_scaled(self) -> bool:
        """True if it is not a product of base units."""
        return self.name in SCALED if self.exponents is None else (self.factor, self.offset) != (1.0, 0.0)

    @property
    def of_differences(self) -> Unit:
        """The unit for differences of values, which has no offset."""
        return self._replace(offset=0.0)


class Affine(NamedTuple):
    """The map gain·x + offset of a value."""

    gain: float = 1.0
    offset: float = 0.0

    def of(self, value: float) -> float:
        """Return the mapped value; the identity returns exactly the value."""
        return value if self == IDENTITY else self.gain * value + self.offset

    def after(self, first: Affine) -> Affine:
        """Return the map that applies ``first``, then this map."""
        return Affine(self.gain * first.gain, self.gain * first.offset + self.offset)

    def inverse(self, value: float) -> float:
        """Return the argument that is mapped to a value; the value itself if the gain is 0."""
        return value if self == IDENTITY or self.gain == 0.0 else (value - self.offset) / self.gain


IDENTITY = Affine()


class Parameter(NamedTuple):
    """A value of a parameter set, whether its unit is converted, and the map that is applied afterwards.

    The value is text if its type is String, Enumeration or Binary.
    """

    name: str
    type: str
    value: float | bool | str
    unit: Unit
    converts: bool = True
    map: Affine = IDENTITY


class Connector(NamedTuple):
    """A connector of a system or component: its kind in SSP, and its unit and type, if stated."""

    kind: str
    unit: Unit = Unit()
    type: str = ""


@dataclass
class Element:
    """A system or component: full name relative to the top system (which has ""), connectors and parameter values.

    Attributes:
        source: member of the archive with the component's FMU; "" for a system.
        unsupported: messages about valid SSP features that a run does not support.
        ignored: sources of parameter mappings that their parameter sets do not have.
        children, connections: elements inside a system, and its connections as XML elements.
    """

    name: str
    connectors: dict[str, Connector]
    parameters: list[Parameter]
    source: str = ""
    children: list[Element] = field(default_factory=list)
    connections: list[ET.Element] = field(default_factory=list)
    unsupported: list[str] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)

    def walk(self) -> Iterator[Element]:
        """Yield all elements, each system after the elements inside it."""
        for child in self.children:
            yield from child.walk()
        yield self


def read_ssp(path: Path) -> tuple[str, Element, DefaultExperiment, bytes]:
    """Return name, top system, default experiment and the SHA-256 of structure and parameter sets of an SSP file."""
    try:
        check_archive(path)
        with zipfile.ZipFile(path) as archive:
            file = _File(path, archive)
            root = file.xml(STRUCTURE, "Description")
            units = units_in(root.find(f"{SSD}Units"))
            top = root.find(f"{SSD}System")
            assert top is not None  # the schema requires it
            if sum(each.tag in (f"{SSD}Component", f"{SSD}System") for each in top.iterfind(".//*")) > MAX_COMPONENTS:
                most = f"{MAX_COMPONENTS} components and systems"
                raise FmuError(f"'{path}' has more than {most}; OMSimulator takes larger systems")
            system = file.element(top, "", units)
            if twice := next((name for name, n in Counter(e.name for e in system.walk()).items() if n > 1), None):
                raise FmuError(
                    f"'{path}': two elements have the name '{twice}', with that of their systems; rename one"
                )
            sources = {element.source for element in system.walk() if element.source}
            if sum(archive.getinfo(source).file_size for source in sources) > MAX_FMUS:
                raise FmuError(f"'{path}': its FMUs have more than {MAX_FMUS // MIB} MiB together")
            default = root.find(f"{SSD}DefaultExperiment")
            times = {} if default is None else default.attrib
            experiment = DefaultExperiment(startTime=times.get("startTime"), stopTime=times.get("stopTime"))
            return root.get("name", ""), system, experiment, file.digest.digest()
    except OSError as error:
        raise FmuError(f"cannot read '{path}': {error.strerror or error}") from error
    except ZIP_ERRORS as error:
        raise FmuError(f"'{path}': {error}") from error


class _File:
    """An open SSP file, read by the names in its XML."""

    def __init__(self, path: Path, archive: zipfile.ZipFile) -> None:
        self._path, self._archive, self._names, self._room = path, archive, {*archive.namelist()}, MAX_DESCRIPTION
        self.digest = sha256()

    def xml(self, name: str, kind: str) -> ET.Element:
        """Return the root of an XML member, validated by its schema."""
        if name not in self._names:
            raise FmuError(f"'{self._path}' has no '{name}'")
        content = read_member(self._archive, name, MAX_DESCRIPTION)
        if not is_plain_xml(content):
            raise FmuError(f"'{self._path}': {name} declares entities or is not UTF-8")
        self.digest.update(content)
        return self._checked(content, name, kind)

    def _checked(self, content: bytes, name: str, kind: str) -> ET.Element:
        content = content.replace(b'version="2.0"', b'version="1.0"')  # the schema refuses by name what 1.0 lacks
        self._room -= len(content)
        if self._room < 0:
            what = "its structure, parameter sets and mappings, each as often as it is bound"
            raise FmuError(f"'{self._path}': {what}, have more than {MAX_DESCRIPTION} bytes")
        try:
            lxml.etree.fromstring(content, lxml.etree.XMLParser(schema=_schema(kind)))
            return ET.fromstring(content)
        except (lxml.etree.XMLSyntaxError, ET.ParseError) as error:
            raise FmuError(f"'{self._path}': {name} is not valid SSP 1.0: {error.msg:.300}") from error

    def element(self, xml: ET.Element, name: str, units: dict[str, Unit]) -> Element:
        """Return a system with the elements inside it, or a component."""
        if len(name) > MAX_NAME:
            raise FmuError(f"'{self._path}': '{name:.40}'… has a name of more than {MAX_NAME} characters")
        connectors = {}
        for connector in xml.iterfind(f"{SSD}Connectors/{SSD}Connector"):
            kind = next((child for child in connector if child.tag.startswith(SSC)), None)
            unit, of = ("", "") if kind is None else (kind.get("unit", ""), kind.tag.removeprefix(SSC))
            facts = connector.get("kind", ""), units.get(unit, Unit(unit)), of
            connectors[connector.get("name", "")] = Connector(*facts)
        bindings = xml.findall(f"{SSD}ParameterBindings/{SSD}ParameterBinding")
        far = [b for b in bindings if any(each.get("sourceBase", "SSD") != "SSD" for each in b.iter())]
        ignored: list[str] = []
        parameters = [parameter for b in bindings if b not in far for parameter in self._bound(b, name, ignored)]
        element = Element(name, connectors, parameters, ignored=ignored)
        if far:
            element.unsupported.append(f"'{name}' has a parameter file inside its FMU: not supported")
        if xml.tag == f"{SSD}Component":
            form = xml.get("type", "")
            if form not in FMU_TYPES or xml.get("implementation") == "ModelExchange":
                what = "a Model Exchange FMU" if form in FMU_TYPES else f"of type {form}"
                element.unsupported.append(f"component '{name}' is {what}; a co-simulation FMU is needed")
            if form in FMU_TYPES:
                element.source = self._member(xml.get("source", ""), name)
            return element
        for feature in ("SignalDictionaries", f"Elements/{SSD}SignalDictionaryReference"):
            if xml.find(f"{SSD}{feature}") is not None:
                element.unsupported.append(f"system '{name or 'of all'}' has signal dictionaries: not supported")
        for child in xml.iterfind(f"{SSD}Elements/*"):
            own = f"{name}.{child.get('name')}" if name else child.get("name", "")
            element.children.append(self.element(child, own, units))
        element.connections = [*xml.iterfind(f"{SSD}Connections/{SSD}Connection")]
        return element

    def _member(self, source: str, name: str) -> str:
        """Return the member of the archive that a URI names."""
        parts = urlsplit(source)
        member = posixpath.normpath(unquote(parts.path))
        if parts.scheme or parts.netloc or member not in self._names:
            raise FmuError(f"'{self._path}': '{source:.80}' of '{name}' is not a file in it")
        return member

    def _bound(self, binding: ET.Element, name: str, ignored: list[str]) -> Iterator[Parameter]:
        root = self._content(binding, f"{SSD}ParameterValues", SSV, "ParameterValues", name)
        units, prefix = units_in(root.find(f"{SSV}Units")), binding.get("prefix", "")
        if len(prefix) > MAX_NAME:
            raise FmuError(f"'{self._path}': a prefix of parameters has more than {MAX_NAME} characters")
        given: dict[str, Parameter] = {}
        rows = root.findall(f"{SSV}Parameters/{SSV}Parameter")
        self._check_once([xml.get("name", "") for xml in rows], f"a parameter set of '{name or 'the system'}' sets")
        for xml in rows:
            kind = next(child for child in xml if child.tag.startswith(SSV))
            text, unit = kind.get("value", ""), kind.get("unit", "")
            of, own = kind.tag.removeprefix(SSV), xml.get("name", "")
            value = NUMBERS[of](text.strip()) if of in NUMBERS else text
            given[prefix + own] = Parameter(prefix + own, of, value, units.get(unit, Unit(unit)))
        mapping = binding.find(f"{SSD}ParameterMapping")
        if mapping is None:
            yield from given.values()
            return
        root = self._content(mapping, "", SSM, "ParameterMapping", name)
        entries = root.findall(f"{SSM}MappingEntry")
        self._check_once([e.get("target", "") for e in entries], f"a mapping of '{name or 'the system'}' sets")
        for entry in entries:
            source, target = entry.get("source", ""), entry.get("target", "")
            if (parameter := given.get(source)) is not None:  # the source has the prefix
                converts = entry.get("suppressUnitConversion") not in TRUE
                what = f"'{self._path}': the mapping of '{source}'"
                yield parameter._replace(name=target, converts=converts, map=transformation(entry, what))
            elif source:  # tools write entries without a source for all variables
                ignored.append(source)

    def _check_once(self, names: list[str], what: str) -> None:
        """Refuse names that are not unique, as the standard demands of a parameter set and of the targets of a map."""
        if twice := next((name for name, count in Counter(names).items() if count > 1), None):
            raise FmuError(f"'{self._path}': {what} '{twice:.80}' twice; leave one value out")

    def _content(self, xml: ET.Element, inside: str, namespace: str, kind: str, name: str) -> ET.Element:
        """Return the root of a parameter set or mapping, which is inline or a file."""
        inline = (xml.find(inside) if inside else xml) if not xml.get("source") else None
        root = None if inline is None else next((c for c in inline if c.tag.startswith(namespace)), None)
        if root is not None:
            return self._checked(ET.tostring(root), f"an inline set of '{name}'", kind)
        return self.xml(self._member(xml.get("source", ""), name or "the system"), kind)


@cache
def _schema(kind: str) -> lxml.etree.XMLSchema:
    return lxml.etree.XMLSchema(file=SCHEMAS / f"SystemStructure{kind}.xsd")


def units_in(xml: ET.Element | None) -> dict[str, Unit]:
    """Return the units that an element of SSP defines, by name."""
    units = {}
    for unit in [] if xml is None else xml.iterfind(f"{SSC}Unit"):
        base, name = unit.find(f"{SSC}BaseUnit"), unit.get("name", "")
        if base is not None:
            exponents = tuple(int(base.get(key, "0")) for key in EXPONENTS)
            units[name] = Unit(name, exponents, float(base.get("factor", "1")), float(base.get("offset", "0")))
    return units


def transformation(xml: ET.Element, what: str) -> Affine:
    """Return the linear transformation of a connection or mapping entry."""
    for child in xml:
        if child.tag.startswith(SSC) and child.tag.endswith("Transformation"):
            if child.tag != f"{SSC}LinearTransformation":
                raise FmuError(f"{what} has a {child.tag.removeprefix(SSC)}: not supported")
            affine = Affine(float(child.get("factor", "1")), float(child.get("offset", "0")))
            if not all(map(math.isfinite, affine)):
                raise FmuError(f"{what} has a transformation that is not finite")
            return affine
    return IDENTITY
