"""Processes of our own, each of which calls one function behind a pipe without a name."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from select import poll
from subprocess import DEVNULL, Popen
from threading import Thread
from typing import Any

from .errors import ChildError, TwoDofError

BOOT = """
import sys
from contextlib import suppress
from multiprocessing.connection import Connection
with Connection(int(sys.argv[1])) as pipe, suppress(OSError):  # nobody is left to be told
    try:
        sys.path[:] = pipe.recv()
        pipe.recv()(pipe)
    except Exception as error:
        own = type(error).__module__ == "twodof.errors"
        pipe.send(error if own else RuntimeError(f"{type(error).__name__}: {error}"))
"""


class Child(Connection):
    """A process that calls one function, and the connection to it; closing it ends the process.

    Nobody else can talk to it, as it inherits one end of a socket pair. It imports nothing from the
    working directory, nor the program's main module. The terminal's signals are not for it, and it
    ends with this process, whatever it is at.

    Args:
        function: of a module; called with the other end of the connection and the arguments.
        arguments: what can be pickled.
        environment: variables beside those of this process.
        output: for stdout and stderr, as of ``subprocess.Popen``.
    """

    def __init__(
        self, function: Callable[..., None], *arguments: object,
        environment: Mapping[str, str] | None = None, output: int | None = None,
    ) -> None:  # fmt: skip
        ours, theirs = socket.socketpair()
        with ours, theirs:
            handle = theirs.fileno()
            self._process = Popen(
                [sys.executable, "-I", "-c", BOOT, str(handle)],  # -I: from Python's own path alone
                pass_fds=[handle], env={**os.environ, **(environment or {})},
                stdin=DEVNULL, stdout=output, stderr=output, start_new_session=True,
            )  # fmt: skip
            super().__init__(ours.detach())
        self.send(_path())
        self.send(partial(_call, function, arguments))

    def send(self, value: object) -> None:
        """Send a value; where the process has ended, ``recv`` says so."""
        with suppress(OSError):
            super().send(value)

    def recv(self) -> Any:
        """What the process has sent next.

        Raises:
            TwoDofError: what its function raised.
            ChildError: it failed otherwise.
            EOFError: it has ended, with the exit status that the text says.
        """
        try:
            value = super().recv()
        except (EOFError, OSError):
            raise EOFError(f"exit status {self._process.wait()}") from None
        if isinstance(value, TwoDofError):
            raise value
        if isinstance(value, RuntimeError):
            raise ChildError(f"a child process failed: {value}")
        return value

    def close(self) -> None:
        """End the process at once."""
        super().close()
        self._process.kill()
        self._process.wait()


def _path() -> list[str]:
    """Where modules are found, but for the working directory, unless this package is in it."""
    home = str(Path(__file__).parents[1])

    def is_same(entry: str, folder: str) -> bool:
        with suppress(OSError):  # where there is none
            return os.path.samefile(entry or ".", folder)
        return False

    entries = [home if is_same(entry, home) else entry for entry in sys.path]
    return [entry for entry in entries if entry == home or not is_same(entry, ".")]


def _call(function: Callable[..., None], arguments: tuple[object, ...], pipe: Connection) -> None:
    """What the process does, as long as the other end of its pipe is open."""
    os.set_inheritable(pipe.fileno(), False)  # what an FMU starts must not keep ours open
    closed = poll()
    closed.register(pipe, 0)
    Thread(target=lambda: closed.poll() and os._exit(1), daemon=True).start()
    function(pipe, *arguments)
