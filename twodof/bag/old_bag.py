"""The bag that a new one replaces."""

import os
from contextlib import suppress
from pathlib import Path

from ..bounds import MAX_METADATA
from ..errors import BagError
from ..files import lock, read_file, temporary_folder
from .provenance import read_provenance, robots_of

REPLACED = ".replaced"


class OldBag:
    """The bag that a new one replaces, if any; it keeps the suffix .replaced until the new one has samples.

    A process that is killed at any time leaves the old bag, or the new one as far as it was written.

    Raises:
        BagError: the folder is not a bag, is being written, or exists and may not be overwritten.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self._path, self._kept = path, path.parent / f"{path.name}{REPLACED}"
        self._left: list[Path] = []  # by runs that were killed
        self._locks: list[int] = []
        if (held := _hold(path, overwrite)) is None:
            return
        self._locks.append(held)
        try:
            while (left := _hold(self._kept, overwrite)) is not None:
                self._locks.append(left)
                self._left.append(self._kept)
                self._kept = path.parent / f"{self._kept.name}{REPLACED}"
            path.rename(self._kept)
        except OSError as error:
            self._release()
            raise BagError(f"cannot write the bag '{path}': {error.strerror}") from error
        except BaseException:
            self._release()
            raise

    def restore(self) -> None:
        """Move the old bag back to its own name, unless there is another bag of this name."""
        if self._locks and not self._path.exists():
            self._kept.rename(self._path)
        self._release()

    def remove(self) -> None:
        """Remove the old bag; if this fails, the next run that overwrites removes it."""
        if self._locks:
            with suppress(OSError):
                for bag in filter(Path.exists, (self._kept, *self._left)):
                    with temporary_folder(bag.parent) as folder:  # which the next process removes if this one is killed
                        bag.rename(folder / bag.name)
            self._release()

    def _release(self) -> None:
        while self._locks:
            os.close(self._locks.pop())


def check_free(path: Path, *, overwrite: bool) -> None:
    """Raise BagError if a new bag cannot have this path."""
    if (held := _hold(path, overwrite)) is not None:
        os.close(held)


def _hold(path: Path, overwrite: bool) -> int | None:
    """Lock a bag that may be overwritten; return the lock's descriptor, or None if the path is free."""
    try:
        if not path.exists():
            return None
        if not overwrite:
            raise BagError(f"'{path}' exists already; choose another with `path` or give `overwrite=True`")
        if Path.cwd().is_relative_to(path.resolve()):  # a relative path would end elsewhere
            raise BagError(f"'{path}' has the working directory in it and is not overwritten")
        held = lock(path)
    except BlockingIOError as error:
        raise BagError(f"'{path}' is being written by another process and is not overwritten") from error
    except OSError as error:
        raise BagError(f"cannot write the bag '{path}': {error.strerror}") from error
    if not _is_bag(path):
        os.close(held)
        raise BagError(f"'{path}' is not a bag and is not overwritten")
    return held


def _is_bag(path: Path) -> bool:
    """Return whether a folder has rosbag2's metadata, or the provenance of a writer that died."""
    try:
        metadata = read_file(path / "metadata.yaml", MAX_METADATA, follow=False)
        return metadata.startswith(b"rosbag2_bagfile_information:")
    except OSError:
        return any(read_provenance(path, name) for name in robots_of(path))
