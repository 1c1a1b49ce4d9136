"""JointStates and points as they are serialised, packed and unpacked without a serialiser.

    message     4 bytes, the second of which is 1 where numbers are little endian; header; the rest
    header      stamp, int32 s and uint32 ns; frame_id
    text        uint32 length; bytes; a NUL, which counts
    sequence    uint32 length; elements

Numbers are aligned to their size, counted from behind the first 4 bytes. Source: OMG, "DDS-XTypes"
1.3, section 7.4.1, "plain CDR".
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..experiments import NANOSECONDS

Array = NDArray[np.float64]

LITTLE_ENDIAN = b"\0\1\0\0"
FRAME = 16  # where a frame_id begins, behind its length


class MixtureError(Exception):
    """Messages are not all of the same joints, or have not equally many numbers."""


class JointStateLayout:
    """Serialised JointStates that differ in stamp and numbers alone, as all of a run do.

    Writing and reading them so is several times faster than one by one.

    Args:
        names: joint names.
        frame: frame_id of the header.
        sizes: how many positions, velocities and efforts there are.
    """

    def __init__(self, names: Sequence[str], frame: str, sizes: Sequence[int]) -> None:
        self._sizes = tuple(sizes)
        self._names = {order: _names(names, order) for order in "<>"}
        self._between: list[bytes] = []
        form, fields = "<4sII", [("head", "u1", 4), ("stamp", "u1", 8)]
        text, end = _text(frame, "<") + self._names["<"][0].tobytes(), FRAME - 4
        for i, size in enumerate(self._sizes):
            text += struct.pack("<I", size)
            text += bytes(_gap(8, end + len(text)) if size else 0)
            end += len(text) + 8 * size
            self._between.append(text)
            form += f"{len(text)}s{size}d"
            fields += [(f"text{i}", "u1", len(text)), (f"numbers{i}", "<f8", size)]
            text = b""
        self._struct = struct.Struct(form)
        self._row = np.dtype(fields)
        plain = self.pack(0, *([0.0] * size for size in self._sizes))
        self._plain = np.frombuffer(plain, self._row)

    def pack(
        self, stamp: int, q: Sequence[float], v: Sequence[float], effort: Sequence[float]
    ) -> bytes:
        """One message, with its stamp in ns."""
        before_q, before_v, before_effort = self._between
        seconds, rest = divmod(stamp, NANOSECONDS)
        return self._struct.pack(
            LITTLE_ENDIAN, seconds, rest, before_q, *q, before_v, *v, before_effort, *effort
        )

    def unpack(self, messages: Sequence[bytes]) -> list[Array]:
        """Positions, velocities, efforts of N messages, N × size each.

        Raises:
            MixtureError: they are not all of these joints and sizes.
            IndexError, ValueError, struct.error: one is damaged.
        """
        if all(len(message) == self._struct.size for message in messages):
            rows = np.frombuffer(b"".join(messages), self._row)
            same = ("head", "text0", "text1", "text2")
            if all((rows[name] == self._plain[name]).all() for name in same):
                return [np.array(rows[f"numbers{i}"]) for i in range(3)]
        return [np.array(part) for part in zip(*map(self._unpack_one, messages), strict=True)]

    def _unpack_one(self, message: bytes) -> list[Array]:
        """Of one in another frame or byte order, or with anything in its gaps.

        A serialiser would take seconds a megabyte for the names.
        """
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


def unpack_point(message: bytes) -> tuple[bytes, tuple[float, float, float]]:
    """Frame and coordinates of a PointStamped, or of a PoseStamped, which begins alike.

    Raises:
        IndexError, struct.error: it is damaged.
    """
    order, end = _header(message)
    x, y, z = struct.unpack_from(f"{order}3d", message, end + _gap(8, end))
    return message[FRAME:end].rstrip(b"\0"), (x, y, z)


def _header(message: bytes) -> tuple[str, int]:
    """Byte order, in struct's letters, and where the frame ends."""
    order = "<" if message[1] else ">"
    return order, FRAME + int(struct.unpack_from(f"{order}I", message, FRAME - 4)[0])


def _gap(size: int, end: int) -> int:
    return (4 - end) % size


def _text(text: str, order: str, gap: bytes = b"\0") -> bytes:
    content = text.encode() + b"\0"
    return struct.pack(f"{order}I", len(content)) + content + gap * _gap(4, len(content))


def _names(names: Sequence[str], order: str) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The bytes of a list of names, and whether they say something: gaps may hold anything."""
    count = struct.pack(f"{order}I", len(names))
    plain, other = (
        np.frombuffer(count + b"".join(_text(name, order, gap) for name in names), np.uint8)
        for gap in (b"\0", b"\1")
    )
    return plain, plain == other
