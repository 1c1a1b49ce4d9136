"""Bags whose names are not plain text: read, or refused before they are written."""

import os
from pathlib import Path

import pytest
from bags import assert_consistent, content, sample, unfinished
from harness import python

import twodof
from twodof.errors import BagError


def renamed(bag: Path, name: bytes) -> Path:
    """A bag with this name in a folder of this name."""
    path = Path(os.fsdecode(os.fsencode(bag.parent) + b"/" + name + b"/" + name))
    path.parent.mkdir()
    bag.rename(path)
    for file in path.iterdir():
        if file.stem == bag.name:
            file.rename(file.with_name(path.name + file.suffix))
    return path


@pytest.mark.parametrize(
    ("storage", "name"),
    [("mcap", b"\xff"), ("mcap", b"a?b"), *[("sqlite3", name) for name in (b"\xff", b"a?b", b"a%41")]],
)
def test_a_bag_name_that_readers_cannot_open_is_refused(run, tmp_path, storage, name):
    bag = renamed(unfinished(tmp_path, run, storage, 10), name)
    before = content(tmp_path)
    if storage == "mcap" and name != b"\xff":
        twodof.recover(bag)
        assert assert_consistent(bag, storage) > 0
        return
    with pytest.raises(BagError, match=r"cannot have|UTF-8"):
        twodof.recover(bag)
    with pytest.raises(BagError, match=r"cannot have|UTF-8"):
        twodof.Bag(bag.with_name(f"{bag.name}2"), storage=storage)
    assert content(tmp_path) == before


@pytest.mark.parametrize("verb", ["info", "plot"])
def test_bag_of_a_name_that_is_not_utf8_is_read(run, tmp_path, verb):
    """The terminal accepts only UTF-8."""
    with twodof.Bag(tmp_path / "bag").begin(run) as sink:
        for k in range(3):
            sink.write(sample(run, k))
    bag = renamed(sink.path, b"\xff")
    options = ["-o", "x.svg"] if verb == "plot" else []
    terminal = {**os.environ, "PYTHONIOENCODING": "utf-8:strict"}
    done = python("-m", "twodof", verb, os.fsencode(bag), *options, cwd=tmp_path, env=terminal)
    assert (done.returncode, done.stderr) == (0, "")
