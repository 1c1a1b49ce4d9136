"""A bag while it is written: location, early ends, memory and disk."""

import fcntl
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from itertools import count
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np
import pytest
from bags import (
    PERIOD,
    SECOND,
    START,
    assert_consistent,
    both_storages,
    joint_state,
    read_with_rosbags,
    read_with_sqlite3,
    sample,
)
from harness import python, wait_until
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from ruamel.yaml import YAML
from tools import needs

import twodof
from twodof.bag.storage import BagWriter
from twodof.errors import BagError, BuildError
from twodof.files import is_being_written
from twodof.ros.messages import LATCHED, STREAM, store_of
from twodof.simulation.experiments import Experiment

MIB = 1024**2
HERE = Path(__file__).parent


# --- where it may be written ---


@pytest.mark.parametrize("moment", ["rename", "open", "add_connection"])
def test_one_of_two_simultaneous_overwrites_is_refused(run, tmp_path, moment, monkeypatch):
    """The second starts just before the first renames the old bag, opens its own, or adds a topic."""
    path = tmp_path / "bag"
    with twodof.Bag(path).begin(run):
        pass
    first, second = (twodof.Bag(path, overwrite=True).begin(run) for _ in range(2))
    place, name = (Path, "rename") if moment == "rename" else (BagWriter, moment)
    original, begun = getattr(place, name), []

    def begin(bag: twodof.Bag) -> None:
        with suppress(BagError):
            begun.append(bag.__enter__())

    def intruded(*arguments: Any, **named: Any) -> Any:
        monkeypatch.setattr(place, name, original)
        begin(second)
        return original(*arguments, **named)

    monkeypatch.setattr(place, name, intruded)
    begin(first)
    (winner,) = begun
    for k in range(3):
        winner.write(sample(run, k))
    winner.__exit__(None, None, None)
    assert assert_consistent(path, "mcap") == 3


def written(run: Experiment, path: Path, samples: int, *, overwrite: bool = False) -> None:
    with twodof.Bag(path, overwrite=overwrite).begin(run) as bag:
        for k in range(samples):
            bag.write(sample(run, k))


def overwrite(run: Experiment, path: Path, moment: int) -> None:
    """Overwrite a bag, and kill the process at a change of a folder, by number."""
    moments = count(1)

    def killed(change: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        if next(moments) == moment:
            os.kill(os.getpid(), signal.SIGKILL)
        return change(*arguments, **named)

    for name in ("mkdir", "rename", "unlink", "rmdir"):
        setattr(os, name, partial(killed, getattr(os, name)))
    written(run, path, 2, overwrite=True)


def test_a_run_killed_at_any_moment_leaves_the_old_bag_or_samples_of_the_new_one(run, tmp_path):
    """It is killed at each change of a folder; between two changes nothing differs."""
    path, left, seen = tmp_path / "bag", dict[str, int](), set[tuple[str, int]]()
    written(run, path, 5)
    keep = shutil.copytree(path, tmp_path / "keep")
    for moment in count(1):
        process = multiprocessing.get_context("fork").Process(target=overwrite, args=(run, path, moment))
        process.start()
        process.join()
        left.clear()
        for bag in tmp_path.glob("bag*"):
            with suppress(BagError):
                left[bag.name] = twodof.recover(bag).counts["/joint_states"]
        assert left.get("bag") in (1, 2, 5) or left["bag.replaced"] == 5, f"after a kill at change {moment}: {left}"
        seen |= left.items()
        for bag in tmp_path.glob("bag*"):
            shutil.rmtree(bag)
        if process.exitcode == 0:
            break
        assert process.exitcode == -signal.SIGKILL
        shutil.copytree(keep, path)
    assert seen >= {("bag", 5), ("bag.replaced", 5), ("bag", 2)}
    assert not any(file for folder in tmp_path.iterdir() if folder != keep for file in folder.iterdir())


@pytest.mark.parametrize("name", [".", "../bag", "../../other/bag"])
def test_a_bag_with_the_working_directory_in_it_is_not_overwritten(run, tmp_path, monkeypatch, name):
    path = tmp_path / "other" / "bag"
    written(run, path, 5)
    monkeypatch.chdir(path)
    with pytest.raises(BagError, match="has the working directory in it"):
        twodof.Bag(name, overwrite=True)
    assert [*path.parent.iterdir()] == [path] and assert_consistent(path, "mcap") == 5


@pytest.mark.parametrize("name", ["bag/../bag", "./bag/", "bag/."])
def test_a_bag_is_overwritten_by_any_of_its_paths(run, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    written(run, Path("bag"), 5)
    written(run, Path(name), 3, overwrite=True)
    assert [*tmp_path.iterdir()] == [tmp_path / "bag"] and assert_consistent(tmp_path / "bag", "mcap") == 3


def test_a_run_that_fails_before_its_first_sample_restores_the_bag_that_it_would_replace(run, tmp_path):
    path = tmp_path / "bag"
    written(run, path, 5)
    with pytest.raises(ZeroDivisionError), twodof.Bag(path, overwrite=True).begin(run):
        raise ZeroDivisionError
    assert [*tmp_path.iterdir()] == [path] and assert_consistent(path, "mcap") == 5


def test_a_run_that_is_interrupted_before_its_first_sample_keeps_the_bag_that_it_would_replace(run, tmp_path):
    path = tmp_path / "bag"
    written(run, path, 5)
    with pytest.raises(KeyboardInterrupt), twodof.Bag(path, overwrite=True).begin(run):
        raise KeyboardInterrupt
    assert len(twodof.read_bag(tmp_path / "bag.replaced").t) == 5 and assert_consistent(path, "mcap") == 0


def test_a_bag_that_a_killed_run_has_renamed_is_named_and_later_removed(run, tmp_path):
    path = tmp_path / "bag"
    written(run, path, 5)
    path.rename(tmp_path / "bag.replaced")
    with pytest.raises(BagError, match=r"no bag '.*bag'; did you mean '.*bag.replaced'"):
        twodof.read_bag(path)
    for size in (2, 3):
        written(run, path, size, overwrite=True)
        assert assert_consistent(path, "mcap") == size
    assert [*tmp_path.iterdir()] == [path]
    notes = tmp_path / "bag.replaced" / "notes.txt"
    notes.parent.mkdir()
    notes.touch()
    with pytest.raises(BagError, match=r"bag.replaced' is not a bag and is not overwritten"):
        written(run, path, 5, overwrite=True)
    assert notes.exists() and assert_consistent(path, "mcap") == 3


def test_a_bag_is_locked_while_another_process_checks_its_lock(run, tmp_path, monkeypatch):
    opened = BagWriter.open

    def looked_at(writer: BagWriter) -> None:
        opened(writer)
        folder = os.open(writer.path, os.O_RDONLY)
        fcntl.flock(folder, fcntl.LOCK_SH)
        Timer(0.2, os.close, [folder]).start()

    monkeypatch.setattr(BagWriter, "open", looked_at)
    with twodof.Bag(tmp_path / "bag").begin(run) as bag:
        assert is_being_written(bag.path)


@pytest.mark.parametrize(
    "files",
    [
        {},
        {"notes.txt": "precious"},
        {"run.json": '{"learning_rate": 0.1}', "notes.txt": "precious"},
        {"metadata.yaml": "title: precious\n", "notes.txt": "precious"},
    ],
    ids=["empty", "other files", "another run.json", "another metadata.yaml"],
)
def test_a_path_that_is_not_a_bag_is_never_overwritten(tmp_path, files):
    """It is a folder, or a file."""
    path = tmp_path / "folder"
    path.mkdir()
    for name, text in files.items():
        (path / name).write_text(text)
    for place in (path, *path.iterdir()):
        with pytest.raises(BagError, match="not a bag"):
            twodof.Bag(place, overwrite=True)
    assert {file.name: file.read_text() for file in path.iterdir()} == files


@pytest.mark.parametrize("overwrite", [False, True])
def test_folder_that_appears_before_the_first_sample_is_kept(run, tmp_path, overwrite):
    path = tmp_path / "bag"
    bag = twodof.Bag(path, overwrite=overwrite).begin(run)
    path.mkdir()
    (path / "notes.txt").write_text("precious")
    with pytest.raises(BagError, match="bag"), bag:
        pass
    assert [file.name for file in path.iterdir()] == ["notes.txt"]


@both_storages
def test_a_link_stays_and_its_target_is_written(run, tmp_path, storage):
    """The bag is new, or replaces another."""
    link, path = tmp_path / "link", tmp_path / "far" / "bag"
    path.parent.mkdir()
    link.symlink_to("far/bag")
    for size in (1, 2):
        with twodof.Bag(link, storage=storage, overwrite=size == 2).begin(run) as bag:
            for k in range(size):
                bag.write(sample(run, k))
        assert assert_consistent(path, storage) == size
    with pytest.raises(BagError, match="exists already"):
        twodof.Bag(link)
    assert link.is_symlink() and sorted(file.name for file in tmp_path.iterdir()) == ["far", "link"]


def test_a_folder_whose_metadata_are_a_link_is_not_overwritten(run, tmp_path):
    with twodof.Bag(tmp_path / "bag").begin(run):
        pass
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "metadata.yaml").symlink_to(tmp_path / "bag" / "metadata.yaml")
    with pytest.raises(BagError, match="not a bag"):
        twodof.Bag(tmp_path / "folder", overwrite=True)


@both_storages
@pytest.mark.parametrize("place", ["below a file", "read-only", "long"])
def test_folder_that_cannot_be_written_is_refused(run, tmp_path, disk, storage, place):
    if place == "below a file":
        (tmp_path / "file").write_text("precious")
        path = tmp_path / "file" / "bag"
    elif place == "read-only":
        path = disk(4096, "ro") / "bag"
    else:
        path = tmp_path / ("x" * 300)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(BagError, match=re.escape(str(path))), twodof.Bag(path, storage=storage).begin(run):
        pass
    assert sorted(tmp_path.rglob("*")) == before


# --- runs that end early ---


@both_storages
@pytest.mark.parametrize(("error", "n"), [(RuntimeError, 1), (KeyboardInterrupt, 137)])
def test_exception_leaves_a_bag_with_every_sample_so_far(run, tmp_path, storage, error, n):
    path = tmp_path / "bag"
    bag = twodof.Bag(path, storage=storage).begin(run)
    with pytest.raises(error, match="enough"), bag:
        for k in range(n):
            bag.write(sample(run, k))
        raise error("enough")
    assert assert_consistent(path, storage) == n
    assert read_with_rosbags(path) == [joint_state(k, sample(run, k)) for k in range(n)]


@both_storages
def test_a_run_that_fails_before_its_first_sample_leaves_no_bag(run, tmp_path, storage):
    with pytest.raises(BuildError, match="enough"), twodof.Bag(tmp_path / "bag", storage=storage).begin(run):
        raise BuildError("enough")
    assert not (tmp_path / "bag").exists()


def fill(bag: twodof.Bag, run: Experiment) -> tuple[str, int]:
    """Write until the disk is full; return the error and the number of written samples."""
    taken = 0
    with pytest.raises(BagError) as caught, bag.begin(run):
        for k in range(200_000):
            bag.write(sample(run, k))
            taken += 1
    return str(caught.value), taken


@both_storages
@pytest.mark.parametrize("size", [2252, 3072])  # KiB: 2.2 and 3 MiB
def test_full_disk_ends_in_a_closed_bag_with_every_sample(run, disk, storage, size):
    path = disk(size) / "bag"
    said, taken = fill(twodof.Bag(path, storage=storage), run)
    assert "disk is full" in said
    kept = assert_consistent(path, storage)
    assert taken - 1 <= kept <= taken  # one may be handed over while the bag is being closed
    assert f"closed with its first {kept} samples" in said
    assert read_with_rosbags(path) == [joint_state(k, sample(run, k)) for k in range(kept)]


@both_storages
def test_disk_too_small_to_begin_with_is_left_as_it_was(run, disk, storage):
    refused = 0
    for size in (4, 16, 512, *range(2048, 2128, 8)):
        path = disk(size) / "bag"
        try:
            with twodof.Bag(path, storage=storage).begin(run):
                pass
        except BagError as error:
            refused += 1
            assert re.search(r"full|No space", str(error))
            assert not path.exists()
        else:
            assert_consistent(path, storage)
    assert refused > 1


@both_storages
def test_reserve_is_room_to_close_a_run_that_was_never_flushed(run, disk, monkeypatch, storage):
    monkeypatch.setattr("twodof.bag.store.FLUSH_PERIOD", 1e6)
    path = disk(2140) / "bag"  # 92 KiB beside the reserve; the messages take 140
    with twodof.Bag(path, storage=storage).begin(run) as bag:
        for k in range(1000):
            bag.write(sample(run, k))
    assert assert_consistent(path, storage) == 1000


# --- long runs ---


@both_storages
def test_messages_reach_the_disk_during_a_long_step(run, tmp_path, storage):
    """They are fewer than fill a buffer, and no more arrive."""
    with twodof.Bag(tmp_path / "bag", storage=storage).begin(run) as bag:
        for k in range(50):
            bag.write(sample(run, k))
        stamps = [START * SECOND + k * PERIOD for k in range(50)]
        wait_until(lambda: [*stored(bag.path, storage)] == stamps)
        shutil.copytree(bag.path, tmp_path / "copy/bag")
    twodof.recover(tmp_path / "copy/bag")
    assert assert_consistent(tmp_path / "copy/bag", storage) == 50


def stored(bag: Path, storage: str) -> Iterator[int]:
    """Log times of the messages of a bag that is being written."""
    if storage == "sqlite3":
        yield from (state.log_time for state in read_with_sqlite3(bag))
        return
    with suppress(EndOfFile), (bag / f"{bag.name}.mcap").open("rb") as content:
        for record in StreamReader(content).records:
            if isinstance(record, McapMessage):
                yield record.log_time


MEMORY = """
import sys
import twodof
from sinks import Memory
from twodof.simulation.sample import Sample

fmu, path, storage = sys.argv[1:]
run = twodof.experiment(fmu)
inputs = {n: v for n, v in run.start_values.items() if run.fmu.variables[n].causality == "input"}
memory = Memory(1000)
with twodof.Bag(path, storage=storage).begin(run) as bag:
    for k in range(20_000):
        numbers = (0.1, 0.2), (0.3, 0.4), (0.5, 0.6), (0.7, 0.8)
        sample = Sample(k, run.time(k), *numbers, inputs, 0.0, k * 10_000_000)
        bag.write(sample)
        memory.write(sample)
print(memory.growth)
"""


@pytest.mark.needs("linux")
@both_storages
def test_memory_does_not_grow_with_the_run(native_path, tmp_path, storage):
    done = python("-c", MEMORY, native_path, tmp_path / "bag", storage, cwd=HERE, check=True)
    assert int(done.stdout) < 5 * MIB
    assert assert_consistent(tmp_path / "bag", storage) == 20_000


@both_storages
def test_fsync_waits_for_the_disk_at_each_flush(run, tmp_path, storage):
    """It shows in the process's system calls."""
    script = """
import sys
import twodof
from twodof.simulation.sample import Sample
fmu, path, storage, fsync = sys.argv[1:]
run = twodof.experiment(fmu)
inputs = dict(run.start_values)
with twodof.Bag(path, storage=storage, fsync=fsync == "True").begin(run) as bag:
    bag.write(Sample(0, 0.0, (0.1, 0.2), (0.3, 0.4), (0.5, 0.6), (0.7, 0.8), inputs, 0.0, 0))
    open(path + "-stored", "w").close()
"""
    trace = needs("strace")
    synced = {}
    for fsync in (False, True):
        bag = tmp_path / f"bag{fsync}"
        log = tmp_path / f"log{fsync}"
        traced = [trace, "-f", "-y", "-e", "trace=fsync,fdatasync,openat", "-o", str(log)]
        arguments = [str(run.fmu.path), str(bag), storage, str(fsync)]
        subprocess.run([*traced, sys.executable, "-c", script, *arguments], check=True)
        # between the bag's creation, whose last file is the reserve, and the first sample
        written = log.read_text().partition("-stored")[0].rpartition("/reserve")[2]
        synced[fsync] = set(re.findall(r"f(?:data)?sync\(\d+<(.*?)>", written))
    file = tmp_path / "bagTrue" / f"bagTrue.{'mcap' if storage == 'mcap' else 'db3'}"
    wanted = {file, file.parent, tmp_path, file.parent / "run.json"}
    assert {str(path) for path in wanted} <= synced[True]
    assert synced[False] == set()


def test_a_run_killed_twice_before_its_first_sample_leaves_the_old_bag(run, tmp_path):
    path = tmp_path / "bag"
    written(run, path, 5)
    killed = (
        "import os, sys, twodof\nrun = twodof.experiment(sys.argv[1])\n"
        "with twodof.Bag(sys.argv[2], overwrite=True).begin(run): os.kill(os.getpid(), 9)"
    )
    for _ in range(2):
        assert python("-c", killed, run.fmu.path, path, cwd=HERE).returncode == -9
    assert len(twodof.read_bag(tmp_path / "bag.replaced").t) == 5
    written(run, path, 3, overwrite=True)
    assert [*tmp_path.iterdir()] == [path] and assert_consistent(path, "mcap") == 3


ODD = "a \x85 b\u2028c\n\t\x7f \x1b 'quoted' \"twice\" back\\slash é 😀: - # {x}\r\n"


def closed(path: Path) -> str:
    """Write a bag with several profiles, and texts that are difficult in YAML; return its metadata."""
    writer = BagWriter(path, "mcap")
    writer.open()
    for k, profiles in enumerate(([], [STREAM], [STREAM, LATCHED])):
        number = writer.add_connection(
            f"/té{k}", "std_msgs/msg/String", typestore=store_of("std_msgs/msg/String"), offered_qos_profiles=profiles
        ).id
    writer.write_all(np.array([5, 7]), {number: np.zeros((2, 9), np.uint8)})
    for key in ("twodof", "twodof/left arm", "null"):
        writer.set_custom_data(f"{key}", ODD)
    writer.close()
    return (path / "metadata.yaml").read_text("utf-8")


def test_metadata_are_those_that_rosbags_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are read by YAML 1.2 and by YAML 1.1, which yaml-cpp and PyYAML have."""
    own = closed(tmp_path / "own" / "bag")
    monkeypatch.delattr(BagWriter, "close")
    theirs = closed(tmp_path / "theirs" / "bag")
    assert own.isascii() and own != theirs
    old = YAML(typ="safe", pure=True)
    old.version = (1, 1)
    assert YAML(typ="safe").load(own) == YAML(typ="safe").load(theirs) == old.load(own)
    for name in ("own", "theirs"):
        with (tmp_path / name / "bag/bag.mcap").open("rb") as file:
            (record,) = make_reader(file).iter_metadata()
        stored = YAML(typ="safe").load(record.metadata["serialized_metadata"])
        assert {"rosbag2_bagfile_information": stored} == YAML(typ="safe").load(own)
