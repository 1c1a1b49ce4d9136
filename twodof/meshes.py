"""The mesh files of a URDF: found, and renamed to where they lie inside an FMU."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlsplit

from .errors import BuildError

MESH = re.compile(r"""(<mesh\b[^>]*?\bfilename\s*=\s*)(["'])(.*?)\2""", re.DOTALL)


def collect_meshes(urdf: str, folder: Path, mesh_dir: Path | None) -> tuple[str, dict[str, bytes]]:
    """The URDF with its meshes renamed to ``package://meshes/…``, and the files by that name.

    Args:
        urdf: XML text.
        folder: the URDF's own folder, where relative names and packages are looked for.
        mesh_dir: folder of the packages, of one package, or of the meshes themselves.

    Raises:
        BuildError: a mesh that is missing or lies outside the folders it may be in.
    """
    files: dict[str, bytes] = {}
    names: dict[str, str] = {}

    def rename(found: re.Match[str]) -> str:
        uri = found[3]
        if uri not in names:
            path = _find(uri, folder, mesh_dir)
            names[uri] = _inside(uri, path, files)
            files[names[uri]] = path.read_bytes()
        return f"{found[1]}{found[2]}package://{names[uri]}{found[2]}"

    return MESH.sub(rename, urdf), files


def _find(uri: str, folder: Path, mesh_dir: Path | None) -> Path:
    candidates = []
    for root, relative in _candidates(uri, folder, mesh_dir):
        path = (root / relative).resolve()
        if not path.is_relative_to(root.resolve()):
            raise BuildError(f"mesh '{uri}' leaves its folder '{root}'")
        if path.is_file():
            return path
        candidates.append(path)
    where = "" if mesh_dir is None else f" in '{mesh_dir}'"
    raise BuildError(
        f"mesh '{uri}' not found{where}; give the folder of the URDF's packages with --mesh-dir"
    )


def _candidates(
    uri: str, folder: Path, mesh_dir: Path | None
) -> Iterator[tuple[Path, PurePosixPath]]:
    scheme = urlsplit(uri).scheme
    if scheme in ("package", "model"):
        # package://NAME/PATH: the given folder may hold the package, be it, or be its meshes
        path = PurePosixPath(unquote(uri.split("://", 1)[1]).lstrip("/"))
        roots = [folder, *folder.resolve().parents] if mesh_dir is None else [mesh_dir]
        depth = 2 if mesh_dir is None else len(path.parts)
        for root in roots:
            for skipped in range(min(depth, len(path.parts))):
                yield root, PurePosixPath(*path.parts[skipped:])
    elif scheme == "file" or PurePosixPath(uri).is_absolute():
        path = PurePosixPath(unquote(urlsplit(uri).path))
        yield Path(path.parent), PurePosixPath(path.name)
    else:
        path = PurePosixPath(uri)
        for root in (folder, *(() if mesh_dir is None else (mesh_dir,))):
            yield root, path


def _inside(uri: str, path: Path, files: dict[str, bytes]) -> str:
    """A name under meshes/ that keeps as much of the original path as tells files apart."""
    parts = [re.sub(r"[^A-Za-z0-9._-]", "_", part) for part in path.parts[1:]]
    for depth in range(1, len(parts) + 1):
        name = "/".join(("meshes", *parts[-depth:]))
        if name not in files:
            return name
    raise BuildError(f"mesh '{uri}': no free name for '{path}'")
