"""Read the summary of an MCAP file if its checksum is valid.

The summary is at the end of a closed file, followed by its checksum:

    … | data end | schemas, channels, chunk indexes, statistics, … | footer | magic
    footer   offset of the summary, offset of the summary offsets, CRC-32 of both

Source: MCAP's specification. A file without a summary, or without its checksum, must be read completely.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

from ..bounds import MAX_SUMMARY
from .mcap import CHANNEL, CHUNK, FOOTER, HEAD, MAGIC, SCHEMA, Tables, messages_in, unpack_chunk
from .records import Batch, Channel, DamageError, ReadBudget, refusing_damage

CHUNK_INDEX, STATISTICS = 8, 11  # opcodes
FOOTER_FIELDS = struct.Struct("<QQI")
END = HEAD.size + FOOTER_FIELDS.size + len(MAGIC)
STATISTICS_FIELDS = struct.Struct("<QHIIIIQQI")
CHUNK_FIELDS = struct.Struct("<QQQQI")  # first and last time, offset, length, size of the rest


@dataclass(frozen=True)
class Chunk:
    """Log times in ns, offset and length of a chunk's record, and its channels."""

    first: int
    last: int
    offset: int
    length: int
    channels: frozenset[int]


@dataclass(frozen=True)
class McapSummary:
    """A file's channels by number, their message counts, and its chunks."""

    path: Path
    channels: dict[int, Channel]
    counts: dict[int, int]
    chunks: list[Chunk]

    def ends(self, topic: str, budget: ReadBudget) -> Iterator[Batch]:
        """Return batches that include the first and the last message of a topic.

        Raises:
            DamageError: a chunk is damaged, or not at its stated offset.
            OSError: the file cannot be read.
        """
        numbers = {n for n, channel in self.channels.items() if channel.topic == topic}
        chunks = [chunk for chunk in self.chunks if chunk.channels & numbers]
        # each of these chunks has a message of the topic
        soonest = min((max(c.first, c.last) for c in chunks), default=0)
        latest = max((min(c.first, c.last) for c in chunks), default=0)
        found = not chunks
        with self.path.open("rb") as file, refusing_damage(self.path):
            for chunk in [c for c in chunks if c.first <= soonest or c.last >= latest]:
                file.seek(chunk.offset)
                opcode, length = HEAD.unpack(file.read(HEAD.size))
                if opcode != CHUNK or HEAD.size + length != chunk.length:
                    raise DamageError(f"'{self.path.name}' is damaged at byte {chunk.offset}")
                budget.left += chunk.length
                content = unpack_chunk(self.path, file.read(length), budget)
                for batch in messages_in(self.path, content, Tables(self.channels), budget):
                    if batch.channel.topic == topic:
                        found = True
                        yield batch
            if not found:
                raise DamageError(f"'{self.path.name}' has no messages on {topic}, which its summary counts")


def read_summary(path: Path) -> McapSummary | None:
    """Return the summary of an MCAP file; None without a valid one.

    Raises:
        OSError: the file cannot be read.
    """
    size = path.stat().st_size
    if path.suffix != ".mcap" or size < END + len(MAGIC):
        return None
    with path.open("rb") as file:
        file.seek(size - END)
        end = file.read()
        start, _, crc = FOOTER_FIELDS.unpack_from(end, HEAD.size)
        length = size - END - start
        sound = end.endswith(MAGIC) and HEAD.unpack_from(end) == (FOOTER, FOOTER_FIELDS.size)
        if not sound or not crc or not 0 < start < size - END or length > MAX_SUMMARY:
            return None
        file.seek(start)
        content = file.read(length)
    if crc32(end[: HEAD.size + 16], crc32(content)) != crc:
        return None
    try:
        return _summary(path, content, start)
    except (struct.error, UnicodeDecodeError, KeyError, DamageError):
        return None


def _summary(path: Path, content: bytes, start: int) -> McapSummary | None:
    """Return a summary from its records at an offset; None if they are inconsistent."""
    tables, chunks, counts = Tables(), [], None
    position, stated, chunk_count = 0, 0, 0
    while position < len(content):
        opcode, length = HEAD.unpack_from(content, position)
        position += HEAD.size
        if opcode in (SCHEMA, CHANNEL):
            tables.add(path, opcode, content, position)
        elif opcode == CHUNK_INDEX:
            first, last, offset, size, more = CHUNK_FIELDS.unpack_from(content, position)
            begin = position + CHUNK_FIELDS.size
            if CHUNK_FIELDS.size + more > length:  # else many records could share the same bytes
                return None
            offsets = content[begin : begin + more]
            channels = frozenset(number for number, _ in struct.iter_unpack("<HQ", offsets))
            chunks.append(Chunk(first, last, offset, size, channels))
        elif opcode == STATISTICS:
            stated, *_, chunk_count, _, _, size = STATISTICS_FIELDS.unpack_from(content, position)
            pairs = content[position + STATISTICS_FIELDS.size : position + STATISTICS_FIELDS.size + size]
            counts = dict(struct.iter_unpack("<HQ", pairs))
        position += length
    whole = counts is not None and sum(counts.values()) == stated and len(chunks) == chunk_count
    inside = all(len(MAGIC) <= c.offset and c.offset + c.length <= start for c in chunks)
    if counts is None or not whole or not inside:
        return None
    indexed = frozenset().union(*(chunk.channels for chunk in chunks))
    used = {number: count for number, count in counts.items() if count}
    return McapSummary(path, tables.channels, used, chunks) if used.keys() <= indexed & tables.channels.keys() else None
