"""rosbags' writer, with storages that can be flushed to the disk during a run.

rosbags commits SQLite transactions only at the end and cuts MCAP chunks at 1 MiB, so that a killed process would leave
few messages or none.
"""

import errno
import json
import os
import re
import sqlite3
import struct
from collections import defaultdict
from collections.abc import Mapping
from functools import cache
from io import BytesIO
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal
from zlib import crc32

import numpy as np
from rosbags.interfaces import ConnectionExtRosbag2, Qos
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionMode
from rosbags.rosbag2.metadata import dump_qos_v8
from rosbags.rosbag2.storage_mcap import McapWriter, PendingChunk
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

from ..errors import BagError
from ..files import sync
from ..ros.cdr import Rows
from .mcap import CHUNK, HEAD, MAGIC, MESSAGE, METADATA
from .mcap import zstd as zstd
from .records import Stamps as Stamps

METADATA_VERSION: Final[Literal[8]] = 8  # Humble reads version 8 and refuses version 9
STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
SYNCHRONOUS = {False: "PRAGMA synchronous = OFF", True: "PRAGMA synchronous = FULL"}
REMOVED = "it was removed while it was being written"
KINDS = {".mcap": "mcap", ".db3": "sqlite3"}
OVERHEAD = 64  # bytes of memory for a waiting message besides its data
BATCH_SIZE = 512 * 1024  # bytes; below the 1 MiB at which rosbags cuts a chunk
RECORD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("times", "<u8", 2)])
"""Header of a message record in MCAP."""
MESSAGE_INDEX = 7  # opcode
PLAIN = re.compile(r"(?!(null|true|false|yes|no|on|off|y|n)\b)[a-z][\w/]*", re.ASCII)
"""Keys that YAML 1.1 and 1.2 read as texts without quotes."""
CHECKSUM = struct.Struct("<I8s")  # end of a file: checksum of the summary, magic
FOOTER = struct.Struct(f"<QQ{CHECKSUM.size}s")  # offsets of summary and summary offsets; checksum, magic


class McapStorage(McapWriter):
    """MCAP storage that closes its chunk at each flush."""

    durable = False  # wait for the disk at the end
    packing = b""  # compression of chunks: b"zstd", or b"" for none

    _end = 0  # end of the last chunk that was written

    def write_all(self, stamps: Stamps, messages: Mapping[int, Rows]) -> None:
        """Write messages, one of each connection for each of the N stamps."""
        if not messages:
            return
        parts, ends, chunk = [], [0], self.chunk
        for connection, rows in messages.items():
            head = np.zeros(len(stamps), RECORD)
            head["opcode"], head["length"] = MESSAGE, RECORD.itemsize - HEAD.size + rows.shape[1]
            head["channel"], head["times"] = connection, stamps[:, None]
            parts += [head.view(np.uint8).reshape(-1, RECORD.itemsize), rows]
            ends.append(ends[-1] + RECORD.itemsize + rows.shape[1])
            self.channel_stats[connection] += len(stamps)
        begin, times = chunk.bio.tell(), stamps.tolist()
        for connection, offset in zip(messages, ends):
            positions = range(begin + offset, begin + ends[-1] * len(times), ends[-1])
            chunk.msgs[connection] += zip(times, positions)
        chunk.bio.write(np.hstack(parts).tobytes())
        for of in (self, chunk):
            of.message_start_time = min(of.message_start_time, min(times))
            of.message_end_time = max(of.message_end_time, max(times))

    def close_chunk(self) -> None:
        """Write the pending chunk and its index in one piece, faster than rosbags does."""
        chunk, plain, begin = self.chunk, self.chunk.bio.getvalue(), self.bio.tell()
        data, kind = zstd.compress(plain) if self.packing else plain, self.packing
        kind = struct.pack("<I", len(kind)) + kind
        times = struct.pack("<QQ", chunk.message_start_time, chunk.message_end_time)
        self._write(CHUNK, times + struct.pack("<QI", len(plain), 0) + kind + struct.pack("<Q", len(data)), data)
        end, positions = self.bio.tell(), b""
        for channel, messages in chunk.msgs.items():
            positions += struct.pack("<HQ", channel, self.bio.tell())
            index = struct.pack(f"<{2 * len(messages)}Q", *chain.from_iterable(messages))
            self._write(MESSAGE_INDEX, struct.pack("<HI", channel, len(index)), index)
        self.chunks.append(record := BytesIO())
        record.write(times + struct.pack("<QQI", begin, end - begin, len(positions)) + positions)
        record.write(struct.pack("<Q", self.bio.tell() - end) + kind + struct.pack("<QQ", len(data), len(plain)))
        self.chunk = PendingChunk(2**63 - 1, 0, BytesIO(), defaultdict(list))
        self._end = self.bio.tell()

    def _write(self, opcode: int, *parts: bytes) -> None:
        self.bio.writelines((HEAD.pack(opcode, sum(map(len, parts))), *parts))

    def describe(self, title: str, key: str, value: str) -> None:
        """Write an entry into the metadata of the file itself."""
        name, *entry = (struct.pack("<I", len(text)) + text for text in map(str.encode, (title, key, value)))
        self._write(METADATA, name, struct.pack("<I", sum(map(len, entry))), *entry)

    def flush(self, sync: bool) -> None:
        """Pass all messages to the operating system, and with ``sync`` to the disk."""
        if self.chunk.msgs:
            self.close_chunk()
        self.bio.flush()
        if sync:
            os.fsync(self.bio.fileno())

    def close(self, version: int, metadata: str) -> None:
        """Write the summary with its checksum, which rosbags omits."""
        super().close(version, metadata)
        with self.path.open("r+b") as file:
            file.seek(-FOOTER.size, os.SEEK_END)
            start, *_ = FOOTER.unpack(file.read())
            file.seek(start)
            checksum = crc32(file.read()[: -CHECKSUM.size])
            file.seek(-CHECKSUM.size, os.SEEK_END)
            file.write(CHECKSUM.pack(checksum, MAGIC))
            if self.durable:  # before metadata.yaml, which marks the bag as complete
                file.flush()
                os.fsync(file.fileno())

    def salvage(self) -> None:
        """Restore a valid file after a failed flush, so that the next can continue."""
        self.bio.flush()
        if self.chunk.msgs:  # the chunk was written in part: cut it off
            self.bio.seek(self._end)
            self.bio.truncate()


class Sqlite3Storage(Sqlite3Writer):
    """SQLite storage whose flush inserts and commits all waiting messages, or none."""

    durable = False  # wait for the disk at the end

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        self.conn.close()
        self.conn = sqlite3.connect(self.path, check_same_thread=False)
        self.conn.execute(SYNCHRONOUS[False])
        self.cursor = self.conn.cursor()
        self._rows: list[tuple[int, int, bytes]] = []

    def write_all(self, stamps: Stamps, messages: Mapping[int, Rows]) -> None:
        """Keep messages until the next flush, one of each connection for each of the N stamps."""
        parts = [(number, rows.tobytes(), rows.shape[1]) for number, rows in messages.items()]
        for k, stamp in enumerate(stamps.tolist()):
            self._rows += [(n, stamp, data[k * size : (k + 1) * size]) for n, data, size in parts]

    def flush(self, sync: bool) -> None:
        """Pass all messages to the operating system, and with ``sync`` to the disk."""
        if sync and not self.conn.in_transaction:  # new topics have opened a transaction; the next flush waits
            self.conn.execute(SYNCHRONOUS[True])
        self.conn.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", self._rows)
        self.conn.commit()
        self._rows.clear()

    def salvage(self) -> None:
        """Restore a valid file after a failed flush, so that the next can continue."""
        self.conn.rollback()

    def close(self, version: int, metadata: str) -> None:
        """Write everything to the file, and close it."""
        self.flush(sync=False)
        super().close(version, metadata)
        if self.durable:
            sync(self.path)


class BagWriter(Writer):
    """rosbags' writer with these storages; with ``fsync`` each flush waits for the disk."""

    STORAGE_PLUGINS = MappingProxyType({StoragePlugin.MCAP: McapStorage, StoragePlugin.SQLITE3: Sqlite3Storage})
    storage: McapStorage | Sqlite3Storage | None

    def __init__(self, path: Path, storage: str, *, fsync: bool = False, compress: str = "") -> None:
        super().__init__(path, version=METADATA_VERSION, storage_plugin=STORAGES[storage])
        self._fsync, self._packing = fsync, compress.encode()

    def open(self) -> None:
        """Create the folder and its files."""
        super().open()
        assert self.storage is not None
        self.storage.durable = self._fsync
        if isinstance(self.storage, McapStorage):
            self.storage.packing = self._packing

    def close(self) -> None:
        """Close the storage and write metadata.yaml, as rosbags does; its YAML library takes 40 ms for a short run."""
        assert self.storage is not None
        facts = self._facts(self.storage.path.name)
        self.storage.close(METADATA_VERSION, yaml_text(facts).strip())
        self.storage = None
        beside = self.metapath.with_suffix(".yaml.tmp")
        beside.write_text(yaml_text({"rosbag2_bagfile_information": facts}), "ascii")
        beside.replace(self.metapath)

    def _facts(self, file: str) -> dict[str, object]:
        """Return the content of metadata.yaml."""
        start, count = {"nanoseconds_since_epoch": self.min_timestamp}, sum(self.counts.values())
        duration = {"nanoseconds": max(0, self.max_timestamp - self.min_timestamp)}
        topics = [
            {
                "topic_metadata": {
                    "name": connection.topic,
                    "type": connection.msgtype,
                    "serialization_format": connection.ext.serialization_format,
                    "offered_qos_profiles": "\n".join(map(profile, connection.ext.offered_qos_profiles)),
                    "type_description_hash": connection.digest,
                },
                "message_count": self.counts[connection.id],
            }
            for connection in self.connections
            if isinstance(connection.ext, ConnectionExtRosbag2)
        ]
        return {
            "version": METADATA_VERSION,
            "storage_identifier": self.storage_plugin.name.lower(),
            "relative_file_paths": [file],
            "duration": duration,
            "starting_time": start,
            "message_count": count,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": file, "starting_time": start, "duration": duration, "message_count": count}],
            "custom_data": self.custom_data or None,
            "ros_distro": "rosbags",
        }

    def write_all(self, stamps: Stamps, messages: Mapping[int, Rows]) -> None:
        """Write messages, one of each connection for each of the N stamps, at the next flush."""
        assert self.storage is not None
        self.storage.write_all(stamps, messages)
        for connection in messages:
            self.counts[connection] += len(stamps)
        self.min_timestamp = min(self.min_timestamp, int(stamps.min()))
        self.max_timestamp = max(self.max_timestamp, int(stamps.max()))

    def flush(self) -> None:
        """Pass all messages to the operating system.

        Raises:
            OSError, sqlite3.Error: the disk is full, or the file is gone.
        """
        assert self.storage is not None
        if not self.storage.path.exists():  # a removed file could be written without an error
            raise FileNotFoundError(errno.ENOENT, REMOVED)
        self.storage.flush(self._fsync)


def yaml_text(value: object, indent: str = "") -> str:
    """Return the YAML of dicts with sorted keys, lists, whole numbers, texts and None, in blocks of lines.

    Texts, and keys that are not names, are in ASCII between double quotes, as in JSON.
    """
    if isinstance(value, dict):
        keys = {key: key if PLAIN.fullmatch(key) else _quoted(key) for key in sorted(value)}
        return "".join(f"{indent}{text}:{_inside(value[key], indent)}" for key, text in keys.items())
    if isinstance(value, list) and value:
        items = (yaml_text(item, f"{indent}  ").removeprefix(f"{indent}  ") for item in value)
        return "".join(f"{indent}- {item}" for item in items)
    text = "null" if value is None else _quoted(value) if isinstance(value, str) else str(value)
    return f"{text}\n"


def _inside(value: object, indent: str) -> str:
    """Return the YAML of a value, as it follows its key."""
    if isinstance(value, dict):
        return "\n" + yaml_text(value, f"{indent}  ")
    return ("\n" if isinstance(value, list) and value else " ") + yaml_text(value, indent)


def _quoted(text: str) -> str:
    quoted = json.dumps(text, ensure_ascii=False)
    return re.sub(r"[^ -~]", lambda character: f"\\U{ord(character[0]):08x}", quoted)


@cache
def profile(qos: Qos) -> str:
    """Return a topic's quality of service as rosbag2's metadata state it."""
    return dump_qos_v8([qos])


def check_path(path: Path, storage: str) -> None:
    """Raise BagError for a path that readers of this storage could not open.

    metadata.yaml contains the bag's name, and rosbags makes a URI of a database's whole path.
    """
    part, text = ("path", str(path)) if storage == "sqlite3" else ("name", path.name)
    if storage == "sqlite3" and any(c in text for c in "?#%"):
        raise BagError(f"'{path}': a sqlite3 bag cannot have ?, # or % in its path")
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise BagError(f"'{path}': the {part} of a {storage} bag must be UTF-8") from error
