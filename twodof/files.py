"""Size-limited reads of untrusted files, atomic writes, folder locks and temporary folders."""

import errno
import fcntl
import io
import json
import os
import re
import shutil
import stat
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import chain, count
from pathlib import Path, PurePosixPath
from types import UnionType
from typing import Any

from .bounds import MAX_ARCHIVE, MAX_DIRECTORY, MAX_FOLDERS_DEEP, MAX_MEMBERS, MAX_UNZIPPED
from .errors import TwoDofError

METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # compression methods that FMI allows
MAX_LINKS_FOLLOWED = 40  # the kernel's limit
TEMPORARY = ".twodof."  # prefix of temporary folders, whose process holds their lock or has died
MADE_HERE = re.compile(r"\.twodof\.tmp\w{8}")  # names that mkdtemp makes
FEW_BYTES = 1_000_000  # free bytes of a disk that is almost full
LOCK_TIMEOUT = 5.0  # s of waiting for a lock
NUMBER = int | float
VALUES = {str: NUMBER}


class UnsafeArchiveError(zipfile.BadZipFile):
    """A zip archive is unsafe to unzip."""


@contextmanager
def refusing(kind: type[TwoDofError], what: str) -> Iterator[None]:
    """Raise ``kind`` if the operating system refuses ``what``."""
    try:
        yield
    except OSError as error:
        where = f" in '{error.filename}'" if error.errno == errno.ENOSPC and error.filename else ""  # maybe TMPDIR
        raise kind(f"cannot {what}: {error.strerror}{where}") from error


def check_file(path: str | Path, most: int) -> None:
    """Refuse anything but a regular file of at most ``most`` bytes, before it is opened.

    Reading a pipe would wait, and a device has no end.

    Raises:
        OSError: with the reason in ``strerror``.
    """
    state = os.stat(path)
    if stat.S_ISDIR(state.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(state.st_mode):
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    if state.st_size > most:
        raise OSError(errno.EFBIG, f"{os.strerror(errno.EFBIG)}, {state.st_size} bytes, at most {most}", str(path))


def read_file(path: str | Path, most: int, *, follow: bool = True) -> bytes:
    """Return the content of a regular file of at most ``most`` bytes.

    Raises:
        OSError: the file cannot be read, ``check_file`` refuses it, or it is a link and ``follow`` is false.
    """
    if not follow and os.path.islink(path):
        raise OSError(errno.ELOOP, "It is a link, and links in a bag are not followed", str(path))
    check_file(path, most)
    with open(os.open(path, os.O_RDONLY | (0 if follow else os.O_NOFOLLOW)), "rb") as file:
        return file.read(os.fstat(file.fileno()).st_size)


def head_of(path: Path, size: int) -> bytes:
    """Return the first bytes of a regular file, b"" without one: to open a pipe would wait."""
    with suppress(OSError), path.open("rb") if path.is_file() else io.BytesIO() as file:
        return file.read(size)
    return b""


def shown(path: str | Path) -> str:
    """Return a path as text for any stream, with bytes outside UTF-8 as escapes."""
    return os.fsencode(path).decode("utf-8", "backslashreplace")


def check_archive(path: str | Path | bytes) -> None:
    """Refuse a zip archive, a file or its content, that is unsafe to unzip, or has too many members to list.

    zipfile reads the whole list of members before it knows their number.

    Raises:
        OSError: with the reason in ``strerror``.
        UnsafeArchiveError: the archive is unsafe; the message says why.
        zipfile.BadZipFile: the archive is damaged.
    """
    if not isinstance(path, bytes):
        check_file(path, MAX_ARCHIVE)
    raw = io.BytesIO(path) if isinstance(path, bytes) else io.FileIO(path)
    with _Directory(raw) as file, zipfile.ZipFile(file) as archive:
        members = archive.infolist()
    names = [PurePosixPath(member.filename) for member in members]  # ./a//b is a/b
    for member in members:
        _check_member(member)
    if len({*names}) < len(names):  # readers differ in the member that they read
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise UnsafeArchiveError(f"it is unsafe: it has two members '{twice}'")
    if len({*names, *(folder for name in names for folder in name.parents)}) > MAX_MEMBERS:
        raise UnsafeArchiveError(f"it has more than {MAX_MEMBERS} files and folders")
    if sum(member.file_size for member in members) > MAX_UNZIPPED:
        raise UnsafeArchiveError(f"it is unsafe: unzipped it exceeds {MAX_UNZIPPED} bytes")


def _check_member(member: zipfile.ZipInfo) -> None:
    name = PurePosixPath(member.filename)
    link = stat.S_ISLNK(member.external_attr >> 16)
    outside = name.is_absolute() or ".." in name.parts or "\\" in member.filename
    if link or outside or not member.filename:
        raise UnsafeArchiveError(f"it is unsafe: its member '{name}' is outside of its folder")
    if len(name.parts) > MAX_FOLDERS_DEEP:
        raise UnsafeArchiveError(f"it is unsafe: its folders are nested deeper than {MAX_FOLDERS_DEEP}")
    if member.compress_type not in METHODS:
        raise UnsafeArchiveError(
            f"its member '{name}' is compressed by method {member.compress_type}; FMI allows 'store' and 'deflate' only"
        )


def read_member(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    """Return a member of an archive, of at most ``most`` bytes.

    Raises:
        KeyError: there is no such member.
        UnsafeArchiveError: the member is larger.
        OSError, zipfile.BadZipFile, …: the archive is damaged.
    """
    member = archive.getinfo(name)
    if member.file_size > most:
        raise UnsafeArchiveError(f"its member '{name}' is larger than {most} bytes")
    content = b""
    with suppress(EOFError), archive.open(member) as file:  # returns at most the size in the list of members
        content = file.read(member.file_size)
    if len(content) < member.file_size:
        raise zipfile.BadZipFile(f"its member '{name}' is shorter than stated")
    return content


class _Directory(io.BufferedReader):
    """A zip archive whose list of members is read, of limited size."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > MAX_DIRECTORY:
            raise OSError(errno.EFBIG, "Too many members")
        return super().read(size)


def write_file(path: Path, content: bytes | Iterable[bytes], *, follow: bool = True) -> None:
    """Write a file atomically, following links; or write into a device, pipe or /dev/stdout; or raise OSError.

    The umask sets the mode of a new file; a replaced file of this user keeps its mode. Without ``follow``, links are
    refused, as for a default name, because an untrusted folder may contain a link of this name to any file.
    """
    if not follow and path.is_symlink():
        raise OSError(errno.ELOOP, "It is a link, and only outputs that you name are written through links", str(path))
    descriptor, target, mode, own = descriptor_of(path), target_of(path), 0, True
    with suppress(FileNotFoundError):
        mode, own = (state := os.stat(path)).st_mode, state.st_uid == os.geteuid()
    if descriptor is not None or stat.S_ISCHR(mode) or stat.S_ISFIFO(mode):
        with open(path if descriptor is None else os.dup(descriptor), "wb") as file:
            file.writelines([content] if isinstance(content, bytes) else content)
        return
    if mode:
        check_file(path, sys.maxsize)
    with temporary_folder(target.parent) as folder:
        with open(folder / "partial", "xb") as file:
            if mode and own:
                os.fchmod(file.fileno(), stat.S_IMODE(mode) & 0o777)
            file.writelines([content] if isinstance(content, bytes) else content)
        os.replace(folder / "partial", target)


def descriptor_of(path: str | Path) -> int | None:
    """Return the descriptor of a name such as /dev/stdout or /dev/fd/3; None for other paths."""
    names = [it.name for it in names_of(path) if it.parent == Path(f"/proc/{os.getpid()}/fd")]
    return next((int(name) for name in names if name.isdecimal()), None)


def target_of(path: str | Path) -> Path:
    """Return the path of an output, through links as far as Linux's rule fs.protected_symlinks follows them.

    In a sticky folder for all users, such as /tmp, links of other users are refused: they could name any file.
    """
    for name in names_of(path):
        folder, owner = name.parent.stat(), name.lstat().st_uid if name.is_symlink() else os.geteuid()
        if folder.st_mode & 0o1002 == 0o1002 and owner not in (os.geteuid(), folder.st_uid):
            raise PermissionError(errno.EACCES, f"'{name}' is a link of another user in a shared folder")
    return Path(os.path.realpath(path))


def names_of(path: str | Path) -> Iterator[Path]:
    """Yield a path and the targets of its links in turn, each with the real path of its folder."""
    for _ in range(MAX_LINKS_FOLLOWED):
        yield (path := Path(os.path.realpath(Path(path).parent), Path(path).name))
        if not path.is_symlink():
            return
        path = path.parent / os.readlink(path)


@contextmanager
def temporary_folder(parent: Path | None = None) -> Iterator[Path]:
    """Make a folder that is removed at the end, or by the next process if this one is killed.

    Without a parent folder it is in the system's folder for temporary files.
    """
    try:
        parent = Path(tempfile.gettempdir()).absolute() if parent is None else Path(parent)  # TMPDIR may be relative
    except FileNotFoundError as error:
        raise OSError(error.errno, f"{error.strerror}; name one in TMPDIR") from error
    for left in parent.glob(f"{TEMPORARY}*"):
        if MADE_HERE.fullmatch(left.name):
            _remove_abandoned(left)
    folder = Path(tempfile.mkdtemp(dir=parent))
    held = lock(folder)
    if is_being_written(folder):  # only now that it is locked: others remove unlocked ones
        folder = folder.rename(folder.with_name(TEMPORARY + folder.name))
    try:
        yield folder
    except OSError as error:
        free = os.statvfs(folder)
        if error.errno == errno.ENOSPC and error.filename is None and free.f_bavail * free.f_frsize < FEW_BYTES:
            raise OSError(error.errno, error.strerror, str(parent)) from error
        raise
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(held)


def _remove_abandoned(folder: Path) -> None:
    """Remove a temporary folder of this user that no process has locked."""
    with suppress(OSError):  # removed, a link, another user's, locked, or on a disk without locks
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            if os.fstat(descriptor).st_uid == os.geteuid():
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(descriptor)


def lock(path: Path, *, wait: bool = False) -> int:
    """Lock a folder against other writers until the returned descriptor is closed or the process ends.

    With ``wait``, wait up to LOCK_TIMEOUT s for processes that only check the lock.

    Raises:
        BlockingIOError: another process writes it.
        OSError: it cannot be opened.
    """
    folder = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # opening a pipe of this name would wait
    try:
        end = time.monotonic() + (LOCK_TIMEOUT if wait else 0.0)
        while not (own := _locked(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)) and time.monotonic() < end:
            time.sleep(0.01)
        if not own or not os.path.samestat(os.fstat(folder), os.stat(path)):
            raise BlockingIOError(errno.EWOULDBLOCK, "another process writes it", str(path))
    except BaseException:
        os.close(folder)
        raise
    return folder


def is_being_written(path: Path) -> bool:
    """Return whether a living process writes the folder."""
    folder = os.open(path, os.O_RDONLY)
    try:
        return not _locked(folder, fcntl.LOCK_SH | fcntl.LOCK_NB)
    finally:
        os.close(folder)


def _locked(folder: int, how: int) -> bool:
    try:
        fcntl.flock(folder, how)
    except BlockingIOError:
        return False
    except OSError:  # the file system has no locks
        pass
    return True


def free_name(name: str, ending: str = "", replaceable: Callable[[Path], bool] = lambda path: False) -> Path:
    """Return the name, or if a file has it, the name with the first free number from 2 on."""
    names = chain([f"{name}{ending}"], (f"{name}-{i}{ending}" for i in count(2)))
    return next(p for p in map(Path, names) if not (os.path.lexists(p) and (p.is_symlink() or not replaceable(p))))


def sync(*paths: Path) -> None:
    """Flush files and folders to the disk."""
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def data_file(*parts: str) -> Path:
    """Return the path of a data file of the package, installed or in a checkout."""
    package = Path(__file__).parent
    installed = package.joinpath(*parts)
    return installed if installed.exists() else package.parent.joinpath(*parts)


JsonObject = dict[str, Any]


def parsed(text: bytes) -> Any:
    """Parse untrusted JSON; "?" replaces surrogates, which UTF-8 does not have.

    Raises:
        ValueError, RecursionError: the text is not JSON, or would take much more memory than its length.
    """
    if text.count(b"{") + text.count(b"[") > len(text) // 8 + 1000:
        raise ValueError("it is damaged")  # empty lists and objects take 24 times the memory of their text
    if re.search(rb"\\u[dD][89a-fA-F]", text):
        text = json.dumps(json.loads(text.decode("utf-8")), ensure_ascii=False).encode("utf-8", "replace")
    return json.loads(text.decode("utf-8"))


def fits(content: object, shape: object) -> bool:
    """Return whether a JSON value has a given shape and only finite numbers.

    A shape is a type, or describes a list or dict: [x] is a list of x of any length, (x, y) a list of an x and a y, and
    {str: x} a dict of x by name.
    """
    if isinstance(shape, list):
        return isinstance(content, list) and all(fits(element, shape[0]) for element in content)
    if isinstance(shape, tuple):
        return isinstance(content, list) and len(content) == len(shape) and all(map(fits, content, shape))
    if isinstance(shape, dict) and isinstance(content, dict):
        keys = content if str in shape else shape
        return all(fits(content.get(key), shape.get(key, shape.get(str))) for key in keys)
    if shape == NUMBER:
        return isinstance(content, NUMBER) and abs(content) <= sys.float_info.max
    return isinstance(shape, type | UnionType) and isinstance(content, shape)
