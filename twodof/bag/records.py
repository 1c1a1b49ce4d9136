"""Record types and limits for untrusted bags.

Every claim of a file is checked: lengths, tables of contents, sizes after decompression. The size of one chunk or
message bounds memory, and the size of the files bounds time. rosbags does not read truncated files, and does not check
complete ones.
"""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..bounds import MAX_CHUNK, MAX_NAME, MAX_RATIO, MAX_TOPICS
from ..ros.cdr import Rows

RECORD = 2000  # bytes of budget for a record; a packed message takes at least 3 bytes of a file
TEXT = 100  # bytes of budget for each byte of a topic's texts, which stay in memory

Stamps = NDArray[np.int64]  # N times, ns since the epoch


class Channel(NamedTuple):
    """A topic as described by a bag's file."""

    topic: str
    type: str
    serialization: str
    definition: str
    qos: str
    hash: str


class Batch(NamedTuple):
    """Messages of a channel with equal lengths: log times in ns, N, and N × bytes."""

    channel: Channel
    stamps: Stamps
    messages: Rows


def add_channel(file: Path, channels: dict[int, Channel], number: int, channel: Channel) -> None:
    """Add a topic of a file to those known, by number; raise DamageError for too many, or for a long name."""
    if channels.setdefault(number, channel) != channel:  # as the specification forbids
        raise DamageError(f"'{file.name}' has two topics of the number {number}")
    if len(channels) > MAX_TOPICS:
        raise DamageError(f"'{file.name}' has more than {MAX_TOPICS} topics")
    if len(channel.topic) + len(channel.type) > MAX_NAME:
        raise DamageError(f"'{file.name}' has a topic with a name of more than {MAX_NAME} characters")


class DamageError(Exception):
    """The file is unreadable from here on; earlier messages are sound."""


@dataclass
class ReadBudget:
    """Read budget of a bag: the bytes to which its files may still unpack.

    A few bytes can unpack to millions of bytes, or to an unlimited number of equal records. The messages of an honest
    bag differ at least in their time stamps. In addition to one large chunk, a bag may therefore unpack to at most
    MAX_RATIO times the bytes that were read. Each record counts as RECORD bytes more.
    """

    left: int = MAX_CHUNK

    def spend(self, size: int) -> None:
        """Subtract bytes from the budget; raise DamageError if it is exhausted."""
        self.left -= size
        if self.left < 0:
            raise DamageError(f"it unpacks to more than {MAX_RATIO} times its size")


@contextmanager
def refusing_damage(file: Path) -> Iterator[None]:
    """Name the file in the error of a malformed field."""
    try:
        yield
    except (struct.error, UnicodeDecodeError, KeyError, TypeError) as error:
        raise DamageError(f"'{file.name}' is damaged") from error
