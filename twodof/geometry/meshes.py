"""Meshes for drawing: triangles, in surfaces of one colour each."""

from __future__ import annotations

import logging
import resource
from collections.abc import Callable
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from subprocess import DEVNULL
from types import TracebackType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..bounds import MAX_FATAL_MESHES, MAX_MESH_WAIT, MAX_MESHES_SECONDS, MAX_SURFACES, MAX_TRIANGLES
from ..children import Child
from ..files import NUMBER, fits, parsed, temporary_folder
from .kinematics import Array
from .mesh_readers import serve

LOG = logging.getLogger(__name__)
ReadMesh = Callable[[str], bytes | None]
"""Function that returns the bytes of a mesh by its name ``meshes/…``, or None if it is missing."""
Colour = tuple[float, float, float]  # red, green and blue, from 0 to 1
COLOURED = (".dae", ".obj")  # formats with colours
MESH_FORMATS = (".stl", ".dae", ".obj", ".ply", ".off")
"""Formats whose geometry is in the file itself; others, such as glTF, read it from further files."""
SHAPE, COLOURS, LIBRARY = "shape", "colours", "colours.mtl"
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # each thread takes address space


class Surface(NamedTuple):
    """Vertices V × 3 in m, triangles T × 3, and their colour, if the file has one."""

    vertices: Array
    triangles: NDArray[np.uint32]
    colour: Colour | None


class _KilledError(ValueError):
    """A mesh that terminated its reader."""


class _AnswerError(Exception):
    """A reader sent an invalid answer."""


class Meshes:
    """Mesh files of one robot, read in confined child processes that start on demand.

    Use it as a context manager. The meshes share a process. They belong to one robot: a mesh that corrupts the
    memory of its reader can only spoil the picture of this robot.
    """

    def __init__(self, read: ReadMesh) -> None:
        self._read = read
        self._results: dict[tuple[str, bool], list[Surface] | ValueError] = {}
        self._readers: dict[str, Child] = {}
        self._stack = ExitStack()
        self._warned: set[str] = set()
        self._fatal = self._triangles = self._surfaces = 0
        self._spent = 0.0  # processor time of readers that have ended

    def __enter__(self) -> Meshes:
        self._folder = self._stack.enter_context(temporary_folder())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for reader in self._readers.values():
            reader.close()
        self._stack.__exit__(kind, error, trace)

    def scaled(self, name: str, scale: Array) -> list[Surface]:
        """Return the surfaces of a mesh, m; if it is unreadable, warn and return none."""
        try:
            surfaces = [s._replace(vertices=s.vertices * scale) for s in self.surfaces(name)]
            if not all(np.isfinite(surface.vertices).all() for surface in surfaces):
                raise ValueError("it has a vertex that is not finite")
            return surfaces
        except ValueError as error:
            if name not in self._warned:
                LOG.warning("mesh '%s' is left out: %s", name, error)
            self._warned.add(name)
            return []

    def surfaces(self, name: str, coloured: bool = True) -> list[Surface]:
        """Return the surfaces of a mesh file in its own unit; none if the file is missing.

        Textures are not shown. The colours of an OBJ file are in a file of the same name and ``.mtl``, which the build
        makes.

        Raises:
            ValueError: the file cannot be read, or its format reads further files.
        """
        key = name, coloured
        if key not in self._results:
            try:
                self._results[key] = self._surfaces_of(name, coloured)
            except ValueError as error:
                self._results[key] = error
        result = self._results[key]
        if isinstance(result, ValueError):
            raise result
        self._triangles += sum(len(surface.triangles) for surface in result)
        self._surfaces += len(result)
        if self._triangles > MAX_TRIANGLES or self._surfaces > MAX_SURFACES:
            raise ValueError(
                f"the robot's meshes have more than {MAX_TRIANGLES} triangles or {MAX_SURFACES} surfaces together"
            )
        return result

    def _surfaces_of(self, name: str, coloured: bool) -> list[Surface]:
        suffix, content = Path(name).suffix.lower(), self._read(name)
        if content is None:
            return []
        if suffix not in MESH_FORMATS:
            raise ValueError(f"its format '{suffix}' is not one of {', '.join(MESH_FORMATS)}")
        if coloured and suffix in COLOURED and all(map(find_spec, ("trimesh", "collada"))):
            try:
                return self._parsed(COLOURS, suffix, content, self._read(f"{name}.mtl"))
            except _KilledError:
                raise
            except ValueError:  # trimesh supports fewer files than assimp
                pass
        if suffix == ".obj":
            content = content.replace(b"mtllib", b"# none")  # a material library at any path
        return self._parsed(SHAPE, suffix, content, None)

    def _parsed(self, kind: str, suffix: str, content: bytes, library: bytes | None) -> list[Surface]:
        """Return a reader's surfaces of a file.

        If a reader that has read other meshes dies, they may be the cause; a new reader tries again.
        """
        file = self._folder / f"mesh{suffix}"
        file.write_bytes(content)
        if library is not None:
            (self._folder / LIBRARY).write_bytes(library)
        fresh = kind not in self._readers
        while True:
            if self._fatal >= MAX_FATAL_MESHES:
                raise _KilledError(f"{MAX_FATAL_MESHES} other meshes crash their reader")
            before, left = _time_of_children(), int(MAX_MESHES_SECONDS - self._spent)
            if kind not in self._readers:
                if left < 1:
                    raise _KilledError(f"the meshes before it have taken more than {MAX_MESHES_SECONDS} s")
                self._readers[kind] = Child(serve, kind, self._folder, left, environment=ONE_THREAD, output=DEVNULL)
            reader = self._readers[kind]
            try:
                reader.send((file.name, None if library is None else LIBRARY))
                return _received(reader)
            except (EOFError, _AnswerError) as error:
                self._readers.pop(kind).close()
                self._spent += _time_of_children() - before
                if fresh:
                    self._fatal += 1
                    raise _KilledError(f"it crashes its reader: {error}") from None
                fresh = True


def _time_of_children() -> float:
    """Return the processor time, s, of child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _received(reader: Child) -> list[Surface]:
    """Return the checked answer of a reader, which a malicious file may control.

    Raises:
        ValueError: the reader refuses the file.
        _AnswerError: the answer is invalid.
        EOFError: the reader has ended.
    """
    try:
        answer = parsed(reader.receive(200 * MAX_SURFACES, MAX_MESH_WAIT))
    except (ValueError, RecursionError) as error:
        raise _AnswerError(f"its answer is invalid: {error}") from None
    if isinstance(answer, str):
        raise ValueError(answer[:500])
    if not fits(answer, [(int, int, NUMBER, NUMBER, NUMBER)]) or any(min(row[:2]) < 0 for row in answer):
        raise _AnswerError("its answer is invalid")
    sizes = [sum(row[i] for row in answer) for i in (0, 1)]
    if sizes[0] > 3 * MAX_TRIANGLES or sizes[1] > MAX_TRIANGLES:
        raise _AnswerError("its answer is too long")
    content = [reader.receive(size * n, MAX_MESH_WAIT) for size, n in zip(sizes, (24, 12))]
    if [len(part) for part in content] != [24 * sizes[0], 12 * sizes[1]]:
        raise _AnswerError("its answer is invalid")
    vertices = np.frombuffer(content[0], "<f8").reshape(-1, 3)
    triangles = np.frombuffer(content[1], "<u4").reshape(-1, 3)
    if not np.isfinite(vertices).all():
        raise ValueError("it has a vertex that is not finite")
    surfaces, i, j = [], 0, 0
    for v, t, *colour in answer:
        own = vertices[i : i + v], triangles[j : j + t]
        if own[1].max(initial=0) >= max(v, 1):
            raise ValueError("it has a triangle of vertices that do not exist")
        if t:
            surfaces.append(Surface(*own, (*colour,) if min(colour) >= 0 else None))
        i, j = i + v, j + t
    if not surfaces:
        raise ValueError("it has no triangles")
    return surfaces
