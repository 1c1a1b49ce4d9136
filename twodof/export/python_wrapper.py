"""What pythonfmu's wrapper of a Python FMU cannot do, told before it crashes, and made up for."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from functools import cache
from pathlib import Path

from ..errors import FmuError

MAX_WRAPPER = 16 * 1024**2  # it has 0.3 MiB


def check_python_wrapper(fmu: Path, library: Path, folder: Path) -> None:
    """Refuse what the wrapper crashes on: it decodes no escape but %20, and needs its module.

    Args:
        fmu: the FMU's file, for messages.
        library: the binary, of this or any other make.
        folder: where the FMU is unzipped.

    Raises:
        FmuError: naming what is wrong.
    """
    with library.open("rb") as file:
        if b"slavemodule.txt" not in file.read(MAX_WRAPPER):
            return  # it is no such wrapper
    _end_before_destructors()
    if "%" in folder.as_uri().replace("%20", ""):
        raise FmuError(
            f"the temporary folder '{folder.parent}' has characters that the FMU's Python wrapper"
            " cannot read; set TMPDIR to a folder with a plain name"
        )
    resources = folder / "resources"
    with suppress(OSError, ValueError):
        name = (resources / "slavemodule.txt").read_text("utf-8").partition("\n")[0]
        if "/" not in name and (resources / f"{name}.py").is_file():
            return
    raise FmuError(f"'{fmu}': resources/slavemodule.txt does not name a module beside it")


@cache
def _end_before_destructors() -> None:
    """Have exit() end the process once Python has: what C++ libraries do after that can abort it.

    A process in which the wrapper has run the plant found its heap corrupted there now and then,
    in no more than the destructors of static objects, and lost its exit status.
    """
    libc = ctypes.CDLL(None)
    if hasattr(libc, "on_exit"):  # glibc's
        libc.on_exit(libc._exit, None)
