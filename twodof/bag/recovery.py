"""Recover bags whose writer died."""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import Reader, ReaderError, WriterError
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

from ..bounds import (
    MAX_COPY,
    MAX_COPY_RATIO,
    MAX_DEFINITION,
    MAX_DEFINITIONS,
    MAX_FILES,
    MAX_MESHES,
    MAX_PROFILES,
    MAX_PROVENANCE,
    MAX_PROVENANCES,
    MAX_TOPICS,
    MAX_WRITTEN_PROFILES,
    MIB,
)
from ..errors import BagError, no_such
from ..files import lock, read_file, sync
from . import provenance
from .contents import read_messages, stated_count, storage_files
from .records import Channel, DamageError, ReadBudget
from .storage import BATCH_SIZE, KINDS, OVERHEAD, BagWriter, McapStorage, check_path, profile
from .summary import read_summaries

UNUSUAL = re.compile(r"[&*<]|\w{41}")  # YAML's references, which can grow without end, and no number of a profile
NO_HASH = "RIHS01_" + "0" * 64  # hash of a type without a known definition


@dataclass(frozen=True)
class Recovered:
    """A recovered bag.

    Attributes:
        path: folder of the recovered bag.
        original: new path of the damaged folder; None if the bag was complete.
        counts: number of messages by topic.
        damage: why messages were lost; "" if the file only lacked its end.
    """

    path: Path
    original: Path | None
    counts: dict[str, int]
    damage: str


def recover(path: str | Path) -> Recovered:
    """Complete the bag of a writer that died: index, metadata.yaml, statistics.

    All readable messages are written to a new bag in the same folder. When the new bag is complete and on the disk, it
    replaces the old bag, which is renamed to ``<name>.unfinished``.

    Raises:
        BagError: there is nothing to recover, the bag is being written, or the new bag cannot be written.
    """
    bag = Path(path)
    folder = bag.resolve()
    original = folder.with_name(f"{folder.name}.unfinished")
    work = folder.with_name(f".{folder.name}.recovering")
    try:
        with _held(bag, folder, original, work):
            files = storage_files(folder)
            if not files:
                raise BagError(no_such("bag", bag))
            if len({file.suffix for file in files}) > 1:
                raise BagError(f"'{bag}' has .mcap and .db3 files; move those of one kind away")
            counts = _counts_if_whole(folder, files)
            if counts is not None:
                return Recovered(bag, None, counts, "")
            check_path(folder, KINDS[files[0].suffix])
            if original.exists():
                raise BagError(f"'{original}', where the old bag would go, exists; move it away")
            work.mkdir()
            counts, damage = copy_messages(folder, files, work / folder.name, KINDS[files[0].suffix])
            if damage and not any(counts.values()):
                raise BagError(f"no message of the bag '{bag}' can be read: {damage}")
            folder.rename(original)
            (work / folder.name).rename(folder)
            sync(folder.parent)
    except BlockingIOError as error:
        raise BagError(f"the bag '{bag}' is still being written, or recovered") from error
    except RecursionError as error:
        raise BagError(f"'{bag}' has folders that are nested too deeply; move them out of the bag") from error
    except (OSError, sqlite3.Error, WriterError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        if isinstance(error, shutil.Error):  # of a folder: source, destination and reason of each file
            _, _, reason = error.args[0][0]
        raise BagError(f"cannot recover the bag '{bag}': {reason}; nothing is lost") from error
    return Recovered(bag, original, counts, damage)


@contextmanager
def _held(bag: Path, folder: Path, original: Path, work: Path) -> Iterator[None]:
    """Lock a bag; undo an earlier recovery that was killed, and this one if it fails.

    Between the two renames of a recovery no folder has the bag's name; the lock then stays on the old folder.
    """
    between = not folder.exists() and (work / folder.name).is_dir()
    if not between and not folder.is_dir():
        if folder.is_file() and folder.suffix in KINDS:
            raise BagError(f"'{bag}' is a file; move it into a folder of its own, and recover that folder")
        whole, _, robot = str(bag).rpartition(":")
        if whole and robot and Path(whole).is_dir():
            raise BagError(f"there is no bag '{bag}'; 'twodof recover {whole}' repairs all its robots")
        raise BagError(no_such("bag", bag))
    held = lock(original if between else folder)
    try:
        _undo(folder, original, work)
        yield
    finally:
        _undo(folder, original, work)
        os.close(held)


def _undo(folder: Path, original: Path, work: Path) -> None:
    if not folder.exists():
        original.rename(folder)
    if work.exists():
        shutil.rmtree(work)


def _counts_if_whole(folder: Path, files: Iterable[Path]) -> dict[str, int] | None:
    """Return the number of messages by topic of a complete and consistent bag, else None."""
    counts: Counter[str] = Counter()
    try:
        stated = stated_count(folder)
        summaries = read_summaries(files)
        budget = ReadBudget()
        for file in files:
            for channel, stamps, _ in read_messages(file, budget):
                counts[channel.topic] += len(stamps)
    except (OSError, DamageError):
        return None
    totals = {stated} if summaries is None else {stated, sum(sum(summary.counts.values()) for summary in summaries)}
    return dict(counts) if totals == {counts.total()} else None


def copy_messages(folder: Path, files: Sequence[Path], new: Path, storage: str) -> tuple[dict[str, int], str]:
    """Write readable messages into a new bag; return their number by topic, and why reading ended early."""
    damage: list[str] = []
    budget = ReadBudget()
    robots = provenance.robots_of(folder)
    if len(robots) > MAX_TOPICS:  # each has a topic
        damage.append(f"run.*.json files of more than {MAX_TOPICS} robots")
        robots = robots[:MAX_TOPICS]
    others = set()
    writer = BagWriter(new, storage)
    kept = _provenances(folder, robots, damage)
    room = 4 * provenance.MAX_YAML
    for robot in (robot for robot in robots if provenance.file_of(robot) in kept):
        with suppress(BagError):  # save the messages without a damaged provenance
            if known := provenance.read_provenance(folder, robot):
                text = provenance.for_metadata(kept[provenance.file_of(robot)], known)
                room -= len(text)
                if room >= 0:
                    writer.set_custom_data(provenance.key_of(robot), text)
    most = MAX_COPY + MAX_COPY_RATIO * sum(file.stat().st_size for file in files)
    with writer:
        topics, pending, written = _Topics(writer), 0, 0
        for file in files:
            try:
                for channel, stamps, messages in read_messages(file, budget):
                    if channel.serialization != "cdr":
                        others.add(channel.topic)
                        continue
                    number = topics.connection(channel).id
                    size = OVERHEAD + messages.shape[1]
                    written += size * len(stamps)
                    if written > most:
                        raise BagError(f"'{folder}' unpacks to more than {most // MIB} MiB of messages; cut its files")
                    some = max(1, BATCH_SIZE // size)
                    for k in range(0, len(stamps), some):
                        writer.write_all(stamps[k : k + some], {number: messages[k : k + some]})
                        pending += size * len(stamps[k : k + some])
                        if pending > BATCH_SIZE:
                            writer.flush()
                            pending = 0
            except DamageError as error:
                damage.append(str(error))
        for name, content in kept.items():
            if isinstance(writer.storage, McapStorage):  # so that a copy of the file alone has the provenance
                writer.flush()
                writer.storage.describe(provenance.KEY, name, content.decode("utf-8", "replace"))
    if others:
        damage.append(f"messages in another form than CDR, on {', '.join(sorted(others))}")
    _copy_meshes(folder, new, robots, damage)
    for name, content in kept.items():
        (new / name).write_bytes(content)
    with Reader(new) as reader:  # the new bag must open in another reader
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
    sync(*new.iterdir(), new)
    return counts, "; ".join(damage)


def _copy_meshes(folder: Path, new: Path, robots: Sequence[str], damage: list[str]) -> None:
    """Write the folders of meshes into the new bag; report those that are too large as damage."""
    room = MAX_FILES
    for name in {Path(robot).parts[0] if robot else "meshes" for robot in robots}:
        if not (folder / name).is_dir() or (folder / name).is_symlink():
            continue
        found = [*islice((folder / name).rglob("*"), room + 1)]
        size = sum(file.lstat().st_size for file in found)
        if len(found) > room:
            damage.append(f"meshes in '{name}', because there are more than {MAX_FILES} files")
        elif size > MAX_MESHES * len(robots):  # a sparse file of a few bytes can have a terabyte
            damage.append(f"meshes of {size} bytes in '{name}'")
        else:
            room -= len(found)
            shutil.copytree(folder / name, new / name, symlinks=True)


def _provenances(folder: Path, robots: Iterable[str], damage: list[str]) -> dict[str, bytes]:
    """Return the provenance files of robots by name; report those for which there is no room as damage."""
    kept: dict[str, bytes] = {}
    for name in map(provenance.file_of, robots):
        with suppress(OSError):
            content = read_file(folder / name, MAX_PROVENANCE, follow=False)
            if sum(map(len, kept.values())) + len(content) > MAX_PROVENANCES:
                damage.append(f"'{name}', because files of its kind have more than {MAX_PROVENANCES // MIB} MiB")
            else:
                kept[name] = content
    return kept


class _Topics:
    """Topics of a new bag, added as they appear."""

    def __init__(self, writer: BagWriter) -> None:
        self._writer = writer
        self._connections: dict[Channel, Connection] = {}
        self._profiles: dict[str, list[Qos]] = {}
        self._hashes: dict[tuple[str, str], str] = {}
        self._yaml = self._defined = 0
        self._room = MAX_WRITTEN_PROFILES

    def connection(self, channel: Channel) -> Connection:
        if channel not in self._connections:
            self._connections[channel] = self._writer.add_connection(
                channel.topic,
                channel.type,
                msgdef=channel.definition,
                rihs01=channel.hash or self._hash(channel),
                serialization_format=channel.serialization,
                offered_qos_profiles=self._qos(channel.qos),
            )
        return self._connections[channel]

    def _qos(self, text: str) -> list[Qos]:
        """Return the QoS profiles of a topic; none if they are invalid or too long, so that players use defaults."""
        if text not in self._profiles:
            self._profiles[text] = []
            self._yaml += len(text)
            if self._yaml < MAX_PROFILES and not UNUSUAL.search(text):
                with suppress(ReaderError, LookupError, TypeError, ValueError, AttributeError, RecursionError):
                    self._profiles[text] = parse_qos(text)
        self._room -= sum(len(profile(qos)) for qos in self._profiles[text])  # of each topic: they are written for each
        return self._profiles[text] if self._room >= 0 else []

    def _hash(self, channel: Channel) -> str:
        """Return ROS 2's hash of a type, computed from the definition in the file."""
        key = channel.type, channel.definition
        if key not in self._hashes:
            self._defined += len(channel.definition)
            self._hashes[key] = _computed_hash(*key) if self._defined < MAX_DEFINITIONS else NO_HASH
        return self._hashes[key]


def _computed_hash(kind: str, definition: str) -> str:
    if len(definition) > MAX_DEFINITION:
        return NO_HASH
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(definition, kind))
        return store.hash_rihs01(kind)
    except (TypesysError, LookupError, ValueError, RecursionError):
        return NO_HASH
