"""An FMU: its file, checked and described, and an instance of it. All of FMPy is here."""

from __future__ import annotations

import logging
import os
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from ctypes import Array, byref, c_double, c_uint
from dataclasses import dataclass
from itertools import count, takewhile
from math import inf
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree as ET

import fmpy
import numpy as np
from fmpy import fmi2
from fmpy.fmi1 import FMICallException
from fmpy.logging import addLoggerProxy
from fmpy.model_description import ModelDescription, ScalarVariable
from numpy.typing import NDArray

from .errors import ZIP_ERRORS, FmuError, SimulationError
from .export.python_wrapper import check_python_wrapper
from .files import UnsafeArchiveError, check_archive, is_plain_xml, read_member, temporary_folder

logger = logging.getLogger(__name__)
LEVELS = {0: logging.INFO, 1: logging.WARNING, 2: logging.ERROR, 3: logging.ERROR}
"""Levels of FMI status ok, warning, discard and error; fatal is CRITICAL."""

WARNING = fmi2.fmi2Warning
Values = Array[c_double]
MAX_DESCRIPTION = 8 * 1024**2  # some 50,000 variables
MAX_RESOURCE = 256 * 1024**2


@dataclass(frozen=True, repr=False)
class Fmu:
    """An FMI 2.0 co-simulation FMU with outputs q[i] and v[i].

    Attributes:
        path: the file.
        description: FMPy's model description.
        variables: by name, in the order of the description.
        platforms: FMI names of the platforms that it has binaries for, e.g. "linux64".
        robot: name of the robot; "" where the FMU does not say.
        joints: joint names, one for each q[i]; "joint1", … where the FMU does not say.
        frame, root, axes: the task frame, the frame its position is expressed in and the task
            axes; "" where the FMU does not say.
        control: name of its control law, e.g. "task"; likewise.
    """

    path: Path
    description: ModelDescription
    variables: dict[str, ScalarVariable]
    platforms: tuple[str, ...]
    robot: str
    joints: tuple[str, ...]
    frame: str
    root: str
    axes: str
    control: str

    def __repr__(self) -> str:
        return f"<Fmu '{self.path}': {self.name}, joints {', '.join(self.joints)}>"

    @property
    def name(self) -> str:
        """The model's name."""
        return str(self.description.modelName)

    @property
    def guid(self) -> str:
        """The FMU's GUID; for FMUs of this package the digest of all that matters."""
        return str(self.description.guid)

    @property
    def library(self) -> str:
        """Name of its binary on this platform."""
        identifier = self.description.coSimulation.modelIdentifier
        return f"{identifier}{fmpy.sharedLibraryExtension}"

    @property
    def urdf(self) -> str | None:
        """The text of resources/robot.urdf, None where there is none."""
        content = read_resource(self, "robot.urdf")
        try:
            return None if content is None else content.decode("utf-8")
        except UnicodeDecodeError as error:
            raise FmuError(f"'{self.path}': resources/robot.urdf is not UTF-8 text") from error

    def vector(self, group: str) -> list[str]:
        """Names of the elements of a vector in order, or of the scalar; empty if there is none."""
        if group in self.variables:
            return [group]
        names = (f"{group}[{i}]" for i in count(1))
        return list(takewhile(self.variables.__contains__, names))

    def groups(self, causality: str) -> dict[str, list[str]]:
        """Vectors and scalars of one causality by group name."""
        groups: dict[str, list[str]] = {}
        for name, variable in self.variables.items():
            if variable.causality == causality:
                groups.setdefault(name.partition("[")[0], []).append(name)
        return groups


def load_fmu(path: str | Path) -> Fmu:
    """Read and check an FMU's description; nothing of it is run or unzipped.

    Raises:
        FmuError: the file is missing, no zip, not FMI 2.0 co-simulation, unsafe to unzip, or
            has no outputs q[i] and v[i].
    """
    path = Path(path)
    xml, members = _read(path)
    try:
        with path.open("rb") as file:  # by its name FMPy would take an XML file too
            description = fmpy.read_model_description(file, validate=True)
        root = ET.fromstring(xml)
    except Exception as error:  # FMPy raises bare exceptions of several libraries
        raise FmuError(f"'{path}': modelDescription.xml is not valid: {error!s:.300}") from error
    if description.fmiVersion != "2.0" or description.coSimulation is None:
        kind = "co-simulation" if description.coSimulation is not None else "model exchange"
        form = f"FMI {description.fmiVersion} {kind}"
        raise FmuError(f"'{path}' is {form}; FMI 2.0 co-simulation is needed")
    fmu = Fmu(
        path=path,
        description=description,
        variables={variable.name: variable for variable in description.modelVariables},
        platforms=_platforms(members, description.coSimulation.modelIdentifier),
        **_vendor_annotation(root, description),
    )
    n = len(fmu.vector("q"))
    logged = [fmu.variables[name] for name in fmu.vector("q") + fmu.vector("v")]
    kinds = {(variable.causality, variable.type) for variable in logged}
    if len(logged) != 2 * n or kinds != {("output", "Real")}:
        raise FmuError(f"'{path}' has no outputs q[1], q[2], … and v[1], v[2], … to log")
    if len(fmu.joints) != n:
        raise FmuError(f"'{path}' names {len(fmu.joints)} joints but has {n} outputs q[i]")
    return fmu


class Instance:
    """One instance of an FMU, from instantiation on, in the order of calls that FMI allows.

    FMU log messages go to the logger "twodof.fmu". A call that the FMU does not accept raises
    SimulationError with the FMU's own words. What is called at each step goes past FMPy's checks.
    """

    def __init__(self, fmu: Fmu, folder: Path) -> None:
        self._fmu = fmu
        self._said = ""
        self._fatal = False
        self._callbacks = fmi2.fmi2CallbackFunctions(
            logger=fmi2.fmi2CallbackLoggerTYPE(self._log),
            allocateMemory=fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc),
            freeMemory=fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free),
        )
        addLoggerProxy(byref(self._callbacks))
        identifier = fmu.description.coSimulation.modelIdentifier
        working_folder = os.getcwd()
        try:
            self._slave = fmi2.FMU2Slave(
                guid=fmu.guid,
                unzipDirectory=str(folder),
                modelIdentifier=identifier,
                instanceName=identifier,
            )
            self._slave.instantiate(callbacks=self._callbacks, loggingOn=True)
            self._do_step, self._component = self._slave.dll.fmi2DoStep, self._slave.component
        except Exception as error:  # FMPy raises bare exceptions
            raise FmuError(f"'{fmu.path}' cannot be loaded: {self._said or error}") from error
        finally:
            os.chdir(working_folder)  # FMPy leaves it where a library cannot be loaded

    def initialise(
        self, start_time: float, stop_time: float, values: Mapping[str, float | bool]
    ) -> None:
        """Set start values and go through initialisation mode; the stop time may be infinite."""
        self.set(values)
        stop = stop_time if stop_time < inf else None
        self._accept(self._slave.setupExperiment, startTime=start_time, stopTime=stop)
        self._accept(self._slave.enterInitializationMode)
        self._accept(self._slave.exitInitializationMode)

    def reset(self) -> None:
        """Back to where it was when it was instantiated."""
        self._accept(self._slave.reset)

    def set(self, values: Mapping[str, float | bool]) -> None:
        """Set variables by name."""
        variables = [self._fmu.variables[name] for name in values]
        for kind, setter in (("Real", self._slave.setReal), ("Boolean", self._slave.setBoolean)):
            chosen = [variable for variable in variables if variable.type == kind]
            if chosen:
                references = [variable.valueReference for variable in chosen]
                self._accept(setter, references, [values[variable.name] for variable in chosen])

    def step(self, t: float, h: float) -> None:
        """One communication step from t to t + h."""
        self._said = ""
        if (status := self._do_step(self._component, t, h, 1)) > WARNING:
            self._refuse(status)

    def reader(self, names: Sequence[str]) -> Callable[[], Values]:
        """A function that reads these Real variables, each time into the same place."""
        n = len(names)
        references = (c_uint * n)(*(self._fmu.variables[name].valueReference for name in names))
        values = (c_double * n)()
        get, component = self._slave.dll.fmi2GetReal, self._component

        def read() -> Values:
            self._said = ""
            if (status := get(component, references, n, values)) > WARNING:
                self._refuse(status)
            return values

        return read

    def derivatives(self, unknown: Sequence[str], known: Sequence[str]) -> NDArray[np.float64]:
        """∂unknown/∂known at the instance's state, a row each of the unknown."""
        references = [[self._fmu.variables[n].valueReference for n in u] for u in (unknown, known)]
        columns = [
            self._slave.getDirectionalDerivative(references[0], [k], [1.0]) for k in references[1]
        ]
        matrix: NDArray[np.float64] = np.array(columns).reshape(len(known), len(unknown)).T
        return matrix

    def free(self) -> None:
        """End the instance; after a fatal failure the standard allows no further call."""
        if self._fatal:
            return
        with suppress(FMICallException):  # it may have failed already, and is freed all the same
            self._slave.terminate()
        self._slave.freeInstance()

    def _call(self, function: Callable[..., object], *arguments: object, **named: object) -> None:
        self._said = ""
        try:
            function(*arguments, **named)
        except FMICallException as error:
            self._refuse(error.status)

    def _refuse(self, status: int) -> NoReturn:
        """Raise what a call's status means, in the FMU's own words where it said something."""
        self._fatal = status == fmi2.fmi2Fatal
        outcome = "discarded" if status == fmi2.fmi2Discard else "failed"
        raise SimulationError(self._said or f"a call failed, status {status}", outcome=outcome)

    def _accept(self, function: Callable[..., object], *arguments: object, **named: object) -> None:
        """A call that must leave no error in the log: pythonfmu's wrapper can give no status."""
        self._call(function, *arguments, **named)
        if self._said:
            raise SimulationError(self._said)

    def _log(
        self, _environment: object, _name: bytes, status: int, _category: bytes, text: bytes
    ) -> None:
        message = text.decode("utf-8", "replace").strip()
        if status > WARNING:
            self._said = message
        logger.log(LEVELS.get(status, logging.CRITICAL), message)


@contextmanager
def instantiate(fmu: Fmu) -> Iterator[Instance]:
    """An instance of the FMU, unzipped into a temporary folder; freed at the end.

    Raises:
        FmuError: it has no binary for this platform, or it cannot be unzipped or loaded.
    """
    if fmpy.platform not in fmu.platforms:
        there = ", ".join(fmu.platforms) or "none"
        reason = f"has no binary for this platform ({fmpy.platform}), only for: {there}"
        raise FmuError(f"'{fmu.path}' {reason}")
    with temporary_folder() as folder:
        try:
            with zipfile.ZipFile(fmu.path) as archive:
                archive.extractall(folder)
        except ZIP_ERRORS as error:
            raise FmuError(f"cannot unzip '{fmu.path}': {error}") from error
        library = folder / "binaries" / fmpy.platform / fmu.library
        check_python_wrapper(fmu.path, library, folder)
        instance = Instance(fmu, folder)
        try:
            yield instance
        finally:
            instance.free()


def read_resource(fmu: Fmu, name: str) -> bytes | None:
    """A file of the FMU's resources/ folder, None where it has no such file."""
    try:
        with zipfile.ZipFile(fmu.path) as archive:
            return read_member(archive, f"resources/{name}", MAX_RESOURCE)
    except KeyError:
        return None
    except ZIP_ERRORS as error:
        raise FmuError(f"cannot read resources/{name} of '{fmu.path}': {error}") from error


def _read(path: Path) -> tuple[bytes, list[str]]:
    """modelDescription.xml and the members' names, after the checks that make unzipping safe."""
    try:
        check_archive(path)
        with zipfile.ZipFile(path) as archive:
            xml = read_member(archive, "modelDescription.xml", MAX_DESCRIPTION)
    except FileNotFoundError as error:
        raise FmuError(f"there is no FMU '{path}'; build one with 'twodof build'") from error
    except OSError as error:
        raise FmuError(f"cannot read '{path}': {error.strerror}") from error
    except KeyError as error:
        raise FmuError(f"'{path}' is no FMU: it has no modelDescription.xml") from error
    except UnsafeArchiveError as error:
        raise FmuError(f"'{path}': {error}") from error
    except ZIP_ERRORS as error:
        raise FmuError(f"'{path}' is no FMU: it is not a sound zip archive ({error})") from error
    if not is_plain_xml(xml):
        raise FmuError(f"'{path}': modelDescription.xml declares entities or is not UTF-8")
    return xml, archive.namelist()


def _platforms(members: list[str], identifier: str) -> tuple[str, ...]:
    suffixes = {"linux": ".so", "win": ".dll", "darwin": ".dylib"}
    platforms = set()
    for folder, platform, name in (m.split("/") for m in members if m.count("/") == 2):
        suffix = suffixes.get(platform.rstrip("0123456789"), "")
        if folder == "binaries" and name == identifier + suffix:
            platforms.add(platform)
    return tuple(sorted(platforms))


def _vendor_annotation(root: ET.Element, description: ModelDescription) -> dict[str, Any]:
    robot = root.find("VendorAnnotations/Tool[@name='twodof']/Robot")
    if robot is None:
        n = sum(re.fullmatch(r"q\[\d+\]", v.name) is not None for v in description.modelVariables)
        joints = tuple(f"joint{i + 1}" for i in range(n))
        nothing = dict.fromkeys(("robot", "frame", "root", "axes", "control"), "")
        return {**nothing, "joints": joints}
    return {
        "robot": robot.get("name", ""),
        "joints": tuple(joint.get("name", "") for joint in robot.iter("Joint")),
        **{key: robot.get(key, "") for key in ("frame", "root", "axes", "control")},
    }
