"""The logger: a sink that writes each sample as sensor_msgs/JointState into a ROS 2 bag."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread

from rosbags.rosbag2 import WriterError

from ..errors import BagError
from ..experiments import Experiment, Value
from ..files import lock, read_file, sync
from ..ros.cdr import Rows
from ..ros.messages import JOINT_STATES, STORE, Messages
from ..sample import Sample, Sink
from .provenance import KEY, ProvenanceFile, read_provenance
from .storage import (
    BATCH_SIZE,
    MAX_METADATA,
    OVERHEAD,
    REMOVED,
    STORAGES,
    BagWriter,
    Stamps,
    check_path,
)

RESERVE = "reserve"
RESERVE_SIZE = 2 * 1024**2
FLUSH_PERIOD = 0.5  # s of wall time
PAUSE = 0.0005  # s between two looks at how far the thread is


class Bag(Sink):
    """A sink that writes a rosbag2 folder.

    Left in whatever way, the bag is closed and readable with every sample written so far; while
    the run goes on, what is older than a second survives the death of the process.

    Samples are serialised, many at a time, and stored by a thread of the bag's own: Ctrl-C, which
    Python raises in the main thread, so never comes between the bytes of a message, and what is
    written reaches the disk also while the FMU takes its time for a step.

    Args:
        path: folder of the bag; must not exist, unless ``overwrite`` and it is a bag.
        storage: "mcap" or "sqlite3".
        scene: add the robot description, transforms, target and end effector.
        effort: put the control effort into JointState.effort.
        overwrite: replace an existing bag.
        fsync: wait for the disk at each flush, so that the machine may lose its power too.
        command_line: for the provenance.

    Attributes:
        path: the folder.
        count: number of samples so far.

    Raises:
        BagError: the folder exists or cannot be written; in ``write`` and at the end where the
            disk is full or the folder is gone.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        storage: str = "mcap",
        scene: bool = False,
        effort: bool = False,
        overwrite: bool = False,
        fsync: bool = False,
        command_line: str = "",
    ) -> None:
        self.path = Path(path)
        if storage not in STORAGES:
            raise BagError(f"storage '{storage}' is not one of {', '.join(STORAGES)}")
        check_path(self.path, storage)
        self._storage = storage
        self._overwrite = overwrite
        self._fsync = fsync
        self._scene, self._effort = scene, effort
        self._command_line = command_line
        self._run: Experiment | None = None
        self.count = 0
        self._lock = -1  # no descriptor yet
        _check_free(self.path, overwrite)

    def begin(self, run: Experiment) -> Bag:
        """Take the experiment whose samples come.

        Raises:
            BagError: the FMU has not what is asked for.
        """
        self._run = run
        self._inputs = run.start_values
        self._messages = Messages(run, scene=self._scene, effort=self._effort)
        self._most = BATCH_SIZE // (self._messages.size + OVERHEAD * len(self._messages.topics))
        return self

    def __enter__(self) -> Bag:
        if self._run is None:
            raise BagError("a bag is given its experiment first: 'with bag.begin(experiment):'")
        try:
            _check_free(self.path, self._overwrite, clear=True)
            self._writer = BagWriter(self.path, self._storage, fsync=self._fsync)
            self._open(self._run)
        except WriterError as error:  # the folder appeared meanwhile and is not ours
            raise BagError(f"cannot write the bag '{self.path}': {error}") from error
        except (OSError, sqlite3.Error) as error:
            raise BagError(f"cannot write the bag '{self.path}': {_reason(error)}") from error
        self._queue: deque[bytes] = deque()  # numbers of samples
        self._changes: deque[tuple[float, dict[str, Value]]] = deque()
        self._taken = 0  # samples, counted by the thread
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
        if sample.inputs is not self._inputs:
            self._note(sample)
        self._queue.append(self._messages.numbers(sample))
        self.count += 1
        if self.count == 1 or self.count - self._taken > self._most:
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
        """Queue what changed of the inputs since the sample before."""
        changed = {n: v for n, v in sample.inputs.items() if v != self._inputs.get(n)}
        if changed:
            self._changes.append((sample.since, changed))
        self._inputs = sample.inputs

    def __exit__(self, _type: object, exception: object, _traceback: object) -> None:
        self._closing = True
        self._due.put(None)
        self._wait(lambda: False)  # if this is interrupted, the thread still ends its work
        if self._failure is not None and not isinstance(exception, BagError):
            raise self._error(self._failure) from self._failure

    def _open(self, run: Experiment) -> None:
        """Create the bag's folder, or leave nothing of it."""
        try:
            self._writer.open()
            self._lock = lock(self.path, wait=True)  # before it is a bag that others may overwrite
            self._provenance = ProvenanceFile(self.path, run, self._command_line)
            with (self.path / RESERVE).open("wb") as reserve:
                reserve.write(b"\0" * RESERVE_SIZE)
                reserve.flush()
                os.fsync(reserve.fileno())
            self._connections = {
                name: self._writer.add_connection(
                    name, topic.type, typestore=STORE, offered_qos_profiles=[topic.qos]
                ).id
                for name, topic in self._messages.topics.items()
            }
            self._writer.flush()
            if self._fsync:
                sync(self._provenance.path, self.path, self.path.absolute().parent)
        except (WriterError, BlockingIOError):  # the folder is another's
            raise
        except BaseException:
            with suppress(OSError, sqlite3.Error):
                self._writer.abort()
            shutil.rmtree(self.path, ignore_errors=True)
            with suppress(OSError):
                os.close(self._lock)
            raise

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
        """Changes of inputs before the messages that show what they did."""
        samples, changes = list(self._queue), list(self._changes)
        self._provenance.add(changes)
        for _ in changes:
            self._changes.popleft()
        if self._fsync and changes:
            sync(self._provenance.path)
        if samples:
            stamps, messages = self._messages.of_all(b"".join(samples))
            if not self._taken:
                self._give(stamps[:1], self._messages.latched(stamps[0]))
            self._give(stamps, messages)
            for _ in samples:
                self._queue.popleft()
            self._taken += len(samples)
        self._writer.flush()

    def _give(self, stamps: Stamps, messages: Mapping[str, Rows]) -> None:
        """Hand messages to the writer, of each topic one by each stamp."""
        rows = {self._connections[topic]: rows for topic, rows in messages.items()}
        self._writer.write_all(stamps, rows)

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
        with suppress(OSError):  # it was removed: the messages are worth closing without it
            self._writer.set_custom_data(KEY, self._provenance.text())
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
            kept = self._writer.counts[self._connections[JOINT_STATES]]
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
            reason = "exists already; choose another with `path` or give `overwrite=True`"
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
        return bool(read_provenance(path))
