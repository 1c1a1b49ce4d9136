"""Meshes as they are drawn: triangles, in surfaces of one colour each."""

from __future__ import annotations

import io
import logging
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..files import temporary_folder
from .kinematics import Array

LOG = logging.getLogger(__name__)
ReadMesh = Callable[[str], bytes | None]
"""The bytes of a mesh by its name ``meshes/…``, None where it is missing."""
Colour = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""
COLOURED = (".dae", ".obj")
"""Formats that have colours."""
MESH_FORMATS = (".stl", ".dae", ".obj", ".ply", ".off")
"""Those whose geometry is in the file itself; others, as glTF, name files to read it from."""


class Surface(NamedTuple):
    """Vertices V × 3 in m and triangles T × 3, with their colour where the file says one."""

    vertices: Array
    triangles: NDArray[np.uint32]
    colour: Colour | None


def surfaces(name: str, read: ReadMesh, scale: Array) -> list[Surface]:
    """The surfaces of a mesh, none where it is not at hand or cannot be read.

    Textures are not shown. An OBJ's colours are those of the file beside it that a build gives
    its name and ``.mtl``.
    """
    content = read(name)
    if content is None:
        return []
    suffix = Path(name).suffix.lower()
    if suffix in COLOURED:
        try:
            return _coloured(suffix, content, read(f"{name}.mtl"), scale)
        except Exception as error:  # of a foreign reader, each in its own way
            LOG.info("mesh '%s' is drawn without its colours: %s", name, error)
    try:
        mesh = load_mesh(name, content, scale)
    except ValueError:
        return []
    triangles = [[mesh.tri_indices(i)[k] for k in range(3)] for i in range(mesh.num_tris)]
    return [Surface(np.array(mesh.vertices()), np.array(triangles, dtype=np.uint32), None)]


def _coloured(suffix: str, content: bytes, library: bytes | None, scale: Array) -> list[Surface]:
    """By trimesh, which places them in the file's scene."""
    import trimesh

    files: defaultdict[str, bytes | None] = defaultdict(lambda: library)  # whatever it is called
    scene = trimesh.load_scene(
        io.BytesIO(content), file_type=suffix[1:], resolver=files, process=False
    )
    coloured = []
    for mesh in scene.dump():
        material = getattr(mesh.visual, "material", None)
        colour = None
        if material is not None and not (suffix == ".obj" and library is None):
            r, g, b = (float(value) / 255.0 for value in material.main_color[:3])
            colour = r, g, b
        vertices = np.array(mesh.vertices) * scale
        coloured.append(Surface(vertices, np.array(mesh.faces, dtype=np.uint32), colour))
    if not coloured:
        raise ValueError("the file has no triangles")
    return coloured


def load_mesh(name: str, content: bytes, scale: Array | Sequence[float]) -> Any:
    """A mesh file as coal's model, its vertices in m.

    Raises:
        ValueError: it cannot be read, or is of a format that has other files read beside it.
    """
    try:
        import coal
    except ImportError as missing:
        raise ValueError(f"{missing}; install the package 'coal'") from missing
    suffix = Path(name).suffix.lower()
    if suffix not in MESH_FORMATS:
        raise ValueError(f"its format '{suffix}' is none of {', '.join(MESH_FORMATS)}")
    if suffix == ".obj":
        content = content.replace(b"mtllib", b"# none")  # a library of colours, anywhere
    with temporary_folder() as folder:
        file = folder / Path(name).name
        file.write_bytes(content)
        # boxes along the axes: others take longer, and complain on stderr of odd triangles
        return coal.MeshLoader(coal.BV_AABB).load(str(file), scale)
