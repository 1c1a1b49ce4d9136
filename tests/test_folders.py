"""Temporary folders of runs: removed at the end or by the next run; other folders stay."""

import errno
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from subprocess import PIPE

import pytest
from tools import needs

import twodof
from twodof.errors import FmuError
from twodof.files import TEMPORARY, temporary_folder


def test_an_abandoned_generator_removes_its_unzipped_fmu(fmu_path, tmp_path, monkeypatch):
    """The FMU's name may contain a space."""
    parent = tmp_path / "a b"
    parent.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(parent))
    run = twodof.samples(fmu_path, stop_time=1.0)
    next(run)
    assert len(list(parent.iterdir())) == 1
    run.close()
    assert list(parent.iterdir()) == []


def test_of_a_native_fmu_only_the_library_is_unzipped(native_path, fmu_path, tmp_path, monkeypatch):
    """A Python FMU reads its resources."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    tops = []
    for path in (native_path, fmu_path):
        run = twodof.samples(path, stop_time=1.0)
        next(run)
        (folder,) = tmp_path.iterdir()
        tops.append({file.relative_to(folder).parts[0] for file in folder.rglob("*") if file.is_file()})
        run.close()
    assert tops[0] == {"binaries"} and {"binaries", "resources", "modelDescription.xml"} <= tops[1]


RUN_THAT_WAITS = """
import os, signal, sys, tempfile
tempfile.tempdir = sys.argv[2]
import twodof
run = twodof.samples(sys.argv[1], stop_time=1.0)
next(run)
print("ready", flush=True)
sys.stdin.read()
print(next(run).k, flush=True)
"""


@contextmanager
def waiting_run(fmu, folder):
    """A process in the middle of a run whose temporary folder is in this one."""
    command = [sys.executable, "-c", RUN_THAT_WAITS, fmu, folder]
    with subprocess.Popen(command, text=True, stdin=PIPE, stdout=PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        yield process
        process.kill()


@pytest.mark.parametrize("foreign", [False, True])
def test_the_rest_of_a_killed_run_is_removed_by_the_next_and_nothing_else(native_path, tmp_path, monkeypatch, foreign):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    others = tmp_path / "others"
    others.mkdir()
    (tmp_path / f"{TEMPORARY}link").symlink_to(others)
    (tmp_path / f"{TEMPORARY}file").touch()
    (tmp_path / f"{TEMPORARY}notes").mkdir()
    if foreign:
        needs("root")
        (tmp_path / f"{TEMPORARY}foreign").mkdir()
        os.chown(tmp_path / f"{TEMPORARY}foreign", 12345, 12345)
    (tmp_path / "twodof").mkdir()
    stay = set(tmp_path.iterdir())
    with waiting_run(native_path, tmp_path) as killed, waiting_run(native_path, tmp_path) as alive:
        (left, held) = set(tmp_path.iterdir()) - stay
        (left / "link").symlink_to(others)
        (others / "file").touch()
        killed.kill()
        killed.wait()
        twodof.simulate(native_path, stop_time=0.01)
        (kept,) = set(tmp_path.iterdir()) - stay
        assert kept in (left, held)
        assert stay < set(tmp_path.iterdir())
        assert (others / "file").exists()
        assert alive.communicate("") == ("1\n", None)
    assert set(tmp_path.iterdir()) == stay


def take_folders(parent, count):
    for _ in range(count):
        with temporary_folder(parent) as folder:
            (folder / "file").write_text("mine")
            assert (folder / "file").read_text() == "mine"


def test_runs_that_start_at_once_leave_each_others_folders_alone(tmp_path):
    with ProcessPoolExecutor(4) as pool:
        for done in [pool.submit(take_folders, tmp_path, 200) for _ in range(4)]:
            done.result()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_could_not_be_locked_is_never_taken_for_abandoned(tmp_path, monkeypatch):
    def fail(descriptor, operation):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    with monkeypatch.context() as patch:
        patch.setattr("fcntl.flock", fail)
        held = temporary_folder(tmp_path)
        folder = held.__enter__()
    with temporary_folder(tmp_path):
        assert folder.exists()
    held.__exit__(None, None, None)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_for_temporary_files_is_named(monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: ["/nowhere"])
    with pytest.raises(OSError, match=r"'/nowhere'.*; name one in TMPDIR"):
        temporary_folder().__enter__()


@pytest.mark.parametrize("name", ["é", "100%41"])
def test_a_temporary_folder_that_the_wrapper_cannot_read_is_refused(name, fmu_path, tmp_path, monkeypatch):
    (tmp_path / name).mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / name))
    with pytest.raises(FmuError, match="set TMPDIR to a folder with a plain name"):
        next(twodof.samples(fmu_path))
