"""Icon of an FMU: its robot at the start, as lines between the origins of its links, in a PNG."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..plant.urdf import Urdf

if TYPE_CHECKING:
    from ..plant.robot import Robot  # this imports Pinocchio

Array = NDArray[np.float64]
WIDTH, HEIGHT, EDGE = 300, 200, 32  # pixels; the edge is free of links
GRAIN = 16  # points are rounded to this fraction of a pixel, so that all machines draw the same picture
INK, SLATE, ORANGE, WHITE, PAPER = (31, 41, 51), (84, 101, 124), (245, 140, 36), (255, 255, 255), (244, 246, 248)
CORNER = 12.0  # radius of the block's corners, pixels
THICK, THIN = 7.0, 4.0  # half the width of the first and the last link, pixels


def icon(urdf: Urdf, robot: Robot, q: Sequence[float]) -> bytes:
    """Return the icon of a robot at joint positions q, rad or m."""
    origins, parents = robot.origins(q), {joint.parent for joint in urdf.joints.values()}
    chains = [urdf.chain(link) for link in urdf.links if link not in parents]
    lines, _ = side_view([[origins[link] for link in (urdf.root, *(j.child for j in c))] for c in chains])
    every = np.concatenate(lines)
    low, high = every.min(axis=0), every.max(axis=0)
    size, room = high - low, np.array([WIDTH, HEIGHT]) - 2.0 * EDGE
    scale = float((room / np.maximum(size, 1e-9)).min()) if size.any() else 1.0
    pixels = np.zeros((HEIGHT, WIDTH, 4))
    corners = np.array([[CORNER, CORNER], [WIDTH - CORNER, HEIGHT - CORNER]])
    for grown, colour in ((0.0, INK), (-2.0, PAPER)):
        _paint(pixels, corners, CORNER + grown, colour, block=True)
    for chain, points in zip(chains, lines):
        placed = (points - 0.5 * (low + high)) * (scale, -scale) + (WIDTH / 2, HEIGHT / 2)
        placed = np.round(GRAIN * placed) / GRAIN
        widths = np.linspace(THICK, THIN, len(placed))
        drawn = [i for i in range(1, len(placed)) if (placed[i] != placed[i - 1]).any()]
        for i in drawn:
            _paint(pixels, placed[i - 1 : i + 1], widths[i], ORANGE if i == drawn[-1] else SLATE)
        for i, joint in enumerate(chain, start=1):
            if joint.moves:
                _paint(pixels, placed[[i, i]], widths[i], INK)
                _paint(pixels, placed[[i, i]], widths[i] - 2.0, WHITE)
    return _png(np.round(pixels).astype(np.uint8))


def side_view(points: Sequence[Sequence[Array]]) -> tuple[list[Array], str]:
    """Return the view (N × 2) of lines (N × 3) along the axis of their smallest extent, and the other axes' letters."""
    lines = [np.array(line) for line in points]
    axes = sorted(np.argsort(np.ptp(np.concatenate(lines), axis=0), kind="stable")[1:])
    return [line[:, axes] for line in lines], "".join("xyz"[axis] for axis in axes)


def _paint(pixels: Array, ends: Array, radius: float, colour: tuple[int, ...], block: bool = False) -> None:
    """Draw all pixels within a radius of a line, or of the block between two corners."""
    (ax, ay), (bx, by) = ends
    left, top = np.maximum(ends.min(axis=0) - radius - 1.0, 0.0).astype(int)
    right, bottom = np.maximum(ends.max(axis=0) + radius + 2.0, 0.0).astype(int)
    near = pixels[top:bottom, left:right]
    y, x = np.mgrid[top : top + near.shape[0], left : left + near.shape[1]] + 0.5
    if block:
        across, up = x - np.clip(x, ax, bx), y - np.clip(y, ay, by)
    else:
        along = (x - ax) * (bx - ax) + (y - ay) * (by - ay)
        part = np.clip(along / max((bx - ax) ** 2 + (by - ay) ** 2, 1e-9), 0.0, 1.0)
        across, up = x - ax - part * (bx - ax), y - ay - part * (by - ay)
    cover = np.clip(radius - np.sqrt(across**2 + up**2) + 0.5, 0.0, 1.0)[..., None]
    near += cover * (np.array([*colour, 255]) - near)


def _png(pixels: NDArray[np.uint8]) -> bytes:
    """Return an image of red, green, blue and alpha as PNG (ISO/IEC 15948)."""
    height, width, _ = pixels.shape

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    rows = b"".join(b"\0" + row.tobytes() for row in pixels)
    head = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b"")
