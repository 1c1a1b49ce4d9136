"""Find the mesh files of a URDF, and rename them to their paths inside an FMU."""

import logging
import os
import re
import xml.etree.ElementTree as ET
from contextlib import suppress
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from ..bounds import MAX_FOLDERS_DEEP, MAX_LIBRARIES, MAX_MESHES, MAX_PATH
from ..errors import BuildError
from ..files import read_file
from ..plant.urdf import MAX_SHAPES

MAX_LISTED = 50  # names listed in a message
LOG = logging.getLogger(__name__)


def collect_meshes(urdf: str, folder: Path, mesh_dir: Path | None) -> tuple[str, dict[str, bytes]]:
    """Return the URDF with its meshes renamed to ``package://meshes/…``, and the files by that name.

    The URDF may be untrusted, and the FMU may be sent to others. Therefore meshes outside ``mesh_dir``, the URDF's
    folder and its package are refused, also if a link leads there. Missing meshes are left out with a warning.

    Args:
        folder: the URDF's own folder, in which relative names and packages are searched.
        mesh_dir: folder of the packages, of one package, or of the meshes themselves.
    """
    tree = ET.fromstring(urdf, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))
    files: dict[str, bytes] = {}
    names: dict[str, str] = {}
    missing: dict[str, None] = {}
    room = MAX_MESHES
    for mesh in tree.iter("mesh"):
        uri = mesh.get("filename")
        if uri is None or uri in missing:
            continue
        if len(names) + len(missing) > MAX_SHAPES:
            raise BuildError(f"the URDF has more than {MAX_SHAPES} different meshes")
        if uri not in names:
            try:
                path = _find(uri, folder, mesh_dir)
                name = _inside(path, files)
                files[name] = read_file(path, room)
                room -= len(files[name])
                if colours := _colours(path, files[name], mesh_dir, room):
                    files[f"{name}.mtl"] = colours
                    room -= len(colours)
                names[uri] = name
            except FileNotFoundError:
                missing[uri] = None
                continue
            except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: a circle of links
                reason = (isinstance(error, OSError) and error.strerror) or error
                raise BuildError(f"mesh '{uri}' cannot be read: {reason}") from error
        mesh.set("filename", f"package://{names[uri]}")
    if missing:
        listed = [*missing][:MAX_LISTED] + [f"{len(missing) - MAX_LISTED} more"] * (len(missing) > MAX_LISTED)
        LOG.warning(
            "meshes are left out, as they were not found; give their folder, or that of their"
            " packages, with `mesh_dir`: %s",
            ", ".join(listed),
        )
    return ET.tostring(tree, encoding="unicode") + "\n", files


def mesh_folders(folder: Path, mesh_dir: Path | None) -> list[Path]:
    """Return the folders from which a URDF may read files: ``mesh_dir``, its own folder and its package.

    The URDF's package is the nearest parent folder with a package.xml. A parent folder of the package's name is not
    enough, because ``package://home/alice/.netrc`` has one too.
    """
    own = folder.resolve()
    package = next((f for f in (own, *own.parents) if (f / "package.xml").is_file()), own)
    return [own, package] if mesh_dir is None else [mesh_dir.resolve(), own, package]


def _find(uri: str, folder: Path, mesh_dir: Path | None) -> Path:
    """Return the file of a mesh, links resolved, inside one of the allowed folders."""
    own, folders = folder.resolve(), mesh_folders(folder, mesh_dir)
    scheme, separator, rest = uri.partition("://")
    if len(uri) > MAX_PATH or unquote(uri).count("/") > MAX_FOLDERS_DEEP:
        raise ValueError(f"its name is too long, or has more than {MAX_FOLDERS_DEEP} folders")
    if not separator or scheme == "file":
        name = unquote(rest) if separator else uri
        candidates = [root / name for root in (own, mesh_dir) if root is not None]
    else:
        # package://NAME/PATH: the mesh folder may contain the package, be the package, or have its meshes;
        # the URDF's package may be in a folder of another name
        parts = PurePosixPath(unquote(rest)).parts
        roots = [own, *own.parents] if mesh_dir is None else [mesh_dir]
        most = min(2, len(parts)) if mesh_dir is None else len(parts)
        candidates = [root.joinpath(*parts[i:]) for root in roots for i in range(most)]
    for candidate in candidates:
        if os.path.isfile(candidate):
            path = candidate.resolve()
            if any(path.is_relative_to(root) for root in folders):
                return path
    if any(os.path.lexists(candidate) for candidate in candidates):
        where = " or ".join(f"'{root}'" for root in dict.fromkeys(folders))
        raise BuildError(
            f"mesh '{uri}' not found in {where}, and no other folder may be read; give the folder"
            " of the meshes, or of their packages, with `mesh_dir`"
        )
    raise FileNotFoundError


def _colours(path: Path, content: bytes, mesh_dir: Path | None, most: int) -> bytes:
    """Return the existing material libraries of an OBJ file, each once, of at most ``most`` bytes together."""
    libraries, names = b"", set[bytes]()
    if path.suffix.lower() != ".obj":
        return libraries
    for line in re.finditer(rb"^mtllib[ \t]+([^\r\n]+)", content, re.MULTILINE):
        name = line[1].strip()
        if name in names:
            continue
        names.add(name)
        if len(names) > MAX_LIBRARIES:
            raise ValueError(f"it has more than {MAX_LIBRARIES} material libraries")
        with suppress(FileNotFoundError):
            libraries += read_file(_find(os.fsdecode(name), path.parent, mesh_dir), most - len(libraries)) + b"\n"
    return libraries


def _inside(path: Path, files: dict[str, bytes]) -> str:
    """Return a unique name in meshes/ with the last parts of the original path."""
    parts = [re.sub(r"[^A-Za-z0-9._-]", "_", part) for part in path.parts[1:]]
    for depth in range(1, len(parts) + 1):
        name = "/".join(("meshes", *parts[-depth:]))
        if name not in files:
            return name
    raise BuildError(f"there is no free name for mesh '{path}'")
