"""Run an instance of an FMU; all uses of FMPy that run code are here."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from ctypes import Array, addressof, byref, c_bool, c_char, c_double, c_int, c_size_t, c_uint, c_void_p, cast
from itertools import accumulate, chain
from math import inf
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import fmpy
import numpy as np
from fmpy import fmi2, fmi3
from fmpy.fmi1 import FMICallException
from numpy.typing import NDArray

from ..errors import FmuError, SimulationError
from ..export.typed_values import IN_FMI_2, IN_FMI_3
from .description import Fmu
from .loading import NAMES, STATUSES, Prepared, loading, unique

logger = logging.getLogger("twodof.fmu")
LEVELS = {0: logging.INFO, 1: logging.WARNING, 2: logging.ERROR, 3: logging.ERROR}
"""Log levels of the FMI statuses ok, warning, discard and error; fatal is CRITICAL."""
WARNING = fmi2.fmi2Warning
Values = Array[c_double]
Part = tuple[str, "Instance", Prepared | None]
"""A component, "" for an FMU alone, its instance, and its call; None if C cannot make it."""


class Instance:
    """An instance of an FMU; its methods must be called in the order that FMI allows.

    FMU log messages go to the logger "twodof.fmu". A call that the FMU refuses raises SimulationError with the FMU's
    message.

    Calls of each step bypass FMPy: they call the library's functions without declared types. Their arguments were
    converted once, because the conversion would take half of a call. Vectors of FMI 3.0 are set and read as a whole. A
    variable of FMI 2.0 is a vector of one element.

    Attributes:
        slave: FMPy's object, for calls that a run does not use.
        final: doStep's argument noSetFMUStatePriorToCurrentPoint; false if a state before a step will be restored.
    """

    def __init__(self, fmu: Fmu, folder: Path, name: str = "") -> None:
        self.fmu = fmu
        self._said, self._heard = "", c_char()
        self._fatal = self._running = False
        self._ends = c_bool()  # doStep's argument terminateSimulation in FMI 3.0
        self._t, self._h = c_double(), c_double()
        starts: dict[tuple[str, int], list[Any]] = {}
        for v in fmu.variables.values():
            vector = starts.setdefault((v.type, v.reference), [])
            if v.element == len(vector):  # an alias has the reference of another vector
                vector.append(v.initial_value)
        self._starts = starts  # start and latest values by type and value reference
        self._vectors = {key: [*vector] for key, vector in starts.items()}
        identifier = fmu.description.coSimulation.modelIdentifier
        self._name = unique(name or identifier)
        try:
            self.slave = self._instantiate(
                guid=fmu.guid, unzipDirectory=str(folder), modelIdentifier=identifier, instanceName=self._name
            )
            self._component = c_void_p(self.slave.component)
            self._step_arguments = self._component, self._t, self._h, *self._rest
        except Exception as error:  # FMPy raises bare exceptions
            NAMES.discard(self._name)
            raise FmuError(f"'{fmu.path}' cannot be loaded: {self._said or error}") from error

    def _instantiate(self, **what: str) -> fmi2.FMU2Slave:
        from fmpy.logging import addLoggerProxy  # missing on aarch64-linux, for which FMI 2.0 has no name

        with loading():
            slave = fmi2.FMU2Slave(**what)
        HEARD[id(self)] = self
        self._callbacks = fmi2.fmi2CallbackFunctions(
            logger=LOGGER,
            componentEnvironment=id(self),
            allocateMemory=fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc),
            freeMemory=fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free),
        )
        addLoggerProxy(byref(self._callbacks))
        slave.instantiate(callbacks=self._callbacks, loggingOn=True)
        self._setters = {kind: getattr(slave, f"set{named}") for kind, named in IN_FMI_2.items()}
        self._getters = {kind: getattr(slave, f"get{named}") for kind, named in IN_FMI_2.items()}
        self._do_step, self._get = slave.dll["fmi2DoStep"], slave.dll["fmi2GetReal"]
        self._put = slave.dll["fmi2SetReal"]
        self.final: c_int | c_bool = c_int(1)
        self._rest: tuple[object, ...] = (self.final,)
        return slave

    def initialise(self, start_time: float, stop_time: float, values: Mapping[str, float | bool | str]) -> None:
        """Set start values, and enter and exit initialisation mode; the stop time may be infinite."""
        self.begin(start_time, stop_time, values)
        self.start()

    def begin(self, start_time: float, stop_time: float, values: Mapping[str, float | bool | str]) -> None:
        """Set start values and enter initialisation mode."""
        self.set(values)
        self._set_up(startTime=start_time, stopTime=stop_time if stop_time < inf else None)

    def start(self) -> None:
        """Exit initialisation mode."""
        self._accept(self.slave.exitInitializationMode)
        self._running = True

    def _set_up(self, **times: float | None) -> None:
        self._accept(self.slave.setupExperiment, **times)
        self._accept(self.slave.enterInitializationMode)

    def reset(self) -> None:
        """Reset to the state after instantiation."""
        self._accept(self.slave.reset)
        self._running = False
        self._vectors = {key: [*vector] for key, vector in self._starts.items()}

    def set(self, values: Mapping[str, float | bool | str]) -> None:
        """Set variables by name; other elements of a vector keep their last values."""
        changed: dict[tuple[str, int], list[object]] = {}
        for name, value in values.items():
            variable = self.fmu.variables[name]
            key = variable.type, variable.reference
            if key not in changed:
                changed[key] = list(self._vectors[key])
            changed[key][variable.element] = value
        for kind, setter in self._setters.items():
            own = {reference: vector for (of, reference), vector in changed.items() if of == kind}
            if own:
                self._accept(setter, list(own), list(chain(*own.values())))
        self._vectors.update(changed)

    def step(self, t: float, h: float) -> None:
        """Do one communication step from t to t + h."""
        self._said = ""
        self._t.value, self._h.value = t, h
        status = self._do_step(*self._step_arguments)
        if status > WARNING or self._ends:
            raise self.failure(status)

    def _columns(self, names: Sequence[str]) -> tuple[list[int], list[int], int]:
        """Return the value references for Real variables, the variables' indices among all values, and their number."""
        wanted = [self.fmu.variables[name] for name in names]
        vectors = list(dict.fromkeys((variable.type, variable.reference) for variable in wanted))
        *firsts, size = accumulate((len(self._starts[vector]) for vector in vectors), initial=0)
        first = dict(zip(vectors, firsts))
        columns = [first[variable.type, variable.reference] + variable.element for variable in wanted]
        return [reference for _, reference in vectors], columns, size

    def _of_size(self, size: int) -> tuple[int, ...]:
        """Return the number of values as an argument, if this version of FMI has this argument."""
        return ()

    def _access(
        self, function: Callable[..., int], names: Sequence[str], values: Values | None
    ) -> tuple[Callable[[], Values], Values, Values, list[int], list[int]]:
        """Return a function that reads or sets the vectors of Real variables, and returns their buffer.

        Further results are the variables' buffer, the vectors' buffer, the vectors' value references, and the
        variables' indices. The two buffers are one if the variables are whole vectors.
        """
        distinct, columns, size = self._columns(names)
        values = (c_double * len(columns))() if values is None else values
        whole = values if columns == [*range(size)] else (c_double * size)()
        references = (c_uint * len(distinct))(*distinct)
        given = byref(references), c_size_t(len(distinct)), byref(whole), *map(c_size_t, self._of_size(size))
        arguments = self._component, *given

        def access() -> Values:
            self._said = ""
            if (status := function(*arguments)) > WARNING:
                raise self.failure(status)
            return whole

        return access, values, whole, distinct, columns

    def reader(self, names: Sequence[str], into: Values | None = None) -> Callable[[], Values]:
        """Return a function that reads Real variables, always into the same buffer, which may be given."""
        read, values, whole, _, columns = self._access(self._get, names, into)

        def read_elements() -> Values:
            read()
            values[:] = [whole[column] for column in columns]
            return values

        return read if whole is values else read_elements

    def writer(self, names: Sequence[str], values: Values) -> Callable[[], object]:
        """Return a function that sets Real variables to the values in a buffer.

        Other elements of their vectors keep their last values.
        """
        write, _, whole, distinct, _ = self._access(self._put, names, values)
        scalars = [self.fmu.variables[name] for name in names]

        def write_elements() -> None:
            for scalar, value in zip(scalars, values):
                self._vectors["Real", scalar.reference][scalar.element] = value
            whole[:] = [*chain(*(self._vectors["Real", reference] for reference in distinct))]
            write()

        return write if whole is values else write_elements

    def prepared(self, names: Sequence[str], address: int, stride: int = 0, *, put: bool = False) -> Prepared | None:
        """Return a call in C that reads or sets Real variables at an address; None if they are parts of vectors.

        The address of the values grows by ``stride`` numbers with each step.
        """
        distinct, columns, size = self._columns(names)
        if columns != [*range(size)]:
            return None
        references = (c_uint * len(distinct))(*distinct)
        given = references, len(distinct), address, size, stride
        return self._in_c(self.fmu.version, self._put if put else self._get, *given)

    def prepared_step(self) -> Prepared:
        """Return the call of doStep in C."""
        return self._in_c(-self.fmu.version, self._do_step, (c_uint * 1)(), 0, 0, 0, 0)

    def _in_c(self, kind: int, function: Any, *given: Any) -> Prepared:
        at, heard = cast(function, c_void_p).value, addressof(self._heard)
        return Prepared(kind, at, self._component, *given, heard)

    def parts(self, names: Sequence[str], address: int) -> list[Part]:
        """Return the calls of one step that C can make, the last of which read Real variables into rows."""
        return [("", self, self.prepared_step()), ("", self, self.prepared(names, address, len(names)))]

    def value(self, name: str, *, raw: bool = False) -> Any:
        """Return the value of a variable; with ``raw``, the number in C of a Boolean of FMI 2.0."""
        variable = self.fmu.variables[name]
        size = len(self._starts[variable.type, variable.reference])
        try:
            read = self._getters[variable.type]([variable.reference], *self._of_size(size))[variable.element]
        except FMICallException as error:
            raise self.failure(error.status) from error
        read = read.decode("utf-8", "replace") if isinstance(read, bytes) else read
        return bool(read) if variable.type == "Boolean" and not raw else read

    def derivatives(self, unknown: Sequence[str], known: Sequence[str]) -> NDArray[np.float64]:
        """Return ∂unknown/∂known at the instance's state, one row for each unknown."""
        matrix = np.empty((len(unknown), len(known)))
        for k, name in enumerate(known):
            matrix[:, k] = self.directional(unknown, {name: 1.0})
        return matrix

    def directional(self, unknown: Sequence[str], seed: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the derivatives of unknowns along a change of knowns."""
        distinct, rows, size = self._columns(unknown)
        references, columns, width = self._columns([*seed])
        changes = np.zeros(width)
        changes[columns] = [*seed.values()]
        try:
            found = self.slave.getDirectionalDerivative(distinct, references, changes, *self._of_size(size))
        except FMICallException as error:
            raise self.failure(error.status) from error
        return np.array(found)[rows]

    def free(self) -> None:
        """End the instance; after a fatal failure the standard allows no further call."""
        if self._fatal:
            return
        with suppress(FMICallException):  # after a failure, terminate may be refused
            if self._running:
                self.slave.terminate()
        self.slave.freeInstance()
        NAMES.discard(self._name)

    def failure(self, status: int) -> SimulationError:
        """Return the error of a call's status, with the FMU's own message, if any."""
        self._fatal = status == fmi2.fmi2Fatal
        outcome = "discarded" if status == fmi2.fmi2Discard else "failed"
        reason = f"a call failed, status {STATUSES.get(status, status)}" if status > WARNING else "the FMU ends the run"
        return SimulationError(self._said or reason, outcome=outcome)

    def failure_in_c(self, status: int) -> SimulationError:
        """Return the error of a status of a prepared call, without messages of earlier calls."""
        self._said = self._said if self._heard else ""
        return self.failure(status)

    def another(self) -> Instance:
        """Return a second instance, of the same loaded library."""
        return type(self)(self.fmu, Path(self.slave.unzipDirectory))

    def refuses(self, call: Callable[[], object]) -> bool:
        """Return whether the FMU returns an error status from a call, or logs an error."""
        self._said = ""
        try:
            call()
        except FMICallException as error:
            self._fatal = error.status == fmi2.fmi2Fatal
            return True
        except SimulationError:
            return True
        return bool(self._said)

    def _accept(self, function: Callable[..., object], *arguments: object, **named: object) -> None:
        """Make a call and raise if it logs an error, because pythonfmu's wrapper cannot return an error status."""
        self._said = ""
        try:
            function(*arguments, **named)
        except FMICallException as error:
            raise self.failure(error.status) from error
        if self._said:
            raise SimulationError(self._said)

    def log(self, status: int, _category: bytes, text: bytes) -> None:
        """Pass a message of the FMU to the logger, and store that of an error for the exception to come."""
        message = text.decode("utf-8", "replace").strip()
        if status > WARNING:
            self._said, self._heard.value = message, b"\1"
        logger.log(LEVELS.get(status, logging.CRITICAL), message)


HEARD: WeakValueDictionary[int, Instance] = WeakValueDictionary()  # instances of FMI 2.0 by their environment


def _pass_on(environment: int, _name: bytes, status: int, category: bytes, text: bytes) -> None:
    """Pass a message to its instance; FMPy's proxy has one logger for all instances of the process."""
    if (instance := HEARD.get(environment)) is not None:
        instance.log(status, category, text)


LOGGER = fmi2.fmi2CallbackLoggerTYPE(_pass_on)


class Instance3(Instance):
    """An instance of FMI 3.0."""

    def _instantiate(self, **what: str) -> fmi3.FMU3Slave:
        with loading():
            slave = fmi3.FMU3Slave(**what)
        slave.instantiate(logMessage=lambda _environment, *message: self.log(*message), loggingOn=True)
        results = byref(c_bool()), byref(self._ends), byref(c_bool()), byref(c_double())
        self._setters = {kind: getattr(slave, f"set{named}") for kind, named in IN_FMI_3.items()}
        self._getters = {kind: getattr(slave, f"get{named}") for kind, named in IN_FMI_3.items()}
        self._do_step, self._get, self._put = (slave.dll[f"fmi3{n}"] for n in ("DoStep", "GetFloat64", "SetFloat64"))
        self.final = c_bool(True)
        self._rest = (self.final, *results)
        return slave

    def _set_up(self, **times: float | None) -> None:
        self._accept(self.slave.enterInitializationMode, **times)

    def _of_size(self, size: int) -> tuple[int, ...]:
        return (size,)
