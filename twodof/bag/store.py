"""The folder of a bag in progress: its files, its lock, and the storing thread."""

import errno
import os
import shutil
import sqlite3
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from typing import Protocol

from rosbags.rosbag2 import WriterError

from ..errors import BagError
from ..files import lock, refusing, sync, target_of
from ..ros.messages import Topic, store_of
from .old_bag import OldBag, check_free
from .storage import REMOVED, STORAGES, BagWriter, check_path

RESERVE = "reserve"
RESERVE_SIZE = 2 * 1024**2
FLUSH_PERIOD = 0.5  # s of wall time
PAUSE = 0.0005  # s between two checks of the thread's progress


class Part(Protocol):
    """The contribution of one robot to a bag."""

    namespace: str

    def open(self) -> None:
        """Add the robot's topics to the store, and its provenance to the folder."""

    def hand_over(self) -> None:
        """Pass the queue to the store; the store's thread calls it."""

    def stored(self) -> int:
        """Return the number of samples in the bag."""

    def metadata(self) -> tuple[str, str]:
        """Return key and text of the robot's provenance; raise OSError if its file was removed."""


class Store:
    """The folder of a bag of one or several robots; the first robot opens it, the last one closes it.

    Arguments and errors are those of ``Bag``. ``writer`` accepts messages while the bag is open.
    """

    def __init__(self, path: Path, storage: str, *, overwrite: bool, fsync: bool, compress: str) -> None:
        if storage not in STORAGES:
            raise BagError(f"storage '{storage}' is not one of {', '.join(STORAGES)}")
        if compress not in ("", "zstd"):
            raise BagError(f"`compress` '{compress}' is unknown; there is: zstd")
        if compress and storage != "mcap":
            raise BagError(f"`compress` applies to storage mcap only, not to {storage}")
        if os.path.islink(path) or path != Path(os.path.normpath(path)):  # the link stays; bag/../bag is bag
            with refusing(BagError, f"write '{path}'"):
                path = target_of(path)
        check_path(path, storage)
        self.path, self.fsync = path, fsync
        self._storage, self._overwrite, self._compress = storage, overwrite, compress
        self._parts: list[Part] = []
        self._entered = 0  # robots that have not left
        self._turn = Lock()  # robots may have threads of their own
        self._names: set[str] = set()  # namespaces in the closed bag
        self._ended = True  # a bag that has not begun accepts nothing
        self._failure: Exception | None = None
        check_free(path, overwrite=overwrite)

    def enter(self, part: Part) -> None:
        """Add one robot's part; the first one creates the folder."""
        with self._turn:
            if self._begun if self._entered else self._names and part.namespace not in self._names:
                raise BagError(f"the bag '{self.path}' is being written and accepts no further robot")
            names = [part.namespace for part in (*self._parts, part)]
            if len(names) > len(set(names)) or ("" in names and len(names) > 1):
                raise BagError(f"the robots of the bag '{self.path}' need namespaces that differ")
            try:
                if not self._entered:
                    self._old = OldBag(self.path, overwrite=self._overwrite)
                    self._create()
                try:
                    part.open()
                    self.writer.flush()
                    if self.fsync:
                        sync(self.path, self.path.absolute().parent)
                except BaseException:
                    if not self._entered:
                        self._remove()
                    raise
            except WriterError as error:  # another process has made the folder meanwhile
                raise BagError(f"cannot write the bag '{self.path}': {error}") from error
            except (OSError, sqlite3.Error) as error:
                raise BagError(f"cannot write the bag '{self.path}': {_reason(error)}") from error
            self._parts.append(part)
            self._entered += 1

    def add_topic(self, name: str, topic: Topic) -> int:
        """Add a topic; return the number of its connection."""
        store, profiles = store_of(topic.type), [topic.qos]
        return self.writer.add_connection(name, topic.type, typestore=store, offered_qos_profiles=profiles).id

    def check(self) -> None:
        """Raise the error that ended the thread, if any; raise BagError if the bag is not open."""
        if self._failure is not None:
            self._wait(lambda: False)
            raise self._error(self._failure) from self._failure
        if self._ended:
            raise BagError(f"the bag '{self.path}' is not open; open it by 'with bag:'")

    def flush(self) -> None:
        """Make the thread store the queue; the first flush starts the thread.

        A thread stores the messages for two reasons. Ctrl-C, which Python raises in the main thread, cannot interrupt
        the writing of a message. Samples also reach the disk during a long step of the FMU.
        """
        before = self._stores
        self._due.put(None)
        self._begin()
        self._wait(lambda: self._stores > before)

    def leave(self, exception: object) -> None:
        """End one robot's part; the last one closes the bag, or removes it if the run failed without a sample.

        A full disk or a lost folder raises BagError, unless the present exception is a BagError already.
        """
        with self._turn:
            self._entered -= 1
            if self._entered:
                return
        self._closing = True
        self._due.put(None)
        self._begin()
        self._wait(lambda: False)  # if this is interrupted, the thread still ends its work
        self._names = {part.namespace for part in self._parts}
        sound = self._closed and self._failure is None
        if sound and isinstance(exception, Exception) and not any(part.stored() for part in self._parts):
            shutil.rmtree(self.path, ignore_errors=True)  # the FMU failed before its first sample
        elif sound and exception is None:
            self._old.remove()  # by a bag without samples; the thread removes it for others
        self._old.restore()
        self._parts.clear()
        if self._failure is not None and not isinstance(exception, BagError):
            raise self._error(self._failure) from self._failure

    def _create(self) -> None:
        """Create the bag's folder, or leave nothing behind."""
        self.writer = BagWriter(self.path, self._storage, fsync=self.fsync, compress=self._compress)
        self._lock = -1  # no descriptor yet
        self._due: SimpleQueue[None] = SimpleQueue()
        self._stores = 0
        self._begun = self._closing = self._closed = self._ended = False
        self._failure = None
        try:
            self.writer.open()
            self._lock = lock(self.path, wait=True)  # before it is a bag that others may overwrite
            with (self.path / RESERVE).open("wb") as reserve:
                reserve.write(b"\0" * RESERVE_SIZE)
                reserve.flush()
                os.fsync(reserve.fileno())
        except (WriterError, BlockingIOError):  # another process has the folder
            self._old.restore()
            raise
        except BaseException:
            self._remove()
            raise

    def _remove(self) -> None:
        with suppress(OSError, sqlite3.Error):
            self.writer.abort()
        shutil.rmtree(self.path, ignore_errors=True)
        self._old.restore()
        with suppress(OSError):
            os.close(self._lock)

    def _begin(self) -> None:
        with self._turn:
            if not self._begun:
                self._begun = True
                Thread(target=self._keep_storing, name="bag writer").start()

    def _wait(self, done: Callable[[], bool]) -> None:
        """Wait until a condition holds or the thread has ended.

        It polls instead of using a lock, an event or a join: Python raises Ctrl-C between any two instructions, and a
        lock that was just acquired would then never be released.
        """
        while not (done() or self._ended):
            time.sleep(PAUSE)

    def _keep_storing(self) -> None:
        """Store the queue twice a second and on request, then close the bag; this is the thread's function."""
        try:
            closing = False
            while not closing:
                with suppress(Empty):
                    self._due.get(timeout=FLUSH_PERIOD)
                if closing := self._closing:
                    (self.path / RESERVE).unlink(missing_ok=True)
                self._store()
                if any(part.stored() for part in self._parts):
                    self._old.remove()
                self._stores += 1
        except Exception as error:  # raised in the main thread
            self._failure = error
        try:
            self._close()
        except Exception as error:
            self._failure = error
        finally:
            os.close(self._lock)
            self._ended = True

    def _store(self) -> None:
        for part in self._parts:
            part.hand_over()
        self.writer.flush()

    def _close(self) -> None:
        """Close the bag; after a failure release the reserve and store the rest."""
        storage = self.writer.storage
        assert storage is not None
        if self._failure is not None:
            if not storage.path.exists():
                self.writer.abort()
                return
            (self.path / RESERVE).unlink(missing_ok=True)
            storage.salvage()
            self._store()
        for part in self._parts:
            with suppress(OSError):  # provenance was removed: close the bag without it
                self.writer.set_custom_data(*part.metadata())
        self.writer.close()
        if self.fsync:
            sync(storage.path, self.path / "metadata.yaml", self.path)
        self._closed = True

    def _error(self, failure: Exception) -> Exception:
        """Return the main thread's error for a failure of the thread."""
        if not isinstance(failure, OSError | sqlite3.Error):
            return failure
        gone = not self.path.exists()  # the storage's own error would be arbitrary
        reason = REMOVED if gone else _reason(failure)
        reason = f"cannot continue writing the bag '{self.path}': {reason}"
        if self._closed:
            kept = min(part.stored() for part in self._parts)
            return BagError(f"{reason}; it is closed with its first {kept} samples")
        if not gone:
            return BagError(f"{reason}; then repair it with 'twodof recover {self.path}'")
        return BagError(reason)


def _reason(error: Exception) -> str:
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    if full or "full" in str(error):
        return "the disk is full"
    return (isinstance(error, OSError) and error.strerror) or str(error)
