"""Read bags of any writer as arrays, and judge runs."""

from __future__ import annotations

import logging
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path

from ..bounds import MAX_DRAWN, MAX_SAMPLES, MAX_SAMPLES_RATIO, MIB
from ..errors import BagError, InputError, no_such, path_of
from ..files import is_being_written, shown
from ..ros.cdr import Rows
from ..ros.messages import JOINT_STATE, JOINT_STATES, POINT, POSE, TARGET
from ..simulation.experiments import Experiment
from ..simulation.judge import BLOCK
from ..simulation.sample import Sample
from ..simulation.setup import robot_of
from ..simulation.stepping import judge_of
from ..simulation.verdict import Verdict, conclude
from .contents import read_messages, stated_count, storage_files
from .downsampling import Downsampler
from .joint_states import Ends, JointStates, Targets
from .provenance import file_of, read_provenance, robot_in, robots_of
from .recording import Array, Inputs, Recording, TopicCount
from .records import Channel, DamageError, ReadBudget, Stamps
from .summary import McapSummary, read_summaries

LOG = logging.getLogger(__name__)


def read_bag(path: str | Path) -> Recording:
    """Read the joint states and targets of a bag of any writer.

    Args:
        path: the bag's folder; for one of several robots, followed by a colon and its namespace.

    Raises:
        BagError: the path is not a bag, or the bag is unfinished, damaged or without joint states.
    """
    return read_bags([path])[0]


def read_downsampled(path: str | Path, most: int, lines: Callable[[Recording], Sequence[Array]]) -> Recording:
    """Read a bag as ``read_bag`` does, downsampled to at most ``most`` samples for drawing.

    Memory holds at most ``most`` samples and a chunk of the bag. ``lines`` returns the curves of a part of the bag that
    are drawn in addition to positions and velocities; its exceptions are passed on.
    """
    return _read([_Robot(Path(path), JointStates, Targets(), Downsampler(most, lines))])[0]


def read_bags(paths: Sequence[str | Path], budget: ReadBudget | None = None) -> list[Recording]:
    """Read robots of one bag as ``read_bag`` does, in one pass; the budget may be that of several bags together."""
    return _read([_Robot(path_of(path, "bag"), JointStates, Targets()) for path in paths], budget)


def read_all_ends(paths: Sequence[Path]) -> list[Recording]:
    """Return the first and the last joint state of robots of one bag.

    Use the summaries of the files if all have a valid one; otherwise read the whole bag once.
    """
    folder, _ = robot_in(paths[0])
    with _refusing(folder):
        summaries = read_summaries(whole_bag(folder))
        found = [None if summaries is None else _ends(path, summaries) for path in paths]
    rest = iter(_read([_Robot(path, Ends, None) for path, known in zip(paths, found) if known is None]))
    return [known or next(rest) for known in found]


def _ends(path: Path, summaries: Sequence[McapSummary]) -> Recording | None:
    """Return a robot's first and last joint state; None if the summaries do not determine the topic."""
    robot, budget, counts = _Robot(path, Ends, None), ReadBudget(), Counter[tuple[str, str]]()
    for summary in summaries:
        for number, count in summary.counts.items():
            counts[summary.channels[number][:2]] += count
    stating = [topic for topic, kind in counts if kind == JOINT_STATE and robot.has(topic)]
    if len(stating) > 1 and robot.usual not in stating:  # the topic that comes first in the file decides
        return None
    chosen = robot.usual if robot.usual in stating else "".join(stating)
    for summary in summaries:
        for batch in summary.ends(chosen, budget):
            robot.add(*batch)
    robot.counts = Counter({topic: count for topic, count in counts.items() if robot.has(topic[0])})
    _check_count(robot.folder, counts.total())
    return robot.recording()


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Name the bag in errors of its files."""
    try:
        yield
    except (FileNotFoundError, NotADirectoryError) as error:
        raise BagError(no_such("bag", path)) from error
    except OSError as error:
        raise BagError(f"cannot read the bag '{path}': {error.strerror}") from error
    except DamageError as error:
        remedy = f"'twodof recover {path}'"
        if path.is_file():
            remedy = "move it into a folder of its own, and 'twodof recover' of that folder"
        raise BagError(f"cannot read the bag '{path}': {error}; {remedy} saves what comes before") from error


class _Robot:
    """Joint states and targets of a robot while its bag is read, downsampled on request."""

    def __init__(
        self, path: Path, kind: type[JointStates], targets: Targets | None, downsampler: Downsampler | None = None
    ) -> None:
        self.path, self.downsampler = path, downsampler
        self.folder, self._namespace = robot_in(path)
        self._prefix = f"/{self._namespace}" if self._namespace else ""
        self._nested = tuple(f"/{name}/" for name in robots_of(self.folder) if name.startswith(f"{self._namespace}/"))
        self.usual = self._prefix + JOINT_STATES
        self._kind, self._targets = kind, targets
        self.counts: Counter[tuple[str, str]] = Counter()
        self._chosen, self.states, self._thinned = "", kind(path), False

    @cached_property
    def _inputs(self) -> Inputs:
        return Inputs(read_provenance(self.folder, self._namespace))

    def has(self, topic: str) -> bool:
        """Return whether a topic is the robot's, and not one of a robot nested in its namespace."""
        return not self._prefix or (topic.startswith(f"{self._prefix}/") and not topic.startswith(self._nested))

    def add(self, channel: Channel, stamps: Stamps, messages: Rows) -> None:
        """Add messages of any topic of the bag."""
        if not self.has(channel.topic):
            return
        self.counts[channel.topic, channel.type] += len(stamps)
        if channel.type == JOINT_STATE:
            if channel.topic != self._chosen and (not self._chosen or channel.topic == self.usual):
                self._chosen, self.states = channel.topic, self._kind(self.path)
            if channel.topic == self._chosen:
                self.states.add(stamps, messages)
                if self.downsampler is not None:
                    self.downsampler.most = min(self.downsampler.most, MAX_DRAWN * len(self.states) // self.states.size)
                    if len(self.states) > self.downsampler.most:
                        self._thin(self.downsampler)
        elif self._targets and channel.topic == self._prefix + TARGET and channel.type in (POINT, POSE):
            self._targets.add(stamps, messages)

    def _thin(self, downsampler: Downsampler) -> None:
        self._thinned = True
        self.states.keep(downsampler.choose(self._made()))

    def _made(self) -> Recording:
        count = self.counts[self._chosen, JOINT_STATE]
        if not count:
            where = f" of the robot of its {file_of(self._namespace)}" if self._namespace else ""
            raise BagError(f"'{self.path}' has no joint states{where}, no messages of type {JOINT_STATE}")
        stamps, q, v, tau = self.states.arrays()
        return Recording(
            path=self.path,
            count=count,
            topics=tuple(TopicCount(*topic, number) for topic, number in sorted(self.counts.items())),
            stamps=stamps,
            joints=self.states.names,
            q=q,
            v=v,
            tau=tau,
            received=self._targets.received(stamps) if self._targets is not None else None,
            provenance=self._inputs.provenance,
            inputs=self._inputs,
        )

    def recording(self) -> Recording:
        """Return the recording at the end of the bag."""
        stating = [topic for topic, kind in self.counts if kind == JOINT_STATE]
        if len(stating) > 1 and self._chosen != self.usual:
            topics = ", ".join(map(shown, stating))
            LOG.warning(f"'{self.path}' has several topics of joint states, {topics}; {shown(self._chosen)} is read")
        if self.downsampler is not None and self._thinned:
            self._thin(self.downsampler)  # downsample the end like the rest
        return self._made()


def _read(robots: Sequence[_Robot], budget: ReadBudget | None = None) -> list[Recording]:
    """Read a bag once, for some of its robots."""
    if not robots:
        return []
    budget, total, most, folder = budget or ReadBudget(), 0, MAX_SAMPLES, robots[0].folder
    with _refusing(folder):
        files = whole_bag(folder)
        if robots[0].downsampler is None:  # a bag of a few MB may unpack to gigabytes
            most = min(most, MAX_DRAWN + MAX_SAMPLES_RATIO * sum(file.stat().st_size for file in files))
        for file in files:
            for channel, stamps, messages in read_messages(file, budget):
                total += len(stamps)
                for robot in robots:
                    robot.add(channel, stamps, messages)
                if channel.type == JOINT_STATE and sum(robot.states.size for robot in robots) > most:
                    much = f"{most // MIB} MiB of joint states"
                    raise BagError(f"'{robots[0].path}' unpacks to more than {much}; cut it into several bags")
        _check_count(folder, total)
    return [robot.recording() for robot in robots]


def _check_count(path: Path, count: int) -> None:
    """Warn if the files and metadata.yaml disagree on the number of messages."""
    stated = stated_count(path) if path.is_dir() else count
    if stated not in (None, count):
        LOG.warning(
            f"'{path}' has {stated} messages according to its metadata.yaml, and {count} in its"
            f" files; 'twodof recover {path}' corrects this"
        )


def whole_bag(path: Path) -> list[Path]:
    """Return the files of a closed bag; raise BagError for an unfinished bag, or for a path that is not a bag."""
    files = storage_files(path)
    if not files:
        packed = f"cannot read the bag '{path}': it is compressed as a whole"
        raise BagError(packed if [*path.glob("*.zstd")] else no_such("bag", path))
    if files != [path] and not (path / "metadata.yaml").is_file():
        if is_being_written(path):
            raise BagError(f"the bag '{path}' is still being written")
        raise BagError(f"the bag '{path}' is unfinished: its writer died; repair it with 'twodof recover {path}'")
    return files


def verdict(run: Recording | str | Path | Iterable[Sample], experiment: Experiment | None = None) -> Verdict:
    """Return the verdict of a run: reached or not, how, and why.

    Args:
        run: a bag, its folder, or all samples of a run.
        experiment: the experiment of the samples.

    Raises:
        BagError, FmuError: the bag, or the robot in the experiment's FMU, cannot be read.
        InputError: samples are given without an experiment, or there are no samples.
    """
    if isinstance(run, Recording | str | Path):
        return (run if isinstance(run, Recording) else read_bag(run)).verdict
    if experiment is None:
        raise InputError("give the `experiment` of the samples, with which they are judged")
    judge, inputs = judge_of(experiment, robot_of(experiment.fmu.urdf)), None
    for k, sample in enumerate(run):
        if inputs is not None and sample.inputs is not inputs:
            judge.change({name: value for name, value in sample.inputs.items() if value != inputs[name]})
        inputs = sample.inputs
        judge.rows.write(array("d", (*sample.q, *sample.v, *sample.x, *sample.tau, *sample.quat)))
        if k % BLOCK == 0:
            judge.flush()
    if inputs is None:
        raise InputError("there are no samples to judge")
    return conclude(judge)
