"""Record types and limits for untrusted bags.

Nothing that a file claims is believed: a length, a table of contents, a size after decompression.
Memory is bounded by the size of one chunk or message, time by the size of the files.
rosbags reads no file that lacks its end, and believes the rest.
"""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..bounds import MAX_CHUNK, MAX_RATIO
from ..ros.cdr import Rows

RECORD = 2000  # bytes that a record counts for; a message takes 3 of the file at least, packed
TEXT = 100  # bytes that one of a topic's texts counts for, which are kept

Stamps = NDArray[np.int64]
"""ns since the epoch, N."""


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


class DamageError(Exception):
    """The file is unreadable from here on; earlier messages are sound."""


@dataclass
class ReadBudget:
    """Read budget of a bag: the bytes to which its files may still unpack.

    A few bytes can unpack to millions, and to records without end that are all alike. The messages
    of an honest bag differ in their time stamps at least. So after a large chunk no more is
    believed than MAX_RATIO times what was read, where each record counts for RECORD bytes more.
    """

    left: int = MAX_CHUNK

    def spend(self, size: int) -> None:
        """Subtract bytes from the budget; raise DamageError where it is exhausted."""
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
