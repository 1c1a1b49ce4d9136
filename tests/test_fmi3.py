"""FMI 3.0: the same plant with other functions and with vectors; through FMPy, and from C."""

from __future__ import annotations

import ctypes
import os
import re
import struct
import subprocess
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path
from typing import Any

import fmpy
import fmpy.build
import lxml.etree
import numpy as np
import pytest
from fmpy.fmi3 import FMU3Model, FMU3Slave
from fmpy.validation import validate_fmu
from harness import Recorded, unzipped, wine
from native_models import HERE, ROBOTS, executable, model, robots_folder
from tools import needs

import twodof
from twodof import FmuOptions, build_fmu
from twodof.errors import BuildError
from twodof.export.compiler import FLAGS, TARGETS, UNITS, ZIG
from twodof.plant.variables import CONTROLS

ERROR = 3
NARROW = {"q_min": [-0.5, -1.0], "q_max": [1.5, 1.0]}
PARTS = ("q", "v", "x", "tau")
HEADERS = Path(fmpy.__file__).parent / "c-code"
"""Those of the standard."""


def options(robot, control):
    if robot == "twodof":
        return {"control": control}
    path, frame, axes = ROBOTS[robot]
    return {"control": control, "urdf": robots_folder() / path, "frame": frame, "axes": axes, "meshes": False}


@pytest.fixture(scope="session")
def pair(tmp_path_factory):
    """FMUs of a robot under a control, of FMI 2.0 and of FMI 3.0."""
    folder, pairs = tmp_path_factory.mktemp("fmi3"), {}

    def build(robot="twodof", control="task"):
        if (robot, control) not in pairs:
            pairs[robot, control] = [
                build_fmu(
                    folder / f"{robot}-{control}-{fmi}.fmu", FmuOptions(native=True, fmi=fmi, **options(robot, control))
                )
                for fmi in (2, 3)
            ]
        return pairs[robot, control]

    return build


class Calls(Recorded):
    def open(self, fmu, start=True, **named):
        self.description = fmpy.read_model_description(str(fmu))
        self.vr = {v.name: v.valueReference for v in self.description.modelVariables}
        self.size = {v.valueReference: int(np.prod(v.shape or ())) for v in self.description.modelVariables}
        super().__init__(
            guid=self.description.guid, modelIdentifier="TwoDof", instanceName="arm", unzipDirectory=unzipped(fmu)
        )
        self.messages = []
        self.instantiate(
            logMessage=lambda _, status, category, text: self.keep(status, text), **{"loggingOn": True, **named}
        )
        if start:
            self.enterInitializationMode(startTime=0.0)
            self.exitInitializationMode()
        return self

    def get(self, *names):
        references = [self.vr[name] for name in names]
        return self.getFloat64(references, sum(self.size[r] for r in references))

    def set(self, name, values):
        self.setFloat64([self.vr[name]], values)


class FMU3Calls(Calls, FMU3Slave):
    pass


class FMU3ExchangeCalls(Calls, FMU3Model):
    pass


def arm(fmu, **named):
    return FMU3Calls.__new__(FMU3Calls).open(fmu, **named)


def exchange(fmu, **named):
    return FMU3ExchangeCalls.__new__(FMU3ExchangeCalls).open(fmu, **named)


def elements(description, name):
    names = [v.name for v in description.modelVariables]
    return [n for n in names if n == name or re.fullmatch(rf"{name}\[\d+\]", n)]


def simulated(fmu, kind, starts=(), stop_time=2.0, parts=PARTS, **named):
    """Rows of all values, by either version's names."""
    description = fmpy.read_model_description(str(fmu))
    start_values: dict[str, Any] = {}
    output = [name for part in parts for name in elements(description, part)]
    for name, values in dict(starts).items():
        names = elements(description, name)
        whole = names == [name]  # an array, or a scalar
        start_values |= {name: values} if whole else dict(zip(names, np.atleast_1d(values)))
    result = fmpy.simulate_fmu(
        str(fmu),
        fmi_type=kind,
        stop_time=stop_time,
        step_size=0.01,
        output_interval=0.01,
        start_values=start_values,
        output=output,
        record_events=False,
        **named,
    )
    return np.array([np.hstack([np.ravel(row[name]) for name in output]) for row in result])


COMBINATIONS = [("twodof", "task"), ("twodof", "pose"), ("twodof", "effort"), ("panda_finger", "task")]


@pytest.mark.parametrize("robot, control", COMBINATIONS)
def test_co_simulation_equals_that_of_fmi_2_bit_for_bit(pair, robot, control):
    n = len(twodof.load_fmu(pair(robot, control)[0]).joints)
    thrown = {"v_start": [0.3] * n}  # a joint under its own control stays where it is
    two, three = (simulated(fmu, "CoSimulation", thrown) for fmu in pair(robot, control))
    assert len(two) == 201 and np.ptp(two, axis=0).max() > 0.0
    assert np.array_equal(two, three)


def test_nothing_is_wrong_with_the_description(pair):
    for robot, control in COMBINATIONS:
        assert validate_fmu(str(pair(robot, control)[1])) == []


@pytest.fixture(scope="module")
def scalars(tmp_path_factory):
    """An FMU of FMI 3.0 without arrays, under the control with most variables."""
    chosen = FmuOptions(native=True, fmi=3, arrays=False, control="pose")
    return build_fmu(tmp_path_factory.mktemp("scalars") / "Arm.fmu", chosen)


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_scalars_are_the_elements_of_the_arrays_bit_for_bit(pair, scalars, kind):
    starts = {"q_max": [0.55, 1.0], "v_start": [4.0, -6.0]}  # into a stop
    arrays, single = (simulated(fmu, kind, starts) for fmu in (pair(control="pose")[1], scalars))
    assert np.array_equal(arrays, single)
    assert 0.54 < single[:, 0].max() <= 0.55  # 0.562 without the stop
    assert [len(sample.q) for sample in twodof.samples(scalars, stop_time=0.01)] == [2, 2]


def test_scalars_have_no_dimension_and_nothing_is_wrong_with_them(pair, scalars):
    assert validate_fmu(str(scalars)) == []
    two = fmpy.read_model_description(str(pair(control="pose")[0]))
    three = fmpy.read_model_description(str(scalars))
    assert not any(variable.dimensions for variable in three.modelVariables)
    names = {variable.name for variable in three.modelVariables}
    indicators = {f"event_indicators[{i + 1}]" for i in range(two.numberOfEventIndicators)}
    assert names == {variable.name for variable in two.modelVariables} | indicators | {"time"}
    assert len(three.eventIndicators) == len(indicators)
    with zipfile.ZipFile(scalars) as archive:
        terminals = ET.fromstring(archive.read("terminalsAndIcons/terminalsAndIcons.xml"))
    members = [member.get("variableName") for member in terminals.iter("TerminalMemberVariable")]
    assert {"q[1]", "tau[2]", "quat_des[4]", "tau_ext[1]"} <= set(members) <= names


def test_derivatives_of_scalars_are_elements_of_those_of_arrays(pair, scalars):
    one, all_of_them = arm(scalars), arm(pair(control="pose")[1])
    matrix = np.reshape(
        [
            all_of_them.getDirectionalDerivative([all_of_them.vr["tau"]], [all_of_them.vr["x_des"]], seed, 2)
            for seed in np.eye(2)
        ],
        (2, 2),
    ).T
    for i, k in np.ndindex(2, 2):
        tau, x_des = [one.vr[f"tau[{i + 1}]"]], [one.vr[f"x_des[{k + 1}]"]]
        assert list(one.getDirectionalDerivative(tau, x_des, [1.0], 1)) == [matrix[i, k]]
        assert list(one.getAdjointDerivative(tau, x_des, [1.0], 1)) == [matrix[i, k]]


def test_arrays_are_left_out_of_native_fmus_of_fmi_3_alone(tmp_path):
    for chosen in (FmuOptions(arrays=False), FmuOptions(native=True, arrays=False)):
        with pytest.raises(BuildError, match="arrays"):
            build_fmu(tmp_path / "Arm.fmu", chosen)


def test_terminals_and_the_icon(pair):
    schema = Path(fmpy.__file__).parent / "schema/fmi3/fmi3TerminalsAndIcons.xsd"
    for control in CONTROLS:
        fmu = pair("twodof", control)[1]
        with zipfile.ZipFile(fmu) as archive:
            text = archive.read("terminalsAndIcons/terminalsAndIcons.xml")
            icon = archive.read("terminalsAndIcons/icon.png")
            assert "model.png" not in archive.namelist()
        root = lxml.etree.fromstring(text)
        lxml.etree.XMLSchema(lxml.etree.parse(schema)).assertValid(root)
        place = {key: float(value) for key, value in root.find(".//Icon").items()}
        width, height = struct.unpack(">II", icon[16:24])
        assert width / height == (place["x2"] - place["x1"]) / (place["y2"] - place["y1"])
        inputs = {
            v.name
            for v in fmpy.read_model_description(str(fmu)).modelVariables
            if v.causality == "input" and v.name[0] != "K"  # gains are nobody's to connect
        }
        members = {
            terminal.get("name"): {member.get("variableName") for member in terminal}
            for terminal in root.iter("Terminal")
        }
        assert members["joints"] == {"q", "v", "tau"}
        assert members["targets"] | members["forces"] == inputs
        assert members["forces"] == {"tau_ext", "f_ext"}


def test_description_has_the_variables_of_fmi_2_as_arrays(pair):
    two, three = (fmpy.read_model_description(str(fmu)) for fmu in pair("twodof", "pose"))
    flat = {}
    for variable in three.modelVariables:
        inner = re.fullmatch(r"der\((.*)\)", variable.name)
        for i, start in enumerate((variable.start or "").split() or [None] * 99):
            if i < int(np.prod(variable.shape or ())):
                name = f"{variable.name}[{i + 1}]" if variable.dimensions else variable.name
                name = f"der({inner[1]}[{i + 1}])" if inner else name
                flat[name] = (variable.causality, variable.unit, start)
    for variable in two.modelVariables:
        assert flat.pop(variable.name) == (variable.causality, variable.unit, variable.start)
    assert {name.partition("[")[0] for name in flat} == {"time", "event_indicators"}


def test_model_exchange_equals_co_simulation_with_stops(pair):
    starts = {**NARROW, "rtol": 1e-10, "atol": 1e-10}
    three = pair()[1]
    stepped = simulated(three, "CoSimulation", starts, parts=("q", "v"))
    solved = simulated(three, "ModelExchange", starts, parts=("q", "v"), solver="CVode", relative_tolerance=1e-10)
    assert stepped[:, :2].min() == -0.5 and stepped[:, :2].max() == 1.0
    assert np.abs(solved - stepped)[:, :2].max() <= 1e-7


def jacobians(instance, unknown, known):
    """∂unknown/∂known by directional and by adjoint derivatives, in the description's arrays."""
    u, k = instance.vr[unknown], instance.vr[known]
    n, m = instance.size[u], instance.size[k]
    directional = [instance.getDirectionalDerivative([u], [k], seed, n) for seed in np.eye(m)]
    adjoint = [instance.getAdjointDerivative([u], [k], seed, m) for seed in np.eye(n)]
    return np.array(directional).T, np.array(adjoint)


@pytest.mark.parametrize("control", ["task", "joint", "effort"])
def test_adjoint_derivatives_are_the_transpose(pair, control):
    two, three = pair("twodof", control)
    by_names = twodof.linearise(two, {"q": 0.3, "v": 0.2})
    ours = twodof.linearise(three, {"q": 0.3, "v": 0.2})
    for matrix in "ABCD":
        assert np.array_equal(getattr(ours, matrix), getattr(by_names, matrix))
    instance = arm(three, start=False)
    instance.set("q_start", [0.3] * instance.size[instance.vr["q"]])
    instance.enterInitializationMode()
    instance.exitInitializationMode()
    for unknown in ("der(v)", "x", "tau"):
        for known in ("q", "v", "tau_ext", "f_ext", *CONTROLS[control].inputs[:1]):
            directional, adjoint = jacobians(instance, unknown, known)
            scale = max(1.0, np.abs(directional).max())
            assert np.abs(directional - adjoint).max() <= 1e-12 * scale, (unknown, known)
    assert np.abs(jacobians(instance, "x", "q")[0]).max() > 0.01


def test_a_sweep_is_that_of_fmi_2(pair):
    two, three = (
        twodof.sweep(fmu, grid={"Kp": [20.0, 60.0], "x_des[2]": [0.1]}, stop_time=0.5, workers=1) for fmu in pair()
    )
    assert two.equals(three) and len(set(two["peak_velocity"])) == 2


# --- what is refused ---


def test_wrong_arrays_are_refused(pair):
    a = arm(pair()[1])
    q, kp, effort = a.vr["q"], a.vr["Kp"], a.vr["limit_effort"]
    a.refused("3 values for variables of 2", "getFloat64", [q], 3)
    a.refused("1 values for variables of 2", "setFloat64", [kp], [1.0])
    for wrong in (0, len(a.vr) + 1):
        a.refused(f"no variable with value reference {wrong}$", "getFloat64", [wrong], 1)
    a.refused(r"^Kp\[2\] = nan is not finite$", "setFloat64", [1, kp], [0.3, 0.1, 1.0, np.nan])
    a.refused("limit_effort is of type Boolean", "getFloat64", [effort], 1)
    a.refused("q\\[1\\] is of type Float64", "getFloat32", [q], 2)
    a.refused("q\\[1\\] is of type Float64", "getInt64", [q], 2)
    a.refused("is computed and cannot be set", "setFloat64", [a.vr["time"]], [0.0])
    a.refused("parameter .* is not allowed", "setFloat64", [a.vr["rtol"]], [0.1])
    a.refused(
        "event_indicators.*has no derivative",
        "getDirectionalDerivative",
        [a.vr["event_indicators"]],
        [q],
        [1.0, 0.0],
        7,
    )
    a.refused("2 values for variables of 1", "getAdjointDerivative", [a.vr["x"]], [a.vr["Kn"]], [1.0, 0.0], 2)
    a.refused("weight of x\\[1\\] is not finite", "getAdjointDerivative", [a.vr["x"]], [q], [np.nan, 0.0], 2)


def test_variables_outside_the_description_are_refused(pair):
    fmu = pair()[1]
    a = arm(fmu)
    for kind in ("CoSimulation", "ModelExchange"):
        with zipfile.ZipFile(fmu) as archive:
            (element,) = ET.fromstring(archive.read("modelDescription.xml")).findall(kind)
        for name in (
            "hasEventMode",
            "providesIntermediateUpdate",
            "providesEvaluateDiscreteStates",
            "canReturnEarlyAfterIntermediateUpdate",
        ):
            assert element.get(name) in (None, "false")
    a.refused("fmi3EnterEventMode is a call of Model Exchange", "enterEventMode")
    a.refused("fmi3EnterStepMode is not supported", "enterStepMode")
    for name in (
        "EvaluateDiscreteStates",
        "EnterConfigurationMode",
        "GetIntervalDecimal",
        "ActivateModelPartition",
        "GetOutputDerivatives",
    ):
        a.messages.clear()
        null = [ctypes.c_void_p()] * 5
        assert a.dll[f"fmi3{name}"](ctypes.c_void_p(a.component), *null) == ERROR
        assert a.messages == [(ERROR, f"fmi3{name} is not supported by this FMU")]
    b = exchange(fmu)
    results: list[Any] = [ctypes.c_bool(), ctypes.c_bool(), ctypes.c_bool(), ctypes.c_double()]
    step = (b.component, 0.0, 0.01, False, *map(ctypes.byref, results))
    b.refused("fmi3DoStep is a call of co-simulation", "fmi3DoStep", *step)


@pytest.mark.parametrize(
    "named, message",
    [
        ({"eventModeUsed": True}, "has no event mode in co-simulation"),
        ({"requiredIntermediateVariables": [0]}, "has no intermediate update"),
    ],
)
def test_instances_that_cannot_be_are_not_made(pair, named, message):
    messages = []
    slave = arm(pair()[1])
    with pytest.raises(Exception, match="Failed to instantiate"):
        slave.instantiate(logMessage=lambda _, s, c, text: messages.append(text.decode()), **named)
    assert len(messages) == 1 and message in messages[0]
    slave.guid, messages[:] = "another", []
    with pytest.raises(Exception, match="Failed to instantiate"):
        slave.instantiate(logMessage=lambda _, s, c, text: messages.append(text.decode()))
    assert "instantiation token is not that of this FMU" in messages[0]


def test_call_order(pair):
    a = arm(pair()[1], start=False)
    a.refused("fmi3ExitInitializationMode is not allowed in the state 'instantiated'", "exitInitializationMode")
    a.refused("stop time 1 < start time 2", "enterInitializationMode", None, 2.0, 1.0)
    a.enterInitializationMode(startTime=0.0, stopTime=0.02)
    a.refused("fmi3DoStep is not allowed", "doStep", 0.0, 0.01)
    a.exitInitializationMode()
    assert a.doStep(0.0, 0.01) == (False, False, False, 0.01)
    a.refused("communication point 0.5 s is not", "doStep", 0.5, 0.01)
    a.refused("communication point inf s is not", "doStep", np.inf, 0.01)
    a.refused("ends after the stop time", "doStep", 0.01, 0.02)
    assert a.get("time") == [0.01]
    a.terminate()
    a.refused("is not allowed in the state 'terminated'", "doStep", 0.01, 0.01)
    a.reset()
    b = exchange(pair()[1])
    b.refused(
        "fmi3SetContinuousStates is not allowed in the state 'event mode'",
        "setContinuousStates",
        (ctypes.c_double * 4)(),
        4,
    )
    b.enterContinuousTimeMode()
    indicators = (ctypes.c_double * 7)()
    b.getEventIndicators(indicators, 7)
    assert b.get("event_indicators") == list(indicators)
    assert b.getNumberOfEventIndicators() == 7 and b.getNumberOfContinuousStates() == 4
    b.refused("fmi3UpdateDiscreteStates is not allowed", "updateDiscreteStates")


def test_restored_run_is_the_same_bit_for_bit(pair):
    a = arm(pair()[1])
    a.doStep(0.0, 0.01)
    state = a.deserializeFMUState(a.serializeFMUState(a.getFMUState()))
    runs = []
    for _ in range(2):
        a.setFMUState(state)
        for k in range(1, 50):
            a.doStep(k * 0.01, 0.01)
        runs.append(a.get(*PARTS))
    assert runs[0] == runs[1]


@pytest.mark.long
def test_random_calls_under_sanitizers(length):
    """Calls are legal and illegal; in full, 100,000 sequences."""
    count = length(100_000, 3_000)
    program = executable(
        model("twodof"),
        HERE / "fuzz.c",
        HERE / "fuzz3.h",
        fmi=3,
        flags=("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
    )
    done = subprocess.run([program, str(count), "1"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{count} sequences")


# --- the sources ---

FMUS = (("A_", "task", 3), ("B_", "joint", 3), ("C_", "effort", 2))


def embedded(pair, folder, *target, suffix=""):
    """The program of embedded.c, and its arguments: three FMUs' tokens and references of q."""
    compiler, objects, arguments = [*target, *FLAGS, "-w", f"-I{HEADERS}"], [], []
    folder.mkdir(exist_ok=True)
    for prefix, control, fmi in FMUS:
        fmu = pair("twodof", control)[fmi - 2]
        home = folder / prefix
        fmpy.extract(str(fmu), home)
        description = fmpy.read_model_description(str(fmu))
        vr = {v.name: v.valueReference for v in description.modelVariables}
        arguments += [description.guid, str(vr["q" if fmi == 3 else "q[1]"])]
        for unit in UNITS:
            output = folder / f"{prefix}{unit}.o"
            define = f"-DFMI{fmi}_FUNCTION_PREFIX={prefix}"
            subprocess.run([*compiler, "-c", define, "-o", output, home / "sources" / unit], check=True)
            objects.append(output)
    program = folder / f"embedded{suffix}"
    command = [*compiler, "-o", program, HERE / "embedded.c", *objects]
    subprocess.run([*command, "-lm"], check=True)
    return program, arguments, objects


@pytest.fixture(scope="module")
def here(pair, tmp_path_factory):
    """embedded.c for Linux x86-64: its output, 50 rows of three arms' joints; and its object files."""
    needs("ziglang")
    folder = tmp_path_factory.mktemp("embedded")
    program, arguments, objects = embedded(pair, folder, *ZIG, *TARGETS["x86_64-linux"])
    return printed([program, *arguments]), objects


def printed(command, **environment):
    text = subprocess.check_output(command, text=True, env={**os.environ, **environment})
    return np.array(text.split(), dtype=float).reshape(50, 6)


def test_three_fmus_in_one_program(pair, here):
    rows, objects = here
    table = subprocess.check_output([needs("nm"), "-g", "--defined-only", *objects], text=True)
    symbols = [line.split()[2] for line in table.splitlines() if len(line.split()) == 3]
    assert len(symbols) == len(set(symbols)) > 190
    assert all(re.match("[ABC]_", symbol) for symbol in symbols)
    alone = [
        [sample.q for sample in twodof.samples(pair("twodof", control)[fmi - 2], stop_time=5.0)]
        for _, control, fmi in FMUS
    ]
    assert np.array_equal(rows, np.hstack(alone)[10::10])  # the same compiler made them


def test_aarch64_equals_x86_64(pair, here, tmp_path):
    """The sources are compiled for aarch64 and run in an emulator.

    The C library is the same: another one's sin and cos differ in the last bit, which the chaotic bare arm amplifies to
    4e-11 in 5 s.
    """
    emulator = needs("qemu"), "-L", str(Path(needs("libc-arm64")).parents[1])
    program, arguments, _ = embedded(pair, tmp_path, *ZIG, *TARGETS["aarch64-linux"])
    assert program.read_bytes()[18:20] == b"\xb7\x00"  # EM_AARCH64
    assert np.abs(printed([*emulator, program, *arguments]) - here[0]).max() <= 1e-12


def test_windows_equals_linux(pair, here, tmp_path):
    """It runs in wine; the chaotic bare arm runs only 2 s, because Windows' sin and cos differ."""
    program, arguments, _ = embedded(pair, tmp_path, needs("mingw"), suffix=".exe")
    with wine(tmp_path) as (command, environment):
        there = printed([command, program, *arguments], **environment)
    assert np.abs(there - here[0])[:, :4].max() <= 1e-12
    assert np.abs(there - here[0])[:20].max() <= 1e-12


MACHINES = {
    "x86_64-linux": (".so", b"\x7fELF", 18, 62),
    "aarch64-linux": (".so", b"\x7fELF", 18, 183),
    "x86_64-windows": (".dll", b"MZ", 0x3C, 0x8664),
    "x86_64-darwin": (".dylib", b"\xcf\xfa\xed\xfe", 4, 7),  # with a bit of 64 bits
    "aarch64-darwin": (".dylib", b"\xcf\xfa\xed\xfe", 4, 12),
}
"""Beginning of the file, where it says for which machine it is, and what."""


def test_libraries_for_every_platform_from_here(tmp_path):
    needs("ziglang")
    chosen = FmuOptions(native=True, fmi=3, platforms=(*MACHINES,), control="joint")
    fmu = build_fmu(tmp_path / "TwoDof.fmu", chosen)
    header = (HEADERS / "fmi3Functions.h").read_text()
    functions = set(re.findall(r"TYPE +(fmi3\w+);", header))
    assert len(functions) == 75
    with zipfile.ZipFile(fmu) as archive:
        for platform, (suffix, magic, place, machine) in MACHINES.items():
            data = archive.read(f"binaries/{platform}/TwoDof{suffix}")
            if suffix == ".dll":
                place = struct.unpack_from("<I", data, place)[0] + 4
            assert data.startswith(magic)
            assert struct.unpack_from("<H", data, place)[0] == machine
            names = {word.decode() for word in re.findall(rb"fmi3[A-Z]\w+(?=\0)", data)}
            assert functions <= names, platform
    assert twodof.load_fmu(fmu).platforms == tuple(sorted(MACHINES))


def test_fmpy_rebuilds_the_library_from_the_sources(pair, tmp_path):
    for tool in ("cmake", "make", "gcc"):  # pip's cmake may be alone
        needs(tool)
    fmu = pair()[1]
    fmpy.extract(fmu, tmp_path)
    library = next(Path(tmp_path, "binaries").rglob("*.so"))
    shipped = library.read_bytes()
    library.unlink()
    fmpy.build.build_platform_binary(tmp_path)
    assert library.read_bytes() != shipped
    first = simulated(fmu, "CoSimulation")
    again = fmpy.simulate_fmu(
        str(tmp_path), fmi_type="CoSimulation", stop_time=2.0, step_size=0.01, output_interval=0.01, output=["q"]
    )
    assert np.abs(np.array([row["q"] for row in again]) - first[:, :2]).max() <= 1e-12


def test_fmu_is_as_small_as_that_of_fmi_2(pair):
    """Its library has the same engine and more functions of the standard."""
    files, libraries = [], []
    for fmu in pair("panda_finger"):
        files.append(fmu.stat().st_size)
        with zipfile.ZipFile(fmu) as archive:
            libraries += [i.file_size for i in archive.infolist() if i.filename.endswith(".so")]
    assert len(libraries) == 2 and libraries[1] - libraries[0] <= 12 * 1024
    assert files[1] <= 1.05 * files[0], (files, libraries)
