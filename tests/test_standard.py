"""Details of the FMI standard: start values, phases of calls, logging, value references, sources."""

from __future__ import annotations

import ctypes
import re
import subprocess
import zipfile
from pathlib import Path
from typing import Any

import fmpy
import lxml.etree
import numpy as np
import pytest
from fmpy.fmi2 import FMU2Model, FMU2Slave
from fmpy.fmi3 import FMU3Model, FMU3Slave
from harness import Driver, Recorded, in_child_process
from native_models import model
from tools import needs

import twodof
from twodof.export.compiler import UNITS, standard_headers

OK, WARNING, DISCARD, ERROR = range(4)


class Kept(Recorded):
    """An instance before its initialisation."""

    def open(self, fmu: Path, folder: Path, logging: bool = True) -> Any:
        description = fmpy.read_model_description(str(fmu))
        self.vr = {v.name: v.valueReference for v in description.modelVariables}
        super().__init__(
            guid=description.guid,
            modelIdentifier="TwoDof",
            instanceName="arm",
            unzipDirectory=fmpy.extract(str(fmu), str(folder)),
        )
        self.messages = []
        if description.fmiVersion == "2.0":
            self.callbacks = self.functions()
            self.instantiate(callbacks=self.callbacks, loggingOn=logging)
        else:
            self.instantiate(logMessage=lambda _, s, c, t: self.keep(s, t), loggingOn=logging)
        return self

    def set_q(self, q1: float) -> Any:
        if "q" in self.vr:
            return self.status("setFloat64", [self.vr["q"]], [q1, 0.35])
        return self.status("setReal", [self.vr["q[1]"]], [q1])

    def q(self) -> list[float]:
        if "q" in self.vr:
            return list(self.getFloat64([self.vr["q"]], 2))
        return list(self.getReal([self.vr["q[1]"], self.vr["q[2]"]]))

    def begin(self) -> None:
        if "q" not in self.vr:
            self.setupExperiment(startTime=0.0)
        self.enterInitializationMode()


class FMU2Co(Kept, FMU2Slave): ...


class FMU2Exchange(Kept, FMU2Model): ...


class FMU3Co(Kept, FMU3Slave): ...


class FMU3Exchange(Kept, FMU3Model): ...


KINDS = {
    (2, "CoSimulation"): FMU2Co,
    (2, "ModelExchange"): FMU2Exchange,
    (3, "CoSimulation"): FMU3Co,
    (3, "ModelExchange"): FMU3Exchange,
}


@pytest.fixture(scope="module")
def fmus(native_path: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """The default arm by version of FMI."""
    options = twodof.FmuOptions(native=True, fmi=3)
    folder = tmp_path_factory.mktemp("standard")
    return {2: native_path, 3: twodof.build_fmu(folder / "TwoDof.fmu", options)}


def made(fmus: dict[int, Path], kind: tuple[int, str], folder: Path, **named: bool) -> Any:
    instance: Any = KINDS[kind]
    return instance.__new__(instance).open(fmus[kind[0]], folder, **named)


# --- the start of the state ---


@in_child_process
def first_row(fmu: str, kind: str, starts: dict[str, Any]) -> None:
    rows = fmpy.simulate_fmu(
        fmu,
        fmi_type=kind,
        start_values=starts,
        stop_time=0.01,
        output_interval=0.01,
        output=list(dict.fromkeys(re.sub("start", "", name) for name in starts)),
    )
    for name, value in starts.items():
        assert np.array_equal(rows[0][name], value), (name, rows[0][name])


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_fmpys_start_values_of_the_state_are_its_start(fmus: dict[int, Path], kind: tuple[int, str]) -> None:
    fmi, interface = kind
    starts = {"q[1]": 1.0, "v[2]": 0.25} if fmi == 2 else {"q": [1.0, 0.35], "v": [0.0, 0.25]}
    first_row(str(fmus[fmi]), interface, starts)


def test_the_python_flavour_takes_them_too(fmu_path: Path) -> None:
    first_row(str(fmu_path), "CoSimulation", {"q[1]": 1.0, "v[2]": 0.25})


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_in_initialization_mode_the_start_parameter_is_asked_for(
    fmus: dict[int, Path], kind: tuple[int, str], tmp_path: Path
) -> None:
    arm = made(fmus, kind, tmp_path)
    assert arm.set_q(1.0) == OK
    arm.begin()
    assert arm.q() == [1.0, 0.35] and arm.set_q(0.7) == ERROR
    ((status, text),) = arm.messages
    assert status == ERROR
    assert "q[1] follows from q_start[1] in initialization mode: set that" in text
    assert arm.q() == [1.0, 0.35]
    arm.freeInstance()


def test_the_python_flavour_asks_for_it_too(fmu_path: Path) -> None:
    arm = Driver(fmu_path)
    arm.call("setReal", [arm.vr["q[2]"]], [0.9])
    arm.call("setupExperiment", startTime=0.0)
    arm.call("enterInitializationMode")
    arm.call("setReal", [arm.vr["q[1]"]], [0.7])
    assert "q[1] follows from q_start[1] in initialization mode: set that" in arm.log[-1][1]
    assert arm.get("q") == [0.5, 0.9]
    arm.free()


# --- FMI 3.0.2: after a discarded step, before initialisation, logging ---


def test_a_discarded_step_of_fmi_3_is_done_with_other_inputs(fmus: dict[int, Path], tmp_path: Path) -> None:
    arm = made(fmus, (3, "CoSimulation"), tmp_path)
    arm.begin()
    arm.exitInitializationMode()
    kp, x_des = [arm.vr["Kp"]], [arm.vr["x_des"]]
    arm.setFloat64(kp + x_des, [1e308, 1e308, 1e300, 1.0])
    assert arm.status("doStep", 0.0, 0.01) == DISCARD
    assert list(arm.getFloat64([arm.vr["time"]], 1)) == [0.0]
    arm.setFloat64(kp + x_des, [50.0, 50.0, 0.2, 0.05])
    assert arm.doStep(0.0, 0.01) == (False, False, False, 0.01)
    expected = [*twodof.samples(fmus[3], stop_time=0.01)][-1].q
    assert tuple(arm.q()) == expected
    arm.freeInstance()


def test_variables_are_read_before_initialisation_in_fmi_3(fmus: dict[int, Path], tmp_path: Path) -> None:
    for number, kind in enumerate([(3, "CoSimulation"), (3, "ModelExchange")]):
        arm = made(fmus, kind, tmp_path / str(number))
        description = fmpy.read_model_description(str(fmus[3]))
        for variable in description.modelVariables:
            if variable.type == "Float64" and variable.start is not None:
                start = [float(number) for number in variable.start.split()]
                assert list(arm.getFloat64([variable.valueReference], len(start))) == start
        assert arm.getBoolean([arm.vr["limit_effort"]], 1) == [False]
        arm.freeInstance()


def test_logging_that_is_off_calls_nobody(fmus: dict[int, Path], tmp_path: Path) -> None:
    arm = made(fmus, (3, "CoSimulation"), tmp_path, logging=False)
    refused = "getFloat64", [0], 1
    assert arm.status(*refused) == ERROR and not arm.messages
    for on, categories, count in (
        (True, [], 1),
        (True, ["logStatusError"], 1),
        (True, ["logStatusWarning"], 0),
        (True, ["logStatusWarning", "logAll"], 1),
        (False, [], 0),
        (False, ["logStatusError"], 0),
    ):
        arm.messages.clear()
        arm.setDebugLogging(on, categories)
        assert arm.status(*refused) == ERROR and len(arm.messages) == count, categories
    arm.freeInstance()


def test_categories_of_fmi_2_choose_too_and_errors_are_no_debug_logging(fmus: dict[int, Path], tmp_path: Path) -> None:
    arm = made(fmus, (2, "CoSimulation"), tmp_path, logging=False)
    for on, categories, count in ((False, [], 1), (True, ["logStatusError"], 1), (True, ["logStatusWarning"], 0)):
        arm.messages.clear()
        arm.setDebugLogging(on, categories)
        assert arm.status("getReal", [0]) == ERROR and len(arm.messages) == count, categories
    arm.freeInstance()


# --- the phases of FMI 3.0.2, sections 2.3, 3.2 and 4.2 ---

PHASES = {"CoSimulation": "INST", "ModelExchange": "INECT"}
"""Instantiated, initialization, step, event and continuous-time mode, terminated."""
WAY = {
    "N": ["enterInitializationMode"],
    "S": ["exitInitializationMode"],
    "E": ["exitInitializationMode"],
    "C": ["updateDiscreteStates", "enterContinuousTimeMode"],
    "T": ["terminate"],
}
"""Calls by the phase to which they lead from the one before."""
ALLOWED = {
    "enterInitializationMode": "I",
    "exitInitializationMode": "N",
    "terminate": "SEC",
    "reset": "INSECT",
    "getFloat64": "INSECT",
    "setFloat64 of an input": "INSEC",
    "setFloat64 of a parameter": "IN",
    "setBoolean": "IN",
    "getDirectionalDerivative": "NSECT",
    "getAdjointDerivative": "NSECT",
    "doStep": "S",
    "enterEventMode": "C",
    "updateDiscreteStates": "E",
    "enterContinuousTimeMode": "E",
    "completedIntegratorStep": "C",
    "setTime": "EC",
    "setContinuousStates": "C",
    "getContinuousStateDerivatives": "NECT",
    "getContinuousStates": "NECT",
    "getEventIndicators": "NECT",
    "getNumberOfContinuousStates": "INECT",
    "getNumberOfEventIndicators": "INECT",
}


@pytest.mark.parametrize("kind", PHASES)
def test_every_call_of_fmi_3_in_every_phase(fmus: dict[int, Path], kind: str, tmp_path: Path) -> None:
    arm = made(fmus, (3, kind), tmp_path)
    vr = {name: [reference] for name, reference in arm.vr.items()}
    along = vr["tau"], vr["x_des"], [1.0, 0.0], 2
    arguments: dict[str, tuple[Any, ...]] = {
        "getFloat64": (vr["tau"], 2),
        "setFloat64 of an input": (vr["x_des"], [0.1, 0.2]),
        "setFloat64 of a parameter": (vr["rtol"], [0.02]),
        "setBoolean": (vr["limit_effort"], [True]),
        "getDirectionalDerivative": along,
        "getAdjointDerivative": along,
        "doStep": (0.0, 0.01),
        "setTime": (0.0,),
        "getEventIndicators": ((ctypes.c_double * 7)(), 7),
    }
    states = (ctypes.c_double * 4)(), 4
    for name in ("setContinuousStates", "getContinuousStates", "getContinuousStateDerivatives"):
        arguments[name] = states
    offered = [call for call in ALLOWED if hasattr(arm, call.split()[0])]
    for phase in PHASES[kind]:
        for call in WAY.get(phase, ()):
            getattr(arm, call)()
        state = arm.getFMUState()
        allowed = set()
        for call in offered:
            arm.messages.clear()
            status = arm.status(call.split()[0], *arguments.get(call, ()))
            assert status == OK or (status, len(arm.messages)) == (ERROR, 1), (phase, call)
            allowed |= {call} if status == OK else set()
            arm.setFMUState(state)
        assert allowed == {call for call in offered if phase in ALLOWED[call]}, phase
        arm.freeFMUState(state)
    arm.freeInstance()


# --- the description ---


@pytest.fixture(scope="module")
def texts(fmus: dict[int, Path], fmu_path: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Descriptions by the kind of FMU."""
    folder = tmp_path_factory.mktemp("texts")
    options = twodof.FmuOptions(native=True, fmi=3, arrays=False, control="pose")
    paths = {"2.0": fmus[2], "3.0": fmus[3], "python": fmu_path}
    paths["scalars"] = twodof.build_fmu(folder / "Scalars.fmu", options)
    found = {}
    for name, path in paths.items():
        with zipfile.ZipFile(path) as archive:
            found[name] = archive.read("modelDescription.xml")
    return found


def test_value_references_are_indices(texts: dict[str, bytes]) -> None:
    """OMSimulator requires it."""
    for name, text in texts.items():
        (variables,) = lxml.etree.fromstring(text).iter("ModelVariables")
        references = [int(variable.get("valueReference")) for variable in variables]
        assert references == [*range(1, len(references) + 1)], name


def test_numbers_are_those_that_every_reader_knows(texts: dict[str, bytes]) -> None:
    """std::stod of C++ throws for subnormal numbers."""
    for text in texts.values():
        for element in lxml.etree.fromstring(text).iter():
            for key in ("min", "max", "nominal", "start"):
                for word in element.get(key, "").split():
                    if word not in ("true", "false"):
                        assert float(word) == 0.0 or abs(float(word)) >= np.finfo(float).tiny


def test_documentation_has_the_version(fmus: dict[int, Path], fmu_path: Path) -> None:
    for path, version in ((fmus[2], "2.0"), (fmus[3], "3.0"), (fmu_path, "2.0")):
        with zipfile.ZipFile(path) as archive:
            page = archive.read("documentation/index.html").decode()
        assert re.findall(r"FMI (\d\.\d) ", page) == [version]


# --- the sources ---


def test_headers_of_fmi_3_are_the_importers(fmus: dict[int, Path]) -> None:
    """FMI 3.0.2, section 2.5.1.3: the FMU does not include them."""
    with zipfile.ZipFile(fmus[3]) as archive:
        assert not [name for name in archive.namelist() if re.search("fmi3[A-Z].*[.]h$", name)]


def written(folder: Path, control: str, fmi: int) -> Path:
    folder.mkdir()
    for name, content in {**standard_headers(), **model("twodof", control).sources(fmi=fmi)}.items():
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_sources_compile_without_a_warning(compiler: str, tmp_path: Path) -> None:
    command = [needs(compiler), "-std=c99", "-fsyntax-only", "-Wall", "-Wextra", "-pedantic"]
    for control in ("task", "pose", "joint", "effort"):
        for fmi in (2, 3):
            folder = written(tmp_path / f"{control}{fmi}", control, fmi)
            done = subprocess.run([*command, *UNITS], cwd=folder, capture_output=True, text=True)
            assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("flag", ["-ffast-math", "-ffinite-math-only"])
def test_sources_refuse_to_lose_their_checks(flag: str, tmp_path: Path) -> None:
    folder = written(tmp_path / "sources", "task", 2)
    command = [needs("gcc"), "-std=c99", "-fsyntax-only", flag, "fmu.c"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode != 0
    assert "compile without -ffast-math" in done.stderr


PREFIXES = {
    (): "",
    ("{}_FUNCTION_PREFIX=A_",): "A_",
    ("{}_OVERRIDE_FUNCTION_PREFIX",): "",
    ("{}_FUNCTION_PREFIX=A_", "{}_OVERRIDE_FUNCTION_PREFIX"): "",
    ("{}_FUNCTION_PREFIX=A_", "{}_OVERRIDE_FUNCTION_PREFIX", "{}_ACTUAL_FUNCTION_PREFIX=B_"): "B_",
}


@pytest.mark.parametrize("fmi", [2, 3])
def test_prefixes_are_those_of_the_standards_headers(fmi: int, tmp_path: Path) -> None:
    folder = written(tmp_path / "sources", "effort", fmi)
    for definitions, prefix in PREFIXES.items():
        options = [f"-D{definition.format(f'FMI{fmi}')}" for definition in definitions]
        names = []
        for unit in UNITS:
            command = [needs("gcc"), "-std=c99", "-c", *options, "-o", "unit.o", unit]
            subprocess.run(command, cwd=folder, check=True)
            table = ["nm", "-g", "--defined-only", "unit.o"]
            names += subprocess.check_output(table, cwd=folder, text=True).split()[2::3]
        assert f"{prefix}twodof_differentiate" in names and f"{prefix}fmi{fmi}DoStep" in names
        assert all(re.match(f"{prefix}(fmi{fmi}[A-Z]|twodof_)", name) for name in names)
