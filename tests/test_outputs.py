"""Output files are written completely or not at all, through links, with the mode of the umask."""

import io
import os
import shutil
import stat
import subprocess
import sys
import zipfile
from pathlib import Path
from threading import Thread

import pytest
from harness import python

import twodof
from twodof.cli.main import main
from twodof.errors import BagError, InputError
from twodof.files import free_name, head_of, write_file
from twodof.pages.arm import is_page

OLD, NEW = b"old", b"new" * 100_000


@pytest.fixture
def umask():
    """Set the umask for a test."""
    before = os.umask(0o022)
    yield os.umask
    os.umask(before)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_link_stays_and_its_target_is_replaced(tmp_path):
    folder, other = tmp_path / "a", tmp_path / "b"
    folder.mkdir()
    other.mkdir()
    target, near, far = other / "file", folder / "near", folder / "far"
    target.write_bytes(OLD)
    near.symlink_to("../b/file")
    far.symlink_to("near")
    held = target.open("rb")
    write_file(far, NEW)
    assert far.is_symlink() and near.is_symlink() and not target.is_symlink()
    assert target.read_bytes() == NEW
    assert held.read() == OLD  # replaced, and not written over, which a reader would see half
    target.unlink()
    write_file(near, OLD)
    assert target.read_bytes() == OLD and near.is_symlink()
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["a", "b", "far", "file", "near"]


@pytest.mark.needs("root")
@pytest.mark.parametrize("write", [lambda path: write_file(path, NEW), lambda path: twodof.Bag(path, overwrite=True)])
@pytest.mark.parametrize(("mode", "owner"), [(0o1777, 2), (0o1777, 1), (0o1777, 0), (0o1755, 2), (0o777, 2)])
def test_a_link_of_another_user_in_a_shared_folder_is_not_followed(mode, owner, write, tmp_path, monkeypatch):
    """The rule is that of Linux's fs.protected_symlinks; user 1 runs, root owns the folder."""
    (folder := tmp_path / "shared").mkdir()
    planted, near, target = folder / "planted", tmp_path / "near", tmp_path / "absent"
    planted.symlink_to(target)
    near.symlink_to(planted)
    os.lchown(planted, owner, owner)
    folder.chmod(mode)
    monkeypatch.setattr(os, "geteuid", lambda: 1)
    for path in (planted, near):
        if (mode, owner) != (0o1777, 2):
            write(path)
            continue
        with pytest.raises((PermissionError, BagError), match="link of another user in a shared folder"):
            write(path)
        assert not target.exists()


def test_a_link_to_itself_is_no_file(tmp_path):
    link = tmp_path / "link"
    link.symlink_to("link")
    with pytest.raises(OSError, match="symbolic links"):
        write_file(link, NEW)
    assert link.is_symlink()


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002, 0o027])
def test_modes_are_those_of_the_umask(mask, umask, tmp_path, native_path):
    """All files that verbs write have the mode of a shell's redirection."""
    umask(mask)
    shutil.copyfile(native_path, tmp_path / "a.fmu")
    twodof.simulate(tmp_path / "a.fmu", twodof.Bag(tmp_path / "bag"), stop_time=0.05)
    for command in (
        ["build", "-o", "b.fmu"],
        ["page", "a.fmu", "-o", "c.html"],
        ["plot", "bag", "-o", "d.png"],
        ["plot", "bag", "-o", "e.html"],
        ["view", "bag", "--export", "f.html"],
        ["layouts", "a.fmu", "-o", "g"],
    ):
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(tmp_path)
            assert main(command) == 0
    modes = {path: mode(path) for path in tmp_path.rglob("*")}
    assert len(modes) > 12
    assert modes.pop(tmp_path / "bag") == 0o755 & ~mask  # made by rosbags
    assert modes == {p: (0o777 if p.is_dir() else 0o666) & ~mask for p in modes}


def test_a_file_that_is_replaced_keeps_its_mode(umask, tmp_path):
    """A private file must not become readable for all."""
    umask(0o022)
    path = tmp_path / "file"
    for kept in (0o600, 0o664, 0o444):
        path.write_bytes(OLD)
        path.chmod(kept)
        write_file(path, NEW)
        assert (mode(path), path.read_bytes()) == (kept, NEW)
        path.chmod(0o600)


@pytest.mark.needs("root")
def test_a_file_of_another_user_does_not_give_its_mode(umask, tmp_path):
    """Otherwise this user could write into the new file."""
    umask(0o077)
    path = tmp_path / "file"
    path.write_bytes(OLD)
    path.chmod(0o666)
    os.chown(path, 65534, 65534)
    write_file(path, NEW)
    assert (mode(path), path.stat().st_uid) == (0o600, os.geteuid())


def test_pipes_and_devices_are_written_to(tmp_path):
    pipe, link, null = tmp_path / "pipe", tmp_path / "link", tmp_path / "null"
    os.mkfifo(pipe)
    link.symlink_to("pipe")
    null.symlink_to(os.devnull)
    before = os.stat(os.devnull)
    for path in (pipe, link):
        writer = Thread(target=write_file, args=(path, NEW))
        writer.start()
        with pipe.open("rb") as reader:
            assert reader.read() == NEW
        writer.join()
    write_file(null, NEW)
    assert pipe.is_fifo() and link.is_symlink() and os.path.samestat(before, os.stat(os.devnull))
    with pytest.raises(OSError, match="No space"):
        write_file(Path("/dev/full"), NEW)
    with pytest.raises(IsADirectoryError):
        write_file(tmp_path, NEW)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "null", "pipe"]


def test_a_disk_that_is_full_leaves_the_old_file(disk):
    path = disk(128) / "file"
    path.write_bytes(OLD)
    with pytest.raises(OSError, match="No space"):
        write_file(path, NEW)
    assert path.read_bytes() == OLD and [*path.parent.iterdir()] == [path]


def test_a_folder_for_temporary_files_that_is_full_is_named(disk, native_path, tmp_path):
    full = disk(200)
    (full / "fill").write_bytes(bytes(190 * 1024))
    command = [sys.executable, "-m", "twodof", "page", str(native_path), "-o", str(tmp_path / "arm.html")]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "TMPDIR": str(full)}, check=False)
    assert (done.returncode, done.stderr) == (1, f"twodof: error: '{full}': No space left on device\n")
    assert not (tmp_path / "arm.html").exists()


@pytest.mark.parametrize("verb", ["run", "sweep", "layouts", "fit robot.urdf bag"])
def test_a_folder_is_no_standard_output(verb, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, words in (("-", "it is a folder"), ("", "it is empty")):
        with pytest.raises(SystemExit):
            main([*verb.split(), "-o", name])
        assert words in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


@pytest.fixture(scope="module")
def bag(tmp_path_factory, native_path):
    folder = tmp_path_factory.mktemp("outputs")
    twodof.simulate(native_path, twodof.Bag(folder / "bag"), stop_time=0.05)
    return folder / "bag"


def twodof_to(output: int | io.BufferedRandom, *arguments: object) -> bytes:
    """Return the standard output of a command that prints facts on standard error."""
    command = [sys.executable, "-m", "twodof", *map(str, arguments)]
    done = subprocess.run(command, stdout=output, stderr=subprocess.PIPE, check=True)
    assert done.stderr.splitlines()
    return done.stdout or b""


@pytest.mark.parametrize("name", ["-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1", "link"])
def test_a_page_goes_to_the_standard_output(name, bag, tmp_path):
    """A command as root once replaced /dev/stdout. Facts go to stderr, and not into the page."""
    before = os.readlink("/dev/stdout")
    if name == "link":
        (tmp_path / "link").symlink_to("/dev/stdout")
        name = str(tmp_path / "link")
    page = twodof_to(subprocess.PIPE, "view", bag, "--export", name)
    assert page.startswith(b"<!DOCTYPE html>") and page.endswith(b"</html>\n")
    with (tmp_path / "file").open("w+b") as file:
        file.write(b"before")
        file.flush()
        twodof_to(file, "view", bag, "--export", name)
        file.seek(0)
        assert file.read() == b"before" + page
    assert os.readlink("/dev/stdout") == before


def test_a_figure_a_page_and_an_fmu_go_to_the_standard_output(bag, native_path, tmp_path):
    assert twodof_to(subprocess.PIPE, "plot", bag, "-o", "-").startswith(b"\x89PNG")
    page = twodof_to(subprocess.PIPE, "page", native_path, "-o", "-")
    assert page.startswith(b"<!DOCTYPE html>") and page.endswith(b"</html>\n")
    fmu = tmp_path / "x.fmu"
    with fmu.open("w+b") as file:
        twodof_to(file, "build", "-o", "/dev/stdout")
    piped = subprocess.run([sys.executable, "-m", "twodof", "build", "-o", "-"], capture_output=True, check=True)
    assert zipfile.ZipFile(fmu).testzip() is None and fmu.read_bytes() == piped.stdout
    assert twodof.load_fmu(fmu).joints == ("joint1", "joint2")


@pytest.mark.parametrize("make", [os.mkfifo, lambda file: file.symlink_to("/dev/zero")])
def test_a_pipe_or_a_device_with_the_name_of_an_output_is_not_read(make, tmp_path):
    make(tmp_path / "x.png")
    assert head_of(tmp_path / "x.png", 100) == b""
    assert free_name(str(tmp_path / "x"), ".png", is_page) == tmp_path / "x-2.png"


def test_the_next_writer_removes_the_file_of_a_killed_one(tmp_path):
    program = (
        "import os, pathlib, twodof.files as files\n"
        "content = (os.kill(os.getpid(), 9) if k else b'1' for k in range(2))\n"
        "files.write_file(pathlib.Path('new.csv'), content)"
    )
    assert python("-c", program, cwd=tmp_path).returncode == -9
    assert len([*tmp_path.iterdir()]) == 1
    write_file(tmp_path / "new.csv", b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["new.csv"]


@pytest.mark.parametrize("there", [False, True])
def test_a_name_that_is_not_given_is_not_written_through_a_link(there, native_path, tmp_path, monkeypatch, capsys):
    """A folder from elsewhere may have links to any file, by the names that commands choose."""
    monkeypatch.chdir(tmp_path)
    names, away, motions = ("TwoDof.fmu", f"{native_path.stem}.rviz", "excite.csv"), tmp_path / "away", []

    def excite(*_, output, **__):
        motions.append(output)
        raise InputError("the design of a motion takes seconds")

    monkeypatch.setattr("twodof.identification.excitation.excite", excite)
    for name in names:
        Path(name).symlink_to(away)
    if there:
        away.write_bytes(OLD)
    assert main(["build", *["--overwrite"] * there]) == 1
    assert main(["layouts", str(native_path), *["--overwrite"] * there]) == 1
    assert main(["fit", "robot.urdf", "--design", "5", "--free", "friction[1]"]) == 1
    assert capsys.readouterr().err.count("It is a link, and only outputs that you name are written through links") == 2
    assert all(Path(name).is_symlink() for name in names) and motions == [Path("excite-2.csv")]
    assert (away.read_bytes() if there else away.exists()) == (OLD if there else False)
