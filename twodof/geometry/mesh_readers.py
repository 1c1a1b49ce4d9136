"""Read mesh files by assimp (coal) and by trimesh, in a confined child process of ``meshes``.

Both libraries are unsafe or unbounded: assimp overruns its heap on damaged files. Only arrays leave the process, as
bytes and never as a pickle.
"""

import io
import json
from collections import defaultdict
from collections.abc import Callable
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..bounds import MAX_MESH_MEMORY, MAX_MESH_SECONDS, MAX_TRIANGLES
from ..children import confine, limit_time

Part = tuple[NDArray[np.float64], NDArray[np.uint32], "list[float] | None"]
Reader = Callable[[bytes, Path, "bytes | None"], list[Part]]
NO_COLOUR = (-1, -1, -1)


def serve(pipe: Connection, kind: str, folder: Path, seconds: int) -> None:
    """Read the mesh files that the parent names over the pipe, one after another, within limits of processor time."""
    read, libraries = READERS[kind]
    reason = ""
    try:
        for library in libraries:  # a confined process cannot import
            import_module(library)
    except ImportError as missing:
        reason = f"{missing}; install the package '{missing.name}'"
    confine(MAX_MESH_MEMORY, seconds, [folder])
    while True:
        name, material = pipe.recv()
        limit_time(MAX_MESH_SECONDS)
        path = folder / name
        try:
            if reason:
                raise ValueError(reason)
            colours = (folder / material).read_bytes() if material else None
            parts = read(path.read_bytes(), path, colours)
            if sum(len(triangles) for _, triangles, _ in parts) > MAX_TRIANGLES:
                raise ValueError(f"it has more than {MAX_TRIANGLES} triangles")
        except MemoryError:
            answer: object = f"it takes more than {MAX_MESH_MEMORY // 2**20} MiB"
        except Exception as error:  # third-party readers raise exceptions of any type
            answer = _reason(error, path)
        else:
            answer = [(len(v), len(t), *(colour or NO_COLOUR)) for v, t, colour in parts]
            pipe.send_bytes(json.dumps(answer).encode())
            pipe.send_bytes(b"".join(v.astype("<f8").tobytes() for v, _, _ in parts))
            pipe.send_bytes(b"".join(t.astype("<u4").tobytes() for _, t, _ in parts))
            continue
        pipe.send_bytes(json.dumps(answer).encode())


def _reason(error: Exception, path: Path) -> str:
    """Return an error as one line, without the file name and the hint that coal adds."""
    text = " ".join(str(error).split()) or type(error).__name__
    text = text.rpartition(" message: ")[2].partition(" Hint: ")[0]
    text = text.removeprefix(f"Could not load resource {path} ")
    return text.replace("std::bad_alloc", f"it takes more than {MAX_MESH_MEMORY // 2**20} MiB")


def _coal(content: bytes, path: Path, library: bytes | None) -> list[Part]:
    import coal

    # axis-aligned boxes: others take longer, and print warnings on degenerate triangles
    mesh = coal.MeshLoader(coal.BV_AABB).load(str(path), np.ones(3))
    if mesh.num_tris > MAX_TRIANGLES:
        raise ValueError(f"it has {mesh.num_tris} triangles, at most {MAX_TRIANGLES}")
    triangles = [[mesh.tri_indices(i)[k] for k in range(3)] for i in range(mesh.num_tris)]
    faces = np.array(triangles, dtype=np.uint32).reshape(-1, 3)
    return [(np.array(mesh.vertices(), dtype=np.float64), faces, None)]


def _trimesh(content: bytes, path: Path, library: bytes | None) -> list[Part]:
    import trimesh

    files: defaultdict[str, bytes | None] = defaultdict(lambda: library)  # for any name
    scene = trimesh.load_scene(io.BytesIO(content), file_type=path.suffix[1:], resolver=files, process=False)
    parts: list[Part] = []
    for mesh in scene.dump():
        material = getattr(mesh.visual, "material", None)
        colour = None
        if material is not None and not (path.suffix == ".obj" and library is None):
            colour = [float(value) / 255.0 for value in material.main_color[:3]]
        parts.append((np.array(mesh.vertices), np.array(mesh.faces, dtype=np.uint32), colour))
    if not parts:
        raise ValueError("the file has no triangles")
    return parts


READERS: dict[str, tuple[Reader, tuple[str, ...]]] = {
    "shape": (_coal, ("coal",)),
    "colours": (_trimesh, ("trimesh", "collada")),
}
"""Readers, and the libraries that they need."""
