"""Read zip archives of FMUs, which are files or members of a system's archive."""

import io
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..bounds import MAX_DESCRIPTION, MAX_RESOURCE
from ..errors import ZIP_ERRORS, FmuError, kind_of, no_such
from ..files import UnsafeArchiveError, check_archive, read_member
from .validation import is_plain_xml


@contextmanager
def open_archive(path: Path, inside: str, *, checked: bool = False) -> Iterator[zipfile.ZipFile]:
    """Open an archive, or an archive that is a member of it, after checking that it is safe to unzip."""
    if checked:
        check_archive(path)
    with zipfile.ZipFile(path) as archive:
        if not inside:
            yield archive
            return
        content = read_member(archive, inside, MAX_RESOURCE)
    if checked:
        check_archive(content)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        yield archive


def read_archive(path: Path, inside: str) -> tuple[bytes, dict[str, int]]:
    """Return modelDescription.xml and the members' checksums of an FMU that is safe to unzip; else raise FmuError."""
    where = Path(path, inside)
    try:
        with open_archive(path, inside, checked=True) as archive:
            xml = read_member(archive, "modelDescription.xml", MAX_DESCRIPTION)
    except (FileNotFoundError, IsADirectoryError) as error:
        raise FmuError(no_such("FMU", path)) from error
    except OSError as error:
        raise FmuError(f"cannot read '{where}': {error.strerror}") from error
    except KeyError as error:
        raise FmuError(f"'{where}' is not an FMU: it has no modelDescription.xml") from error
    except UnsafeArchiveError as error:
        raise FmuError(f"'{where}': {error}") from error
    except ZIP_ERRORS as error:
        other = kind_of(path) not in ("", "FMU", "system")
        why = f"'{where}' is not an FMU: it is not a valid zip archive ({error})"
        raise FmuError(no_such("FMU", path) if other else why) from error
    if not is_plain_xml(xml):
        raise FmuError(f"'{where}': modelDescription.xml declares entities or is not UTF-8")
    return xml, checksums(archive)


def checksums(archive: zipfile.ZipFile) -> dict[str, int]:
    """Return the checksums of an archive's members by name."""
    return {member.filename: member.CRC for member in archive.infolist()}
