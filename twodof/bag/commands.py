"""Commands that a bag holds, as inputs of an FMU over time."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain, repeat
from pathlib import Path

from ..errors import BagError, InputError
from ..experiments import NANOSECONDS, Changes, resolve
from ..files import shown
from ..fmu import Fmu, load_fmu
from ..ros.cdr import Rows
from ..ros.commands import CommandError, Commands
from ..ros.messages import END_EFFECTOR, JOINT_STATE, JOINT_STATES
from .contents import read_messages
from .provenance import KNOWN_UNTIL, read_provenance
from .reader import whole_bag
from .records import Allowance, DamageError

MAX_COMMANDS = 1_000_000
SAMPLES = (JOINT_STATES, END_EFFECTOR)  # topics of what a robot did


def read_commands(fmu: Fmu | str | Path, path: str | Path, topic: str | None = None) -> Changes:
    """Commands of a bag, of this or another writer: times, s, and the inputs that change there.

    JointStates, points or poses, as the FMU's control follows them (``ros.commands``), each at the
    time when it was recorded, after the bag's first joint state that is no command.

    Args:
        fmu: that is commanded, or its path.
        path: the bag's folder.
        topic: of the commands; None: the changes of inputs that the bag's run.json has, or else the
            only topic that can be commands.

    Raises:
        BagError: it is no bag, or is unfinished or damaged.
        InputError: it has no such commands, or one that is none.
    """
    fmu, path = fmu if isinstance(fmu, Fmu) else load_fmu(fmu), Path(path)
    run = read_provenance(path) if topic is None else {}
    if run.get("input_changes"):
        if KNOWN_UNTIL in run:
            raise InputError(f"'{path}' knows its inputs until {run[KNOWN_UNTIL]:g} s only")
        start = run["start_time"]
        return [(t - start, resolve(fmu, values)) for t, values in run["input_changes"]]
    follows = Commands(fmu)
    try:
        files, allowance = whole_bag(path), Allowance()
        messages = chain.from_iterable(read_messages(file, allowance) for file in files)
        found: dict[str, list[tuple[int, str, bytes]]] = {}
        begins: dict[str, int] = {}
        for channel, stamps, data in messages:
            if channel.type == JOINT_STATE:
                first = int(stamps.min())
                begins[channel.topic] = min(first, begins.get(channel.topic, first))
            wanted = channel.topic not in SAMPLES if topic is None else channel.topic == topic
            if channel.type in follows.types and wanted:
                told = zip(stamps.tolist(), repeat(channel.type), map(Rows.tobytes, data))
                found.setdefault(channel.topic, []).extend(told)
    except (OSError, DamageError) as error:
        raise BagError(f"cannot read the bag '{path}': {error}") from error
    chosen = _only(found, path, topic, follows)
    states = [begin for name, begin in begins.items() if name != chosen]
    commands = sorted(found[chosen], key=lambda command: command[0])
    if len(commands) > MAX_COMMANDS:
        raise InputError(f"'{path}' has more than {MAX_COMMANDS} messages on {shown(chosen)}")
    return _changes(commands, min(states, default=commands[0][0]), follows, f"'{path}'")


def _only(found: Mapping[str, object], path: Path, topic: str | None, follows: Commands) -> str:
    """The topic of the commands."""
    if len(found) == 1:
        return next(iter(found))
    there = ", ".join(sorted(map(shown, found)))
    if there:
        raise InputError(f"'{path}' has several topics that can be commands: {there}; choose one")
    kinds = " or ".join(follows.types) or "nothing: it has no inputs for them"
    where = f" on {topic}" if topic else ""
    raise InputError(f"'{path}' has no commands{where} for this FMU, which follows {kinds}")


def _changes(
    commands: list[tuple[int, str, bytes]], begin: int, follows: Commands, bag: str
) -> Changes:
    changes: Changes = []
    for stamp, kind, data in commands:
        t = (stamp - begin) / NANOSECONDS
        try:
            changes.append((t, dict(follows.read(kind, data).inputs)))
        except CommandError as error:
            raise InputError(f"{bag}: the command at {t:g} s {error}") from error
    return changes
