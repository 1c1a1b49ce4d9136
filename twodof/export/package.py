"""An FMU's file: whether it is there already, and the zip."""

from __future__ import annotations

import hashlib
import io
import logging
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from ..errors import ZIP_ERRORS, BuildError
from ..files import check_archive, data_file, read_member, refusing, write_file
from ..plant.urdf import RobotError
from ..version import versions
from .compiler import compiles_for_the_web, host_platform
from .options import FmuOptions

LOG = logging.getLogger(__name__)
MADE_OF = ("fmu_src", "urdf", "meshes", "export", "geometry", "plant")
"""Folders of what is shipped."""
TOOLS = ("pin", "numpy", "scipy", "coal", "ziglang")
"""Packages whose other versions may make another FMU of the same."""
MAX_PAGE = 512 * 1024**2  # bytes of documentation
ZIP_DATE = (1980, 1, 1, 0, 0, 0)


def build_fmu(output: str | Path | None = None, options: FmuOptions | None = None) -> Path:
    """Build an FMU.

    Args:
        output: the file; None: ``<name>.fmu``, or ``<name>-native.fmu``, in the working
            directory, which replaces an FMU alone. Written whole or not at all.
        options: what to build; None: the shipped planar arm in the Python flavour.

    Returns:
        The path of the FMU. A file that already holds exactly this FMU is left alone.

    Raises:
        BuildError: naming what is wrong with the URDF, a mesh, an option, the compiler or the
            output folder.
    """
    options = options or FmuOptions()
    default = f"{options.name}-native.fmu" if options.native else f"{options.name}.fmu"
    path = Path(output if output is not None else default)
    there = output is None and path.exists()
    if there and not _fits(path, lambda zipped: "modelDescription.xml" in zipped.namelist()):
        raise BuildError(f"'{path}' is no FMU, and is not replaced; move it away")
    made_of = _shipped(options) if options.native and options.urdf is None else b""
    if made_of and _fits(path, lambda zipped: zipped.comment == made_of):
        return path
    from .composition import compose, is_live  # Pinocchio and SciPy take most of a run's time

    try:
        flavour, files, finish = compose(options)
        built = files["modelDescription.xml"], flavour.platforms, is_live(options)
        if made_of or not _fits(path, lambda zipped: _holds(zipped, *built)):
            if there:
                LOG.warning(f"'{path}' was another FMU, and is replaced")
            _write_zip(path, {**files, **finish()}, made_of)
    except RobotError as error:
        raise BuildError(f"{options.urdf or '2dof.urdf'}: {error}") from error
    return path


def _shipped(options: FmuOptions) -> bytes:
    """A digest of all that the shipped arm's native FMU is made of, on this machine."""
    digest = hashlib.sha256()
    machine = host_platform(2), host_platform(3), compiles_for_the_web()
    digest.update(repr((versions(*TOOLS), options, machine)).encode())
    for folder in map(data_file, MADE_OF):
        for file in sorted(folder.rglob("*")):
            if file.is_file() and file.suffix != ".pyc":
                digest.update(file.relative_to(folder).as_posix().encode() + b"\0")
                digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest().encode()


def _fits(path: Path, fits: Callable[[zipfile.ZipFile], bool]) -> bool:
    """Whether a file is a sound zip archive of which something holds."""
    try:
        check_archive(path)
        with zipfile.ZipFile(path) as archive:
            return fits(archive)
    except (*ZIP_ERRORS, KeyError):
        return False


def _holds(
    archive: zipfile.ZipFile, description: bytes, platforms: Sequence[str], live: bool
) -> bool:
    """Whether it is already this FMU; its guid is a digest of all that matters."""
    from .arm_page import CONTAINER

    built_for = {name.split("/")[1] for name in archive.namelist() if name[:9] == "binaries/"}
    with archive.open("modelDescription.xml") as file:
        same = file.read(len(description) + 1) == description
    page = read_member(archive, "documentation/index.html", MAX_PAGE)
    return same and built_for == set(platforms) and (CONTAINER in page) == live


def _write_zip(path: Path, files: Mapping[str, bytes], comment: bytes) -> None:
    """Sorted entries with fixed dates, so that equal inputs give equal bytes; whole or not."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.comment = comment
        for name in sorted(files):
            entry = zipfile.ZipInfo(name, ZIP_DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, files[name])
    with refusing(BuildError, f"write '{path}'"):
        write_file(path, content.getvalue())
