"""Programs that some tests need and that pip does not install: one table.

``python3 tests/tools.py`` prints the Debian packages of missing programs.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import platform
import shutil
import socket
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, NoReturn

if TYPE_CHECKING:
    import pytest

NODE = Path(__file__).with_name("node_modules")
X86_64 = sys.platform == "linux" and platform.machine() == "x86_64"
INSTALL = "npm install --no-package-lock --prefix tests"


class Tool(NamedTuple):
    """A tool: the subject of its tests, its Debian package or another remedy, its names."""

    subject: str
    package: str = ""
    names: tuple[str, ...] = ()
    """Commands or paths, the first that exists; the table's own name if empty."""
    remedy: str = ""
    module: str = ""
    here: bool | None = None
    """Presence on this machine, of what is not a program."""


def loads(library: str) -> bool:
    """Return whether the dynamic linker finds a library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def named() -> bool:
    """Return whether the machine's own name has an address."""
    try:
        return bool(socket.getaddrinfo(socket.gethostname(), None))
    except OSError:
        return False


TOOLS = {
    "binutils": Tool("the symbols of libraries", "binutils", ("readelf",)),
    "chromium": Tool("pages in a browser", "chromium", ("chromium", "chromium-browser", "google-chrome")),
    "clang": Tool("warnings of another compiler", "clang"),
    "cmake": Tool("libraries that FMPy rebuilds from the sources", "cmake"),
    "cyclonedds": Tool("ROS 2 networks", remedy="use Python 3.13 or older, or build Cyclone DDS", module="cyclonedds"),
    "disks": Tool("full disks", names=("mount",), remedy="run as root, where tmpfs can be mounted"),
    "fastdds": Tool("ROS 2 networks with Fast DDS", "libfastrtps-dev", ("/usr/include/fastdds/dds",)),
    "fastddsgen": Tool("ROS 2 networks with Fast DDS", "fastddsgen"),
    "ecospy": Tool("FMUs in ecos", remedy="pip install ecospy", module="ecospy"),
    "eslint": Tool("rules of the pages' scripts", names=(str(NODE / ".bin" / "eslint"),), remedy=INSTALL),
    "fmuloader": Tool("FMUs in fmuloader", remedy="use Python 3.11 or newer", module="fmuloader"),
    "foxglove": Tool("Foxglove's own client", names=(str(NODE / "@foxglove"),), remedy=INSTALL),
    "g++": Tool("ROS 2 networks with Fast DDS", "g++", ("g++", "c++")),
    "gcc": Tool("the engine's inner functions in C", "gcc", ("gcc", "cc", "clang")),
    "hostname": Tool("a page under the machine's own name", remedy="add it to /etc/hosts", here=named()),
    "ip": Tool("separate networks", "iproute2"),
    "linux": Tool("Linux's own rules", remedy="run on Linux", here=sys.platform == "linux"),
    "linux64": Tool("libraries for Linux x86-64", remedy="run on Linux x86-64", here=X86_64),
    "libc-arm64": Tool("libraries for ARM", "libc6-arm64-cross", ("/usr/aarch64-linux-gnu/lib/ld-linux-aarch64.so.1",)),
    "libatomic": Tool(
        "FMUs in libcosim", "libatomic1", ("/usr/lib/x86_64-linux-gnu/libatomic.so.1", "/usr/lib64/libatomic.so.1")
    ),
    "libcosimpy": Tool("FMUs in libcosim", remedy="use Python 3.11 or newer", module="libcosimpy"),
    "libpython": Tool("C programs that embed Python", remedy="use a Python built with --enable-shared"),
    "make": Tool("libraries that FMPy rebuilds from the sources", "make"),
    "mingw": Tool("libraries for Windows", "gcc-mingw-w64-x86-64-win32", ("x86_64-w64-mingw32-gcc",)),
    "networks": Tool("separate networks", names=("unshare",), remedy="run as root, where namespaces are allowed"),
    "node": Tool("Foxglove's own client", "nodejs"),
    "nm": Tool("the symbols of libraries", "binutils"),
    "npm": Tool("Foxglove's own client", "npm"),
    "openssl": Tool("clusters with keys", "openssl"),
    "pathsim": Tool("FMUs in PathSim", remedy="pip install pathsim-fmi", module="pathsim_fmi"),
    "qemu": Tool("libraries for ARM", "qemu-user", ("qemu-aarch64", "qemu-aarch64-static")),
    "root": Tool("files of another user", remedy="run as root", here=os.geteuid() == 0),
    "strace": Tool("the order of writes to a disk", "strace"),
    "tbb": Tool("FMUs in ecos", "libtbb12", here=loads("libtbb.so.12")),
    "tsc": Tool("types in the pages' scripts", "node-typescript"),
    "urdf-loader": Tool("scenes in three.js", names=(str(NODE / "urdf-loader"),), remedy=INSTALL),
    "valgrind": Tool("memory errors", "valgrind"),
    "wine": Tool("libraries for Windows", "wine64", ("wine64", "wine", "/usr/lib/wine/wine64")),
    "wineserver": Tool("libraries for Windows", "wine64"),
    "ziglang": Tool("libraries for other platforms", remedy="pip install '.[native]'", module="ziglang"),
}


def found(name: str) -> str | None:
    """Return where a tool is, or None."""
    tool = TOOLS[name]
    if tool.here is not None:
        return name if tool.here else None
    if tool.module:
        return tool.module if importlib.util.find_spec(tool.module) else None
    for known in tool.names or (name,):
        if program := shutil.which(known):
            return program
        if Path(known).is_absolute() and Path(known).exists():
            return known
    return None


def needs(name: str) -> str:
    """Return the path of a tool; without it, the test is skipped, or fails in CI."""
    return found(name) or missing(name)


def missing(name: str) -> NoReturn:
    """End a test, or the import of tests, that this machine cannot run; CI can run all of them."""
    import pytest

    tool = TOOLS[name]
    remedy = tool.remedy or f"apt install {tool.package}"
    reason = f"of {tool.subject} were not run: {remedy}"
    if os.environ.get("CI"):
        pytest.fail(f"tests {reason}")
    pytest.skip(reason, allow_module_level=True)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Check the tools that the marks of a test name."""
    for mark in item.iter_markers("needs"):
        needs(*mark.args)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print one line for each reason for which tests were not run."""
    reports = terminalreporter.getreports("skipped")
    reasons = Counter(str(report.longrepr[2]).removeprefix("Skipped: ") for report in reports)
    for reason, count in sorted(reasons.items()):
        known = reason.startswith("of ")
        terminalreporter.write_line(f"{count} tests {reason}" if known else f"{count} tests were not run: {reason}")


if __name__ == "__main__":
    print(*sorted({tool.package for name, tool in TOOLS.items() if tool.package and not found(name)}))
