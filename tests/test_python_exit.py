"""A process that has run the Python FMU ends without use of freed memory, in FMPy and from C."""

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import fmpy
import pytest
from native_models import HERE
from tools import missing, needs

import twodof
from twodof.errors import BuildError
from twodof.export import flavours
from twodof.export.python_wrapper import repaired_wrapper

LIBRARY = "binaries/linux64/TwoDof.so"
FMPY = """
import sys
from fmpy.fmi2 import FMU2Slave
folder, guid = sys.argv[1:]
slave = FMU2Slave(guid=guid, unzipDirectory=folder, modelIdentifier="TwoDof", instanceName="arm")
slave.instantiate()
slave.setupExperiment()
slave.enterInitializationMode()
slave.exitInitializationMode()
slave.doStep(0.0, 0.01)
slave.terminate()
slave.freeInstance()
"""
BARE = """
from importlib import import_module
from pathlib import Path

class TwoDof(import_module(f"twodof_{Path(__file__).stem[6:]}.pythonfmu.fmi2slave").Fmi2Slave):
    def do_step(self, time, step):
        return True
"""
"""A slave without a plant, whose imports take valgrind a second in place of a minute."""


def original() -> bytes:
    """The library as pythonfmu ships it."""
    return (flavours.PYTHONFMU / "resources/binaries/linux64/libpythonfmu-export.so").read_bytes()


@pytest.fixture
def unzipped(fmu_path, tmp_path):
    with zipfile.ZipFile(fmu_path) as archive:
        archive.extractall(tmp_path / "unzipped")
    return tmp_path / "unzipped"


def in_fmpy(folder: Path, guid: str, _: Path) -> tuple[list[str], dict[str, str]]:
    return [sys.executable, "-c", FMPY, str(folder), guid], {}


def from_c(folder: Path, guid: str, scratch: Path) -> tuple[list[str], dict[str, str]]:
    """A C program with libpython preloaded, as in docs/fmi-tools.md."""
    libpython = Path(sysconfig.get_config_var("LIBDIR"), sysconfig.get_config_var("INSTSONAME") or "")
    if not libpython.is_file():
        missing("libpython")
    headers = Path(fmpy.__file__).parent / "c-code"
    subprocess.run(
        [
            "gcc",
            "-std=c99",
            "-Wall",
            "-Wextra",
            "-Werror",
            f"-I{headers}",
            "-o",
            scratch / "host",
            HERE / "python_host.c",
            "-ldl",
        ],
        check=True,
    )
    packages = os.pathsep.join(filter(None, sys.path))
    command = [str(scratch / "host"), str(folder / LIBRARY), guid, (folder / "resources").as_uri()]
    return command, {"LD_PRELOAD": str(libpython), "PYTHONPATH": packages}


@pytest.mark.parametrize("host", [in_fmpy, from_c])
def test_the_process_ends_without_use_of_freed_memory(unzipped, tmp_path, host):
    guid = fmpy.read_model_description(str(unzipped)).guid
    valgrind = [needs("valgrind"), "-q", "--error-limit=no", "--undef-value-errors=no"]  # which take half of its time
    command, variables = host(unzipped, guid, tmp_path)
    reports = []
    for _ in ("repaired", "original"):
        done = subprocess.run([*valgrind, *command], env={**os.environ, **variables}, capture_output=True, text=True)
        reports.append(done.stderr)
        (unzipped / LIBRARY).write_bytes(original())
        next((unzipped / "resources").glob("slave_*.py")).write_text(BARE)
    assert done.returncode == 0, reports  # valgrind's heap is none that is damaged
    assert "TwoDof.so" not in reports[0] and "_dl_call_fini" not in reports[0], reports[0]
    assert "finalizePythonInterpreter" in reports[1]  # valgrind does see it in the original


def test_an_fmu_of_pythonfmus_own_is_repaired_where_it_is_loaded(fmu_path, tmp_path, monkeypatch):
    other, loaded = tmp_path / "Other.fmu", []
    with zipfile.ZipFile(fmu_path) as archive, zipfile.ZipFile(other, "w") as copy:
        for name in archive.namelist():
            copy.writestr(name, original() if name == LIBRARY else archive.read(name))
    monkeypatch.setattr(
        "twodof.fmu.instance.Instance.__init__",
        lambda self, fmu, folder, *_: loaded.append((folder / LIBRARY).read_bytes()),
    )
    monkeypatch.setattr("twodof.fmu.instance.Instance.free", lambda self: None)
    with twodof.fmu.instantiate(twodof.load_fmu(other)):
        assert loaded == [repaired_wrapper(original())]


def test_a_library_that_is_not_known_is_refused(tmp_path, monkeypatch):
    shutil.copytree(flavours.PYTHONFMU, tmp_path / "pythonfmu")
    library = tmp_path / "pythonfmu/resources/binaries/linux64/libpythonfmu-export.so"
    library.write_bytes(original() + b"\0")
    monkeypatch.setattr(flavours, "PYTHONFMU", tmp_path / "pythonfmu")
    with pytest.raises(BuildError, match=r"is not the library of pythonfmu 0\.7\.0; run 'pip "):
        twodof.build_fmu(tmp_path / "TwoDof.fmu")
    assert not (tmp_path / "TwoDof.fmu").exists()
