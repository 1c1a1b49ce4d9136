"""Run the FMUs of a system together, with the interface of an instance of one FMU.

    at each communication point t_k, in the order of direct feedthrough:
        outputs y(t_k) of each FMU; inputs u(t_k) = gain · y(t_k) + offset of the FMUs that they are connected to
    at the first one, in initialisation mode, in the order of InitialUnknowns, and again until no output changes
    then each FMU steps from t_k to t_(k+1) with its inputs held

Therefore direct feedthrough of an FMU adds no delay, and the order of the FMUs has no effect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from ctypes import addressof, c_double, sizeof
from functools import partial
from itertools import groupby

import fmpy

from ..bounds import MAX_COMPONENTS
from ..errors import FmuError, SimulationError
from ..export.python_wrapper import check_python_wrapper
from ..files import temporary_folder
from .description import Fmu, opened
from .instance import Instance, Instance3, Part, Values
from .loading import Prepared
from .ssp_file import IDENTITY
from .system import System
from .wiring import Link, Node

Move = tuple[str, Callable[[], object], Prepared | None]
"""A component, a function that reads its outputs or sets its inputs, and the same call in C if it is one call."""
READ = ("documentation/", "sources/")
"""Folders of an FMU that its library does not need."""


class SystemInstance:
    """Instances of a system's FMUs, which step together; the methods are those of ``Instance``."""

    def __init__(self, system: System, instances: Mapping[str, Instance]) -> None:
        self._system, self._instances = system, instances
        self._outer: dict[Node, list[Link]] = {}
        for link in system.links:
            if link.source.element not in instances:
                self._outer.setdefault(link.source, []).append(link)
        self._discrete: dict[Node, float | bool] = {}
        self._moves, _ = self._in_order(system.batches)
        self._initial, self._signals = self._in_order(system.initial)
        self._steps = [(name, instance.step, instance.prepared_step()) for name, instance in instances.items()]
        self._due = True

    def initialise(self, start_time: float, stop_time: float, values: Mapping[str, float | bool | str]) -> None:
        """Set start values, and enter and exit initialisation mode, for all FMUs together."""
        own = self._by_component(values)
        for name, instance in self._instances.items():
            bound = {node.connector: v for node, v in self._system.bound.items() if node.element == name}
            with _named(name):
                instance.begin(start_time, stop_time, {**bound, **own.get(name, {})})
        self._settle()
        for name, instance in self._instances.items():
            with _named(name):
                instance.start()
        self._propagate()

    def reset(self) -> None:
        """Reset to the state after instantiation."""
        for name, instance in self._instances.items():
            with _named(name):
                instance.reset()

    def set(self, values: Mapping[str, float | bool | str]) -> None:
        """Set variables and connectors of the system by name."""
        for name, own in self._by_component(values).items():
            with _named(name):
                self._instances[name].set(own)
        self._due = True

    def _by_component(self, values: Mapping[str, float | bool | str]) -> dict[str, dict[str, float | bool | str]]:
        """Return values by component and its variable's name; a connector's value goes to the connected variables."""
        own: dict[str, dict[str, float | bool | str]] = {}
        for name, value in values.items():
            node = self._system.nodes[name]
            ends = [(link.target, link.map) for link in self._outer.get(node, [])] or [(node, IDENTITY)]
            for target, affine in ends:
                own.setdefault(target.element, {})[target.connector] = (
                    value if isinstance(value, str) else affine.of(value)
                )
        return own

    def step(self, t: float, h: float) -> None:
        """Do one communication step of all FMUs from t to t + h."""
        if self._due:
            self._propagate()
        self._each(self._steps, t, h)
        self._propagate()

    def reader(self, names: Sequence[str]) -> Callable[[], Values]:
        """Return a function that reads Real variables, always into the same buffer."""
        values = (c_double * len(names))()
        reads = [
            (element, self._instances[element].reader(own, _part(values, first, len(own))), None)
            for element, first, own in self._columns(names)
        ]

        def read_all() -> Values:
            self._each(reads)
            return values

        return read_all if len(reads) > 1 else reads[0][1]

    def parts(self, names: Sequence[str], address: int) -> list[Part]:
        """Return the calls of one step that C can make, the last of which read Real variables into rows."""
        calls = [(element, call) for element, _, call in [*self._steps, *self._moves]]
        for element, first, own in self._columns(names):
            target = address + first * sizeof(c_double)
            calls.append((element, self._instances[element].prepared(own, target, len(names))))
        return [(element, self._instances[element], call) for element, call in calls]

    def _columns(self, names: Sequence[str]) -> Iterator[tuple[str, int, list[str]]]:
        """Yield components, the index of the first of their variables, and the variables' names there."""
        nodes, first = [self._system.nodes[name] for name in names], 0
        for element, group in groupby(nodes, key=lambda node: node.element):
            own = [node.connector for node in group]
            yield element, first, own
            first += len(own)

    def _propagate(self) -> None:
        """Pass the outputs of this instant to the inputs."""
        self._due = False
        self._each(self._moves)

    def _settle(self) -> None:
        """Pass outputs to inputs in initialisation mode until none changes, because not all dependencies are stated."""
        self._each(self._initial)
        for _ in range(MAX_COMPONENTS):
            before = {**self._signals(), **self._discrete}
            self._each(self._initial)
            after = {**self._signals(), **self._discrete}
            changed = [node for node, value in after.items() if value != before[node] and value == value]
            if not changed:
                return
        why = "it is in an algebraic loop, or has another value at each read; `twodof check` tries its FMU"
        raise SimulationError(f"'{changed[0]}' changes with each evaluation in initialisation mode: {why}")

    def _each(self, calls: Sequence[tuple[str, Callable[..., object], Prepared | None]], *arguments: float) -> None:
        """Run functions in order; an error names the component."""
        name = ""
        try:
            for name, call, _ in calls:  # noqa: B007
                call(*arguments)
        except SimulationError as error:
            raise SimulationError(f"'{name}': {error}", outcome=error.outcome) from error

    def _in_order(self, batches: Sequence[Sequence[Node]]) -> tuple[list[Move], Callable[[], dict[Node, float]]]:
        """Return functions that pass outputs to inputs in an order, and one that returns the latest Real outputs."""
        signals, columns = (c_double * max(1, sum(map(len, batches))))(), dict[Node, int]()
        incoming = {link.target: link for link in self._system.links}
        moves = [move for batch in batches for move in self._moves_of(batch, incoming, signals, columns)]
        return moves, lambda: dict(zip(columns, signals))

    def _moves_of(
        self, batch: Sequence[Node], incoming: Mapping[Node, Link], signals: Values, columns: dict[Node, int]
    ) -> Iterator[Move]:
        """Yield components and functions that read a batch's outputs, or set inputs from earlier outputs."""
        for element, instance in self._instances.items():
            own = [node for node in batch if node.element == element]
            variables = self._system.components[element].variables
            reals = [node for node in own if variables[node.connector].type == "Real"]
            sinks = [incoming[node] for node in reals if node in incoming]
            if sources := [node for node in reals if node not in incoming]:
                first = len(columns)
                columns |= {node: first + i for i, node in enumerate(sources)}
                part, names = _part(signals, first, len(sources)), [node.connector for node in sources]
                yield element, instance.reader(names, part), instance.prepared(names, addressof(part))
            if sinks:
                rows = sorted((columns[link.source], link) for link in sinks)
                yield element, *_writer(instance, rows, signals)
            for node in (node for node in own if node not in reals):
                move = self._set_one if node in incoming else self._read_one
                source = incoming[node].source if node in incoming else node
                yield element, partial(move, instance, node, source), None

    def _read_one(self, instance: Instance, node: Node, _node: Node) -> None:
        self._discrete[node] = instance.value(node.connector)

    def _set_one(self, instance: Instance, node: Node, source: Node) -> None:
        instance.set({node.connector: self._discrete[source]})


def _writer(
    instance: Instance, rows: Sequence[tuple[int, Link]], signals: Values
) -> tuple[Callable[[], object], Prepared | None]:
    """Return a function that sets inputs from columns of signals, and None or the same call in C.

    The call in C exists for consecutive columns without conversions, which are not copied.
    """
    names, first = [link.target.connector for _, link in rows], rows[0][0]
    equal = all(link.map == IDENTITY for _, link in rows)
    if equal and [column for column, _ in rows] == [*range(first, first + len(rows))]:
        part = _part(signals, first, len(rows))
        return instance.writer(names, part), instance.prepared(names, addressof(part), put=True)
    values = (c_double * len(rows))()
    write, maps = instance.writer(names, values), [(link.map, column) for column, link in rows]

    def move() -> None:
        values[:] = [affine.of(signals[column]) for affine, column in maps]
        write()

    return move, None


def _part(values: Values, first: int, size: int) -> Values:
    """Return a part of a buffer, with the same memory."""
    return (c_double * size).from_buffer(values, first * sizeof(c_double))


@contextmanager
def instantiate_fmu(fmu: Fmu, name: str = "") -> Iterator[Instance]:
    """Instantiate an FMU from a temporary folder, and free the instance at the end.

    Its documentation is not unzipped, and of a native FMU of this package only the library is. The name of the instance
    is that of its model by default.
    """
    if fmu.platform not in fmu.platforms:
        here = fmu.platform or f"{fmpy.platform_tuple}, which FMI 2.0 has no name for"
        there = ", ".join(fmu.platforms) or "none"
        remedy = "" if fmu.platform else "; build one with `native` and `fmi` 3"
        raise FmuError(f"'{fmu.path}' has no binary for this platform ({here}), only for: {there}{remedy}")
    with temporary_folder() as folder:
        with opened(fmu) as archive:
            own = f"binaries/{fmu.platform}/" if fmu.is_native else ""
            names = [name for name in archive.namelist() if name.startswith(own) and not name.startswith(READ)]
            archive.extractall(folder, names)
        check_python_wrapper(fmu.path, folder / "binaries" / fmu.platform / fmu.library, folder, fmu.members)
        instance = (Instance if fmu.version == 2 else Instance3)(fmu, folder, name)
        try:
            yield instance
        finally:
            instance.free()


@contextmanager
def instantiate(fmu: Fmu) -> Iterator[Instance | SystemInstance]:
    """Instantiate an FMU, or the FMUs of a system, from temporary folders, and free the instances at the end.

    Raises:
        FmuError: an FMU has no binary for this platform, or cannot be unzipped or loaded.
    """
    if not isinstance(fmu, System):
        with instantiate_fmu(fmu) as instance:
            yield instance
        return
    with ExitStack() as stack:
        parts = {}
        for name, part in fmu.components.items():
            with _named(name):
                parts[name] = stack.enter_context(instantiate_fmu(part, name))
        yield SystemInstance(fmu, parts)


@contextmanager
def _named(component: str) -> Iterator[None]:
    """Name the component in errors."""
    try:
        yield
    except SimulationError as error:
        raise SimulationError(f"'{component}': {error}", outcome=error.outcome) from error
    except FmuError as error:
        raise FmuError(f"'{component}': {error}") from error
