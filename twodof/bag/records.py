"""What a bag's file holds, message by message, also where it ends in the middle.

Nothing that a file claims is believed: a length, a table of contents, a size after decompression.
Memory is bounded by the size of the file and of one chunk, time by the size of the file.
rosbags reads no file that lacks its end, and believes the rest.
"""

from __future__ import annotations

import re
import shutil
import sqlite3
import struct
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
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
LARGE_CHUNK = 32 * 1024**2  # bytes, beyond which compression is not believed that is better than
MAX_RATIO = 100
MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, FOOTER = 3, 4, 5, 6, 2  # opcodes of the MCAP specification
READ = (SCHEMA, CHANNEL, MESSAGE, CHUNK)
HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<BQHIQQ")  # with the record's head: channel, sequence, two times
COLUMNS = "topic_id, timestamp, data"


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


def storage_files(folder: Path) -> list[Path]:
    """The files that hold a bag's messages, in the order in which they were written."""
    found = [p for p in folder.iterdir() if p.suffix in (".mcap", ".db3") and p.is_file()]
    return sorted(found, key=lambda p: [int(n) for n in re.findall(r"\d{1,9}", p.stem)][-1:])


def read_messages(file: Path) -> Iterator[tuple[Channel, int, bytes]]:
    """Channel, log time in ns and serialised message, in the order of the file.

    Raises:
        DamageError: where the file ends in the middle or is not sound.
        OSError: it cannot be read.
    """
    read = _mcap_messages if file.suffix == ".mcap" else _sqlite3_messages
    try:
        yield from read(file)
    except (struct.error, UnicodeDecodeError, KeyError, TypeError) as error:
        raise DamageError(f"'{file.name}' is damaged") from error


def _mcap_messages(path: Path) -> Iterator[tuple[Channel, int, bytes]]:
    schemas: dict[int, tuple[str, str]] = {0: ("", "")}
    channels: dict[int, Channel] = {}
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise DamageError(f"'{path.name}' is no MCAP file")
        for opcode, content in _mcap_records(path, file):
            chunk = _unpack(path, content) if opcode == CHUNK else content
            position = 0
            while position < len(chunk):
                opcode, length = HEAD.unpack_from(chunk, position)
                end = position + HEAD.size + length
                if end > len(chunk) or not opcode:
                    raise DamageError(f"'{path.name}' has a damaged chunk")
                if opcode == MESSAGE:
                    _, _, channel, _, stamp, _ = MESSAGE_HEAD.unpack_from(chunk, position)
                    yield channels[channel], stamp, chunk[position + MESSAGE_HEAD.size : end]
                elif opcode == SCHEMA:
                    number, name, _, text = _fields("Hsss", chunk, position + HEAD.size)
                    schemas[number] = (name, text)
                elif opcode == CHANNEL:
                    number, channel = _channel(chunk, position + HEAD.size, schemas)
                    channels[number] = channel
                    if len(channels) > MAX_TOPICS:
                        raise DamageError(f"'{path.name}' has more than {MAX_TOPICS} topics")
                position = end


def _mcap_records(path: Path, file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Opcode of each record up to the footer that matters, and the record with its head.

    Of a chunk, the content alone.
    """
    size, position = path.stat().st_size, len(MAGIC)
    while True:
        start = position
        head = file.read(HEAD.size)
        if len(head) < HEAD.size:
            raise DamageError(f"'{path.name}' ends in the middle, at byte {start + len(head)}")
        opcode, length = HEAD.unpack(head)
        position += HEAD.size + length
        if opcode == 0 or position > size:
            raise DamageError(f"'{path.name}' ends in the middle or is damaged at byte {start}")
        if opcode in READ and length > MAX_CHUNK:
            raise DamageError(f"'{path.name}' has a record of {length} bytes")
        if opcode == FOOTER:
            file.seek(length, 1)
            if file.read(len(MAGIC)) != MAGIC:
                raise DamageError(f"'{path.name}' ends in the middle, at byte {size}")
            return
        if opcode == CHUNK:
            yield opcode, file.read(length)
        elif opcode in READ:
            yield opcode, head + file.read(length)
        elif length:
            file.seek(length, 1)


def _unpack(path: Path, content: bytes) -> bytes:
    """The records of a chunk."""
    _, _, size, crc, compression = _fields("QQQIs", content, 0)
    start = 28 + 4 + len(compression.encode()) + 8
    packed = content[start : start + struct.unpack_from("<Q", content, start - 8)[0]]
    if size > min(MAX_CHUNK, LARGE_CHUNK + MAX_RATIO * len(packed)):
        raise DamageError(f"'{path.name}' has a chunk of {size} bytes")
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
    number, schema, topic, encoding = _fields("HHss", content, position)
    position += 4 + 4 + len(topic.encode()) + 4 + len(encoding.encode())
    (length,) = struct.unpack_from("<I", content, position)
    metadata = content[position + 4 : position + 4 + length]
    entries, position = {}, 0
    while position < len(metadata):
        key, value = _fields("ss", metadata, position)
        entries[key] = value
        position += 8 + len(key.encode()) + len(value.encode())
    name, definition = schemas[schema]
    qos = entries.get("offered_qos_profiles", "")
    return number, Channel(
        topic, name, encoding, definition, qos, entries.get("topic_type_hash", "")
    )


def _fields(form: str, content: bytes, position: int) -> list[Any]:
    """Fields of a record: struct's letters, and s for a text with its length before it."""
    found: list[Any] = []
    for letter in form:
        if letter == "s":
            (length,) = struct.unpack_from("<I", content, position)
            position += 4
            if position + length > len(content):
                raise struct.error
            found.append(content[position : position + length].decode())
            position += length
        else:
            found += struct.unpack_from(f"<{letter}", content, position)
            position += struct.calcsize(f"<{letter}")
    return found


def _sqlite3_messages(path: Path) -> Iterator[tuple[Channel, int, bytes]]:
    size = path.stat().st_size
    try:
        with _database(path) as database:
            channels = _sqlite3_channels(path, database)
            read = 0
            for topic, stamp, data in database.execute(f"SELECT {COLUMNS} FROM messages"):
                read += len(data) + 1
                if read > size:  # pages that are read in a circle
                    raise DamageError(f"'{path.name}' is damaged")
                if not isinstance(stamp, int) or stamp < 0 or not isinstance(data, bytes):
                    raise DamageError(f"'{path.name}' is damaged")
                yield channels[topic], stamp, data
    except sqlite3.Error as error:
        raise DamageError(f"'{path.name}': {error}") from error


@contextmanager
def _database(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database without changing it: where a writer died over it, a copy is repaired."""
    unfinished = [path.with_name(path.name + suffix) for suffix in ("-journal", "-wal")]
    unfinished = [file for file in unfinished if file.is_file() and file.stat().st_size]
    with temporary_folder(path.absolute().parent.parent if unfinished else None) as folder:
        if unfinished:
            for file in (path, *unfinished):
                shutil.copyfile(file, folder / file.name)
            uri = (folder / path.name).as_uri()
        else:
            uri = path.absolute().as_uri() + "?immutable=1"
        with closing(sqlite3.connect(uri, uri=True)) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            yield database


def _sqlite3_channels(path: Path, database: sqlite3.Connection) -> dict[int, Channel]:
    """Topics by their id; tables that compute what they hold are refused."""
    columns = {}
    for table in ("messages", "topics", "message_definitions"):
        kind = "SELECT count(*) FROM sqlite_master WHERE name = ? AND type = 'table' AND rootpage"
        (exists,) = database.execute(kind, (table,)).fetchone()
        rows = database.execute(f"PRAGMA table_xinfo({table})").fetchall() if exists else []
        columns[table] = {name for _, name, _, _, _, _, hidden in rows if not hidden}
        if len(columns[table]) < len(rows):
            raise DamageError(f"'{path.name}' has computed columns")
    if not columns["messages"].issuperset(COLUMNS.split(", ")):
        raise DamageError(f"'{path.name}' has no messages")
    definitions: dict[str, str] = {}
    if columns["message_definitions"]:
        query = "SELECT topic_type, encoded_message_definition FROM message_definitions"
        definitions = dict(database.execute(f"{query} LIMIT {MAX_TOPICS}"))
    wanted = ["id", "name", "type", "serialization_format"]
    wanted += [
        name if name in columns["topics"] else "''"
        for name in ("offered_qos_profiles", "type_description_hash")
    ]
    query = f"SELECT {', '.join(wanted)} FROM topics LIMIT {MAX_TOPICS + 1}"
    channels = {}
    for number, *texts in database.execute(query):
        if not all(isinstance(text, str) for text in texts):
            raise DamageError(f"'{path.name}' is damaged")
        topic, kind, serialization, qos, digest = texts
        definition = definitions.get(kind, "")
        channels[number] = Channel(topic, kind, serialization, definition, qos, digest)
    if len(channels) > MAX_TOPICS:
        raise DamageError(f"'{path.name}' has more than {MAX_TOPICS} topics")
    return channels
