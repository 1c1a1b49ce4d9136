"""Read the commands in a bag as inputs of an FMU over time."""

from __future__ import annotations

import logging
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from itertools import chain, count, repeat
from math import floor, inf
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..bounds import (
    CHANGE,
    MAX_COMMANDS,
    MAX_COMMANDS_SIZE,
    MAX_FOLLOWED,
    MAX_FREE_COMMANDS,
    MAX_HELD,
    MAX_POINTS,
    MIB,
    MIN_COMMAND_PACKED,
    TRAJECTORY,
)
from ..errors import BagError, InputError
from ..files import shown
from ..fmu import Fmu, load_fmu
from ..plant.variables import CONTROLS
from ..ros.commands import LONGEST_NAME, Command, CommandError, Commands
from ..ros.messages import END_EFFECTOR, JOINT_STATE, JOINT_STATES, JOINT_TRAJECTORY, TRUE_STATES
from ..ros.trajectories import Trajectory, follow, read_trajectory
from ..simulation.experiments import NANOSECONDS, default
from ..simulation.input_values import Changes, Setting, Value, resolve
from .contents import read_messages
from .provenance import KNOWN_UNTIL, read_provenance, robot_in
from .reader import whole_bag
from .recording import Recording
from .records import DamageError, ReadBudget

LOG = logging.getLogger(__name__)
COMMAND_SIZE = 150  # bytes that a message takes in memory in addition to its own
SAMPLES = (JOINT_STATES, TRUE_STATES, END_EFFECTOR)  # topics of a robot's motion, not of commands
COMMANDS = "/joint_commands"
FOLLOWING = ("q_des", "v_des", "a_des")  # groups of inputs that trajectories set
Read = TypeVar("Read", Command, Trajectory)
Stored = list[tuple[int, str, bytes]]  # messages: recording time (ns since the epoch), type and content


def read_commands(
    fmu: Fmu | str | Path,
    path: str | Path,
    topic: str | None = None,
    *,
    step: float | None = None,
    settings: Mapping[str, Setting] | None = None,
) -> Changes:
    """Return the commands in a bag: times, s, and the inputs that change at these times.

    Commands are JointStates, points or poses, as the FMU's control law requires (``ros.commands``). Their times are the
    recording times relative to the bag's first joint state that is not a command. For control 'joint' they may also be
    JointTrajectories, which are converted to inputs at whole steps (``ros.trajectories``).

    Args:
        fmu: the commanded FMU, or its path.
        path: the bag's folder; for one of several robots, followed by a colon and its namespace.
        topic: topic of the commands; None: the inputs in run.json (initial ones at time −∞), or if there is none, the
            only topic that can contain commands.
        step: communication step of the run, for trajectories, s; None: the FMU's default.
        settings: settings of the run: trajectories begin at rest at its q_des, or else at its q_start.

    Raises:
        BagError: the path is not a bag, or the bag is unfinished or damaged.
        InputError: the bag has no such commands, or an invalid one.
    """
    fmu, path = fmu if isinstance(fmu, Fmu) else load_fmu(fmu), Path(path)
    provenance = read_provenance(*robot_in(path)) if topic is None else {}
    if provenance:
        if KNOWN_UNTIL in provenance:
            raise InputError(f"'{path}' has inputs only until {provenance[KNOWN_UNTIL]:g} s")
        start = provenance["start_time"]
        changes, room = [], MAX_HELD  # a change of a vector counts for each element
        for t, values in provenance["input_changes"]:
            changes.append((t - start, resolve(fmu, values)))
            room -= CHANGE + len(changes[-1][1])
            if room < 0:
                raise InputError(f"'{path}' has more than {MAX_HELD} values of inputs")
        return [(-inf, resolve(fmu, _inputs(fmu, provenance["start_values"]))), *changes]
    follows = Commands(fmu)
    types = (*follows.types, *[JOINT_TRAJECTORY] * all(map(fmu.vector, (*FOLLOWING, "q_start"))))
    topics, begins, size = _messages(path, types, topic)
    chosen = _only(topics, path, topic, types)
    most = _most(path, topics[chosen])
    if len(topics[chosen]) > most or size > MAX_COMMANDS_SIZE:
        limit = f"{most} messages or {MAX_COMMANDS_SIZE // MIB} MiB of them"
        raise InputError(f"'{path}' has more than {limit} on {shown(chosen)}; cut it into several bags")
    commands = sorted(topics[chosen], key=lambda command: command[0])
    begin = min((t for name, t in begins.items() if name != chosen), default=commands[0][0])
    if len({kind == JOINT_TRAJECTORY for _, kind, _ in commands}) > 1:
        raise InputError(f"'{path}' has trajectories and other commands on {shown(chosen)}")
    if commands[0][1] == JOINT_TRAJECTORY:
        step = default(fmu, "stepSize", 0.01) if step is None else step
        return _followed(commands, begin, fmu, resolve(fmu, settings or {}), step, f"'{path}'")
    read = _read(commands, begin, lambda _, kind, data: follows.read(kind, data), f"'{path}'")
    return [((came - begin) / NANOSECONDS, dict(command.inputs)) for came, command in read]


def has_joint_commands(recording: Recording) -> bool:
    """Return whether a bag has joint states on another topic than those of the robot."""
    return any(topic.type == JOINT_STATE and topic.name not in SAMPLES for topic in recording.topics)


def joint_commands(
    path: Path, recording: Recording
) -> tuple[tuple[str, str, str], list[tuple[float, Mapping[str, Value]]]]:
    """Return an FMU's URDF, frame and axes, and the times, s, of commands in a bag with all values of the FMU.

    Commands before the time at which each joint has had one are left out.

    Raises:
        InputError: the bag has no such commands.
    """
    if not has_joint_commands(recording):
        raise InputError(
            f"'{recording.path}' has no efforts, and no run.json or commands that give them: record the efforts, or the"
            f" topic {COMMANDS}"
        )
    fmu, usual = load_fmu(path), any(topic.name == COMMANDS for topic in recording.topics)
    starts = {name: each.start_value for name, each in fmu.variables.items() if each.start_value is not None}
    schedule, changed = list[tuple[float, Mapping[str, Value]]](), dict[str, Value]()
    for at, values in read_commands(fmu, recording.path, COMMANDS if usual else None):
        changed = {**changed, **values}
        if changed.keys() >= {*fmu.vector("q_des"), *fmu.vector("tau_cmd")}:
            schedule.append((at, ChainMap(changed, starts)))
    return (fmu.urdf or "", fmu.frame, fmu.axes), schedule


def _messages(path: Path, types: Sequence[str], topic: str | None) -> tuple[dict[str, Stored], dict[str, int], int]:
    """Return possible commands by topic, the first time of each topic of joint states, and the commands' bytes.

    Commands beyond MAX_COMMANDS_SIZE are left out.
    """
    size, topics = 0, dict[str, Stored]()
    begins: dict[str, int] = {}
    try:
        files, budget = whole_bag(path), ReadBudget()
        messages = chain.from_iterable(read_messages(file, budget) for file in files)
        for channel, stamps, data in messages:
            if channel.type == JOINT_STATE:
                first = int(stamps.min())
                begins[channel.topic] = min(first, begins.get(channel.topic, first))
            wanted = channel.topic not in SAMPLES if topic is None else channel.topic == topic
            if channel.type in types and wanted:
                stored = topics.setdefault(channel.topic, [])
                size += data.nbytes + COMMAND_SIZE * len(data)
                if size <= MAX_COMMANDS_SIZE:
                    stored.extend(zip(stamps.tolist(), repeat(channel.type), map(np.ndarray.tobytes, data)))
    except (OSError, DamageError) as error:
        raise BagError(f"cannot read the bag '{path}': {error}") from error
    return topics, begins, size


def _most(path: Path, commands: Stored) -> int:
    """Return the largest number of such commands that are read from a bag, by the size of its files."""
    packed = sum(file.stat().st_size for file in whole_bag(path))
    most = min(MAX_COMMANDS, MAX_FREE_COMMANDS + packed // MIN_COMMAND_PACKED)
    return most // TRAJECTORY if commands and commands[0][1] == JOINT_TRAJECTORY else most


def _inputs(fmu: Fmu, values: Mapping[str, float]) -> dict[str, float]:
    """Return the start values of a bag's inputs that command the FMU."""
    commands = {group for law in CONTROLS.values() for group in law.inputs}

    def commands_it(name: str) -> bool:
        known = fmu.variables.get(name)
        return known.causality == "input" if known else name.partition("[")[0] in commands

    return {name: value for name, value in values.items() if commands_it(name)}


def _only(topics: Mapping[str, object], path: Path, topic: str | None, types: Sequence[str]) -> str:
    if len(topics) == 1:
        return next(iter(topics))
    there = ", ".join(sorted(map(shown, topics)))
    if there:
        raise InputError(f"'{path}' has several topics that can be commands: {there}; choose one")
    kinds = " or ".join(types) or "nothing: it has no inputs for them"
    where = f" on {topic}" if topic else ""
    raise InputError(f"'{path}' has no commands{where} for this FMU, which follows {kinds}")


def _read(commands: Stored, begin: int, read: Callable[[int, str, bytes], Read], bag: str) -> list[tuple[int, Read]]:
    """Return the time and content of each command; errors name the bag."""
    read_so_far, names = [], set[str]()
    for came, kind, data in commands:
        try:
            command = read(came, kind, data)
        except CommandError as error:
            t = (came - begin) / NANOSECONDS
            raise InputError(f"{bag}: the command at {t:g} s {error}") from error
        if len(names) < LONGEST_NAME:  # a message may have thousands of names, which take three times its bytes
            names.update(command.unknown_joints[:LONGEST_NAME])
        read_so_far.append((came, command._replace(unknown_joints=())))
    if names:
        unknown_joints = ", ".join(sorted(names))[:LONGEST_NAME]
        LOG.warning(f"{bag}: joints that this robot does not have are ignored: {unknown_joints!r}")
    return read_so_far


def _followed(commands: Stored, begin: int, fmu: Fmu, given: Mapping[str, Value], step: float, bag: str) -> Changes:
    """Return inputs with which joints follow trajectories, at the steps at which they change."""
    joints = {name: i for i, name in enumerate(fmu.joints)}
    points = count()

    def read_one(came: int, _: str, data: bytes) -> Trajectory:
        trajectory = read_trajectory(data, joints, came, begin)
        if max(next(points) for _ in trajectory.points) >= MAX_POINTS:
            raise InputError(f"{bag} has trajectories of more than {MAX_POINTS} points; cut it into several bags")
        return trajectory

    trajectories = [trajectory for _, trajectory in _read(commands, begin, read_one, bag)]
    begun, ended = min(it.start for it in trajectories), max(it.times[-1] for it in trajectories)
    if not ended - begun <= MAX_COMMANDS * step < inf:
        most = f"{MAX_COMMANDS} steps of {step:g} s"
        raise InputError(f"{bag}: its trajectories take {ended - begun:g} s, more than {most}")
    inputs = len(FOLLOWING) * len({i for it in trajectories for i in it.joints})
    if ended - begun > (longest := MAX_FOLLOWED // (inputs + CHANGE) * step):
        raise InputError(
            f"{bag}: its trajectories take {ended - begun:g} s, and those of {inputs // len(FOLLOWING)} joints can take"
            f" {longest:g} s at steps of {step:g} s; cut it into several bags, or use longer steps"
        )
    grid = step * np.arange(floor(begun / step) - 1.0, floor(ended / step) + 3.0)
    groups = [fmu.vector(group) for group in FOLLOWING]
    starts = fmu.vector("q_start")
    known = {**{name: float(fmu.variables[name].start or 0.0) for name in starts}, **given}
    rest = [float(known.get(q_des, known[q_start])) for q_des, q_start in zip(groups[0], starts)]
    means = follow(trajectories, rest, grid)
    names = [group[i] for i in means for group in groups]
    table = np.hstack([*means.values()])
    changes = [(-inf, dict(zip(chain(*groups), chain(rest, repeat(0.0)))))]
    for k in 1 + np.flatnonzero((np.diff(table, axis=0) != 0.0).any(axis=1)):
        changes.append((float(grid[k]), dict(zip(names, table[k].tolist()))))
    return changes
