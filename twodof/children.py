"""Child processes that each run one function over an anonymous pipe, and their confinement.

A child that parses untrusted bytes confines itself. Limits of memory and time apply on every POSIX system. On Linux,
Landlock restricts it to reading the given folders, and on x86-64 seccomp restricts it to the system calls that a parser
needs. On a kernel without these, only the limits apply. Sources: landlock(7), seccomp(2).
"""

import ctypes
import os
import platform
import resource
import socket
import struct
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from select import poll
from signal import SIGKILL, strsignal
from subprocess import DEVNULL, Popen
from threading import Thread, Timer
from typing import Any

from .errors import ChildError, TwoDofError

BOOT = """
import sys
from contextlib import suppress
from multiprocessing.connection import Connection
with Connection(int(sys.argv[1])) as pipe, suppress(OSError):  # the parent has ended
    try:
        sys.path[:] = pipe.recv()
        pipe.recv()(pipe)
    except Exception as error:
        own = type(error).__module__ == "twodof.errors"
        pipe.send(error if own else RuntimeError(f"{type(error).__name__}: {error}"))
"""

DESCRIPTORS = 64  # open at a time
NO_NEW_PRIVILEGES = 38  # option of prctl
LANDLOCK_CREATE, LANDLOCK_ADD, LANDLOCK_RESTRICT = 444, 445, 446  # on all architectures
FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}  # number of rights to files that a version of Landlock handles
READ, EXECUTE = 1 << 2 | 1 << 3, 1 << 0  # files and folders; programs
SECCOMP, FILTER, ALL_THREADS = 317, 1, 1
X86_64 = 0xC000003E
READ_ONLY = ~(os.O_CLOEXEC | os.O_NONBLOCK | os.O_DIRECTORY | os.O_NOFOLLOW | 0o100000)
ALLOWED = (
    *(0, 1, *range(3, 16), 17, 19, 20, 21),  # read, write, close, *stat, poll, lseek, mmap … brk, rt_sig*, access
    *(24, 25, 28, 35, 39, 60, 79, 89, 96, 98),  # … madvise, nanosleep, exit, getcwd … getrusage; not fcntl: SIGIO
    *(131, 186, 202, 217, 228, 230, 231),  # sigaltstack, gettid, futex, getdents64 … exit_group
    *(262, 267, 271, 273, 318, 324, 332, 334),  # fstatat, readlinkat, ppoll, getrandom, statx, rseq
)
"""Numbers of system calls on x86-64."""
OPEN, LIMIT = 257, 302  # openat for reading, prlimit64 of the process itself


class Child(Connection):
    """A process that runs one function, and the connection to it; closing it ends the process.

    No other process can communicate with it, because it inherits one end of a socket pair. It imports nothing from the
    working directory, and not the program's main module. It does not receive the terminal's signals, and it ends when
    this process ends.

    Args:
        function: function at module level; called with the other end of the connection and the arguments.
        arguments: arguments that can be pickled.
        environment: environment variables in addition to those of this process.
        output: destination of stdout and stderr, as in ``subprocess.Popen``.
    """

    def __init__(
        self,
        function: Callable[..., None],
        *arguments: object,
        environment: Mapping[str, str] | None = None,
        output: int | None = None,
    ) -> None:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            handle = theirs.fileno()
            self._process = Popen(
                [sys.executable, "-I", "-c", BOOT, str(handle)],  # -I: import from Python's own path only
                pass_fds=[handle],
                env={**os.environ, **(environment or {})},
                stdin=DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
            super().__init__(ours.detach())
        self.send(_path())
        self.send(partial(_call, function, arguments))

    def send(self, value: object) -> None:
        """Send a value; if the process has ended, the next ``recv`` raises."""
        with suppress(OSError):
            super().send(value)

    def recv(self) -> Any:
        """Return the next value from the process.

        Raises:
            TwoDofError: the function raised it.
            ChildError: the function failed with another exception.
            EOFError: the process has ended; the text has its exit status.
        """
        try:
            value = super().recv()
        except (EOFError, OSError):
            raise EOFError(self._end()) from None
        if isinstance(value, TwoDofError):
            raise value
        if isinstance(value, RuntimeError):
            raise ChildError(f"a child process failed: {value}")
        return value

    def receive(self, most: int, seconds: float) -> bytes:
        """Return the next bytes from an untrusted process.

        Args:
            most: largest number of bytes; more bytes end the process.
            seconds: longest wall time; the process is killed afterwards.

        Raises:
            EOFError: the process has ended; the text says how.
        """
        timer = Timer(seconds, self._kill)
        timer.daemon = True
        timer.start()
        try:
            return self.recv_bytes(most)
        except (EOFError, OSError):
            super().close()
            raise EOFError(self._end()) from None
        finally:
            timer.cancel()

    def _end(self) -> str:
        """Return in words how the process ended."""
        status = self._process.wait()
        return f"exit status {status}" if status >= 0 else str(strsignal(-status))

    def close(self) -> None:
        """End the process at once."""
        super().close()
        self._kill()
        self._process.wait()

    def _kill(self) -> None:
        """End the process with the programs that it has started, which are in its session."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, SIGKILL)


def _path() -> list[str]:
    """Return the module path without the working directory, unless this package is in it."""
    home = str(Path(__file__).parents[1])

    def is_same(entry: str, folder: str) -> bool:
        with suppress(OSError):  # a missing folder
            return os.path.samefile(entry or ".", folder)
        return False

    entries = [home if is_same(entry, home) else entry for entry in sys.path]
    return [entry for entry in entries if entry == home or not is_same(entry, ".")]


def _call(function: Callable[..., None], arguments: tuple[object, ...], pipe: Connection) -> None:
    """Run the function in the child, until the other end of its pipe closes."""
    os.set_inheritable(pipe.fileno(), False)  # programs that an FMU starts must not keep the pipe open
    closed = poll()
    closed.register(pipe, 0)
    Thread(target=_end_with, args=(closed,), daemon=True).start()
    function(pipe, *arguments)


def _end_with(closed: poll) -> None:
    """End this process, and the programs that it has started, once its pipe has closed."""
    closed.poll()
    os.killpg(0, SIGKILL)


def confine(memory: int, seconds: int, folders: Sequence[Path] = ()) -> None:
    """Confine this process irrevocably; import everything that it needs beforehand.

    Args:
        memory: largest address space, bytes.
        seconds: processor time since its start.
        folders: the only folders whose files it may read, on kernels with Landlock.
    """
    limit(memory, {resource.RLIMIT_CPU: seconds, resource.RLIMIT_FSIZE: 0, resource.RLIMIT_NOFILE: DESCRIPTORS})
    libc = _allow_files(dict.fromkeys(folders, READ))
    if libc is not None and platform.machine() == "x86_64":
        _allow_calls(libc)


def confine_program(memory: int, seconds: int, file: int, program: Path, folders: Sequence[Path]) -> None:
    """Confine this process, which then starts a program, and the program irrevocably.

    Args:
        memory: largest address space of each process, bytes.
        seconds: processor time of each process since its start.
        file: largest size of a file that it writes, bytes.
        program: folder of the program and its files, which it may read and execute on kernels with Landlock.
        folders: the only other folders in which it may read and write there.
    """
    limit(memory, {resource.RLIMIT_CPU: seconds, resource.RLIMIT_FSIZE: file})
    _allow_files({program: READ | EXECUTE, **dict.fromkeys(folders, ~EXECUTE)})


def limit(memory: int, others: Mapping[int, int] | None = None) -> None:
    """Limit the address space of this process, bytes, and other resources; it leaves no core dump."""
    for kind, most in {resource.RLIMIT_AS: memory, resource.RLIMIT_CORE: 0, **(others or {})}.items():
        hard = resource.getrlimit(kind)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))


@contextmanager
def memory_for(size: int) -> Iterator[None]:
    """Limit the address space of this process for a while, on Linux, to its present size and some bytes.

    Larger allocations then fail, in all threads.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    if sys.platform == "linux":
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        known = [most for most in (soft, hard) if most != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min(used + size, *known), hard) if known else (used + size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def limit_time(seconds: float) -> None:
    """Limit the processor time of this process from now on; call it again for the next task."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    most = resource.getrlimit(resource.RLIMIT_CPU)[1]
    soft = int(used.ru_utime + used.ru_stime + seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (min(soft, most), most))


def _allow_files(folders: Mapping[Path, int]) -> ctypes.CDLL | None:
    """Restrict file access with Landlock to rights below each folder; return Linux's C library if it can restrict."""
    libc = ctypes.CDLL(None) if sys.platform == "linux" else None
    if libc is None or libc.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0) != 0:
        return None
    version = libc.syscall(LANDLOCK_CREATE, None, 0, 1)
    if version < 1:
        return libc
    handled = (1 << FILE_RIGHTS[min(version, max(FILE_RIGHTS))]) - 1
    rules = libc.syscall(LANDLOCK_CREATE, struct.pack("Q", handled), 8, 0)
    for folder, rights in folders.items():
        with suppress(OSError):  # a folder that does not exist needs no rule
            descriptor = os.open(folder, os.O_PATH | os.O_DIRECTORY)
            libc.syscall(LANDLOCK_ADD, rules, 1, struct.pack("=Qi", rights & handled, descriptor), 0)
            os.close(descriptor)
    libc.syscall(LANDLOCK_RESTRICT, rules, 0)
    os.close(rules)
    return libc


def _allow_calls(libc: ctypes.CDLL) -> None:
    """Restrict all threads to a table of system calls with seccomp; others fail with EPERM."""
    load, equal, mask, end = 0x20, 0x15, 0x54, 0x06
    allow, refuse = (end, 0, 0, 0x7FFF0000), (end, 0, 0, 0x00050001)
    number, architecture, first, third = 0, 4, 16, 32  # offsets in struct seccomp_data
    program = [(load, 0, 0, architecture), (equal, 1, 0, X86_64), refuse, (load, 0, 0, number)]
    for call in ALLOWED:
        program += [(equal, 0, 1, call), allow]
    program += [
        (equal, 0, 4, OPEN),
        (load, 0, 0, third),
        (mask, 0, 0, READ_ONLY & 0xFFFFFFFF),
        (equal, 0, 1, 0),
        allow,
        (load, 0, 0, number),
        (equal, 0, 3, LIMIT),
        (load, 0, 0, first),
        (equal, 0, 1, 0),
        allow,
        refuse,
    ]
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in program))
    head = struct.pack("HP", len(program), ctypes.addressof(code))
    libc.syscall(SECCOMP, FILTER, ALL_THREADS, head)
