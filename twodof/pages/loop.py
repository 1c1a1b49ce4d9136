"""The loop that steps an FMU in real time as a page asks; it knows the page by a connection alone.

The two talk through a pipe: the page tells what its controls ask for, which is done between two
steps, and thirty times a second that it is ready for more, whereupon the loop tells what has
happened.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import chain, count
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from ..bag.writer import Bag
from ..errors import BagError, PageError, SimulationError
from ..experiments import Experiment, Setting, resolve
from ..master import at_rest, samples
from ..pace import RealTime
from ..sample import Sample

MOST_ROWS = 10_000  # that wait for a page to ask
IDLE = 0.05  # s between two looks at whether to go on


class Excerpt(Bag):
    """A bag that begins in the midst of a run, with the sample that is at hand.

    Its provenance is that of a run which starts there: from the joint positions and velocities and
    with the inputs of its first sample. Its stamps start at the wall clock's time.
    """

    def __init__(self, path: Path, run: Experiment, first: Sample, command_line: str) -> None:
        super().__init__(path, scene=True, effort=bool(first.tau), command_line=command_line)
        state = {
            name: value
            for group, values in (("q_start", first.q), ("v_start", first.v))
            for name, value in zip(run.fmu.vector(group), values)
        }
        starts = {**run.start_values, **first.inputs, **state}
        run = replace(run, start_time=first.t, start_values=starts, changes=[])
        self._later = run.first_stamp() - first.stamp
        self.begin(run).__enter__()
        self.write(first)

    def write(self, sample: Sample) -> None:
        """Write one sample."""
        super().write(sample._replace(stamp=sample.stamp + self._later))


class News(NamedTuple):
    """What the loop tells the page.

    Attributes:
        sample: the latest.
        rows: joint positions and distance from the target, m, of each sample since the last news.
        again: whether the run has begun again since.
        playing: whether it is to go on.
        missed, steps, worst: deadlines missed, of how many steps, and the largest delay, s.
        recorded: number of samples in the bag that is being recorded, 0 where there is none.
        notes: what to tell the user, titles and texts.
    """

    sample: Sample
    rows: list[tuple[float, ...]]
    again: bool
    playing: bool
    missed: int
    steps: int
    worst: float
    recorded: int
    notes: list[tuple[str, str]]


class Loop:
    """Steps an FMU as a page asks.

    Args:
        run: what to run; a long one.
        bag: name of the first recording; None: rosbag2_<date and time>.
        command_line: for the provenance of recordings.

    Attributes:
        recorded: the bags that were written.
        pace: keeps the time.
        steps: number of steps in real time.

    Raises:
        PageError: the FMU carries no robot, or no target.
        FmuError, SimulationError: it cannot be instantiated.
    """

    def __init__(self, run: Experiment, *, bag: str | None = None, command_line: str = "") -> None:
        fmu = run.fmu
        drives = [group for group in ("x_des", "q_des", "tau_cmd") if fmu.vector(group)]
        if fmu.urdf is None or not fmu.axes or not drives:
            raise PageError(f"'{fmu.path}' carries no robot, or no inputs that drive it")
        self._run, self._bag, self._command_line = run, bag, command_line
        self.recorded: list[Path] = []
        self.pace = RealTime()
        self.steps = 0
        self._recording: Excerpt | None = None
        self._changes: dict[str, Setting] = {}
        self._notes: list[tuple[str, str]] = []
        self._playing, self._watched, self._singles = True, False, 0
        self._begin()

    def _begin(self) -> None:
        """Instantiate the FMU and take its first sample."""
        self._source = samples(self._run, pace=self.pace, resume=self._resume)
        self.pace.restart()
        self._rows: list[tuple[float, ...]] = []
        self._again, self._broken = True, False
        self._take(next(self._source))

    def play(self, page: Connection, stop: Callable[[], bool]) -> None:
        """Step the FMU as the page asks, until ``stop`` is true.

        Raises:
            PageError: the page's process has ended.
        """
        try:
            while not stop():
                if self._singles and not self._broken:
                    self._singles -= 1
                    self.pace.restart()
                    self._step()
                elif self._playing and self._watched and not self._broken:
                    self._step()
                    self.steps += 1
                else:
                    self.pace.restart()
                    page.poll(IDLE)
                while page.poll():
                    self._obey(page, *page.recv())
        except (EOFError, OSError) as error:
            raise PageError("the process of the page has ended") from error
        finally:
            self._end_recording()
            self._source.close()

    def news(self) -> News:
        """What has happened since it was asked before."""
        rows, self._rows = self._rows, []
        notes, self._notes = self._notes, []
        again, self._again = self._again, False
        return News(
            self._sample, rows, again, self._playing, self.pace.missed, self.steps, self.pace.worst,
            0 if self._recording is None else self._recording.count, notes,
        )  # fmt: skip

    def _obey(self, page: Connection, order: str, value: Any) -> None:
        if order == "more":
            self._watched = value
            page.send(self.news())
        elif order == "change":
            self._changes.update(value)
        elif order == "play":
            self._playing = value
        elif order == "step":
            self._playing = False
            self._singles += 1
        elif order == "reset":
            self._reset()
        elif not value:
            self._end_recording()
        elif self._recording is None:
            self._record()

    def _step(self) -> None:
        changes, self._changes = self._changes, {}
        try:
            self._take(self._source.send(changes or None))
        except (SimulationError, StopIteration) as error:
            self._broken = True
            self._notes.append(("The simulation has ended", f"{error or 'its time is over'}"))
            self._end_recording()

    def _resume(self, sample: Sample, error: SimulationError) -> Mapping[str, Setting] | None:
        rest = at_rest(self._run.fmu, sample)
        if rest is not None:
            self._notes.append(("The robot is stopped where it is", str(error)))
        return rest

    def _take(self, sample: Sample) -> None:
        self._sample = sample
        self._rows.append((*sample.q, sample.error or 0.0))
        del self._rows[:-MOST_ROWS]  # while no page asks
        if self._recording is not None:
            try:
                self._recording.write(sample)
            except BagError as error:
                self._notes.append(("The recording has ended", str(error)))
                self._recording = None

    def _reset(self) -> None:
        """The arm back to its start; the inputs stay."""
        self._end_recording()
        self._source.close()
        inputs = {**self._sample.inputs, **resolve(self._run.fmu, self._changes)}
        self._changes = {}
        self._run = replace(
            self._run,
            start_values={**self._run.start_values, **inputs},
            given={**self._run.given, **inputs},
        )
        self._begin()

    def _record(self) -> None:
        path = self._free_name()
        try:
            self._recording = Excerpt(path, self._run, self._sample, self._command_line)
        except BagError as error:
            self._notes.append(("There is no recording", str(error)))
        self.pace.restart()  # opening a bag may wait for the disk: time has stood still

    def _end_recording(self) -> None:
        recording, self._recording = self._recording, None
        if recording is None:
            return
        try:
            recording.__exit__(None, None, None)
            self.recorded.append(recording.path)
            self._notes.append(("Recorded", f"{recording.path}, {recording.count} samples"))
        except BagError as error:
            self._notes.append(("The recording has ended", str(error)))
        self.pace.restart()

    def _free_name(self) -> Path:
        name = self._bag or time.strftime("rosbag2_%Y_%m_%d-%H_%M_%S")
        names = chain([name], (f"{name}-{i}" for i in count(2)))
        return next(path for path in map(Path, names) if not path.exists())
