"""What readers of a bag's files give, and how far they believe what a file claims.

Nothing that a file claims is believed: a length, a table of contents, a size after decompression.
Memory is bounded by the size of one chunk or message, time by the size of the files.
rosbags reads no file that lacks its end, and believes the rest.
"""

from __future__ import annotations

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
    """A topic as a bag's file describes it."""

    topic: str
    type: str
    serialization: str
    definition: str
    qos: str
    hash: str


class Batch(NamedTuple):
    """Messages of a channel that are equally long: log times in ns, N, and N × bytes."""

    channel: Channel
    stamps: Stamps
    messages: Rows


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
        """Take so many bytes off; a DamageError where they are not left."""
        self.left -= size
        if self.left < 0:
            raise DamageError(f"it unpacks to more than {MAX_RATIO} times its size")


@contextmanager
def refusing_damage(file: Path) -> Iterator[None]:
    """Name the file where something in it is not what its place asks for."""
    try:
        yield
    except (struct.error, UnicodeDecodeError, KeyError, TypeError) as error:
        raise DamageError(f"'{file.name}' is damaged") from error
