"""Files that others made: regular ones only, and no larger than can be borne."""

from __future__ import annotations

import errno
import os
import stat
import tempfile
import zipfile
from pathlib import Path

MAX_ARCHIVE = 2 * 1024**3
MAX_DIRECTORY = 4 * 1024**2  # of a zip: some 50,000 members


def check_file(path: str | Path, most: int) -> None:
    """Refuse what is no regular file of at most ``most`` bytes, before it is opened.

    A pipe would be waited for, and a device has no end.

    Raises:
        OSError: with the reason in ``strerror``.
    """
    state = os.stat(path)
    if stat.S_ISDIR(state.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(state.st_mode):
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    if state.st_size > most:
        reason = f"{os.strerror(errno.EFBIG)}, {state.st_size} bytes, at most {most}"
        raise OSError(errno.EFBIG, reason, str(path))


def read_file(path: str | Path, most: int) -> bytes:
    """The content of a regular file of at most ``most`` bytes.

    Raises:
        OSError: it cannot be read, or ``check_file`` refuses it.
    """
    check_file(path, most)
    with Path(path).open("rb") as file:
        return file.read(os.fstat(file.fileno()).st_size)


def shown(path: str | Path) -> str:
    """A path as text that can be written anywhere: what is no UTF-8 in it as escapes."""
    return os.fsencode(path).decode("utf-8", "backslashreplace")


def check_archive(path: str | Path) -> None:
    """Refuse a zip archive with more members than can be listed.

    zipfile reads the whole list before it can be asked how long it is.

    Raises:
        OSError: with the reason in ``strerror``.
        zipfile.BadZipFile: it is damaged.
    """
    check_file(path, MAX_ARCHIVE)
    with open(path, "rb") as file:
        end = zipfile._EndRecData(file)  # type: ignore[attr-defined]
    if end is not None and end[zipfile._ECD_SIZE] > MAX_DIRECTORY:  # type: ignore[attr-defined]
        raise OSError(errno.EFBIG, "Too many members", str(path))


def write_file(path: Path, content: bytes) -> None:
    """Write a file whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=".twodof-", delete=False) as file:
        partial = Path(file.name)
        try:
            file.write(content)
            file.flush()
            os.chmod(partial, 0o644)
            os.replace(partial, path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
