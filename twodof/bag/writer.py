"""The logger: a sink that writes each sample as sensor_msgs/JointState into a ROS 2 bag."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Mapping
from copy import copy
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from ..errors import BagError, path_of
from ..files import sync
from ..fmu import resource_reader
from ..ros.cdr import Rows
from ..ros.messages import JOINT_STATES, Messages, check_name
from ..simulation.experiments import Experiment
from ..simulation.input_values import Value
from ..simulation.sample import Sample, Sink, TakeRows
from ..simulation.verdict import Verdict
from .provenance import ProvenanceFile
from .storage import BATCH_SIZE, OVERHEAD, Stamps
from .store import Store


class Bag(Sink):
    """A sink that writes a rosbag2 folder.

    However the context ends, the bag is closed and readable, with every sample written so far. During the run, samples
    older than a second survive the death of the process.

    A thread serialises and stores many samples at a time.

    Args:
        path: folder of the bag; it must not exist, except as a bag with ``overwrite``.
        storage: "mcap" or "sqlite3".
        scene: add the robot description, transforms, target and end effector.
        meshes: store the robot's meshes in the folder; the robot description refers to them by file URIs.
        effort: put the control effort into JointState.effort.
        measured: /joint_states has the measured values, and /joint_states_true the true ones.
        overwrite: replace an existing bag.
        fsync: wait for the disk at each flush, so that samples also survive a power failure.
        compress: "zstd" compresses the chunks of an MCAP file.
        command_line: command line for the provenance.

    Attributes:
        path: the folder.
        namespace: namespace of the robot's topics; "" in a bag of one robot.
        count: number of samples so far.

    Raises:
        BagError: the folder exists or cannot be written. ``write`` and the end of the context raise it if the disk is
            full or the folder was removed.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        storage: str = "mcap",
        scene: bool = False,
        meshes: bool = False,
        effort: bool = False,
        measured: bool = False,
        overwrite: bool = False,
        fsync: bool = False,
        compress: str = "",
        command_line: str = "",
    ) -> None:
        self.path, self.namespace = path_of(path, "bag"), ""
        self._store = Store(self.path, storage, overwrite=overwrite, fsync=fsync, compress=compress)
        self._scene, self._meshes, self._effort, self._measured = scene or meshes, meshes, effort, measured
        self._command_line = command_line
        self._run: Experiment | None = None
        self.count = 0

    def of(self, namespace: str) -> Bag:
        """Return a sink for one of several robots in this bag; a ROS 2 namespace contains its topics."""
        check_name("namespace", namespace)
        robot = copy(self)
        robot.namespace = namespace.strip("/")
        return robot

    @property
    def address(self) -> str:
        """Address for readers: the folder, followed by the robot's namespace, if any."""
        return f"{self.path}:{self.namespace}" if self.namespace else str(self.path)

    @property
    def topic(self) -> str:
        """Topic of the joint states."""
        return self._named(JOINT_STATES)

    def begin(self, run: Experiment) -> Bag:
        """Receive the experiment of the following samples; BagError: the FMU lacks a requested output."""
        self._run = run
        self._inputs = run.start_values
        # letters beyond ASCII stay: rerun and Pinocchio do not decode names, and RViz and Foxglove take both
        name = re.sub(r"[^\w/.~-]", lambda character: quote(character[0]), f"{self._folder}/")
        folder = f"file://{name}" if self._meshes else ""
        self._messages = Messages(
            run, scene=self._scene, effort=self._effort, meshes_in=folder, measured=self._measured
        )
        self._most = BATCH_SIZE // (self._messages.size + OVERHEAD * len(self._messages.topics))
        return self

    def __enter__(self) -> Bag:
        if self._run is None:
            raise BagError("the bag is not open; open it by 'with bag.begin(experiment):'")
        self._queue: deque[bytes] = deque()  # packed numbers of waiting samples
        self._rows: deque[NDArray[np.float64]] = deque()  # outputs of waiting samples after these
        self._changes: deque[tuple[float, dict[str, Value]]] = deque()
        self._verdict: dict[str, object] | None = None
        self._taken = 0  # samples that the thread has taken
        self._store.enter(self)
        return self

    def write(self, sample: Sample) -> None:
        """Write one sample: one JointState, and the scene's messages."""
        self._store.check()
        if sample.inputs is not self._inputs:
            self._note(sample)
        self._queue.append(self._messages.numbers(sample))
        self.count += 1
        if self.count == 1 or self.count - self._taken > self._most:
            self._store.flush()

    @property
    def takes_rows(self) -> bool:
        """True if the bag needs outputs only, and no derived class overrides ``write``."""
        return not self._measured and type(self).write is Bag.write

    def take_rows(self, first: Sample) -> TakeRows:
        """Write the first sample; return a function that writes the outputs of further ones, whose inputs are equal."""
        self.write(first)
        self._first = first
        return self._write_rows

    def _write_rows(self, rows: NDArray[np.float64]) -> None:
        self._store.check()
        self._rows.append(rows)
        self.count += len(rows)
        if self.count - self._taken > self._most:
            self._store.flush()

    def conclude(self, verdict: Callable[[], Verdict]) -> None:
        """Receive the verdict, to be stored with the provenance."""
        self._verdict = verdict().facts()

    def __exit__(self, *exception: object) -> None:
        self._store.leave(exception[1])

    def open(self) -> None:
        """Add the robot's topics to the store, and its provenance to the folder."""
        run = self._run
        assert run is not None
        self._provenance = ProvenanceFile(self.path, self.namespace, run, self._command_line)
        if self._store.fsync:
            sync(self._provenance.path)
        read = resource_reader(run.fmu)
        meshes = [name for name in run.fmu.members if self._meshes and name.startswith("resources/meshes/")]
        for name in (name for name in meshes if not name.endswith("/")):  # many tools store folders too
            file = self._folder / name.removeprefix("resources/")
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(read(name.removeprefix("resources/")) or b"")
        add, topics = self._store.add_topic, self._messages.topics.items()
        self._connections = {name: add(self._named(name), topic) for name, topic in topics}

    def hand_over(self) -> None:
        """Pass the queue to the store: changes of inputs first, then the messages that they affect."""
        samples, rows, changes = list(self._queue), list(self._rows), list(self._changes)
        self._provenance.add(changes, self._verdict)
        for _ in changes:
            self._changes.popleft()
        if self._store.fsync and changes:
            sync(self._provenance.path)
        if samples or rows:
            numbers = b"".join(samples)
            if rows:
                numbers += self._messages.numbers_of(np.concatenate(rows), self._first, self._taken + len(samples))
            stamps, messages = self._messages.of_all(numbers)
            if not self._taken:
                self._give(stamps[:1], self._messages.latched(stamps[0]))
            self._give(stamps, messages)
            for waiting, taken in ((self._queue, samples), (self._rows, rows)):
                for _ in taken:
                    waiting.popleft()
            self._taken += len(stamps)

    def stored(self) -> int:
        """Return the number of samples in the bag."""
        return self._store.writer.counts[self._connections[JOINT_STATES]]

    def metadata(self) -> tuple[str, str]:
        """Return key and text of the provenance; raise OSError if its file was removed."""
        return self._provenance.key, self._provenance.text()

    @property
    def _folder(self) -> Path:
        """Folder of the robot's meshes."""
        return self.path.absolute() / self.namespace

    def _named(self, topic: str) -> str:
        return f"/{self.namespace}{topic}" if self.namespace else topic

    def _give(self, stamps: Stamps, messages: Mapping[str, Rows]) -> None:
        rows = {self._connections[topic]: rows for topic, rows in messages.items()}
        self._store.writer.write_all(stamps, rows)

    def _note(self, sample: Sample) -> None:
        """Queue the inputs that changed since the previous sample."""
        changed = {n: v for n, v in sample.inputs.items() if v != self._inputs.get(n)}
        if changed:
            self._changes.append((sample.since, changed))
        self._inputs = sample.inputs
