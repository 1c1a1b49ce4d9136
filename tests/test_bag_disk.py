"""Bags and the disk: read-only folders, foreign locks, and the order in which --fsync writes."""

import fcntl
import os
import shutil
import sqlite3
import subprocess
from contextlib import closing
from pathlib import Path

import pytest

import twodof
from twodof.errors import BagError


def test_an_unfinished_database_in_a_read_only_folder_is_read(native_path, tmp_path, disk):
    """Its writer's log is next to it."""
    bag, place = tmp_path / "bag", disk(8192)
    twodof.simulate(native_path, twodof.Bag(bag, storage="sqlite3"), stop_time=0.1)
    with closing(sqlite3.connect(bag / "bag.db3", isolation_level=None)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("DELETE FROM messages WHERE id > 5")
        shutil.copytree(bag, place / "bag")
    assert (place / "bag" / "bag.db3-wal").stat().st_size
    subprocess.run(["mount", "-o", "remount,ro", str(place)], check=True)
    assert len(twodof.read_bag(place / "bag").t) == 5


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_messages_are_on_the_disk_before_metadata_counts_them(native_path, tmp_path, monkeypatch, storage):
    told: list[tuple[str, int]] = []
    fsync, replace = os.fsync, Path.replace

    def synced(number: int) -> None:
        fsync(number)
        told.append((os.readlink(f"/proc/self/fd/{number}"), os.fstat(number).st_size))

    def replaced(path: Path, target: Path) -> Path:
        told.append((str(target), 0))
        return replace(path, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "replace", replaced)
    bag = tmp_path / "bag"
    twodof.simulate(native_path, twodof.Bag(bag, storage=storage, fsync=True), stop_time=0.1)
    (data,) = (path for path in bag.iterdir() if path.suffix in (".mcap", ".db3"))
    whole = told.index((str(data), data.stat().st_size))
    assert whole < told.index((str(bag / "metadata.yaml"), 0))


def test_the_wait_for_a_foreign_lock_is_bounded(native_path, tmp_path, monkeypatch):
    """Another program locks each new folder."""
    monkeypatch.setattr("twodof.files.LOCK_TIMEOUT", 0.1)
    mkdir, held = Path.mkdir, []

    def locked(path: Path, mode: int = 0o777, *, parents: bool = False, exist_ok: bool = False) -> None:
        mkdir(path, mode, parents, exist_ok)
        held.append(os.open(path, os.O_RDONLY))
        fcntl.flock(held[-1], fcntl.LOCK_EX)

    monkeypatch.setattr(Path, "mkdir", locked)
    with pytest.raises(BagError, match="another process writes it"):
        twodof.simulate(native_path, twodof.Bag(tmp_path / "bag"), stop_time=0.1)
    for number in held:
        os.close(number)
