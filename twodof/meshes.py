"""The mesh files of a URDF: found, and renamed to where they lie inside an FMU."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from .errors import BuildError
from .files import read_file

MAX_MESHES = 256 * 1024**2  # bytes of all meshes together


def collect_meshes(urdf: str, folder: Path, mesh_dir: Path | None) -> tuple[str, dict[str, bytes]]:
    """The URDF with its meshes renamed to ``package://meshes/…``, and the files by that name.

    Args:
        urdf: XML text.
        folder: the URDF's own folder, where relative names and packages are looked for.
        mesh_dir: folder of the packages, of one package, or of the meshes themselves.

    Raises:
        BuildError: a mesh that is missing, cannot be read, or leaves its package's folder.
    """
    tree = ET.fromstring(urdf, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))
    files: dict[str, bytes] = {}
    names: dict[str, str] = {}
    for mesh in tree.iter("mesh"):
        uri = mesh.get("filename")
        if uri is None:
            continue
        if uri not in names:
            try:
                path = _find(uri, folder, mesh_dir)
                names[uri] = _inside(path, files)
                files[names[uri]] = read_file(path, MAX_MESHES - sum(map(len, files.values())))
            except (OSError, ValueError, RuntimeError) as error:  # the last: links in a circle
                reason = (isinstance(error, OSError) and error.strerror) or error
                raise BuildError(f"mesh '{uri}' cannot be read: {reason}") from error
        mesh.set("filename", f"package://{names[uri]}")
    return ET.tostring(tree, encoding="unicode") + "\n", files


def _find(uri: str, folder: Path, mesh_dir: Path | None) -> Path:
    for path in _candidates(uri, folder, mesh_dir):
        if path.is_file():
            return path
    where = "" if mesh_dir is None else f" in '{mesh_dir}'"
    raise BuildError(
        f"mesh '{uri}' not found{where}; give the folder of the URDF's packages with --mesh-dir"
    )


def _candidates(uri: str, folder: Path, mesh_dir: Path | None) -> Iterator[Path]:
    scheme, separator, rest = uri.partition("://")
    if not separator and PurePosixPath(uri).is_absolute():
        yield Path(uri)
    elif not separator:  # relative to the URDF, often as ../meshes/…, or to the mesh folder
        yield _within(folder.resolve().parent, folder / uri, uri)
        if mesh_dir is not None:
            yield _within(mesh_dir, mesh_dir / uri, uri)
    elif scheme == "file":
        yield Path(unquote(rest))
    else:
        # package://NAME/PATH: the given folder may hold the package, be it, or be its meshes;
        # without one, the packages are around the URDF
        parts = PurePosixPath(unquote(rest)).parts
        roots = [folder, *folder.resolve().parents] if mesh_dir is None else [mesh_dir]
        most = len(parts) if mesh_dir is not None else min(2, len(parts))
        for root in roots:
            for skipped in range(most):
                yield _within(root, root.joinpath(*parts[skipped:]), uri)


def _within(root: Path, path: Path, uri: str) -> Path:
    if not path.resolve().is_relative_to(root.resolve()):
        raise BuildError(f"mesh '{uri}' leaves its folder '{root}'")
    return path


def _inside(path: Path, files: dict[str, bytes]) -> str:
    """A name under meshes/ that keeps as much of the original path as tells files apart."""
    parts = [re.sub(r"[^A-Za-z0-9._-]", "_", part) for part in path.resolve().parts[1:]]
    for depth in range(1, len(parts) + 1):
        name = "/".join(("meshes", *parts[-depth:]))
        if name not in files:
            return name
    raise BuildError(f"mesh '{path}' has no name that is free")
