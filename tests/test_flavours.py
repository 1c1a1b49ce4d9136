"""The two flavours side by side, through the master and the command line."""

import subprocess
import zipfile

import numpy as np
import pytest
from tools import needs

import twodof
from twodof import FmuOptions, build_fmu
from twodof.cli.main import main
from twodof.export.compiler import UNITS


def test_trajectories_of_both_flavours_agree(fmu_path, native_path):
    """The tolerance is the default; `test_control.py` uses a tight one."""
    settings = {
        "q_min": (-0.2, 0.8),
        "q_max": (0.8, 1.9),
        "q_start": (0.3, 1.3),
        "Kp": 400.0,
        "x_des": (0.14, -0.03),
        "tau_ext": (0.2, -0.1),
        "limit_effort": True,
    }
    runs = [list(twodof.samples(fmu, stop_time=2.0, settings=settings)) for fmu in (fmu_path, native_path)]
    for group in ("q", "v", "x", "tau"):
        python, native = (np.array([getattr(s, group) for s in run]) for run in runs)
        scale = np.maximum(1.0, np.abs(python))
        assert (np.abs(native - python) / scale).max() <= 1e-9, group
    assert [s.inputs for s in runs[0]] == [s.inputs for s in runs[1]]


def test_sources_compiled_without_any_flag_show_the_standard_functions_alone(native_path, tmp_path):
    """Otherwise libc's advance(), or another FMU's functions, would be called instead."""
    with zipfile.ZipFile(native_path) as archive:
        archive.extractall(tmp_path)
    files = [tmp_path / "sources" / name for name in UNITS]
    library = tmp_path / "library.so"
    subprocess.run([needs("gcc"), "-shared", "-fPIC", "-o", library, *files, "-lm"], check=True)
    symbols = subprocess.check_output([needs("nm"), "-D", "--defined-only", library], text=True).split()
    names = [name for name in symbols[2::3] if not name.startswith("_") and not name.startswith("twodof_")]
    assert len(names) == 44
    assert all(name.startswith("fmi2") for name in names)


def test_run_native_builds_its_own_fmu_once(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = ["run", "--native", "--stop-time", "0.1", "--overwrite", "-o", "bag"]
    assert main(arguments) == 0
    built = (tmp_path / "TwoDof-native.fmu").stat().st_mtime_ns
    assert main(arguments) == 0
    assert (tmp_path / "TwoDof-native.fmu").stat().st_mtime_ns == built
    assert "TwoDof-native.fmu" in capsys.readouterr().out
    assert not (tmp_path / "TwoDof.fmu").exists()


def test_run_native_beside_an_fmu_is_refused(native_path, capsys):
    assert main(["run", "--native", str(native_path)]) == 2
    assert "--native builds the default arm's FMU" in capsys.readouterr().err


def test_a_host_without_the_python_flavour_takes_the_native_one_and_reports_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("twodof.export.compiler.host_platform", lambda fmi=2: "darwin64")
    monkeypatch.setattr("twodof.export.composition.host_platform", lambda fmi=2: "linux64")  # what can run here
    assert main(["run", "--stop-time", "0.1", "-o", "bag"]) == 0
    captured = capsys.readouterr()
    assert "a Python FMU needs Linux x86-64: building a native FMU" in captured.err
    assert "TwoDof-native.fmu" in captured.out


@pytest.mark.parametrize(
    "options, message",
    [
        (FmuOptions(platforms=("win64",)), "for native FMUs only"),
        (FmuOptions(native=True, link_environment=True), "needs no Python environment"),
    ],
)
def test_options_that_do_not_fit_a_flavour_are_refused(options, message, tmp_path):
    with pytest.raises(twodof.TwoDofError, match=message):
        build_fmu(tmp_path / "A.fmu", options)
    assert list(tmp_path.iterdir()) == []


def test_the_shipped_arms_file_is_identified_by_its_inputs(tmp_path, monkeypatch):
    """No FMU is composed for that, unless options or sources differ, or the file is damaged."""

    class ComposedError(Exception):
        pass

    def compose(options):
        raise ComposedError

    path = build_fmu(tmp_path / "A.fmu", FmuOptions(native=True))
    content = path.read_bytes()
    monkeypatch.setattr("twodof.export.composition.compose", compose)
    assert build_fmu(path, FmuOptions(native=True)).read_bytes() == content
    for other in ({"control": "joint"}, {"q_start": (0.4, 0.3)}):
        with pytest.raises(ComposedError):
            build_fmu(path, FmuOptions(native=True, **other))
    path.write_bytes(content[:-100])
    with pytest.raises(ComposedError):
        build_fmu(path, FmuOptions(native=True))
    path.write_bytes(content)
    with monkeypatch.context() as patch, pytest.raises(ComposedError):
        patch.setattr("twodof.export.package.versions", lambda *names: {"pin": "0"})
        build_fmu(path, FmuOptions(native=True))
    monkeypatch.setattr("twodof.export.package.data_file", lambda name: tmp_path)
    with pytest.raises(ComposedError):
        build_fmu(path, FmuOptions(native=True))


def test_the_python_flavour_is_of_fmi_2(fmu_path, tmp_path):
    """It accepts `fmi=2`."""
    assert build_fmu(tmp_path / "A.fmu", FmuOptions(fmi=2)).read_bytes() == fmu_path.read_bytes()
    with pytest.raises(twodof.TwoDofError, match="native FMUs only"):
        build_fmu(tmp_path / "B.fmu", FmuOptions(fmi=3))
