"""The logger: a sink that writes each sample as sensor_msgs/JointState into a ROS 2 bag."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread

from rosbags.interfaces import Connection
from rosbags.rosbag2 import WriterError

from ..errors import BagError
from ..files import read_file
from ..inputs import Changes
from ..master import Experiment, Sample
from . import provenance
from .messages import JOINT_STATES, STORE, Messages, Serialised, Stamps
from .storage import BATCH_SIZE, REMOVED, STORAGES, BagWriter, check_path, lock, sync

MAX_METADATA = 64 * 1024**2  # bytes
PROVENANCE_KEY = "twodof"
MOST_CHANGES = 100_000  # of inputs, that the provenance of an open-ended run has room for
RESERVE = "reserve"
RESERVE_SIZE = 2 * 1024**2
FLUSH_PERIOD = 0.5  # s of wall time
PAUSE = 0.0005  # s between two looks at how far the thread is


class Bag:
    """A sink that writes a rosbag2 folder.

    Left in whatever way, the bag is closed and readable with every sample written so far; while
    the run goes on, what is older than a second survives the death of the process.

    Messages are serialised where ``write`` is called, and stored by a thread of the bag's own:
    Ctrl-C, which Python raises in the main thread, so never comes between the bytes of a message,
    and what is written reaches the disk also while the FMU takes its time for a step.

    Args:
        path: folder of the bag; must not exist, unless ``overwrite`` and it is a bag.
        run: the experiment whose samples come; goes into the provenance.
        storage: "mcap" or "sqlite3".
        scene: add the robot description, transforms, target and end effector.
        effort: put the control effort into JointState.effort.
        stamp_start: time of the first stamp, s since the epoch; None: the wall clock.
        overwrite: replace an existing bag.
        fsync: wait for the disk at each flush, so that the machine may lose its power too.
        open_ended: how long the run will be and what will change its inputs is not known before;
            the provenance is completed at the end.
        command_line: for the provenance.

    Attributes:
        path: the folder.
        stamps: of the messages.
        count: number of samples so far.

    Raises:
        BagError: the folder exists or cannot be written; in ``write`` and at the end where the
            disk is full or the folder is gone.
    """

    def __init__(
        self,
        path: str | Path,
        run: Experiment,
        *,
        storage: str = "mcap",
        scene: bool = False,
        effort: bool = False,
        stamp_start: float | None = None,
        overwrite: bool = False,
        fsync: bool = False,
        open_ended: bool = False,
        command_line: str = "",
    ) -> None:
        self.path = Path(path)
        self._run = run
        if storage not in STORAGES:
            raise BagError(f"storage '{storage}' is not one of {', '.join(STORAGES)}")
        check_path(self.path, storage)
        self._storage = storage
        self._overwrite = overwrite
        self._fsync = fsync
        self._open_ended = open_ended
        self._command_line = command_line
        self.count = 0
        self._lock = -1  # no descriptor yet
        self._inputs, self._latest = run.start_values, run.start_time
        self._changes: Changes = []
        self.stamps = Stamps(run, stamp_start)
        self._messages = Messages(run, scene=scene, effort=effort)
        _check_free(self.path, overwrite)

    def __enter__(self) -> Bag:
        start = self.stamps.now() if self._open_ended else self.stamps.start
        text = provenance.provenance(self._run, start, self._command_line)
        try:
            _check_free(self.path, self._overwrite, clear=True)
            self._writer = BagWriter(self.path, self._storage, fsync=self._fsync)
            self._open(text)
        except WriterError as error:  # the folder appeared meanwhile and is not ours
            raise BagError(f"cannot write the bag '{self.path}': {error}") from error
        except (OSError, sqlite3.Error) as error:
            raise BagError(f"cannot write the bag '{self.path}': {_reason(error)}") from error
        self._queue: deque[tuple[Connection, int, Serialised]] = deque()
        self._given = self._taken = 0  # bytes, counted by one thread each
        self._due: SimpleQueue[None] = SimpleQueue()
        self._stores = 0
        self._closing = self._closed = self._ended = False
        self._failure: Exception | None = None
        Thread(target=self._keep_storing, name="bag writer").start()
        return self

    def write(self, sample: Sample) -> None:
        """Write one sample: one JointState, and the scene's messages."""
        if self._failure is not None:
            self._wait(lambda: False)
            raise self._error(self._failure) from self._failure
        stamp = self.stamps.of(sample)
        if first := not self._given:
            self._give(self._messages.latched(stamp), stamp)
        self._give(self._messages.of(sample, stamp), stamp)
        self._note(sample)
        if first or self._given - self._taken > BATCH_SIZE:
            self._flush()

    def _flush(self) -> None:
        """Have the thread store what is queued."""
        before = self._stores
        self._due.put(None)
        self._wait(lambda: self._stores > before)

    def _wait(self, done: Callable[[], bool]) -> None:
        """Wait until something is done, or the thread has ended.

        Without a lock, an event or a join: Ctrl-C, which Python raises between any two instructions
        of this thread, would leave a lock taken for ever if it came when that had just been.
        """
        while not (done() or self._ended):
            time.sleep(PAUSE)

    def _note(self, sample: Sample) -> None:
        """Remember what changed inputs since the sample before, to which it was the answer."""
        if sample.inputs is not self._inputs and len(self._changes) < MOST_CHANGES:
            changed = {n: v for n, v in sample.inputs.items() if v != self._inputs.get(n)}
            if changed:
                self._changes.append((self._latest, changed))
        self._inputs, self._latest = sample.inputs, sample.t
        self.count += 1

    def _complete(self) -> None:
        """Put into the provenance what was not known before the run."""
        run = replace(self._run, steps=self.count - 1, changes=self._changes)
        text = provenance.provenance(run, self.stamps.start, self._command_line)
        self._writer.set_custom_data(PROVENANCE_KEY, text)
        file = self.path / provenance.FILE
        try:
            file.with_suffix(".new").write_text(text + "\n", "utf-8")
            file.with_suffix(".new").replace(file)
        except OSError as error:
            raise BagError(f"cannot write '{file}': {_reason(error)}") from error

    def __exit__(self, _type: object, exception: object, _traceback: object) -> None:
        try:
            if self._open_ended and self.count and self._failure is None:
                self._complete()
        finally:
            self._closing = True
            self._due.put(None)
            self._wait(lambda: False)  # if this is interrupted, the thread still ends its work
        if self._failure is not None and not isinstance(exception, BagError):
            raise self._error(self._failure) from self._failure

    def _open(self, text: str) -> None:
        """Create the bag's folder, or leave nothing of it."""
        try:
            self._writer.set_custom_data(PROVENANCE_KEY, text)
            self._writer.open()
            self._lock = lock(self.path, wait=True)  # before it is a bag that others may overwrite
            (self.path / provenance.FILE).write_text(text + "\n", "utf-8")
            with (self.path / RESERVE).open("wb") as reserve:
                reserve.write(b"\0" * RESERVE_SIZE)
                reserve.flush()
                os.fsync(reserve.fileno())
            self._connections = {
                name: self._writer.add_connection(
                    name, topic.type, typestore=STORE, offered_qos_profiles=[topic.qos]
                )
                for name, topic in self._messages.topics.items()
            }
            self._writer.flush()
            if self._fsync:
                sync(self.path / provenance.FILE, self.path, self.path.absolute().parent)
        except (WriterError, BlockingIOError):  # the folder is another's
            raise
        except BaseException:
            with suppress(OSError, sqlite3.Error):
                self._writer.abort()
            shutil.rmtree(self.path, ignore_errors=True)
            with suppress(OSError):
                os.close(self._lock)
            raise

    def _give(self, messages: Iterable[tuple[str, Serialised]], stamp: int) -> None:
        """Queue messages for the thread."""
        for topic, data in messages:
            self._queue.append((self._connections[topic], stamp, data))
            self._given += len(data)

    def _keep_storing(self) -> None:
        """The thread: stores what is queued twice a second, and when asked to; then closes."""
        try:
            closing = False
            while not closing:
                with suppress(Empty):
                    self._due.get(timeout=FLUSH_PERIOD)
                if closing := self._closing:
                    (self.path / RESERVE).unlink(missing_ok=True)
                self._store()
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
        while self._queue:
            connection, stamp, data = self._queue.popleft()
            self._writer.write(connection, stamp, data)
            self._taken += len(data)
        self._writer.flush()

    def _close(self) -> None:
        """Close the bag; after a failure give up the reserve and store what is still there."""
        storage = self._writer.storage
        assert storage is not None
        if self._failure is not None:
            if not storage.path.exists():
                self._writer.abort()
                return
            (self.path / RESERVE).unlink(missing_ok=True)
            storage.salvage()
            self._store()
        self._writer.close()
        if self._fsync:
            sync(storage.path, self.path / "metadata.yaml", self.path)
        self._closed = True

    def _error(self, failure: Exception) -> Exception:
        """What the main thread raises for a failure of the thread."""
        if not isinstance(failure, OSError | sqlite3.Error):
            return failure
        gone = not self.path.exists()  # the storage fails with this or that then
        reason = REMOVED if gone else _reason(failure)
        reason = f"cannot go on writing the bag '{self.path}': {reason}"
        if self._closed:
            kept = self._writer.counts[self._connections[JOINT_STATES].id]
            return BagError(f"{reason}; it is closed with its first {kept} samples")
        if not gone:
            return BagError(f"{reason}; then make it whole with 'twodof recover {self.path}'")
        return BagError(reason)


def _reason(error: Exception) -> str:
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    if full or "full" in str(error):
        return "the disk is full"
    return (isinstance(error, OSError) and error.strerror) or str(error)


def _check_free(path: Path, overwrite: bool, *, clear: bool = False) -> None:
    """Refuse what is in a bag's place; with ``clear``, remove what may be overwritten."""
    try:
        if not path.exists():
            return
        if not overwrite:
            reason = "exists already; choose another name with -o or use --overwrite"
            raise BagError(f"'{path}' {reason}")
        held = lock(path)
        try:
            if path.is_symlink() or not _is_bag(path):
                raise BagError(f"'{path}' is not a bag and is not overwritten")
            if clear:
                shutil.rmtree(path)
        finally:
            os.close(held)
    except BlockingIOError as error:
        reason = "is being written by another process and is not overwritten"
        raise BagError(f"'{path}' {reason}") from error
    except OSError as error:
        raise BagError(f"cannot write the bag '{path}': {error.strerror}") from error


def _is_bag(path: Path) -> bool:
    """A folder with rosbag2's metadata, or with our provenance where the writer died."""
    try:
        metadata = read_file(path / "metadata.yaml", MAX_METADATA)
        return metadata.startswith(b"rosbag2_bagfile_information:")
    except OSError:
        return bool(provenance.read_provenance(path))
