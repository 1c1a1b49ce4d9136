"""Detect and repair the faults of pythonfmu's wrapper, the library of a Python FMU."""

import hashlib
import struct
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from ..bounds import MAX_WRAPPER
from ..errors import FmuError

DT_FINI_ARRAYSZ = 28  # tag in an ELF library's dynamic section: size of its array of exit functions
WRAPPER = "4be156a552c16f30eb4395805c59855d8d4086056d0f165442565f6c5fbac0c9"
"""SHA-256 of pythonfmu 0.7.0's libpythonfmu-export.so, for linux64."""
OWNERS: dict[str, tuple[str, Mapping[str, int]]] = {}
"""Folder and checksums of the resources from which modules of FMUs came, by the module's name."""


def repaired_wrapper(library: bytes) -> bytes | None:
    """Return the wrapper without its faulty exit function; None if it is not that of pythonfmu 0.7.0.

    The function resets a static shared_ptr in freed memory, because C++ has already destroyed it. The library has two
    exit functions; the first one, which destroys static objects, stays.
    """
    if hashlib.sha256(library).hexdigest() != WRAPPER:
        return None
    both, one = (struct.pack("<qq", DT_FINI_ARRAYSZ, size) for size in (16, 8))
    return library.replace(both, one, 1)


def _forget_others(resources: Path, slave: str, content: Mapping[str, int]) -> None:
    """Remove modules of other FMUs from ``sys.modules`` that have the names of this FMU's modules."""
    for name in {path.stem for path in resources.iterdir()}:
        folder, owned = OWNERS.get(name, ("", None))
        if owned == content:
            continue
        OWNERS[name] = str(resources), content
        for module in [each for each in sys.modules if each.partition(".")[0] == name]:
            file = getattr(sys.modules[module], "__file__", None) or ""
            if name == slave or (folder and file.startswith(folder)):
                del sys.modules[module]


def check_python_wrapper(fmu: Path, library: Path, folder: Path, members: Mapping[str, int]) -> None:
    """Refuse an unzipped FMU whose wrapper would crash; repair the wrapper of an FMU that pythonfmu built.

    The wrapper decodes only the escape %20 in its path, and needs the module of the slave, which it imports by name.
    """
    with library.open("rb") as file:
        content = file.read(MAX_WRAPPER)
    if b"slavemodule.txt" not in content:
        return  # not pythonfmu's wrapper
    if (repaired := repaired_wrapper(content)) is not None:
        library.write_bytes(repaired)
    if "%" in folder.as_uri().replace("%20", ""):
        raise FmuError(
            f"the temporary folder '{folder.parent}' has characters that the FMU's Python wrapper"
            " cannot read; set TMPDIR to a folder with a plain name"
        )
    resources = folder / "resources"
    with suppress(OSError, ValueError):
        name = (resources / "slavemodule.txt").read_text("utf-8").partition("\n")[0]
        if "/" not in name and (resources / f"{name}.py").is_file():
            _forget_others(resources, name, {m: crc for m, crc in members.items() if m.startswith("resources/")})
            return
    raise FmuError(f"'{fmu}': resources/slavemodule.txt does not name a module beside it")
