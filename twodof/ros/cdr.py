"""Pack and unpack many serialised messages (CDR) of a topic at a time.

    message     4 bytes, the second of which is 1 where numbers are little endian; header; the rest
    header      stamp, int32 s and uint32 ns; frame_id
    text        uint32 length; bytes; a NUL, which counts
    sequence    uint32 length; elements

Numbers are aligned to their size, counted from behind the first 4 bytes. Source: OMG, "DDS-XTypes"
1.3, section 7.4.1, "plain CDR".
"""

import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..simulation.experiments import NANOSECONDS

Array = NDArray[np.float64]
Rows = NDArray[np.uint8]
"""Serialised messages of equal length, N × bytes."""

LITTLE_ENDIAN = b"\0\1\0\0"
FRAME = 16  # where a frame_id begins, behind its length


class Numbers(NamedTuple):
    """A number of consecutive 64-bit numbers in a message."""

    size: int


class Stamp(NamedTuple):
    """Time of a message; with a frame_id after it, its header."""


class MixtureError(Exception):
    """Messages differ in joint names or array lengths."""


class Layout:
    """Layout of serialised messages that differ only in stamps and numbers, as those of a run do.

    Args:
        parts: a stamp, a text, the length of a sequence, or numbers, as they follow each other.
    """

    def __init__(self, *parts: Stamp | str | int | Numbers) -> None:
        content = LITTLE_ENDIAN
        self._stamps: list[int] = []
        self._numbers: list[slice] = []
        for part in parts:
            if isinstance(part, Numbers):
                content += bytes(_gap(8, len(content)) if part.size else 0)
                self._numbers.append(slice(len(content), len(content) + 8 * part.size))
                content += bytes(8 * part.size)
                continue
            content += bytes(_gap(4, len(content)))
            if isinstance(part, Stamp):
                self._stamps.append(len(content))
                content += bytes(8)
            else:
                content += _text(part, "<") if isinstance(part, str) else struct.pack("<I", part)
        self._plain = np.frombuffer(content, np.uint8)
        self._fixed = np.ones(len(content), bool)
        for at in (*self._numbers, *(slice(at, at + 8) for at in self._stamps)):
            self._fixed[at] = False

    @property
    def size(self) -> int:
        """Bytes of a message."""
        return len(self._plain)

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
        """Return the numbers of N messages, N × count each; None where other bytes differ."""
        if rows.shape[1] != self.size or (rows[:, self._fixed] != self._plain[self._fixed]).any():
            return None
        return [np.ascontiguousarray(rows[:, where]).view("<f8").astype(np.float64) for where in self._numbers]


class JointStateLayout(Layout):
    """Layout of the serialised JointStates of a run.

    Args:
        names: joint names.
        frame: frame_id of the header.
        sizes: how many positions, velocities and efforts there are.
    """

    def __init__(self, names: Sequence[str], frame: str, sizes: Sequence[int]) -> None:
        self._sizes = tuple(sizes)
        self._names = {order: _names(names, order) for order in "<>"}
        parts = [part for size in self._sizes for part in (size, Numbers(size))]
        super().__init__(Stamp(), frame, len(names), *names, *parts)

    def read(self, rows: Rows) -> list[Array]:
        """Return positions, velocities and efforts of N messages, N × size each.

        Raises:
            MixtureError: they are not all of these joints and sizes.
            IndexError, ValueError, struct.error: one is damaged.
        """
        parts = self.unpack(rows)
        if parts is None:
            parts = [np.array(p) for p in zip(*map(self._read_one, rows), strict=True)]
        return parts

    def _read_one(self, row: Rows) -> list[Array]:
        """Read a message with another frame, byte order or padding.

        A serialiser would take seconds a megabyte for the names.
        """
        message = row.tobytes()
        order, end = _header(message)
        start = end + _gap(4, end)
        expected, said = self._names[order]
        end = start + len(expected)
        if (np.frombuffer(message[start:end], np.uint8) != expected)[said].any():
            raise MixtureError("joints")
        parts = []
        for size in self._sizes:
            if struct.unpack_from(f"{order}I", message, end) != (size,):
                raise MixtureError("sizes")
            end += 4
            end += _gap(8, end) if size else 0
            parts.append(np.frombuffer(message, f"{order}f8", size, end).astype(np.float64))
            end += 8 * size
        if len(message) - end > 3:
            raise ValueError("it is too long")
        return parts


def unpack_points(rows: Rows) -> tuple[bytes, Array]:
    """Return frame and coordinates, N × 3, of PointStampeds, or of PoseStampeds, which begin alike.

    Raises:
        MixtureError: they are in different frames.
        IndexError, struct.error: one is damaged.
    """
    order, end = _header(rows[0].tobytes())
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


def _header(message: bytes) -> tuple[str, int]:
    """Return the byte order, in struct's letters, and the end of the frame_id."""
    order = "<" if message[1] else ">"
    return order, FRAME + int(struct.unpack_from(f"{order}I", message, FRAME - 4)[0])


def _gap(size: int, end: int) -> int:
    return (4 - end) % size


def _text(text: str, order: str) -> bytes:
    content = text.encode() + b"\0"
    return struct.pack(f"{order}I", len(content)) + content


def _names(names: Sequence[str], order: str) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the bytes of a list of names, and a mask of the meaningful ones: padding is arbitrary."""
    count = struct.pack(f"{order}I", len(names))
    texts = [_text(name, order) for name in names]
    plain, other = (
        np.frombuffer(count + b"".join(t + gap * _gap(4, len(t)) for t in texts), np.uint8) for gap in (b"\0", b"\1")
    )
    return plain, plain == other
