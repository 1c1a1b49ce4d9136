"""Libraries of FMUs: loading in any thread, and calls that C makes."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import POINTER, Structure, c_int, c_size_t, c_uint, c_void_p
from itertools import chain, count
from threading import Lock

from fmpy import fmi1

LOADING = Lock()
STATUSES = {2: "discard: try another step size", 3: "error", 4: "fatal", 5: "pending"}
NAMES: set[str] = set()  # of living instances


class _Staying:
    """The module os with a ``chdir`` that does nothing."""

    def __getattr__(self, name: str) -> object:
        return getattr(os, name)

    def chdir(self, folder: str) -> None:
        """Do nothing."""


@contextmanager
def loading() -> Iterator[None]:
    """Prevent FMPy from changing the working directory while it loads a library.

    FMPy changes to the library's folder, as Windows requires, which would change the relative paths of all threads.
    """
    with LOADING:
        vars(fmi1)["os"] = _Staying()
        try:
            yield
        finally:
            vars(fmi1)["os"] = os


def unique(name: str) -> str:
    """Return the name, or the name and a number if a living instance has it, as FMI demands."""
    with LOADING:
        own = next(each for each in chain([name], (f"{name} {k}" for k in count(2))) if each not in NAMES)
        NAMES.add(own)
    return own


class Prepared(Structure):
    """A call of an FMU, as in ``spans.c``."""

    _fields_ = (
        ("kind", c_int),
        ("function", c_void_p),
        ("instance", c_void_p),
        ("references", POINTER(c_uint)),
        ("count", c_size_t),
        ("values", c_void_p),
        ("size", c_size_t),
        ("stride", c_size_t),
        ("heard", c_void_p),
    )
