"""Read SQLite files of ROS 2 row by row, unfinished ones too."""

import os
import shutil
import sqlite3
import sys
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from itertools import count, groupby, islice
from operator import length_hint
from pathlib import Path
from typing import Any

import numpy as np

from ..bounds import MIB
from ..files import temporary_folder
from .records import Batch, Channel, DamageError, add_channel

PLAIN = ("CREATE TABLE ", "CREATE INDEX ")  # beginnings of SQLite's schema records of plain tables
TABLES = {  # ROS 2's tables and their columns; older versions lack the last ones
    "topics": "id name type serialization_format offered_qos_profiles type_description_hash",
    "message_definitions": "id topic_type encoding encoded_message_definition",
    "messages": "id topic_id timestamp data",
}
READABLE = {*TABLES, "sqlite_master"}
STEPS = 1000  # instructions of SQLite's virtual machine: all for the schema, and one for each byte of the rows
MAX_SQL = 4096  # characters of a table's definition; those of ROS 2 have some hundred
MOST_LOST = 16  # ratio of a database's stated size to that of its files, which a crash may have shortened
SOME, SOME_BYTES = 1000, 16 * MIB  # largest number of rows in a group, and the size at which a group ends


def sqlite3_messages(path: Path) -> Iterator[Batch]:
    """Read all messages of a file; errors as in ``read_messages``."""
    try:
        with _database(path) as database:
            channels = _sqlite3_channels(path, database)
            rows, failure = _rows(path, database, "messages"), None
            while failure is None:
                waiting: dict[int, list[tuple[int, bytes]]] = {}
                size = 0
                try:
                    for _, topic, stamp, data in islice(rows, SOME):
                        if not isinstance(stamp, int) or stamp < 0 or not isinstance(data, bytes):
                            raise DamageError(f"'{path.name}' is damaged")
                        waiting.setdefault(topic, []).append((stamp, data))
                        size += len(data)
                        if size > SOME_BYTES:
                            break
                except (sqlite3.Error, DamageError) as error:
                    failure = error  # raised after the rows read before
                for topic, messages in waiting.items():
                    yield from _batches(channels[topic], messages)
                if not waiting and failure is None:
                    return
            raise failure
    except sqlite3.Error as error:
        raise DamageError(f"'{path.name}': {error}") from error


@contextmanager
def _database(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database of plain tables without changing it.

    If its writer died, SQLite repairs a copy. A journal can name a super-journal at any path, which SQLite would look
    for and delete; appended zero bytes remove this name from the copy.
    """
    unfinished = _unfinished(path)
    beside = path.absolute().parent.parent  # this disk usually has room for a copy
    use = beside if unfinished and os.access(beside, os.W_OK) else None
    with temporary_folder(use) as folder:
        uri = path.absolute().as_uri() + "?immutable=1"
        if unfinished:
            for file in (path, *unfinished):
                copy = shutil.copyfile(file, folder / file.name)
                if copy.name.endswith("-journal"):
                    with copy.open("ab") as journal:
                        journal.write(bytes(8))
            uri = (folder / path.name).as_uri()
        with closing(sqlite3.connect(uri, uri=True)) as database:
            database.set_authorizer(_authorize)
            if sys.version_info >= (3, 11):  # SQLite compares all constraints of a table with each other
                database.setlimit(sqlite3.SQLITE_LIMIT_SQL_LENGTH, MAX_SQL)
            database.execute("PRAGMA writable_schema = ON")  # reads files that lack their end
            database.set_progress_handler(lambda: 1, STEPS)
            # a file can have an index of its schema with other rows
            schema = [*database.execute("SELECT name, sql FROM sqlite_master NOT INDEXED WHERE sql NOT NULL")]
            if not {name for name, _ in schema} >= {"topics", "messages"}:
                raise DamageError(f"'{path.name}' has no messages")
            if not all(isinstance(sql, str) and sql.startswith(PLAIN) for _, sql in schema):  # names may repeat
                raise DamageError(f"'{path.name}' has views, triggers or virtual tables")
            yield database


def _authorize(action: int, table: str | None, _: str | None, __: str | None, view: str | None) -> int:
    """Return whether SQLite may do an action: read ROS 2's tables and the schema, but not through a view."""
    readable = action == sqlite3.SQLITE_READ and table in READABLE
    allowed = readable or action in (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_PRAGMA)
    return sqlite3.SQLITE_OK if allowed and view is None else sqlite3.SQLITE_DENY


def _unfinished(path: Path) -> list[Path]:
    """Return the files that a killed writer leaves next to its database."""
    files = [path.with_name(path.name + suffix) for suffix in ("-journal", "-wal")]
    return [f for f in files if f.is_file() and not f.is_symlink() and f.stat().st_size]


def _sqlite3_channels(path: Path, database: sqlite3.Connection) -> dict[int, Channel]:
    definitions = {row[1]: row[3] for row in _rows(path, database, "message_definitions")}
    channels: dict[int, Channel] = {}
    for number, topic, kind, serialization, qos, digest in _rows(path, database, "topics"):
        definition = definitions.get(kind, "")
        channel = Channel(topic, kind, serialization, definition, qos or "", digest or "")
        if not all(isinstance(text, str) for text in channel):
            raise DamageError(f"'{path.name}' is damaged")
        add_channel(path, channels, number, channel)
    return channels


def _rows(path: Path, database: sqlite3.Connection, table: str) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a table of ROS 2, with NULL in missing and computed columns.

    Rows may not have more bytes than the files, because a damaged file can link pages in a circle or use a page in many
    rows. ROS 2's columns must come first, so that no other column has to be skipped.
    """
    columns = TABLES[table].split()
    infos = database.execute(f"PRAGMA table_xinfo({table})")
    stored = ["" if computed else name for _, name, *_, computed in infos]
    listed = database.execute("SELECT 1 FROM sqlite_master NOT INDEXED WHERE name = ?", [table])
    if not stored and listed.fetchone():
        raise DamageError(f"'{path.name}' is damaged")  # its columns cannot be read
    known = [name for name in columns if name in stored]
    if stored[: len(known)] != known:
        raise DamageError(f"'{path.name}' has {table} that are not those of ROS 2")
    names = ", ".join(name if name in known else "NULL" for name in columns)
    room = sum(file.stat().st_size for file in (path, *_unfinished(path)))
    if sys.version_info >= (3, 11):  # SQLite would read a value of a gigabyte from pages in a circle
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(room, MIB))
    else:
        (pages,), (size,) = (database.execute(f"PRAGMA page_{what}").fetchone() for what in ("count", "size"))
        if pages * size > max(SOME_BYTES, MOST_LOST * room):
            raise DamageError(f"'{path.name}' is damaged")
    steps, most = count(), room // STEPS
    database.set_progress_handler(lambda: next(steps) > most, STEPS)
    for row in database.execute(f"SELECT {names} FROM {table} NOT INDEXED") if stored else ():
        room -= len(known) + sum(map(length_hint, row))
        if room < 0:
            raise DamageError(f"'{path.name}' is damaged")
        yield row


def _batches(channel: Channel, messages: Iterable[tuple[int, bytes]]) -> Iterator[Batch]:
    """Yield stamps and messages in groups of equal message length."""
    for size, group in groupby(messages, lambda message: len(message[1])):
        stamps, contents = zip(*group)
        rows = np.frombuffer(b"".join(contents), np.uint8).reshape(len(stamps), size)
        yield Batch(channel, np.array(stamps), rows)
