"""The native libraries for every platform: their symbols, their runs, and their builds."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import stat
import struct
import subprocess
import sys
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import fmpy
import fmpy.build
import numpy as np
import pytest
from harness import in_child_process, wine
from native_models import robots_folder
from tools import needs

import twodof
from twodof import FmuOptions, build_fmu
from twodof.cli.main import main
from twodof.errors import BuildError
from twodof.export.compiler import UNITS, compile_library, host_platform

HOST = Path(__file__).parent / "native" / "host.c"
BINARIES = {
    "linux64": "binaries/linux64/TwoDof.so",
    "win64": "binaries/win64/TwoDof.dll",
    "darwin64": "binaries/darwin64/TwoDof.dylib",
}
LIMITED = {"q_min[1]": 0.3, "q_max[2]": 1.2, "x_des[1]": 0.1, "x_des[2]": 0.2, "tau_ext[1]": 0.02, "tau_ext[2]": 0.02}
"""A run in which joints stop at their limits, away from the singularity at q[2] = 0."""


def native(path: Path, *platforms: str) -> Path:
    return build_fmu(path, FmuOptions(native=True, platforms=platforms))


@pytest.fixture(scope="module")
def shipped(tmp_path_factory):
    """The default arm's FMU for all platforms."""
    needs("ziglang")
    path = tmp_path_factory.mktemp("all platforms") / "TwoDof.fmu"
    assert main(["build", "--native", "--platform", "all", "-o", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def unzipped(shipped):
    fmpy.extract(shipped, shipped.parent / "unzipped")
    return shipped.parent / "unzipped"


@pytest.fixture
def without_zig(monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "ziglang" else find_spec(name))


def test_files_and_description(shipped, fmu_path):
    """The description is that of the Python flavour, except for the flavours' differences."""
    with zipfile.ZipFile(shipped) as archive:
        binaries = {name for name in archive.namelist() if name.startswith("binaries/")}
        ours = ET.fromstring(archive.read("modelDescription.xml"))
        sources = {name[8:] for name in archive.namelist() if name.startswith("sources/")}
    assert binaries == set(BINARIES.values())
    with zipfile.ZipFile(fmu_path) as archive:
        theirs = ET.fromstring(archive.read("modelDescription.xml"))
    for kind in ("CoSimulation", "ModelExchange"):
        (element,) = ours.findall(kind)
        assert element.get("needsExecutionTool") == "false"
        assert element.get("providesDirectionalDerivative") == "true"
        files = [file.get("name") for file in element.iter("File")]
        assert files == list(UNITS) and sources >= set(UNITS)
    for scalar in ours.iter("ScalarVariable"):  # states, which may be set anew
        if scalar.get("initial") == "approx":
            assert scalar.attrib["name"][:2] in ("q[", "v[")
            assert scalar[0].attrib.pop("reinit") == "true" and scalar[0].get("start")
    ours.remove(*ours.findall("ModelExchange"))
    del ours.attrib["numberOfEventIndicators"]
    del ours.findall("CoSimulation")[0].attrib["providesDirectionalDerivative"]
    for tree in (ours, theirs):
        assert tree.attrib.pop("guid") and tree.attrib.pop("generationTool")
        (simulation,) = tree.findall("CoSimulation")
        del simulation.attrib["needsExecutionTool"]
        del simulation.attrib["canNotUseMemoryManagementFunctions"]
        for element in simulation.findall("SourceFiles"):
            simulation.remove(element)
    assert canonical(ours) == canonical(theirs)


def canonical(tree: ET.Element) -> str:
    return ET.canonicalize(ET.tostring(tree), strip_text=True)


# --- what the libraries contain ---


def fmi_functions() -> set[str]:
    """Return the functions of FMI 2.0, that of several steps, and the count of evaluations."""
    header = (Path(fmpy.__file__).parent / "c-code/fmi2Functions.h").read_text()
    return {*re.findall(r"FMI2_Export \w+TYPE +(\w+);", header), "twodof_evaluations", "twodof_span"}


def shown(*command: object) -> str:
    """Return the output of a binutils program on a library."""
    needs("binutils")
    return subprocess.check_output([*map(str, command)], text=True)


def test_linux_library(unzipped):
    """ELF: only FMI functions, libc and libm, of glibc 2.17 at most."""
    library = unzipped / BINARIES["linux64"]
    assert "X86-64" in shown("readelf", "-h", library) and library.stat().st_size < 200_000
    symbols = shown("readelf", "-W", "--dyn-syms", library)
    assert set(re.findall(r"DEFAULT +\d+ (\w+)$", symbols, re.MULTILINE)) == fmi_functions()
    dynamic = shown("readelf", "-W", "-d", library)
    assert set(re.findall(r"NEEDED.*\[(.*)\]", dynamic)) <= {"libc.so.6", "libm.so.6"}
    assert re.findall(r"SONAME.*\[(.*)\]", dynamic) == ["TwoDof.so"]
    versions = re.findall(r"Name: (\S+) +Flags", shown("readelf", "-W", "-V", library))
    assert versions and all(version.startswith("GLIBC_2.") for version in versions)
    assert max([int(part) for part in v[6:].split(".")] for v in versions) <= [2, 17]


def test_windows_library(unzipped):
    """PE: only FMI functions, Windows and its C runtime."""
    library = unzipped / BINARIES["win64"]
    header, exported = shown("objdump", "-p", library).split("The Export Tables")
    assert "pei-x86-64" in header and library.stat().st_size < 200_000
    names = exported.split("[Ordinal/Name Pointer] Table")[1].partition("\n\n")[0]
    assert set(re.findall(r"\].* (\w+)$", names, re.MULTILINE)) == fmi_functions()
    imported = re.findall(r"DLL Name: (\S+)", header)
    assert imported and all(name.startswith("api-ms-win-crt-") for name in imported)
    assert re.search(r"Entry d 0+ 0+ Delay", header)  # nothing is loaded later


def test_mac_library(unzipped):
    """Mach-O for both architectures, from macOS 11 on, signed if macOS requires it."""
    data = (unzipped / BINARIES["darwin64"]).read_bytes()
    magic, count = struct.unpack_from(">II", data)
    assert (magic, count) == (0xCAFEBABE, 2)
    processors = []
    for i in range(count):
        cpu, _, offset, size, align = struct.unpack_from(">5I", data, 8 + 20 * i)
        assert offset % 2**align == 0 and size < 200_000
        thin = data[offset : offset + size]
        assert len(thin) == size
        header, own_cpu, kind, commands = struct.unpack_from("<II4xII", thin)
        assert (header, own_cpu, kind) == (0xFEEDFACF, cpu, 6)  # 64 bit, a dynamic library
        processors.append(cpu)
        place = 32
        seen: dict[int, list[int]] = {}
        for _ in range(commands):
            command, length = struct.unpack_from("<II", thin, place)
            seen.setdefault(command, []).append(place)
            place += length

        def text(at, thin=thin):
            return thin[at : thin.index(b"\0", at)].decode()

        def name(at, thin=thin, text=text):
            return text(at + struct.unpack_from("<I", thin, at + 8)[0])

        assert [name(at) for at in seen[0xD]] == ["@rpath/TwoDof.dylib"]
        assert {name(at) for at in seen[0xC]} == {"/usr/lib/libSystem.B.dylib"}
        assert struct.unpack_from("<II", thin, seen[0x32][0] + 8) == (1, 11 << 16)  # macOS, 11.0
        assert cpu == 0x1000007 or 0x1D in seen  # a code signature
        symbols, number, strings = struct.unpack_from("<III", thin, seen[0x2][0] + 8)
        rows = [struct.unpack_from("<IB", thin, symbols + 16 * k) for k in range(number)]
        exported = {text(strings + row[0]) for row in rows if row[1] & 1 and row[1] & 0xE}
        exported -= {"___dso_handle", "__mh_dylib_header"}  # zig's linker exports them always
        assert exported == {f"_{function}" for function in fmi_functions()}
    assert processors == [0x1000007, 0x100000C]  # x86_64, arm64


# --- runs ---


def variables(fmu: Path) -> tuple[str, dict[str, int]]:
    """GUID, and value references by name."""
    description = fmpy.read_model_description(str(fmu))
    return description.guid, {v.name: v.valueReference for v in description.modelVariables}


def drive(
    unzipped: Path, platform: str, folder: Path, settings: dict[str, float], wine: tuple[str, dict[str, str]]
) -> subprocess.CompletedProcess[str]:
    """Return the output of an importer compiled for the platform, over 5 s; Windows programs run in wine."""
    windows = platform == "win64"
    importer = folder / ("host.exe" if windows else "host")
    if not importer.exists():
        compiler = needs("mingw") if windows else needs("gcc")
        sources = str(unzipped / "sources")
        building = [compiler, "-I", sources, "-o", str(importer), str(HOST)]
        subprocess.run([*building, *([] if windows else ["-ldl"])], check=True)
    library = shutil.copy(unzipped / BINARIES[platform], folder)
    guid, references = variables(unzipped)
    first, last = references["q[1]"], references["tau[2]"]
    arguments = [guid, str(first), str(last - first + 1), str(references["der(v[1])"]), str(references["q[1]"])]
    for name, value in settings.items():
        arguments += [str(references[name]), repr(value)]
    name = Path(library).name if windows else str(library)
    command, environment = wine if windows else ("env", dict(os.environ))
    return subprocess.run(
        [command, str(importer), name, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


TURNED = {"quat_des[3]": 0.5, "quat_des[4]": 0.8, "omega_des[3]": 0.1}
RUNS = {
    "task": ({}, LIMITED),
    "pose": (TURNED, {**TURNED, "q_min[1]": 0.3}),
    "joint": (
        {"q_des[1]": 0.9, "q_des[2]": -0.6, "f_ext[2]": -0.5},
        {"q_min[1]": 0.3, "q_min[2]": -1.0, "q_des[1]": 0.0, "q_des[2]": 1.5, "payload": 0.5},
    ),
    "effort": (
        {"tau_cmd[1]": 0.4, "tau_cmd[2]": 0.1, "q_max[2]": 0.5},
        {"q_min[1]": 0.3, "q_max[2]": 1.2, "tau_cmd[2]": 0.5},
    ),
}
"""By control, the last one with stops."""


@pytest.fixture(scope="module")
def machines(tmp_path_factory):
    """A folder for the importer of each platform and for wine, and the command of wine."""
    folder = tmp_path_factory.mktemp("machines")
    with wine(folder) as called:
        yield folder, called


@pytest.mark.parametrize("control", RUNS)
def test_windows_library_runs_as_linux_library(control, machines, tmp_path):
    needs("ziglang")
    folder, wine = machines
    chosen = FmuOptions(native=True, control=control, platforms=("linux64", "win64"))
    unzipped = Path(fmpy.extract(build_fmu(tmp_path / "TwoDof.fmu", chosen), tmp_path / "fmu"))
    for settings in RUNS[control]:
        runs = [drive(unzipped, kind, folder, settings, wine) for kind in ("linux64", "win64")]
        assert not any(run.returncode for run in runs), [run.stderr for run in runs]
        linux, windows = (np.array([line.split() for line in run.stdout.splitlines()], float) for run in runs)
        assert linux.shape == windows.shape and len(linux) == 51
        np.testing.assert_allclose(windows, linux, rtol=1e-12, atol=1e-12)
        assert np.ptp(linux[:, :2], axis=0).min() > 0.0
    limits = [value for name, value in settings.items() if name[:5] in ("q_min", "q_max")]
    assert np.isin(limits, linux[:, :2]).all()  # they were met
    refused = [drive(unzipped, kind, folder, {"payload": -1e18}, wine) for kind in ("linux64", "win64")]
    for run in refused:
        assert run.returncode == 4 and "payload = -1e+18 must be >= 0\n" in run.stderr
    assert refused[1].stderr.replace("\r", "") == refused[0].stderr


def test_a_windows_library_with_more_than_a_page_of_local_variables_runs_as_linux_library(machines, tmp_path):
    needs("ziglang")
    folder, wine = machines
    panda = robots_folder() / "panda_description/urdf/panda.urdf"
    chosen = FmuOptions(
        panda,
        name="TwoDof",
        frame="panda_hand_tcp",
        lock={"panda_finger_joint*": 0.0},
        q_start=(0.0, -0.6, 0.0, -1.9, 0.0, 1.6, 0.7),
        meshes=False,
        native=True,
        control="pose",
        platforms=("linux64", "win64"),
    )
    unzipped = Path(fmpy.extract(build_fmu(tmp_path / "TwoDof.fmu", chosen), tmp_path / "fmu"))
    moved = {"x_des[1]": 0.4, "x_des[2]": 0.2, "x_des[3]": 0.5, "payload": 0.5}
    runs = [drive(unzipped, kind, folder, moved, wine) for kind in ("linux64", "win64")]
    assert not any(run.returncode for run in runs), [run.stderr for run in runs]
    linux, windows = (np.array([line.split() for line in run.stdout.splitlines()], float) for run in runs)
    assert linux.shape == windows.shape and len(linux) == 51 and np.ptp(linux[:, 0]) > 0.0
    np.testing.assert_allclose(windows, linux, rtol=1e-9, atol=1e-9)


def outputs(fmu: Path, **named) -> np.ndarray:
    names = [f"{group}[{i}]" for group in ("q", "v", "x", "tau") for i in (1, 2)]
    start = {name: value for name, value in LIMITED.items() if "tau" not in name}
    result = fmpy.simulate_fmu(str(fmu), stop_time=5.0, output_interval=0.01, output=names, start_values=start, **named)
    assert len(result) == 501
    return np.array([result[name] for name in names])


needs_linux = pytest.mark.needs("linux64")


@needs_linux
def test_fmpy_rebuilds_the_library_from_the_sources(shipped, tmp_path, monkeypatch):
    """FMPy's flags hide no names; functions must still not be replaced by others."""
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    needs("cmake")
    needs("make")
    needs("gcc")
    fmpy.extract(shipped, tmp_path)
    shutil.rmtree(tmp_path / "binaries")
    fmpy.build.build_platform_binary(tmp_path)
    rebuilt = tmp_path / BINARIES["linux64"]
    with zipfile.ZipFile(shipped) as archive:
        assert rebuilt.read_bytes() != archive.read(BINARIES["linux64"])
    compare(tmp_path, shipped)


@in_child_process
def compare(ours, theirs):
    assert np.abs(outputs(ours) - outputs(theirs)).max() <= 1e-12


@needs_linux
def test_own_compiler_serves_without_zig(shipped, tmp_path, without_zig):
    needs("gcc")
    own = native(tmp_path / "own.fmu")  # for this machine
    with zipfile.ZipFile(shipped) as zig, zipfile.ZipFile(own) as archive:
        name = BINARIES["linux64"]
        assert [file for file in archive.namelist() if file.startswith("binaries/")] == [name]
        assert archive.read(name) != zig.read(name)
    assert np.abs(outputs(own) - outputs(shipped)).max() <= 1e-12


def test_equal_bytes_from_an_empty_cache_without_a_home(unzipped, monkeypatch):
    """Without a home folder, zig's cache is temporary."""
    for name, value in (("HOME", "/dev/null"), ("XDG_CACHE_HOME", ""), ("ZIG_GLOBAL_CACHE_DIR", "")):
        monkeypatch.setenv(name, value)
    sources = {path.name: path.read_bytes() for path in (unzipped / "sources").iterdir()}
    library = compile_library(sources, "linux64", "TwoDof")
    assert library == (unzipped / BINARIES["linux64"]).read_bytes()


# --- machines ---


@pytest.fixture
def raspberry(monkeypatch):
    """A machine that identifies itself as a Raspberry Pi or a Jetson."""
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("fmpy.platform_tuple", "aarch64-linux")  # as it says there


@pytest.mark.parametrize(
    "machine, system, names",
    [
        ("x86_64", "linux", ("linux64", "x86_64-linux")),
        ("aarch64", "linux", ("", "aarch64-linux")),
        ("armv7l", "linux", ("", "")),
        ("AMD64", "win32", ("win64", "x86_64-windows")),
        ("x86_64", "darwin", ("darwin64", "x86_64-darwin")),
        ("arm64", "darwin", ("darwin64", "aarch64-darwin")),
    ],
)
def test_names_of_machines(machine, system, names, monkeypatch):
    monkeypatch.setattr("platform.machine", lambda: machine)
    monkeypatch.setattr("sys.platform", system)
    assert (host_platform(2), host_platform(3)) == names


def test_a_raspberry_builds_fmi_3_for_itself(raspberry, tmp_path, monkeypatch, capsys):
    needs("ziglang")
    monkeypatch.chdir(tmp_path)
    assert main(["build", "--native", "--control", "joint"]) == 0
    assert "TwoDof-native.fmu" in capsys.readouterr().out
    fmu = twodof.load_fmu("TwoDof-native.fmu")
    assert (fmu.version, fmu.platforms, fmu.platform) == (3, ("aarch64-linux",), "aarch64-linux")
    with zipfile.ZipFile(fmu.path) as archive:
        library = archive.read("binaries/aarch64-linux/TwoDof.so")
    assert library[:4] == b"\x7fELF" and library[18:20] == b"\xb7\x00"  # EM_AARCH64


@pytest.mark.parametrize(
    "options, expected",
    [
        (("--fmi", "2"), "FMI 2.0 has no name for this machine; choose one with --platform, or --fmi 3, which has one"),
        (("--platform", "aarch64-linux"), "FMI 2.0 has no platform 'aarch64-linux'; --fmi 3 has it"),
        (("--platform", "solaris"), "FMI 2.0 has no platform 'solaris'; there are: linux64, win64, darwin64\n"),
    ],
)
def test_fmi_2_on_a_raspberry_is_refused_at_the_build(raspberry, tmp_path, monkeypatch, capsys, options, expected):
    monkeypatch.chdir(tmp_path)
    assert main(["build", "--native", *options]) == 1
    captured = capsys.readouterr()
    assert (captured.out, captured.err.count("\n")) == ("", 1) and expected in captured.err
    assert not list(tmp_path.iterdir())


def test_fmi_2_on_a_raspberry_is_refused_at_the_run(raspberry, fmu_path, tmp_path, capsys):
    """linux64 means x86-64; FMPy accepts it on any 64-bit Linux."""
    assert fmpy.platform == "linux64"
    assert main(["build", "-o", str(fmu_path)]) == 0
    assert capsys.readouterr().out.split("next")[1].startswith("\n  twodof build --native\n")
    assert main(["run", str(fmu_path), "-o", str(tmp_path / "bag")]) == 1
    captured = capsys.readouterr()
    assert captured.err.strip().endswith(
        f"'{fmu_path}' has no binary for this platform (aarch64-linux, which FMI 2.0 has no name"
        " for), only for: linux64; build one with --native and --fmi 3"
    )
    assert not (tmp_path / "bag").exists()


def test_fmi_3_needs_none_of_fmpys_logger(tmp_path):
    """FMPy has no logger for aarch64-linux, and prints that on import."""
    code = """import sys
sys.modules["fmpy.logging"] = None  # cannot be imported
from twodof import samples
print(len(list(samples("A.fmu", stop_time=0.1))))
"""
    options = FmuOptions(native=True, fmi=3)
    build_fmu(tmp_path / "A.fmu", options)
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "11\n"), done.stderr


# --- bad input, missing and failing compilers ---


def refused(folder: Path, *platforms: str) -> str:
    with pytest.raises(BuildError) as caught:
        native(folder / "arm.fmu", *platforms)
    assert not list(folder.glob("*.fmu*"))
    return str(caught.value)


@needs_linux
@pytest.mark.parametrize(
    "platform, reason",
    [("win64", "this machine's own compiler builds for linux64"), ("linux64", "this machine has no C compiler")],
)
def test_a_missing_compiler_is_named(platform, reason, tmp_path, without_zig, monkeypatch):
    if platform == "linux64":
        monkeypatch.setenv("PATH", str(tmp_path))
    message = refused(tmp_path, platform)
    assert f"cannot compile for {platform}: {reason}" in message
    assert "install the extra 'native': " in message


@needs_linux
@pytest.mark.parametrize(
    "script, expected",
    [
        ("#!/bin/sh\necho 'plant.c:1: no room for this' >&2\nexit 3\n", "no room for this"),
        ("#!/bin/sh\nexit 3\n", "exit status 3"),
        ("#!/does/not/exist\n", "cannot run the compiler"),
    ],
)
def test_compiler_that_fails(tmp_path, without_zig, monkeypatch, script, expected):
    compiler = tmp_path / "cc"
    compiler.write_text(script)
    compiler.chmod(compiler.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert expected in refused(tmp_path, "linux64")
