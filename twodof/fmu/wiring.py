"""Connections of a system from outputs of FMUs through nested systems to inputs, in the order of feedthrough."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from graphlib import CycleError, TopologicalSorter
from typing import NamedTuple
from xml.etree import ElementTree as ET

from ..bounds import MAX_COMPONENTS, MAX_WIRING
from ..errors import FmuError, SspError, choice
from .description import Fmu
from .scalar import Scalar
from .ssp_file import EXPONENTS, IDENTITY, Affine, Connector, Element, Unit, transformation
from .validation import NUMBERS, TRUE

SOURCES = ("output", "calculatedParameter")
ROUNDING = 1e-5
"""Relative difference of factors and offsets of one unit, which tools write with few digits."""


class Node(NamedTuple):
    """A connector: full name of its system or component ("" for the top system), and its own name."""

    element: str
    connector: str

    def __str__(self) -> str:
        return f"{self.element}.{self.connector}" if self.element else self.connector


class Link(NamedTuple):
    """A connection from its first source, a component's output or a system's connector, to a component's variable."""

    source: Node
    target: Node
    map: Affine


class Wiring:
    """Elements of a system by full name, their variables and units, and their connections."""

    def __init__(self, path: object, top: Element, fmus: Mapping[str, Fmu]) -> None:
        self._path, self._fmus = path, fmus
        self.elements = {element.name: element for element in top.walk()}
        self._units = {name: units_of(fmu) for name, fmu in fmus.items()}
        variables = ((name, variable) for name, fmu in fmus.items() for variable in fmu.variables.values())
        self._relative = {Node(name, variable.name) for name, variable in variables if variable.relative}
        for name, fmu in fmus.items():
            for own, connector in self.elements[name].connectors.items():
                if own in fmu.variables:
                    self._check_connector(Node(name, own), connector, fmu.variables[own])
        self._incoming: dict[Node, tuple[Node, bool, Affine]] = {}
        self._ways: list[list[Node]] = []  # from components' variables back to their first sources
        for element in self.elements.values():
            for connection in element.connections:
                self._connect(element, connection)

    def scalar(self, node: Node) -> Scalar | None:
        """Return a component's variable; None for a connector of a system."""
        if (fmu := self._fmus.get(node.element)) is None:
            return None
        if node.connector not in fmu.variables:
            raise SspError(f"'{self._path}': there is no '{node!s:.80}'{choice(node.connector, fmu.variables)}")
        return fmu.variables[node.connector]

    def find(self, name: str) -> Node | None:
        """Return the variable or connector with a full name, or None."""
        for element in [*self.elements][::-1]:  # the innermost element is the last
            own = name.removeprefix(f"{element}.") if element else name
            named = self._fmus[element].variables if element in self._fmus else self.elements[element].connectors
            if own in named and (own != name or not element):
                return Node(element, own)
        return None

    def unit(self, node: Node) -> Unit:
        """Return the unit of a variable, else that stated by its connector, as it applies there."""
        stated = self.elements[node.element].connectors.get(node.connector, Connector("")).unit
        scalar = self.scalar(node)
        own = self._own_unit(node, scalar) if scalar is not None else Unit()
        known = stated if not own.name or (own.exponents is None and own.name == stated.name) else own
        return self.applied(node, known)

    def applied(self, node: Node, unit: Unit) -> Unit:
        """Return a unit as it applies to a variable or connector: a difference has no offset."""
        return unit.of_differences if node in self._relative else unit

    def _own_unit(self, node: Node, scalar: Scalar) -> Unit:
        return self._units[node.element].get(scalar.unit or "", Unit(scalar.unit or ""))

    def _check_connector(self, node: Node, connector: Connector, scalar: Scalar) -> None:
        """Refuse a connector that contradicts its variable in kind, type or unit."""
        stated, own = connector.unit, self._own_unit(node, scalar)
        what = f"'{self._path}': the connector '{node}' states"
        for word, says, has in (("type", connector.type, scalar.type), ("kind", connector.kind, scalar.causality)):
            if {says, has} <= {*NUMBERS, "input", "output"} and says != has:
                raise SspError(f"{what} the {word} {says}, and its FMU {has}; state that of the FMU")
        if stated.exponents is None and own.name and stated.name not in ("", own.name):
            raise FmuError(
                f"{what} the unit '{stated.name}' without a definition, and its FMU '{own.name}'; state that"
            )
        if stated.exponents is None or own.exponents is None:
            return
        alike = stated.exponents == own.exponents and math.isclose(stated.factor, own.factor, rel_tol=ROUNDING)
        if not alike or not math.isclose(stated.offset, own.offset, rel_tol=ROUNDING):
            raise SspError(f"{what} the unit '{stated.name}', and its FMU another, '{own.name}'; state that of the FMU")

    def _kind(self, node: Node) -> str:
        scalar = self.scalar(node)
        if scalar is not None:
            return scalar.causality
        connectors = self.elements[node.element].connectors
        if node.connector not in connectors:
            raise SspError(f"'{self._path}': there is no connector '{node}'{choice(node.connector, connectors)}")
        return connectors[node.connector].kind

    def _connect(self, system: Element, connection: ET.Element) -> None:
        """Add a connection inside a system; its start may be the sink."""
        ends = []
        for end in ("start", "end"):
            inner = connection.get(f"{end}Element", "")
            name = system.name if not inner else f"{system.name}.{inner}" if system.name else inner
            if name not in self.elements:
                raise SspError(f"'{self._path}': a connection names '{inner:.80}', which is not an element")
            node = Node(name, connection.get(f"{end}Connector", ""))
            gives = (self._kind(node) in SOURCES) == bool(inner)
            ends.append((node, gives))
        (start, start_gives), (sink, sink_gives) = ends
        what = f"'{self._path}': the connection of '{start}' and '{sink}'"
        affine = transformation(connection, what)
        if start_gives == sink_gives or (sink_gives and affine != IDENTITY):
            raise SspError(f"{what} is not from an output to an input")
        if sink_gives:
            start, sink = sink, start
        if sink in self._incoming:
            raise SspError(f"'{self._path}': two connections end at '{sink}'; leave one out")
        self._incoming[sink] = start, connection.get("suppressUnitConversion") not in TRUE, affine

    def links(self) -> list[Link]:
        """Return the connections of components' variables with their first sources.

        Raises:
            FmuError: connections form a loop without a component, or connect different types or units.
        """
        room = MAX_WIRING
        for target in self._incoming:
            if target.element not in self._fmus:
                continue
            way = [target]
            while way[-1] in self._incoming:
                if len(way) > MAX_COMPONENTS:
                    what = f"a cycle of systems, or longer than {MAX_COMPONENTS}"
                    raise FmuError(f"'{self._path}': the connections to '{target}' are {what}")
                way.append(self._incoming[way[-1]][0])
                if way[-1].element in self._fmus:
                    break
            room = _spent(self._path, room, len(way))
            self._ways.append(way)
            if self._relative & {way[0], way[-1]}:
                self._relative |= {node for node in way if node.element not in self._fmus}
        return [Link(way[-1], way[0], self._map(way[::-1])) for way in self._ways]

    def passed(self, starts: Mapping[Node, float | bool]) -> dict[Node, float | bool]:
        """Return the values that connectors of systems pass to components' variables; the outermost value counts."""
        values = {}
        for way in self._ways:
            valued = [k for k, node in enumerate(way) if node in starts and node.element not in self._fmus]
            if valued:
                last = valued[-1]
                values[way[0]] = self._map(way[last::-1]).of(starts[way[last]])
        return values

    def _map(self, way: list[Node]) -> Affine:
        """Return the map of values along a path of connections, with conversions of units."""
        total, unit = IDENTITY, self.unit(way[0])
        for node in way[1:]:
            start, converts, affine = self._incoming[node]
            own = self.unit(node)
            if converts:
                total = conversion(self._path, unit, own, f"'{start}' and '{node}'").after(total)
            total, unit = affine.after(total), own if own.name else unit
        source, target = self.scalar(way[0]), self.scalar(way[-1])
        assert target is not None
        if target.type not in ("Real", "Integer", "Boolean") or (source is not None and source.type != target.type):
            types = target.type if source is None else f"{source.type} and {target.type}"
            raise FmuError(f"'{self._path}': '{way[0]}' and '{way[-1]}' are of type {types}: not supported")
        if target.causality not in ("input", "parameter") or (source is not None and target.causality == "parameter"):
            raise FmuError(f"'{self._path}': '{way[-1]}' is of causality {target.causality}: not supported")
        if not all(map(math.isfinite, total)):
            raise FmuError(f"'{self._path}': the units of '{way[0]}' and '{way[-1]}' have no finite conversion")
        if target.type != "Real" and total != IDENTITY:
            raise FmuError(f"'{self._path}': '{way[-1]}' is of type {target.type}, which is not transformed")
        return total


def conversion(path: object, source: Unit, target: Unit, what: str) -> Affine:
    """Return the conversion between units; the identity if one of them is not stated."""
    if not source.name or not target.name or source == target:
        return IDENTITY
    if source.exponents is None or target.exponents is None:
        if source.name == target.name:
            return IDENTITY
        raise FmuError(
            f"'{path}': {what} have the units '{source.name}' and '{target.name}', of which one is not defined"
        )
    if source.exponents != target.exponents:
        raise SspError(f"'{path}': {what} have units of different dimensions, '{source.name}' and '{target.name}'")
    if not (target.factor and source.factor and math.isfinite(source.factor / target.factor)):
        names = f"'{source.name}' or '{target.name}'"
        raise FmuError(f"'{path}': the unit {names} of {what} has no valid factor")
    return Affine(source.factor / target.factor, (source.offset - target.offset) / target.factor)


def units_of(fmu: Fmu) -> dict[str, Unit]:
    """Return the units that an FMU defines, by name."""
    units = {}
    for unit in fmu.description.unitDefinitions:
        if (base := unit.baseUnit) is not None:
            exponents = tuple(int(getattr(base, key) or 0) for key in EXPONENTS)
            factor, offset = (float(1.0 if x is None else x) for x in (base.factor, base.offset))
            units[unit.name] = Unit(unit.name, exponents, factor, offset)
    return units


def _spent(path: object, room: int, size: int) -> int:
    """Return what is left of ``MAX_WIRING``."""
    if size > room:
        what = "connections, as often as values pass them, or direct dependencies of outputs"
        raise FmuError(f"'{path}' has more than {MAX_WIRING} {what}; cut it into several systems")
    return room - size


def order(path: object, fmus: Mapping[str, Fmu], links: Iterable[Link], initial: bool = False) -> list[list[Node]]:
    """Return batches of outputs and inputs in the order of evaluation at one instant.

    An output follows the connected inputs on which it depends directly by its FMU's ModelStructure. Without stated
    dependencies, it follows all of them.

    Args:
        initial: whether the instant is in initialisation mode, in which InitialUnknowns take precedence.

    Raises:
        FmuError: there is an algebraic loop, which the message names.
    """
    between = [link for link in links if link.source.element in fmus]
    inputs: dict[str, dict[int, list[Node]]] = {name: {} for name in fmus}  # by value reference
    for link in between:
        name, own = link.target
        inputs[name].setdefault(fmus[name].variables[own].reference, []).append(link.target)
    known = {name: _dependencies(fmu, initial) for name, fmu in fmus.items()}
    graph: dict[Node, list[Node]] = {link.target: [link.source] for link in between}
    needs: dict[tuple[str, int], list[Node]] = {}
    room = MAX_WIRING
    for source in dict.fromkeys(link.source for link in between):
        name, here = source.element, inputs[source.element]
        output = name, fmus[name].variables[source.connector].reference
        if output not in needs:
            references = known[name].get(output[1], here)
            needs[output] = [node for reference in references for node in here.get(reference, [])]
        graph[source] = needs[output]
        room = _spent(path, room, len(needs[output]))
    sorter, batches = TopologicalSorter(graph), []
    try:
        sorter.prepare()
    except CycleError as error:
        loop = " -> ".join(str(node) for node in error.args[1])
        remedy = "an FMU in it has to delay its output, as one with a control_period or a state does"
        if initial:
            remedy = "an FMU in it needs an output whose start value depends on no input, by its InitialUnknowns"
        raise FmuError(f"'{path}' has an algebraic loop{' at its start' * initial}: {loop}; {remedy}") from error
    while sorter.is_active():
        batches.append([*sorter.get_ready()])
        sorter.done(*batches[-1])
    return batches


def _dependencies(fmu: Fmu, initial: bool) -> dict[int, list[int]]:
    """Return the value references on which an FMU's unknowns depend directly, if its ModelStructure states them."""
    unknowns = [*fmu.description.outputs, *(fmu.description.initialUnknowns if initial else ())]
    return {
        unknown.variable.valueReference: [*dict.fromkeys(variable.valueReference for variable in unknown.dependencies)]
        for unknown in unknowns
        if unknown.dependencies is not None
    }
