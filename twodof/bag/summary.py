"""Read the summary of an MCAP file if its checksum is valid.

The summary is at the end of a closed file, followed by its checksum:

    … | data end | schemas, channels, chunk indexes, statistics, … | footer | magic
    footer   offset of the summary, offset of the summary offsets, CRC-32 of both

Source: MCAP's specification. A file without a summary, or without its checksum, must be read completely.
"""

import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

from ..bounds import MAX_SUMMARY, MAX_TOPICS
from .mcap import CHANNEL, CHUNK, FOOTER, HEAD, MAGIC, SCHEMA, Tables, messages_in, unpack_chunk
from .records import Batch, Channel, DamageError, ReadBudget, refusing_damage

CHUNK_INDEX, STATISTICS = 8, 11  # opcodes
FOOTER_FIELDS = struct.Struct("<QQI")
END = HEAD.size + FOOTER_FIELDS.size + len(MAGIC)
STATISTICS_FIELDS = struct.Struct("<QHIIIIQQI")
CHUNK_FIELDS = struct.Struct("<QQQQI")  # first and last time, offset, length, size of the offsets by channel
OFFSET_SIZE = 10  # of the message index of one channel
INDEX_SIZE = struct.Struct("<Q")  # of all message indexes of a chunk, which follow it
SMALLEST_CHUNK = 49  # bytes of a chunk without records
INDEX_HEAD, INDEX_ENTRY = 15, 16  # bytes of a message index of one channel, besides those of each message


class Chunk(NamedTuple):
    """Log times in ns, offset and length of a chunk's record, end of its message indexes, and its message counts."""

    first: int
    last: int
    offset: int
    length: int
    end: int
    counts: dict[int, int]


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
        counted = ((c, sum(count for n, count in c.counts.items() if n in numbers)) for c in self.chunks)
        having = [(c, count) for c, count in counted if count]
        soonest = min((max(c.first, c.last) for c, _ in having), default=0)
        latest = max((min(c.first, c.last) for c, _ in having), default=0)
        with self.path.open("rb") as file, refusing_damage(self.path):
            for chunk, count in [(c, n) for c, n in having if c.first <= soonest or c.last >= latest]:
                file.seek(chunk.offset)
                opcode, length = HEAD.unpack(file.read(HEAD.size))
                if opcode != CHUNK or HEAD.size + length != chunk.length:
                    raise DamageError(f"'{self.path.name}' is damaged at byte {chunk.offset}")
                budget.left += chunk.length
                content, found = unpack_chunk(self.path, file.read(length), budget), 0
                for batch in messages_in(self.path, content, Tables(self.channels), budget):
                    if batch.channel.topic == topic:
                        found += len(batch.stamps)
                        yield batch
                if found != count:
                    where = f"'{self.path.name}' has {found} messages on {topic} at byte {chunk.offset}"
                    raise DamageError(f"{where}, and {count} according to its summary")


def read_summaries(paths: Iterable[Path]) -> list[McapSummary] | None:
    """Return the summaries of all MCAP files of a bag; None if one is not valid, or if they are very large together."""
    summaries, room = list[McapSummary](), MAX_SUMMARY
    for path in paths:
        content, start = _bytes_of_summary(path, room)
        room -= len(content)
        try:
            summary = _summary(path, content, start)
        except (struct.error, UnicodeDecodeError, KeyError, DamageError):
            return None
        if summary is None:
            return None
        summaries.append(summary)
    return summaries


def _bytes_of_summary(path: Path, most: int) -> tuple[bytes, int]:
    """Return the summary of a file and its offset; no bytes if its checksum differs or it is larger than ``most``."""
    none = b"", 0
    size = path.stat().st_size
    if path.suffix != ".mcap" or size < END + len(MAGIC):
        return none
    with path.open("rb") as file:
        file.seek(size - END)
        end = file.read()
        start, _, crc = FOOTER_FIELDS.unpack_from(end, HEAD.size)
        length = size - END - start
        sound = end.endswith(MAGIC) and HEAD.unpack_from(end) == (FOOTER, FOOTER_FIELDS.size)
        if not sound or not crc or not 0 < start < size - END or length > most:
            return none
        file.seek(start)
        content = file.read(length)
    return (content, start) if crc32(end[: HEAD.size + 16], crc32(content)) == crc else none


def _summary(path: Path, content: bytes, start: int) -> McapSummary | None:
    """Return a summary from its records at an offset; None if they are inconsistent."""
    tables, chunks, counts, indexed = Tables(), list[Chunk](), None, Counter[int]()
    position, stated, chunk_count = 0, 0, 0
    while position < len(content):
        opcode, length = HEAD.unpack_from(content, position)
        position += HEAD.size
        if opcode in (SCHEMA, CHANNEL):
            tables.add(path, opcode, content, position)
        elif opcode == CHUNK_INDEX:
            chunks.append(chunk := _chunk(path, content[position : position + length]))
            for number, count in chunk.counts.items():
                indexed[number] += count
        elif opcode == STATISTICS:
            stated, *_, chunk_count, _, _, size = STATISTICS_FIELDS.unpack_from(content, position)
            pairs = content[position + STATISTICS_FIELDS.size : position + STATISTICS_FIELDS.size + size]
            counts = Counter(dict(struct.iter_unpack("<HQ", pairs)))
        position += length
    if counts is None or counts != indexed or counts.total() != stated or len(chunks) != chunk_count:
        return None
    chunks.sort(key=attrgetter("offset"))
    ends = [len(MAGIC), *(chunk.end for chunk in chunks)]
    apart = all(end <= begin for end, begin in zip(ends, [*(chunk.offset for chunk in chunks), start]))
    used = {number: total for number, total in indexed.items() if total}
    return McapSummary(path, tables.channels, used, chunks) if apart and used.keys() <= tables.channels.keys() else None


def _chunk(path: Path, record: bytes) -> Chunk:
    """Return a chunk from its index record; its message counts follow from the sizes of its message indexes."""
    first, last, offset, length, size = CHUNK_FIELDS.unpack_from(record)
    if size > MAX_TOPICS * OFFSET_SIZE or length < SMALLEST_CHUNK:
        raise DamageError(f"'{path.name}' has a damaged summary")
    offsets = record[CHUNK_FIELDS.size : CHUNK_FIELDS.size + size]
    (index_size,) = INDEX_SIZE.unpack_from(record, CHUNK_FIELDS.size + size)
    begin = offset + length
    indexes = sorted((index_offset, number) for number, index_offset in struct.iter_unpack("<HQ", offsets))
    counts, end = dict[int, int](), begin + index_size
    for index_offset, number in reversed(indexes):
        counts[number] = (end - index_offset - INDEX_HEAD) // INDEX_ENTRY
        if counts[number] < 0 or index_offset < begin:
            raise DamageError(f"'{path.name}' has a damaged summary")
        end = index_offset
    return Chunk(first, last, offset, length, begin + index_size, counts)
