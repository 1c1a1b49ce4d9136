"""Read MCAP files record by record, truncated ones too. Source: MCAP's specification."""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any
from zlib import crc32

import lz4.frame
import numpy as np
from numpy.typing import NDArray

from ..bounds import MAX_CHUNK, MAX_LOOSE, MAX_PROVENANCE, MAX_RATIO
from ..ros.cdr import Rows
from .records import RECORD, TEXT, Batch, Channel, DamageError, ReadBudget, add_channel, refusing_damage

if sys.version_info >= (3, 14):
    from compression import zstd as zstd
else:
    from backports import zstd as zstd

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA, FOOTER = 3, 4, 5, 6, 12, 2  # opcodes
READ = (SCHEMA, CHANNEL, MESSAGE, CHUNK)
HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<BQHIqQ")  # record header, channel, sequence, two times
STAMP = slice(15, 23)  # the first of the two times
MANY = 1000  # records outside chunks that are read at a time
FEW = 16  # periods that are not read at once, and records between two searches for a period


def mcap_messages(path: Path, budget: ReadBudget) -> Iterator[Batch]:
    """Read all messages of a file; errors as in ``read_messages``."""
    tables = Tables()
    for records in _chunks(path, budget):
        yield from messages_in(path, records, tables, budget)


def _chunks(path: Path, budget: ReadBudget) -> Iterator[bytes]:
    """Yield the records of each chunk, and groups of records outside chunks."""
    loose: list[bytes] = []
    size = 0
    try:
        for opcode, content in _records(path, budget):
            if opcode != CHUNK:
                loose.append(content)
                size += len(content)
            if opcode == CHUNK or len(loose) > MANY or size > MAX_LOOSE:
                before, loose, size = b"".join(loose), [], 0
                yield before
            if opcode == CHUNK:
                yield unpack_chunk(path, content, budget)
    except DamageError:  # earlier records are sound
        yield b"".join(loose)
        raise
    yield b"".join(loose)


def read_metadata(path: Path, name: str, key: str) -> str:
    """Return an entry of a file's own metadata, or ""; errors as in ``read_messages``."""
    with refusing_damage(path):
        for _, content in _records(path, ReadBudget(), (METADATA,)):
            title, _, position = fields("sI", content, HEAD.size)
            if title == name:
                if len(content) > MAX_PROVENANCE:
                    raise DamageError(f"'{path.name}' has metadata '{name}' of {len(content)} bytes")
                return _entries(content[position:]).get(key, "")
    return ""


def messages_in(path: Path, chunk: bytes, tables: Tables, budget: ReadBudget) -> Iterator[Batch]:
    """Return the messages of a chunk in batches of one channel and length; a batch takes 0.1 ms.

    Later records of topics change no earlier topic, so that messages before and after them are one batch. If records
    repeat periodically, as in most bags of ROS 2, all of them are read at once. One by one, each would take a
    microsecond.
    """
    position = skips = 0
    seen: dict[bytes, int] = {}  # different headers of the latest message records, and their offsets
    waiting: dict[bytes, list[int]] = {}  # offsets by header
    every = np.frombuffer(chunk, np.uint8)

    def gathered() -> Iterator[Batch]:
        for head, offsets in waiting.items():
            size = HEAD.size + HEAD.unpack_from(head)[1]
            yield tables.batch(path, np.lib.stride_tricks.sliding_window_view(every, size)[offsets])
        waiting.clear()

    while position + HEAD.size <= len(chunk):
        opcode, length = HEAD.unpack_from(chunk, position)
        end = position + HEAD.size + length
        if end > len(chunk) or not opcode:
            break
        budget.spend(RECORD)
        head = chunk[position : position + HEAD.size + 2]
        if opcode in (SCHEMA, CHANNEL):
            seen = {}
            try:
                budget.spend(TEXT * length)
                tables.add(path, opcode, chunk, position + HEAD.size)
            except Exception:  # earlier messages are sound
                yield from gathered()
                raise
        elif opcode == MESSAGE and head in seen and not skips:
            turn = [offset for offset in seen.values() if offset >= seen[head]]
            rows = _turns(every[turn[0] :], [offset - turn[0] for offset in turn], position - turn[0])[1:]
            seen = {}
            if len(rows) > FEW:
                budget.spend(RECORD * (len(rows) * len(turn) - 1))
                yield from gathered()
                for offset in turn:
                    yield tables.batch(path, rows[:, offset - turn[0] :])
                position += rows.size
                continue
            skips = FEW  # each search takes 20 µs
        if opcode == MESSAGE:
            waiting.setdefault(head, []).append(position)
            if skips:
                skips -= 1
            else:
                seen[head] = position
        position = end
    yield from gathered()
    if position < len(chunk):
        raise DamageError(f"'{path.name}' has a damaged chunk")


def _turns(every: NDArray[np.uint8], turn: Sequence[int], length: int) -> Rows:
    """Return records that repeat every ``length`` bytes, one row for each period; ``turn`` has their offsets in it."""
    rows = every[: len(every) // length * length].reshape(-1, length)
    heads = np.concatenate([np.arange(offset, offset + HEAD.size + 2) for offset in turn])
    count, ahead = 1, 16
    while count < len(rows):
        same = (rows[count : count + ahead, heads] == rows[0, heads]).all(axis=1)
        if not same.all():
            return rows[: count + int(np.argmin(same))]
        count, ahead = count + len(same), 2 * ahead
    return rows[:count]


class Tables:
    """The schemas and channels of an MCAP file that were read so far."""

    def __init__(self, channels: Mapping[int, Channel] = MappingProxyType({})) -> None:
        self._schemas: dict[int, tuple[str, str]] = {0: ("", "")}
        self.channels = dict(channels)

    def add(self, path: Path, opcode: int, content: bytes, position: int) -> None:
        """Add a schema or a channel, whose fields begin at a position."""
        if opcode == SCHEMA:
            number, name, _, text, _ = fields("Hsss", content, position)
            self._schemas[number] = (name, text)
            return
        number, schema, topic, encoding, length, position = fields("HHssI", content, position)
        entries = _entries(content[position : position + length])
        name, text = self._schemas[schema]
        qos, hashed = entries.get("offered_qos_profiles", ""), entries.get("topic_type_hash", "")
        add_channel(path, self.channels, number, Channel(topic, name, encoding, text, qos, hashed))

    def batch(self, path: Path, rows: Rows) -> Batch:
        """Return the messages of records with the same channel and length."""
        _, length, channel, *_ = MESSAGE_HEAD.unpack_from(rows[0])
        end = HEAD.size + length
        if end < MESSAGE_HEAD.size:
            raise struct.error
        stamps = np.ascontiguousarray(rows[:, STAMP]).view("<i8")[:, 0]
        if stamps.min() < 0:
            raise DamageError(f"'{path.name}' has a stamp after the year 2262")
        return Batch(self.channels[channel], stamps, rows[:, MESSAGE_HEAD.size : end])


def _records(path: Path, budget: ReadBudget, wanted: Sequence[int] = READ) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and bytes of each record up to the footer; for a chunk, only its content."""
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise DamageError(f"'{path.name}' is not an MCAP file")
        size, position = path.stat().st_size, len(MAGIC)
        while True:
            start = position
            head = file.read(HEAD.size)
            if len(head) < HEAD.size:
                raise DamageError(f"'{path.name}' ends in the middle, at byte {start + len(head)}")
            opcode, length = HEAD.unpack(head)
            budget.left += MAX_RATIO * length
            budget.spend(RECORD)
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
            if opcode in wanted:
                yield opcode, (b"" if opcode == CHUNK else head) + file.read(length)
            elif length:
                file.seek(length, 1)


def unpack_chunk(path: Path, content: bytes, budget: ReadBudget) -> bytes:
    """Return the records of a chunk."""
    _, _, size, crc, compression, length, start = fields("QQQIsQ", content, 0)
    packed = content[start : start + length]
    if size > MAX_CHUNK:
        raise DamageError(f"'{path.name}' has a chunk of {size} bytes")
    budget.spend(size)
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


def _entries(metadata: bytes) -> dict[str, str]:
    entries, position = {}, 0
    while position < len(metadata):
        key, value, position = fields("ss", metadata, position)
        entries[key] = value
    return entries


def fields(form: str, content: bytes, position: int) -> list[Any]:
    """Return the fields of a record and their end, by the format letters of ``struct``; s is a length-prefixed text."""
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
