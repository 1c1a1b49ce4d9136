"""The loop that steps an FMU in real time at the request of pages.

A separate thread serves the pages. It queues the requests of their controls, which the loop executes between two steps,
and reads the updates for the pages. Neither thread waits for the other.
"""

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from threading import Condition
from typing import NamedTuple

from ..bag.writer import Bag
from ..errors import BagError, PageError, SimulationError
from ..files import JsonObject, free_name
from ..simulation.experiments import Experiment
from ..simulation.input_values import Setting, Value, check_going_on, resolve
from ..simulation.pace import RealTime
from ..simulation.sample import Sample
from ..simulation.stepping import at_rest, samples

MOST_ROWS = 1000  # rows kept for pages that have not read them
MOST_AT_ONCE = 200  # rows in one message
MOST_NOTES = 4
MOST_ORDERS = 16  # waiting requests above which a page's messages are read later
MOST_STEPS = 10  # steps in one request
IDLE = 0.05  # s between two checks of ``stop``
TOLD = ("x_des", "quat_des", "q_des")  # inputs sent with a sample


class PartialBag(Bag):
    """A partial bag that begins during a run, at the current sample.

    Its provenance describes a run that starts with the joint positions, velocities and inputs of its first sample. Its
    stamps start at the present wall time.
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


class Order(NamedTuple):
    """A request: its name, its value as a number, and the values of a "change" by variable."""

    name: str
    number: int
    values: dict[str, Value]


class Loop:
    """Steps an FMU at the request of pages.

    Args:
        run: the experiment, with a long stop time.
        bag: name of the first recording; None: rosbag2_<date and time>.
        command_line: command line for the provenance of recordings.

    Attributes:
        recorded: the written bags.
        viewers: number of open pages; without one, the FMU is not stepped.

    Raises:
        PageError: the FMU contains no robot, or has no target.
        FmuError, SimulationError: the FMU cannot be instantiated.
    """

    def __init__(self, run: Experiment, *, bag: str | None = None, command_line: str = "") -> None:
        fmu = run.fmu
        drives = [group for group in ("x_des", "q_des", "tau_cmd") if fmu.vector(group)]
        if fmu.urdf is None or not fmu.axes or not drives:
            raise PageError(f"'{fmu.path}' contains no robot, or no inputs that drive it")
        self._run, self._bag, self._command_line = run, bag, command_line
        self._first = run
        self.recorded: list[Path] = []
        self.pace = RealTime()
        self.steps = 0
        self.viewers = 0
        self._recording: PartialBag | None = None
        self._changes: dict[str, Value] = {}
        self._playing = True
        self._orders: deque[Order] = deque()
        self._groups = [name for group in TOLD for name in fmu.vector(group)]
        self._lock = Condition()  # protects the requests and the data for updates
        self._rows: deque[list[float]] = deque(maxlen=MOST_ROWS)
        self._notes: deque[str] = deque(maxlen=MOST_NOTES)
        self._number = self._count = self._noted = 0
        self._values: dict[str, Value] = {}
        self._begin()

    def _begin(self) -> None:
        """Instantiate the FMU and take its first sample."""
        self._source = samples(self._run, pace=self.pace, resume=self._resume)
        self.pace.restart()
        sample = next(self._source)
        self._broken = False
        with self._lock:
            self._rows.clear()
            self._count, self._number = 0, self._number + 1
            self._values = dict(self._run.start_values)
            self._take(sample)  # in one assignment, so that no update describes a run without a sample

    def play(self, stop: Callable[[], bool]) -> None:
        """Step the FMU as pages request, until ``stop`` returns true."""
        try:
            while not stop():
                if self._playing and self.viewers and not self._broken:
                    self._step(paced=True)
                else:
                    self.pace.restart()
                    self._obey(IDLE)
                for _ in range(len(self._orders)):  # requests added meanwhile wait
                    if not stop():
                        self._obey()
        finally:
            self._end_recording()
            self._source.close()

    def tell(self, order: str, value: object = None) -> None:
        """Queue a request for execution between two steps; callable from any thread.

        Successive requests of one kind are merged, and the newest values win.

        Args:
            order: "change" inputs and parameters (a parameter restarts the simulation), "play", "step", "reset" or
                "record".
            value: for "change", settings by name; for "play", whether to run; for "reset", whether inputs and
                parameters are reset too; for "record", whether to record.

        Raises:
            InputError: a setting is invalid.
            ValueError: there is no such request.
        """
        values: dict[str, Value] = {}
        with self._lock:
            if order == "change" and isinstance(value, Mapping):
                values = resolve(self._run.fmu, value)
                check_going_on(self._run.fmu, values, self._values)
                self._values |= values
            elif order in ("play", "step"):
                self._playing = order == "play" and bool(value)
            elif order not in ("reset", "record"):
                raise ValueError(order)
            newest = Order(order, int(order == "step" or bool(value)), values)
            same = self._orders and self._orders[-1].name == order
            self._orders.append(_joined(self._orders.pop(), newest) if same else newest)
            self._lock.notify()

    @property
    def behind(self) -> bool:
        """Return whether too many requests wait; callable from any thread."""
        return len(self._orders) >= MOST_ORDERS

    def note(self, text: str) -> None:
        """Show a text on all pages; callable from any thread."""
        with self._lock:
            self._notes.append(text)
            self._noted += 1

    def news(self, run: int = 0, seen: int = 0) -> JsonObject:
        """Return an update for a page since its last one; callable from any thread.

        Args:
            run, seen: values of the last update.

        Returns:
            run: number of the run; another number means that the simulation was restarted.
            t: time of the latest sample, s.
            seen: number of the last row.
            rows: time, s, and the groups in ``TOLD`` of each new sample.
            values: inputs and parameters after all requests so far.
            playing: whether the simulation runs.
            missed, steps, worst: missed deadlines, number of steps, and largest delay, s.
            recorded: number of samples in the present recording, 0 without one.
            notes, noted: the latest notes for the user, and their total number.
        """
        recording = self._recording
        with self._lock:
            known = len(self._rows)
            new = min(known, self._count - (seen if run == self._number else 0))
            rows = [*islice(self._rows, known - new, known - new + MOST_AT_ONCE)]
            return {
                "run": self._number,
                "t": self._sample.t,
                "seen": self._count - new + len(rows),
                "rows": rows,
                "values": dict(self._values),
                "playing": self._playing,
                "missed": self.pace.missed,
                "steps": self.steps,
                "worst": self.pace.worst,
                "recorded": 0 if recording is None else recording.count,
                "notes": [*self._notes],
                "noted": self._noted,
            }

    def _obey(self, timeout: float = 0.0) -> None:
        with self._lock:
            if not self._lock.wait_for(lambda: self._orders, timeout):
                return
            order, number, values = self._orders.popleft()
        if order == "change":
            self._change(values)
        elif order == "step" and not self._broken:
            self.pace.restart()
            for _ in range(number):
                self._step()
        elif order == "reset":
            self._restart({}, self._first if number else None)
        elif order == "record" and not number:
            self._end_recording()
        elif order == "record" and self._recording is None:
            self._record()

    def _change(self, values: Mapping[str, Value]) -> None:
        """Change inputs from the next step on; a parameter restarts the simulation."""
        inputs = self._sample.inputs
        self._changes |= {name: values[name] for name in values if name in inputs}
        with self._lock:
            self._values |= values  # again, because an earlier request may have reset them
        parameters = {name: values[name] for name in values if name not in inputs}
        if parameters:
            self._restart(parameters)

    def _step(self, *, paced: bool = False) -> None:
        changes, self._changes = self._changes, {}
        try:
            self._take(self._source.send(changes or None), paced)
        except (SimulationError, StopIteration) as error:
            self._broken = True
            self.note(f"The simulation has ended: {error or 'its time is over'}")
            self._end_recording()

    def _resume(self, sample: Sample, error: SimulationError) -> Mapping[str, Setting] | None:
        rest = at_rest(self._run.fmu, sample)
        if rest is not None:
            self.note(f"The robot is stopped where it is: {error}")
            with self._lock:
                self._values |= resolve(self._run.fmu, rest)
        return rest

    def _take(self, sample: Sample, paced: bool = False) -> None:
        self._sample = sample
        inputs = (float(sample.inputs[name]) for name in self._groups)
        row = [sample.t, *sample.q, *sample.v, *sample.x, *sample.quat, *sample.tau, *inputs]
        with self._lock:
            self._rows.append(row)
            self._count += 1
            self.steps += paced
        if self._recording is not None:
            try:
                self._recording.write(sample)
            except BagError as error:
                self.note(f"The recording has ended: {error}")
                self._recording = None

    def _restart(self, values: Mapping[str, Value], first: Experiment | None = None) -> None:
        """Restart the simulation; inputs and parameters keep their values unless they are given or reset."""
        self._end_recording()
        self._source.close()
        now, self._changes = {**self._sample.inputs, **self._changes}, {}
        runs = [first or self._starting({**now, **values}), self._starting(now), self._run]
        for self._run in runs:
            try:
                return self._begin()
            except SimulationError as error:
                self.note(str(error))

    def _starting(self, values: Mapping[str, Value]) -> Experiment:
        """Return the experiment with these start values."""
        run = self._run
        return replace(run, start_values={**run.start_values, **values}, given={**run.given, **values})

    def _record(self) -> None:
        path = free_name(self._bag or time.strftime("rosbag2_%Y_%m_%d-%H_%M_%S"))
        try:
            self._recording = PartialBag(path, self._run, self._sample, self._command_line)
        except BagError as error:
            self.note(f"There is no recording: {error}")
        self.pace.restart()  # opening a bag may have waited for the disk

    def _end_recording(self) -> None:
        recording, self._recording = self._recording, None
        if recording is None:
            return
        try:
            recording.__exit__(None, None, None)
            self.recorded.append(recording.path)
            self.note(f"Recorded: {recording.path}, {recording.count} samples")
        except BagError as error:
            self.note(f"The recording has ended: {error}")
        self.pace.restart()


def _joined(before: Order, newest: Order) -> Order:
    """Merge two successive requests of one name."""
    merged = {"step": min(before.number + newest.number, MOST_STEPS), "reset": before.number | newest.number}
    number = merged.get(newest.name, newest.number)
    return Order(newest.name, number, {**before.values, **newest.values})
