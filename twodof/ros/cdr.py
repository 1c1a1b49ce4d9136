"""Pack and unpack many serialised messages (CDR) of a topic at a time.

    message     4 bytes, the second of which is 1 for little-endian numbers; header; fields
    header      stamp, int32 s and uint32 ns; frame_id
    text        uint32 length; bytes; a NUL, which counts
    sequence    uint32 length; elements

Numbers are aligned to their size, relative to the end of the first 4 bytes. Source: OMG, "DDS-XTypes"
1.3, section 7.4.1, "plain CDR".
"""

import struct
from base64 import b64encode
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..simulation.experiments import NANOSECONDS

Array = NDArray[np.float64]
Rows = NDArray[np.uint8]  # serialised messages of equal length, N × bytes

LITTLE_ENDIAN = b"\0\1\0\0"
FRAME = 16  # offset of a frame_id, after its length


class Numbers(NamedTuple):
    """A number of consecutive 64-bit numbers in a message."""

    size: int


class Stamp(NamedTuple):
    """Time of a message; with a frame_id after it, its header."""


class MixtureError(Exception):
    """Messages differ in joint names or array lengths."""


class Layout:
    """Layout of serialised messages that differ only in stamps and numbers, like the messages of a run.

    Its parts, in their order, are stamps, texts, lengths of sequences, constant numbers, and numbers.
    """

    def __init__(self, *parts: Stamp | str | int | Array | Numbers) -> None:
        content = LITTLE_ENDIAN
        self._stamps: list[int] = []
        self._numbers: list[slice] = []
        for part in parts:
            if isinstance(part, Numbers):
                content += bytes(_gap(8, len(content)) if part.size else 0)
                self._numbers.append(slice(len(content), len(content) + 8 * part.size))
                content += bytes(8 * part.size)
                continue
            if isinstance(part, np.ndarray):
                content += bytes(_gap(8, len(content))) + part.astype("<f8").tobytes()
                continue
            content += bytes(_gap(4, len(content)))
            if isinstance(part, Stamp):
                self._stamps.append(len(content))
                content += bytes(8)
            elif isinstance(part, str):
                text = part.encode() + b"\0"
                content += struct.pack("<I", len(text)) + text
            else:
                content += struct.pack("<I", part)
        self._plain = np.frombuffer(content, np.uint8)
        self._fixed = np.ones(len(content), bool)
        for at in (*self._numbers, *(slice(at, at + 8) for at in self._stamps)):
            self._fixed[at] = False

    @property
    def size(self) -> int:
        """Bytes of a message."""
        return len(self._plain)

    def template(self) -> dict[str, object]:
        """Return the message with zeros for stamps and numbers, in base64, and the offsets of each stamp and number."""
        numbers = [at for where in self._numbers for at in range(where.start, where.stop, 8)]
        return {"plain": b64encode(self._plain.tobytes()).decode(), "stamps": self._stamps, "numbers": numbers}

    def pack(self, stamps: ArrayLike, *numbers: Array) -> Rows:
        """Pack N messages with their stamps, ns, and numbers, N × count each."""
        rows = np.tile(self._plain, (np.size(stamps), 1))
        time = np.stack(np.divmod(stamps, NANOSECONDS), axis=-1).astype("<u4").view(np.uint8)
        for at in self._stamps:
            rows[:, at : at + 8] = time
        for where, part in zip(self._numbers, numbers, strict=True):
            if part.size:
                rows[:, where] = np.ascontiguousarray(part, "<f8").view(np.uint8)
        return rows

    def unpack(self, rows: Rows) -> list[Array] | None:
        """Return the numbers of N messages, N × count each; None if the messages have another layout."""
        if rows.shape[1] != self.size or (rows[:, self._fixed] != self._plain[self._fixed]).any():
            return None
        return [np.ascontiguousarray(rows[:, where]).view("<f8").astype(np.float64) for where in self._numbers]


def joint_state_layout(names: Sequence[str], frame: str, sizes: Sequence[int]) -> Layout:
    """Return the layout of serialised JointStates with given numbers of positions, velocities and efforts."""
    parts = [part for size in sizes for part in (size, Numbers(size))]
    return Layout(Stamp(), frame, len(names), *names, *parts)


def unpack_points(rows: Rows) -> tuple[bytes, Array]:
    """Return frame and coordinates, N × 3, of PointStampeds, or of PoseStampeds, which begin with the same fields.

    Raises:
        MixtureError: the points are in different frames.
        IndexError, struct.error: a message is damaged.
    """
    message = rows[0].tobytes()
    order = "<" if message[1] else ">"
    end = FRAME + int(struct.unpack_from(f"{order}I", message, FRAME - 4)[0])
    start = end + _gap(8, end)
    if start + 24 > rows.shape[1]:
        raise struct.error
    alike = np.r_[0:4, FRAME - 4 : end]
    if (rows[:, alike] != rows[0, alike]).any():
        each = [unpack_points(row[None]) for row in rows]
        if len({frame for frame, _ in each}) > 1:
            raise MixtureError("frames")
        return each[0][0], np.concatenate([point for _, point in each])
    points = np.ascontiguousarray(rows[:, start : start + 24]).view(f"{order}f8")
    return rows[0, FRAME:end].tobytes().rstrip(b"\0"), points.astype(np.float64)


def _gap(size: int, end: int) -> int:
    return (4 - end) % size
