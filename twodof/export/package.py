"""Build an FMU file, unless the file already exists with the same content."""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ..errors import ZIP_ERRORS, BuildError, path_of
from ..files import check_archive, data_file, descriptor_of, head_of, refusing, write_file
from ..notebook import busy
from ..plant.urdf import RobotError
from ..version import versions
from .compiler import FOLDER, compiles_for_the_web, host_platform, remember, remembered, zig_cache
from .fmu_options import FmuOptions

MADE_OF = ("fmu_src", "urdf", "meshes", "export", "plant")  # folders of shipped files
TOOLS = ("pin", "numpy", "scipy", "ziglang")  # packages whose versions influence the content of an FMU
ZIP_DATE = (1980, 1, 1, 0, 0, 0)
DEFAULT_ARM = b"twodof: the default arm"
"""Beginning of the zip comment of the default arm's FMUs, in any flavour and version."""


@busy("building an FMU")
def build_fmu(output: str | Path | None = None, options: FmuOptions | None = None, *, overwrite: bool = False) -> Path:
    """Build an FMU.

    Args:
        output: the file, written completely or not at all; None: ``<name>.fmu`` or ``<name>-native.fmu``, or
            ``<name>.ssp`` of a split robot, in the working directory.
        options: options of the build; None: the shipped planar arm in the Python flavour.
        overwrite: replace an existing file. Without it, only an FMU of the shipped arm with default settings is
            replaced, because ``build_fmu()`` makes it again.

    Returns:
        The path of the FMU. A file with exactly this FMU is not written again.

    Raises:
        BuildError: the URDF, a mesh, an option, the compiler or the output is at fault, or another file exists at
            the output; the message names it.
    """
    options = options or FmuOptions()
    if not isinstance(options, FmuOptions):
        raise BuildError(f"the options are {options!r:.50}; give twodof.FmuOptions(urdf=…)")
    if options.part == "split":
        return _build_system(output, options, overwrite=overwrite)
    default = f"{options.name}-native.fmu" if options.native else f"{options.name}.fmu"
    path = path_of(default if output is None else output, "FMU")
    comment = DEFAULT_ARM if options.is_default_arm else b""
    if options.native and options.urdf is None:
        comment += _shipped(options)
        if _is_known(path, comment):
            return path
    from .composition import compose  # the import of Pinocchio and SciPy takes most of a run's time

    try:
        flavour, files, finish = compose(options)
        built = files["modelDescription.xml"], flavour.platforms, options.reference
        key = repr((built, comment)).encode()
        if options.native and _is_known(path, key):
            return path
        replaced = overwrite or not path.is_file() or descriptor_of(path) is not None or is_default_arm(path)
        if not replaced and not _fits(path, lambda zipped: _holds(zipped, *built)):
            raise _other(path, f"is {'another' if is_fmu(path) else 'not an'} FMU")
        content = _zipped(files, comment, finish)
        built_now = zipfile.ZipFile(io.BytesIO(content))
        if not replaced and not _fits(path, lambda zipped: _is_same(zipped, built_now)):
            raise _other(path, "has the description of this FMU and other contents: it was changed, or others built it")
        with refusing(BuildError, f"write '{path}'"):
            if not _has(path, content):
                write_file(path, content, follow=output is not None)
        if options.native:
            for known in filter(None, map(_known, (comment, key))):
                remember(known, hashlib.sha256(content).digest())
    except RobotError as error:
        raise BuildError(f"{options.urdf or '2dof.urdf'}: {error}") from error
    return path


def _is_known(path: Path, key: bytes) -> bool:
    """Return whether a file is the one that was built last for a key, by the digest in the user's own cache.

    The FMU's code will run, so what the file states about itself is not trusted.
    """
    known = _known(key)
    digest = remembered(known) if known else None
    return digest is not None and _fits(path, lambda _: hashlib.sha256(path.read_bytes()).digest() == digest)


def _known(key: bytes) -> Path | None:
    """Return the file with the digest of the FMU of a key; None without a cache."""
    cache = zig_cache(silent=True)
    return cache / FOLDER / hashlib.sha256(key).hexdigest() if cache else None


def _has(path: Path, content: bytes) -> bool:
    there = path.is_file() and descriptor_of(path) is None and path.stat().st_size == len(content)
    return there and path.read_bytes() == content


def _is_same(archive: zipfile.ZipFile, other: zipfile.ZipFile) -> bool:
    """Return whether two archives have equal contents; the first may be untrusted, and unpack to gigabytes."""
    first, second = ({member.filename: member.file_size for member in each.infolist()} for each in (archive, other))
    return first == second and all(archive.read(name) == other.read(name) for name in first)


def _other(path: Path, what: str) -> BuildError:
    remedy = "move it away, or build with another `output` or with `overwrite=True`"
    return BuildError(f"'{path}' {what}, and is not replaced: {remedy}")


def _build_system(output: str | Path | None, options: FmuOptions, *, overwrite: bool) -> Path:
    """Build the system of a plant and its controller; errors as of ``build_fmu``."""
    from .split import system_files  # as above

    path = Path(output if output is not None else f"{options.name}.ssp")
    try:
        files, fmus = system_files(options)
    except RobotError as error:
        raise BuildError(f"{options.urdf or '2dof.urdf'}: {error}") from error
    content = _zipped({**files, **{name: _zipped(fmu) for name, fmu in fmus.items()}})
    with refusing(BuildError, f"write '{path}'"):
        known = overwrite or head_of(path, len(content) + 1) == content
        if path.is_file() and descriptor_of(path) is None and not known:
            raise BuildError(f"'{path}' is another file, and is not replaced: move it away, or use `overwrite=True`")
        write_file(path, content, follow=output is not None)
    return path


def is_fmu(path: Path) -> bool:
    """Return whether a file is a zip archive with a model description."""
    return has_member(path, "modelDescription.xml")


def has_member(path: Path, name: str) -> bool:
    """Return whether a file is a sound zip archive with such a member."""
    return _fits(path, lambda zipped: name in zipped.namelist())


def is_default_arm(path: Path) -> bool:
    """Return whether a file is an FMU of the shipped arm with its default settings."""
    return _fits(path, lambda zipped: zipped.comment.startswith(DEFAULT_ARM))


def _shipped(options: FmuOptions) -> bytes:
    """Return a digest of all inputs of the shipped arm's native FMU on this machine."""
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
    """Return whether a file is a valid zip archive for which a condition holds."""
    try:
        check_archive(path)
        with zipfile.ZipFile(path) as archive:
            return fits(archive)
    except (*ZIP_ERRORS, KeyError):
        return False


def _holds(archive: zipfile.ZipFile, description: bytes, platforms: Sequence[str], reference: bool) -> bool:
    """Return whether a file is already this FMU; its GUID is a digest of all relevant inputs."""
    refers = any(name[:6] == "extra/" for name in archive.namelist())
    built_for = {name.split("/")[1] for name in archive.namelist() if name[:9] == "binaries/"}
    with archive.open("modelDescription.xml") as file:
        same = file.read(len(description) + 1) == description
    return same and refers == reference and built_for == set(platforms)


def _zipped(
    files: Mapping[str, bytes], comment: bytes = b"", finish: Callable[[], Mapping[str, bytes]] = dict
) -> bytes:
    """Return a zip archive of files and of those that ``finish`` returns, which may replace any but resources.

    Resources are compressed while ``finish`` runs, and therefore come first in the archive. Its directory is sorted.
    Entries have a fixed date, so that equal inputs give equal bytes.
    """
    content = io.BytesIO()
    with ThreadPoolExecutor(1) as pool, zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.comment = comment
        finished = pool.submit(finish)
        resources = {name: files[name] for name in files if name.startswith("resources/")}
        _add(archive, resources)
        others = {**files, **finished.result()}
        _add(archive, {name: others[name] for name in others.keys() - resources})
        archive.filelist.sort(key=lambda entry: entry.filename)
    return content.getvalue()


def _add(archive: zipfile.ZipFile, files: Mapping[str, bytes]) -> None:
    for name in sorted(files):
        entry = zipfile.ZipInfo(name, ZIP_DATE)
        entry.compress_type = zipfile.ZIP_STORED if name.endswith(".fmu") else zipfile.ZIP_DEFLATED
        entry.external_attr = 0o644 << 16
        archive.writestr(entry, files[name])
