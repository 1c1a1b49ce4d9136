"""Links in an untrusted bag, which could make a command read or copy any file of this machine."""

import json
import os
import shutil
from pathlib import Path

import pytest

import twodof
from twodof.cli.main import main
from twodof.errors import BagError

SIZE = 300 * 1024**2  # bytes, more than a robot's meshes may have
SECRET = "a word that must not get out"


@pytest.fixture(scope="module", params=["mcap", "sqlite3"])
def bag(request, tmp_path_factory, native_path):
    folder = tmp_path_factory.mktemp("links")
    sink = twodof.Bag(folder / "bag", storage=request.param)
    twodof.simulate(native_path, sink, stop_time=0.1)
    return folder / "bag"


@pytest.fixture
def linked(bag, tmp_path):
    """A copy of a bag whose writer died, next to a folder of private files."""
    copy = tmp_path / "bag"
    shutil.copytree(bag, copy)
    (copy / "metadata.yaml").unlink()
    (tmp_path / "private").mkdir()
    return copy


def move_out(file: Path) -> Path:
    """Move a bag's file to the private folder, and replace it by a link."""
    target = file.parent.parent / "private" / file.name
    file.rename(target)
    file.symlink_to(target)
    return target


@pytest.mark.parametrize("kind", ["link", "chain", "name"])
def test_a_linked_provenance_is_not_copied(kind, linked):
    """The messages are saved without it."""
    target = move_out(linked / "run.json")
    content = json.loads(target.read_text())
    target.write_text(json.dumps({**content, "command_line": SECRET}))
    if kind == "chain":
        (linked / "run.json").rename(linked / "other")
        (linked / "run.json").symlink_to("other")
    if kind == "name":
        (linked / "run.json").rename(linked / "run.left.json")
    assert main(["info", str(linked)]) == 1
    recovered = twodof.recover(linked)
    assert recovered.counts == {"/joint_states": 11}
    files = [path for path in linked.iterdir() if not path.is_symlink()]
    assert len(files) == 2 and len([*linked.iterdir()]) == 2
    assert not any(SECRET.encode() in path.read_bytes() for path in files)
    assert twodof.read_bag(linked).q.shape == (11, 2)


def test_linked_messages_are_refused(linked, capsys):
    (file,) = (path for path in linked.iterdir() if path.suffix in (".mcap", ".db3"))
    target = move_out(file)
    before = target.read_bytes()
    for command in ("info", "plot", "view", "recover"):
        more = ["--export", "x.html"] if command == "view" else []
        assert main([command, str(linked), *more]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert f"'{file}' is a link, and links in a bag are not followed" in line
    with pytest.raises(BagError, match="not followed"):
        twodof.read_bag(linked)
    assert target.read_bytes() == before
    assert sorted(path.name for path in linked.parent.iterdir()) == ["bag", "private"]


def test_a_pipe_in_the_place_of_messages_is_refused(linked, capsys):
    (file,) = (path for path in linked.iterdir() if path.suffix in (".mcap", ".db3"))
    file.unlink()
    os.mkfifo(file)
    for command in ("info", "recover"):
        assert main([command, str(linked)]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line == f"twodof: error: '{file}' is not a regular file; remove it from the bag"


def test_more_provenances_and_meshes_than_a_bag_has_are_left_out(linked):
    """Each file is flushed to the disk, which takes milliseconds."""
    (linked / "run.json").unlink()
    (linked / "r0000").mkdir()
    for i in range(1001):
        (linked / f"run.r{i:04}.json").write_bytes(b"{}")
    for i in range(50_001):
        (linked / f"r0000/{i}").touch()
    recovered = twodof.recover(linked)
    assert recovered.counts == {"/joint_states": 11}
    assert recovered.damage == (
        "run.*.json files of more than 1000 robots; meshes in 'r0000', because there are more than 50000 files"
    )
    assert len([*linked.iterdir()]) == 1002


def test_a_pipe_among_the_meshes_is_refused(linked, capsys):
    (linked / "meshes").mkdir(exist_ok=True)
    for name in ("one", "two"):
        os.mkfifo(linked / "meshes" / name)
    assert main(["recover", str(linked)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    start, end = f"twodof: error: cannot recover the bag '{linked}': ", " is a named pipe; nothing is lost"
    assert line in [f"{start}`{linked}/meshes/{name}`{end}" for name in ("one", "two")]


def test_a_bag_that_the_user_names_by_a_link_is_read(linked):
    twodof.recover(linked)
    (linked.parent / "name").symlink_to(linked)
    assert twodof.read_bag(linked.parent / "name").q.shape == (11, 2)
    for file in linked.glob("*.mcap"):
        (linked.parent / "single.mcap").symlink_to(file)
        assert twodof.read_bag(linked.parent / "single.mcap").q.shape == (11, 2)


def test_linked_metadata_is_not_read(linked):
    """Its number of messages decides whether a bag is complete."""
    text = "rosbag2_bagfile_information:\n  message_count: 11\n"
    (linked.parent / "private/x").write_text(text)
    (linked / "metadata.yaml").symlink_to(linked.parent / "private/x")
    recovered = twodof.recover(linked)
    assert recovered.original is not None
    assert not (linked / "metadata.yaml").is_symlink()


def test_meshes_without_end_are_not_copied(linked):
    """A sparse file of zeros takes no space on the disk until it is copied."""
    (linked / "meshes").mkdir()
    with (linked / "meshes/x.stl").open("wb") as file:
        file.truncate(SIZE)
    recovered = twodof.recover(linked)
    assert recovered.damage == f"meshes of {SIZE} bytes in 'meshes'"
    assert recovered.counts == {"/joint_states": 11}
    assert not (linked / "meshes").exists()


def test_meshes_in_hundreds_of_nested_folders_are_refused(linked, monkeypatch):
    (linked / "meshes").mkdir()
    monkeypatch.chdir(linked / "meshes")
    for _ in range(700):
        os.mkdir("a")
        os.chdir("a")
    with pytest.raises(BagError, match=r"folders that are nested too deeply; move them out of the bag"):
        twodof.recover(linked)
    assert {file.name for file in linked.parent.iterdir()} == {"bag", "private"}


@pytest.mark.parametrize("name", ["bag", "bag-wal", "bag-journal"])
def test_a_file_of_zeros_without_blocks_is_neither_read_nor_copied(name, linked):
    (file,) = (file for file in linked.iterdir() if file.suffix in (".mcap", ".db3"))
    sparse = file.with_name(name.replace("bag", file.name))
    with sparse.open("ab") as opened:
        opened.truncate(2**40)
    with pytest.raises(BagError, match=rf"'{sparse}' is damaged: of its {2**40} bytes only \d+ are on the disk"):
        twodof.recover(linked)


@pytest.mark.parametrize("name", ["%2E", "%2E%2E", "%2F", "a%2F%2E%2E"])
def test_names_of_robots_are_no_paths(name, linked):
    (linked / "run.json").rename(linked / f"run.{name}.json")
    assert twodof.recover(linked).counts == {"/joint_states": 11}
    assert [path.name for path in linked.iterdir() if path.suffix == ".json"] == []
