"""A confined child process can use the given files, and nothing else of the system."""

import ctypes
import errno
import os
import socket
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest

from twodof.children import Child, confine, limit_time

pytestmark = pytest.mark.needs("linux64")
MEMORY, SECONDS = 1024**3, 20


def attempt(pipe: Connection, folder: Path, name: str) -> None:
    """Try a function in the confined child; send the error number or the result."""
    confine(MEMORY, SECONDS, [folder])
    try:
        pipe.send(ATTEMPTS[name](folder))
    except OSError as error:
        pipe.send(errno.errorcode[error.errno or 0])
    except MemoryError:
        pipe.send("MemoryError")


def create(folder: Path) -> object:
    return os.open(folder / "new", os.O_CREAT | os.O_WRONLY)


def raw_call(number: int, *arguments: int) -> object:
    """Make a system call as injected code would, without the C library's functions."""
    libc = ctypes.CDLL(None, use_errno=True)
    status = libc.syscall(number, *arguments)
    if status < 0:
        raise OSError(ctypes.get_errno(), "")
    return status


ATTEMPTS: dict[str, Callable[[Path], object]] = {
    "read in the folder": lambda folder: (folder / "mesh").read_bytes(),
    "read beside it": lambda folder: (folder.parent / "secret").read_bytes(),
    "read through a link": lambda folder: (folder / "link").read_bytes(),
    "list beside it": lambda folder: os.listdir(folder.parent),
    "create": create,
    "write": lambda folder: os.open(folder / "mesh", os.O_RDWR),
    "truncate": lambda folder: os.truncate(folder / "mesh", 0),
    "remove": lambda folder: os.unlink(folder / "mesh"),
    "link": lambda folder: os.link(folder / "mesh", folder / "other"),
    "permit": lambda folder: os.chmod(folder / "mesh", 0o777),
    "connect": lambda folder: socket.socket(),
    "fork": lambda folder: os.fork(),
    "start a program": lambda folder: os.execv("/bin/true", ["true"]),
    "end its parent": lambda folder: raw_call(62, os.getppid(), 0),
    "read another process": lambda folder: raw_call(310, os.getppid(), 0, 0, 0, 0, 0),
    "signals to another process": lambda folder: raw_call(72, 1, 8, os.getppid()),
    "io_uring": lambda folder: raw_call(425, 1, 0),
    "limits of another process": lambda folder: raw_call(302, os.getppid(), 7, 0, 0),
    "take memory": lambda folder: len(np.ones(MEMORY // 8)),
}
ANSWERS = {
    "read in the folder": b"mesh",
    "read beside it": "EACCES",
    "read through a link": "EACCES",
    "list beside it": "EACCES",
    "take memory": "MemoryError",
}
"""EPERM from all others."""


@pytest.mark.parametrize("name", ATTEMPTS)
def test_a_confined_child_accesses_only_given_files(name, tmp_path):
    folder = tmp_path / "given"
    folder.mkdir()
    (folder / "mesh").write_bytes(b"mesh")
    (tmp_path / "secret").write_bytes(b"secret")
    (folder / "link").symlink_to(tmp_path / "secret")
    with Child(attempt, folder, name) as child:
        assert child.recv() == ANSWERS.get(name, "EPERM")
    assert sorted(path.name for path in folder.iterdir()) == ["link", "mesh"]
    assert (folder / "mesh").read_bytes() == b"mesh"


def spin(pipe: Connection) -> None:
    confine(MEMORY, SECONDS)
    limit_time(1)
    while True:
        pass


def sleep(pipe: Connection) -> None:
    pipe.send_bytes(b"awake")
    time.sleep(1000)


def test_a_parser_without_end_is_ended():
    with Child(spin) as child, pytest.raises(EOFError, match="CPU time limit exceeded"):
        child.receive(100, 60)


def test_a_parser_that_waits_or_floods_is_ended():
    with Child(sleep) as child:
        assert child.receive(5, 60) == b"awake"
        with pytest.raises(EOFError, match="Killed"):
            child.receive(5, 0.2)
    with Child(sleep) as child, pytest.raises(EOFError):
        child.receive(4, 60)
