"""Read bags of any writer as arrays."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from ..bounds import MAX_DRAWN, MAX_SAMPLES, MAX_SAMPLES_RATIO, MIB
from ..errors import BagError, no_such, path_of
from ..files import is_being_written, shown
from ..ros.messages import JOINT_STATE, JOINT_STATES, POINT, POSE, TARGET
from .contents import read_messages, stated_count, storage_files
from .downsampling import Downsampler
from .joint_states import Ends, JointStates, Targets
from .provenance import file_of, read_provenance, robot_in, robots_of
from .recording import Array, Inputs, Recording, TopicCount
from .records import DamageError, ReadBudget
from .summary import read_summary

LOG = logging.getLogger(__name__)


def read_bag(path: str | Path) -> Recording:
    """Read the joint states and targets of a bag of any writer.

    Args:
        path: the bag's folder; for one of several robots, followed by a colon and its namespace.

    Raises:
        BagError: the path is not a bag, or the bag is unfinished, damaged or without joint states.
    """
    return _read(path_of(path, "bag"), JointStates, Targets())


def read_downsampled(path: str | Path, most: int, lines: Callable[[Recording], Sequence[Array]]) -> Recording:
    """Read a bag as ``read_bag`` does, downsampled to at most ``most`` samples for drawing.

    Memory holds at most ``most`` samples and a chunk of the bag. ``lines`` returns the curves of a part of the bag that
    are drawn in addition to positions and velocities; its exceptions are passed on.
    """
    return _read(Path(path), JointStates, Targets(), Downsampler(most, lines))


def read_ends(path: str | Path) -> Recording:
    """Return the first and the last joint state of a bag.

    Use the summaries of the files if all have a valid one; otherwise read the whole bag.

    Raises:
        BagError: as ``read_bag``.
    """
    path = Path(path)
    folder, prefix, others = _place(path)
    with _refusing(folder):
        summaries = [read_summary(file) for file in whole_bag(folder)]
        if None in summaries:
            return _read(path, Ends, None)
        counts: Counter[tuple[str, str]] = Counter()
        total = 0
        for summary in filter(None, summaries):
            for number, count in summary.counts.items():
                channel = summary.channels[number]
                if _is_within(channel.topic, prefix, others):
                    counts[channel.topic, channel.type] += count
                total += count
        stating = [topic for topic, kind in counts if kind == JOINT_STATE]
        usual = prefix + JOINT_STATES
        if len(stating) > 1 and usual not in stating:  # the topic that comes first in the file decides
            return _read(path, Ends, None)
        chosen = usual if usual in stating else "".join(stating)
        ends, budget = Ends(path), ReadBudget()
        for summary in filter(None, summaries):
            for batch in summary.ends(chosen, budget):
                ends.add(batch.stamps, batch.messages)
        _check_count(folder, total)
        return _recording(path, counts, chosen, ends, None, lambda: Inputs(read_provenance(*robot_in(path))))


def _place(path: Path) -> tuple[Path, str, tuple[str, ...]]:
    """Return a bag's folder, the chosen robot's topic prefix, and the prefixes of robots nested in its namespace."""
    folder, namespace = robot_in(path)
    inside = (name for name in robots_of(folder) if name.startswith(f"{namespace}/"))
    return folder, f"/{namespace}" if namespace else "", tuple(f"/{name}/" for name in inside)


def _is_within(topic: str, prefix: str, others: tuple[str, ...]) -> bool:
    return not prefix or (topic.startswith(f"{prefix}/") and not topic.startswith(others))


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
        raise BagError(
            f"cannot read the bag '{path}': {error}; 'twodof recover {path}' saves what comes before"
        ) from error


def _read(
    path: Path, kind: type[JointStates], targets: Targets | None, downsampler: Downsampler | None = None
) -> Recording:
    """Read a bag's joint states with the given accumulator, and downsample them."""
    counts: Counter[tuple[str, str]] = Counter()
    chosen, states, total = "", kind(path), 0
    budget, thinned, most = ReadBudget(), False, MAX_SAMPLES

    inputs = cache(lambda: Inputs(read_provenance(*robot_in(path))))

    def thin(downsampler: Downsampler) -> None:
        states.keep(downsampler.choose(_recording(path, counts, chosen, states, targets, inputs)))

    folder, prefix, others = _place(path)
    with _refusing(folder):
        files = whole_bag(folder)
        if downsampler is None:  # a bag of a few MB may unpack to gigabytes
            most = min(most, MAX_DRAWN + MAX_SAMPLES_RATIO * sum(file.stat().st_size for file in files))
        for file in files:
            for channel, stamps, messages in read_messages(file, budget):
                total += len(stamps)
                if not _is_within(channel.topic, prefix, others):
                    continue
                counts[channel.topic, channel.type] += len(stamps)
                if channel.type == JOINT_STATE:
                    usual = channel.topic == prefix + JOINT_STATES
                    if channel.topic != chosen and (not chosen or usual):
                        chosen, states = channel.topic, kind(path)
                    if channel.topic == chosen:
                        states.add(stamps, messages)
                        if states.size > most:
                            much = f"{most // MIB} MiB of joint states"
                            raise BagError(f"'{path}' unpacks to more than {much}; cut it into several bags")
                        if downsampler is not None:
                            downsampler.most = min(downsampler.most, MAX_DRAWN * len(states) // states.size)
                            if len(states) > downsampler.most:
                                thin(downsampler)
                                thinned = True
                elif targets and channel.topic == prefix + TARGET and channel.type in (POINT, POSE):
                    targets.add(stamps, messages)
        _check_count(folder, total)
    stating = [topic for topic, kind in counts if kind == JOINT_STATE]
    if len(stating) > 1 and chosen != prefix + JOINT_STATES:
        LOG.warning(
            f"'{path}' has several topics of joint states, {', '.join(map(shown, stating))}; {shown(chosen)} is read"
        )
    if downsampler is not None and thinned:
        thin(downsampler)  # downsample the end like the rest
    return _recording(path, counts, chosen, states, targets, inputs)


def _check_count(path: Path, count: int) -> None:
    """Warn if the files and metadata.yaml disagree on the number of messages."""
    stated = stated_count(path) if path.is_dir() else count
    if stated not in (None, count):
        LOG.warning(
            f"'{path}' has {stated} messages according to its metadata.yaml, and {count} in its"
            f" files; 'twodof recover {path}' corrects this"
        )


def _recording(
    path: Path,
    counts: Counter[tuple[str, str]],
    chosen: str,
    states: JointStates,
    targets: Targets | None,
    inputs: Callable[[], Inputs],
) -> Recording:
    if not counts[chosen, JOINT_STATE]:
        _, robot = robot_in(path)
        where = f" of the robot that its {file_of(robot)} is of" if robot else ""
        raise BagError(f"'{path}' has no joint states{where}, no messages of type {JOINT_STATE}")
    stamps, q, v, tau = states.arrays()
    return Recording(
        path=path,
        count=counts[chosen, JOINT_STATE],
        topics=tuple(TopicCount(*topic, count) for topic, count in sorted(counts.items())),
        stamps=stamps,
        joints=states.names,
        q=q,
        v=v,
        tau=tau,
        received=targets.received(stamps) if targets is not None else None,
        provenance=inputs().provenance,
        inputs=inputs(),
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
