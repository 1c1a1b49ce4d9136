"""What a bag's file holds, message by message, also where it ends in the middle.

Nothing that a file claims is believed: a length, a table of contents, a size after decompression.
Memory is bounded by the size of one chunk or message, time by the size of the files.
rosbags reads no file that lacks its end, and believes the rest.
"""

from __future__ import annotations

import re
import shutil
import sqlite3
import struct
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from operator import length_hint
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from zlib import crc32

import lz4.frame

from ..files import temporary_folder

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_TOPICS = 1000
MAX_CHUNK = 256 * 1024**2  # bytes, of a message too; writers cut chunks at 1 to 4 MiB
MAX_RATIO = 1000  # of unpacked to packed; an arm at rest reaches 24, one of 50 joints 220
RECORD = 2000  # bytes that a record counts for; a message takes 3 of the file at least, packed
TEXT = 100  # bytes that one of a topic's texts counts for, which are kept
MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA, FOOTER = 3, 4, 5, 6, 12, 2  # of the MCAP specification
READ = (SCHEMA, CHANNEL, MESSAGE, CHUNK)
HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<BQHIqQ")  # with the record's head: channel, sequence, two times
PLAIN = ("CREATE TABLE ", "CREATE INDEX ")  # as SQLite begins its records of them
TABLES = {  # of ROS 2, and their columns; those of older versions end earlier
    "topics": "id name type serialization_format offered_qos_profiles type_description_hash",
    "message_definitions": "id topic_type encoding encoded_message_definition",
    "messages": "id topic_id timestamp data",
}
SCHEMA_STEPS = 1000  # of SQLite's machine, for which it reads a hundred of those


class Channel(NamedTuple):
    """A topic as a bag's file describes it."""

    topic: str
    type: str
    serialization: str
    definition: str
    qos: str
    hash: str


class DamageError(Exception):
    """The file cannot be read from here on; what came before is sound."""


@dataclass
class Allowance:
    """What a bag's files together may still unpack to, bytes.

    A few bytes can unpack to millions, and to records without end that are all alike. The messages
    of an honest bag differ in their time stamps at least. So after a large chunk no more is
    believed than MAX_RATIO times what was read, where each record counts for RECORD bytes more.
    """

    left: int = MAX_CHUNK

    def spend(self, size: int) -> None:
        """Take so many bytes off.

        Raises:
            DamageError: they are not left.
        """
        self.left -= size
        if self.left < 0:
            raise DamageError(f"it unpacks to more than {MAX_RATIO} times its size")


def storage_files(folder: Path) -> list[Path]:
    """The files that hold a bag's messages, in the order in which they were written.

    An MCAP file alone, as pages and other tools write them, is a bag too.
    """
    if folder.suffix == ".mcap" and folder.is_file():
        return [folder]
    files = [p for p in folder.iterdir() if p.suffix in (".mcap", ".db3") and p.is_file()]
    return sorted(files, key=lambda p: [int(n) for n in re.findall(r"\d{1,9}", p.stem)][-1:])


def read_messages(file: Path, allowance: Allowance) -> Iterator[tuple[Channel, int, bytes]]:
    """Channel, log time in ns and serialised message, in the order of the file.

    Args:
        file: one of a bag's.
        allowance: of the bag.

    Raises:
        DamageError: where the file ends in the middle or is not sound.
        OSError: it cannot be read.
    """
    mcap = file.suffix == ".mcap"
    try:
        yield from _mcap_messages(file, allowance) if mcap else _sqlite3_messages(file)
    except (struct.error, UnicodeDecodeError, KeyError, TypeError) as error:
        raise DamageError(f"'{file.name}' is damaged") from error


def _mcap_messages(path: Path, allowance: Allowance) -> Iterator[tuple[Channel, int, bytes]]:
    schemas: dict[int, tuple[str, str]] = {0: ("", "")}
    channels: dict[int, Channel] = {}
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise DamageError(f"'{path.name}' is no MCAP file")
        for opcode, content in _mcap_records(path, file, allowance):
            allowance.left += MAX_RATIO * len(content)
            chunk = _unpack(path, content, allowance) if opcode == CHUNK else content
            position = 0
            while position < len(chunk):
                opcode, length = HEAD.unpack_from(chunk, position)
                end = position + HEAD.size + length
                if end > len(chunk) or not opcode:
                    raise DamageError(f"'{path.name}' has a damaged chunk")
                allowance.spend(RECORD)
                if opcode == MESSAGE:
                    _, _, channel, _, stamp, _ = MESSAGE_HEAD.unpack_from(chunk, position)
                    if stamp < 0:
                        raise DamageError(f"'{path.name}' has a stamp beyond 2262")
                    yield channels[channel], stamp, chunk[position + MESSAGE_HEAD.size : end]
                elif opcode == SCHEMA:
                    allowance.spend(TEXT * length)
                    number, name, _, text, _ = _fields("Hsss", chunk, position + HEAD.size)
                    schemas[number] = (name, text)
                elif opcode == CHANNEL:
                    allowance.spend(TEXT * length)
                    number, channel = _channel(chunk, position + HEAD.size, schemas)
                    channels[number] = channel
                    if len(channels) > MAX_TOPICS:
                        raise DamageError(f"'{path.name}' has more than {MAX_TOPICS} topics")
                position = end


def read_metadata(path: Path, name: str, key: str) -> str:
    """An entry of an MCAP file's own metadata; "" where it has none of that name.

    Raises:
        DamageError, OSError: as ``read_messages``.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise DamageError(f"'{path.name}' is no MCAP file")
            for _, content in _mcap_records(path, file, Allowance(), (METADATA,)):
                found, _, position = _fields("sI", content, HEAD.size)
                if found == name:
                    return _entries(content[position:]).get(key, "")
    except (struct.error, UnicodeDecodeError) as error:
        raise DamageError(f"'{path.name}' is damaged") from error
    return ""


def _mcap_records(
    path: Path, file: BinaryIO, allowance: Allowance, wanted: Sequence[int] = READ
) -> Iterator[tuple[int, bytes]]:
    """Opcode of each record up to the footer that is wanted, and the record with its head.

    Of a chunk, the content alone.
    """
    size, position = path.stat().st_size, len(MAGIC)
    while True:
        start = position
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            raise DamageError(f"'{path.name}' ends in the middle, at byte {start + len(head)}")
        opcode, length = HEAD.unpack(head)
        allowance.spend(RECORD)
        position += HEAD.size + length
        if opcode == 0 or position > size:
            raise DamageError(f"'{path.name}' ends in the middle or is damaged at byte {start}")
        if opcode in wanted and length > MAX_CHUNK:
            raise DamageError(f"'{path.name}' has a record of {length} bytes")
        if opcode == FOOTER:
            file.seek(length, 1)
            if file.read(len(MAGIC)) != MAGIC:
                raise DamageError(f"'{path.name}' ends in the middle, at byte {size}")
            return
        if opcode == CHUNK and opcode in wanted:
            yield opcode, file.read(length)
        elif opcode in wanted:
            yield opcode, head + file.read(length)
        elif length:
            file.seek(length, 1)


def _unpack(path: Path, content: bytes, allowance: Allowance) -> bytes:
    """The records of a chunk."""
    _, _, size, crc, compression, length, start = _fields("QQQIsQ", content, 0)
    packed = content[start : start + length]
    if size > MAX_CHUNK:
        raise DamageError(f"'{path.name}' has a chunk of {size} bytes")
    allowance.spend(size)
    try:
        if compression == "zstd":
            packed = zstd.ZstdDecompressor().decompress(packed, max_length=size)
        elif compression == "lz4":
            packed = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
        elif compression:
            raise DamageError(f"'{path.name}' is compressed in an unknown way, '{compression}'")
    except (zstd.ZstdError, RuntimeError, EOFError) as error:
        raise DamageError(f"'{path.name}' has a damaged chunk") from error
    if len(packed) != size or (crc and crc32(packed) != crc):
        raise DamageError(f"'{path.name}' has a damaged chunk")
    return packed


def _channel(
    content: bytes, position: int, schemas: dict[int, tuple[str, str]]
) -> tuple[int, Channel]:
    number, schema, topic, encoding, length, position = _fields("HHssI", content, position)
    entries = _entries(content[position : position + length])
    name, definition = schemas[schema]
    qos = entries.get("offered_qos_profiles", "")
    return number, Channel(
        topic, name, encoding, definition, qos, entries.get("topic_type_hash", "")
    )


def _entries(metadata: bytes) -> dict[str, str]:
    entries, position = {}, 0
    while position < len(metadata):
        key, value, position = _fields("ss", metadata, position)
        entries[key] = value
    return entries


def _fields(form: str, content: bytes, position: int) -> list[Any]:
    """Fields of a record, and where they end; struct's letters, and s for a text and its length."""
    values: list[Any] = []
    for letter in form:
        if letter == "s":
            (length,) = struct.unpack_from("<I", content, position)
            position += 4
            if position + length > len(content):
                raise struct.error
            values.append(content[position : position + length].decode())
            position += length
        else:
            values += struct.unpack_from(f"<{letter}", content, position)
            position += struct.calcsize(f"<{letter}")
    return [*values, position]


def _sqlite3_messages(path: Path) -> Iterator[tuple[Channel, int, bytes]]:
    try:
        with _database(path) as database:
            channels = _sqlite3_channels(path, database)
            for _, topic, stamp, data in _rows(path, database, "messages"):
                if not isinstance(stamp, int) or stamp < 0 or not isinstance(data, bytes):
                    raise DamageError(f"'{path.name}' is damaged")
                yield channels[topic], stamp, data
    except sqlite3.Error as error:
        raise DamageError(f"'{path.name}': {error}") from error


@contextmanager
def _database(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database of tables alone, without changing it.

    Where a writer died over it, a copy is repaired. A journal can name that of several databases,
    which SQLite would look for, anywhere, and delete; a copy that is longer names none.
    """
    unfinished = _unfinished(path)
    with temporary_folder(path.absolute().parent.parent if unfinished else None) as folder:
        uri = path.absolute().as_uri() + "?immutable=1"
        if unfinished:
            for file in (path, *unfinished):
                copy = shutil.copyfile(file, folder / file.name)
                if copy.name.endswith("-journal"):
                    with copy.open("ab") as journal:
                        journal.write(bytes(8))
            uri = (folder / path.name).as_uri()
        with closing(sqlite3.connect(uri, uri=True)) as database:
            database.set_progress_handler(lambda: 1, SCHEMA_STEPS)
            tables = "SELECT name, sql FROM sqlite_master WHERE sql NOT NULL"
            schema = dict(database.execute(tables))
            database.set_progress_handler(None, 0)
            if not schema.keys() >= {"topics", "messages"}:
                raise DamageError(f"'{path.name}' has no messages")
            if not all(sql.startswith(PLAIN) for sql in schema.values()):
                raise DamageError(f"'{path.name}' has views, triggers or virtual tables")
            yield database


def _unfinished(path: Path) -> list[Path]:
    """The files that a writer which died leaves beside its database."""
    files = [path.with_name(path.name + suffix) for suffix in ("-journal", "-wal")]
    return [file for file in files if file.is_file() and file.stat().st_size]


def _sqlite3_channels(path: Path, database: sqlite3.Connection) -> dict[int, Channel]:
    """Topics by their id."""
    definitions = {row[1]: row[3] for row in _rows(path, database, "message_definitions")}
    channels = {}
    for number, topic, kind, serialization, qos, digest in _rows(path, database, "topics"):
        definition = definitions.get(kind, "")
        channel = Channel(topic, kind, serialization, definition, qos or "", digest or "")
        if not all(isinstance(text, str) for text in channel):
            raise DamageError(f"'{path.name}' is damaged")
        channels[number] = channel
        if len(channels) > MAX_TOPICS:
            raise DamageError(f"'{path.name}' has more than {MAX_TOPICS} topics")
    return channels


def _rows(path: Path, database: sqlite3.Connection, table: str) -> Iterator[tuple[Any, ...]]:
    """The rows of a table of ROS 2, NULL in the columns that it has not or computes.

    No more is believed to lie in them than there is room for in the files: pages can be linked in
    a circle, or be part of many rows. Nor may there be others before them, to be passed by.
    """
    columns = TABLES[table].split()
    infos = database.execute(f"PRAGMA table_xinfo({table})")
    stored = ["" if computed else name for _, name, *_, computed in infos]
    known = [name for name in columns if name in stored]
    if stored[: len(known)] != known:
        raise DamageError(f"'{path.name}' has {table} that are not those of ROS 2")
    names = ", ".join(name if name in known else "NULL" for name in columns)
    room = sum(file.stat().st_size for file in (path, *_unfinished(path)))
    for row in database.execute(f"SELECT {names} FROM {table} NOT INDEXED") if stored else ():
        room -= len(known) + sum(map(length_hint, row))
        if room < 0:
            raise DamageError(f"'{path.name}' is damaged")
        yield row
