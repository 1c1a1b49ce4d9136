"""Processes that run commands on untrusted files under limits.

Each process has limits of time and memory, and may write only below one folder of a folder tree.
"""

from __future__ import annotations

import faulthandler
import gc
import importlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, NoReturn

import pytest
from bags import assert_consistent
from sinks import resident

from twodof.cli.main import main

SECONDS = 10  # of processor time
WAIT = 300  # s by the clock: a guard against hanging
MIB = 1024**2
MEMORY = 1024 * MIB  # bytes beyond what the worker has at its start
ADDRESS_SPACE = 8192 * MIB
SECRET = b"not for the FMU"


class Outcome(NamedTuple):
    """The end of a command.

    Attributes:
        status: its exit status, −N where it died of signal N.
        memory: the most that it held beyond what it had at its start, bytes.
        out, err: what it wrote.
    """

    status: int
    memory: int
    out: str
    err: str


class Worker:
    """A process with all modules loaded, which forks for each command."""

    def __init__(self, folder: Path, tmp: Path) -> None:
        environment = {
            **os.environ,
            "TMPDIR": str(tmp),
            "HOME": str(folder),
            "OPENBLAS_NUM_THREADS": "1",  # a process that forks has one thread
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        }
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            cwd=folder,
            env=environment,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )

    def run(self, *arguments: object) -> Outcome:
        """Run a command; a command that takes too long ends with a traceback."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([*map(str, arguments)]) + "\n")
        self._process.stdin.flush()
        return Outcome(*json.loads(self._process.stdout.readline()))

    def stop(self) -> None:
        self._process.communicate()


MODULES = (
    "twodof.bag.reader",
    "twodof.bag.recovery",
    "twodof.export.package",
    "twodof.simulation.master",
    "twodof.ros.scene",
    "lxml.etree",
    "tqdm",
)


def serve() -> None:
    """Run a worker, which receives arguments as lines of JSON and returns outcomes."""
    for module in MODULES:
        importlib.import_module(module)
    requests = os.fdopen(os.dup(0), "r")
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.fsync = lambda fd: None  # the disk is not what is tested
    gc.freeze()  # or every child copies what it looks through
    for line in requests:
        files = [os.memfd_create("out"), os.memfd_create("err")]
        child = os.fork()
        if child == 0:
            for number, file in enumerate(files, start=1):
                os.dup2(file, number)
            run(json.loads(line))
        before = resident()
        _, status, usage = os.wait4(child, 0)
        texts = [Path(f"/proc/self/fd/{file}").read_text("utf-8", "replace") for file in files]
        for file in files:
            os.close(file)
        memory = usage.ru_maxrss * 1024 - before
        answers.write(json.dumps((os.waitstatus_to_exitcode(status), memory, *texts)) + "\n")
        answers.flush()


def run(arguments: list[str]) -> NoReturn:
    """Run a command in this process to its end."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    faulthandler.enable()
    faulthandler.register(signal.SIGXCPU, chain=True)
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, 2 * SECONDS))
    faulthandler.dump_traceback_later(WAIT, exit=True)
    try:
        status = main(arguments)
    except BaseException:
        traceback.print_exc()
        status = 1
    if arguments[0] == "run":
        sys.exit(status)  # libraries that were loaded may crash now
    sys.stdout.flush()
    os._exit(status)


class Jail:
    """A folder tree in which a command may write only below ``target``.

    Attributes:
        input: folder of the input files.
        target: folder of the output files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.input = folder / "jail/input"
        self.target = folder / "jail/target"
        self._tmp = folder / "jail/tmp"
        self._tmp.mkdir(parents=True)
        self._worker = Worker(folder / "jail", self._tmp)

    def clean(self) -> None:
        for path in (self.input, self.target):
            shutil.rmtree(path, ignore_errors=True)
            path.mkdir()
        for path in (self._folder, self._folder / "jail", self.input):
            (path / "secret").write_bytes(SECRET)

    def close(self) -> None:
        self._worker.stop()

    def run(self, *arguments: object, prints: bool = False) -> Outcome:
        """Return the outcome of a command, after checking the guarantees of every command.

        Args:
            arguments: arguments of the command line.
            prints: whether the command runs code that may print any text.
        """
        before = self._listing()
        outcome = self._worker.run(*arguments)
        print(arguments, outcome)
        assert outcome.status in (0, 1, 130)
        lines = outcome.err.splitlines()
        if outcome.status:
            assert lines[-1:] == [line for line in lines if line.startswith("twodof: error: ")]
            assert len(lines.pop()) < 5000
            assert outcome.out == ""
        others = [line for line in lines if not line.startswith(("WARNING: ", "ERROR: "))]
        assert prints or others == []
        assert self._listing() == before
        assert outcome.memory < MEMORY
        return outcome

    def _listing(self) -> dict[str, tuple[int, int, int]]:
        """All files outside the target: mode, size and time of change."""
        found = {}
        for folder, folders, files in os.walk(self._folder):
            for name in [*folders, *files]:
                path = os.path.join(folder, name)
                if not path.startswith(str(self.target)):
                    state = os.lstat(path)
                    changed = 0 if path == str(self._tmp) else state.st_mtime_ns
                    found[path] = (state.st_mode, state.st_size, changed)
        return found


@pytest.fixture(scope="module")
def the_jail(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Jail]:
    jail = Jail(tmp_path_factory.mktemp("mutations"))
    yield jail
    jail.close()


@pytest.fixture
def jail(the_jail: Jail) -> Jail:
    the_jail.clean()
    return the_jail


def sparse(path: Path) -> None:
    """Zeros that take no space on the disk."""
    with path.open("wb") as file:
        file.truncate(3000 * MIB)


SPECIAL: dict[str, tuple[Callable[[Path], object], str]] = {
    "a pipe": (os.mkfifo, "Not a regular file"),
    "3 GB of zeros": (sparse, "File too large"),
    "a device": (lambda path: path.symlink_to("/dev/zero"), "Not a regular file"),
    "a folder": (Path.mkdir, "Is a directory|it is a folder"),
    "a link to itself": (lambda path: path.symlink_to(path.name), "symbolic links"),
}


def without_slow(metafunc: pytest.Metafunc, tables: Mapping[str, Mapping[str, object]], slow: Collection[str]) -> None:
    """Parameters of a test from its table; without --full, none that takes a second."""
    full = metafunc.config.getoption("full")
    for name in tables.keys() & set(metafunc.fixturenames):
        table = {case: value for case, value in tables[name].items() if full or case not in slow}
        metafunc.parametrize(name, table.values(), ids=table)


def refused(jail: Jail, reason: str, *command: object) -> None:
    """Assert that the command ends with this reason and leaves nothing."""
    outcome = jail.run(*command)
    assert outcome.status == 1
    assert re.search(reason, outcome.err), outcome.err
    assert list(jail.target.iterdir()) == []


def check_reading(jail: Jail, bag: Path) -> None:
    """Assert that reading changes nothing, and that recovery keeps the old bag and makes one that others open."""
    before = contents(bag)
    jail.run("info", bag)
    assert contents(bag) == before
    recovered = jail.run("recover", bag)
    old = bag.with_name("bag.unfinished")
    if old.exists():
        assert recovered.status == 0
        assert contents(old) == before
        storage = "mcap" if (bag / "bag.mcap").exists() else "sqlite3"
        assert_consistent(bag, storage)
        assert jail.run("recover", bag).out.endswith("there is nothing to recover\n")
        jail.run("info", bag)
    else:
        assert contents(bag) == before
    assert set(bag.parent.iterdir()) <= {bag, old}


def contents(folder: Path) -> dict[str, bytes | int]:
    """The files of a folder; of large ones only the size."""
    sizes = {path: path.stat().st_size for path in folder.iterdir() if path.is_file()}
    return {p.name: p.read_bytes() if size < MIB else size for p, size in sizes.items()}


if __name__ == "__main__":
    serve()
