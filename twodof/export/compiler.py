"""Compile the C sources of an FMU for all platforms, on any platform."""

import hashlib
import importlib.util
import json
import logging
import os
import platform as host
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import version
from multiprocessing.connection import Connection
from pathlib import Path

from ..bounds import MAX_COMPILER_FILE, MAX_COMPILER_MEMORY, MAX_COMPILER_SECONDS, MAX_COMPILER_TEXT, MAX_COMPILER_WAIT
from ..children import Child, confine_program
from ..errors import BuildError
from ..files import data_file, temporary_folder, write_file
from ..notebook import busy
from ..version import install

LOG = logging.getLogger(__name__)
Run = Callable[[Sequence[str], Path, Mapping[str, str]], None]  # run a command in a folder, with environment variables
TARGETS: dict[str, tuple[str, ...]] = {
    "linux64": ("x86_64-linux-gnu.2.17",),
    "win64": ("x86_64-windows-gnu",),
    "darwin64": ("x86_64-macos.11.0", "aarch64-macos.11.0"),
    "x86_64-linux": ("x86_64-linux-gnu.2.17",),
    "aarch64-linux": ("aarch64-linux-gnu.2.17",),
    "x86_64-windows": ("x86_64-windows-gnu",),
    "x86_64-darwin": ("x86_64-macos.11.0",),
    "aarch64-darwin": ("aarch64-macos.11.0",),
}
"""zig's targets by FMI platform; several targets are joined into one universal library."""
PLATFORMS = {2: tuple(name for name in TARGETS if "-" not in name), 3: tuple(name for name in TARGETS if "-" in name)}
"""Platforms by version of FMI."""
ZIG = (sys.executable, "-m", "ziglang", "cc", "-target")
UNITS = ("directional.c", "fmu.c")  # the C files that are compiled; they include the others
EXTENSIONS = {
    name: ".dylib" if "macos" in zig[0] else ".dll" if "windows" in zig[0] else ".so" for name, zig in TARGETS.items()
}
FLAGS = (
    "-std=c99",
    "-O3",
    "-ffp-contract=off",
    "-fcx-limited-range",
    "-fno-math-errno",
    "-fno-tree-slp-vectorize",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
    "-pedantic",
)
"""Compiler flags. Multiplications are not fused with additions, so that platforms agree. Complex multiplications do not
check for infinities. Vectorisation of scalars takes long and gains nothing. gcc unrolls and vectorises short loops over
joints only at -O3, zig already at -O2.
"""

WINDOWS = "windows.c"  # the additional C file of a library for Windows
WINDOWS_RUNTIME = ("math", "heap", "stdio", "string", "private")
"""Parts of the Universal C Runtime, which Windows includes since version 10."""
FOLDER = "twodof"  # in the cache
KEPT_FOR = 30 * 86400.0  # s after which an unused library is removed from the cache
DIGEST = hashlib.sha256().digest_size  # number of bytes before the library in a cache file


def standard_headers() -> dict[str, bytes]:
    """Return the headers of FMI 2.0 and 3.0 by file name, from FMPy."""
    fmpy = importlib.util.find_spec("fmpy")
    assert fmpy is not None and fmpy.origin is not None
    return {header.name: header.read_bytes() for header in (Path(fmpy.origin).parent / "c-code").glob("fmi[23]*.h")}


def compile_library(
    sources: Mapping[str, bytes], platform: str, name: str, *, units: Sequence[str] = UNITS, flags: Sequence[str] = ()
) -> bytes:
    """Compile the shared library of an FMU.

    Args:
        sources: contents of the C files and headers by file name, including ``model.h`` and the headers of the
            FMI standard.
        platform: FMI platform, a key of ``TARGETS``.
        name: model identifier, the library's name without extension.
        units: files to compile; they include the others.
        flags: further flags for the compiler.

    Raises:
        BuildError: the platform does not exist, there is no compiler for it, or the compiler failed.
    """
    if platform not in TARGETS:
        raise BuildError(f"there is no platform '{platform}'; there are {', '.join(TARGETS)}")
    output = name + EXTENSIONS[platform]
    if output.endswith(".dll"):
        sources = {**sources, WINDOWS: data_file("fmu_src", WINDOWS).read_bytes()}
        units = [*units, WINDOWS]
    built = [
        _compile(sources, [*compiler, *FLAGS, *flags, *_link_flags(output), *units], output)
        for compiler in _compilers(platform)
    ]
    return built[0] if len(built) == 1 else universal(built)


@busy("compiling for the browser")
def compile_web_module(sources: Mapping[str, bytes], units: Sequence[str]) -> bytes:
    """Compile C files to a WebAssembly module without imports; attributes in the files name its exports.

    The module's function ``_initialize`` must be called first. The files may be untrusted: the compiler is confined.

    Raises:
        BuildError: there is no compiler for WebAssembly, or the compiler failed.
    """
    if not compiles_for_the_web():
        raise BuildError(f"cannot compile for the browser: {install('native')}")
    LOG.info("compiling for the browser")
    command = [*ZIG, "wasm32-wasi", *FLAGS, "-mexec-model=reactor", "-s", *units]
    return _compile(sources, command, "module.wasm", _run_confined)


def compiles_for_the_web() -> bool:
    """Return whether there is a compiler for WebAssembly."""
    return importlib.util.find_spec("ziglang") is not None


def host_platform(fmi: int = 2) -> str:
    """Return this machine's platform in a version of FMI; "" if FMI has no name for it."""
    machine = host.machine().lower()
    architecture = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    if fmi == 3:
        name = f"{architecture}-{'windows' if sys.platform == 'win32' else sys.platform}"
        return name if name in TARGETS else ""
    if architecture == "x86_64" or sys.platform == "darwin":
        return {"linux": "linux64", "win32": "win64", "darwin": "darwin64"}.get(sys.platform, "")
    return ""


def universal(libraries: Sequence[bytes]) -> bytes:
    """Join Mach-O libraries of several architectures into one file.

    Its header is that of ``mach-o/fat.h``: magic and count, and per architecture CPU type and
    subtype (from its own header), offset, size and alignment (2¹⁴), big-endian.
    """
    align = 14
    entries, body = [], b""
    offset = 1 << align
    for library in libraries:
        cpu, subtype = struct.unpack_from("<II", library, 4)
        body += b"\0" * (-len(body) % (1 << align)) + library
        entries.append(struct.pack(">5I", cpu, subtype, offset, len(library), align))
        offset = (1 << align) + len(body) + -len(body) % (1 << align)
    header = struct.pack(">II", 0xCAFEBABE, len(libraries)) + b"".join(entries)
    return header.ljust(1 << align, b"\0") + body


def _compilers(platform: str) -> list[list[str]]:
    """Return the commands that compile for a platform, one for each architecture."""
    if compiles_for_the_web():  # zig compiles for all platforms
        return [[*ZIG, target] for target in TARGETS[platform]]
    own = next((cc for cc in ("cc", "gcc", "clang") if shutil.which(cc)), None)
    here = [name for name in (host_platform(2), host_platform(3)) if name]
    if platform in here and own:
        architectures = ["-arch", "x86_64", "-arch", "arm64"] if platform == "darwin64" else []
        return [[own, *architectures]]
    there = " or ".join(here) or "no FMI platform"
    missing = f"this machine's own compiler builds for {there} only"
    if platform in here:
        missing = "this machine has no C compiler"
    raise BuildError(f"cannot compile for {platform}: {missing}; {install('native')}")


def _link_flags(output: str) -> list[str]:
    """Return linker flags for a library that does not depend on this machine or the time."""
    flags = ["-shared", "-s"]
    if output.endswith(".so"):
        return ["-fPIC", *flags, f"-Wl,-soname,{output}", "-lm"]
    if output.endswith(".dylib"):
        return [*flags, f"-Wl,-install_name,@rpath/{output}"]
    # only the system's C runtime: zig takes a minute for mingw's, which a library does not need
    ziglang = importlib.util.find_spec("ziglang")
    assert ziglang is not None and ziglang.origin is not None
    headers = Path(ziglang.origin).parent / "lib" / "libc" / "include" / "any-windows-any"
    flags += ["-isystem", str(headers), "-U__CRT__NO_INLINE", "-D__USE_MINGW_ANSI_STDIO=0"]
    flags += ["-fno-builtin-sin", "-nostdlib", "-Wl,--no-entry"]
    return [*flags, *(f"-lapi-ms-win-crt-{part}-l1-1-0" for part in WINDOWS_RUNTIME)]


def _compile(sources: Mapping[str, bytes], command: Sequence[str], output: str, run: Run | None = None) -> bytes:
    """Compile C files by a command, which ``run`` runs; cache the output of zig."""
    with temporary_folder() as folder:
        environment, kept = dict(os.environ), None
        if command[: len(ZIG)] == [*ZIG]:
            cache = zig_cache()
            environment["ZIG_GLOBAL_CACHE_DIR"] = str(cache or folder / "zig-cache")
            environment["ZIG_LOCAL_CACHE_DIR"] = str(folder / "zig-cache")  # for these sources only
            parts = repr((version("ziglang"), *command[1:], output))
            made_of = hashlib.sha256(parts.replace(sys.prefix, "").encode())  # equal in all virtual environments
            for file, content in sorted(sources.items()):
                made_of.update(repr((file, len(content))).encode() + content)
            kept = cache / FOLDER / made_of.hexdigest() if cache else None
            if kept and (known := remembered(kept)) is not None:
                return known
        for file, content in sources.items():
            write_file(folder / file, content)
        (run or _run)([*command, "-o", str(folder / output)], folder, environment)
        content = (folder / output).read_bytes()
        if kept:
            remember(kept, content)
        return content


def remembered(file: Path) -> bytes | None:
    """Return the content of a file in the user's cache; None if it is missing or damaged, or others can write it."""
    try:
        if not _is_ours(file):
            return None
        content = file.read_bytes()
        os.utime(file)
    except OSError:
        return None
    digest, content = content[:DIGEST], content[DIGEST:]
    return content if hashlib.sha256(content).digest() == digest else None


def remember(file: Path, content: bytes) -> None:
    """Store content in the user's cache if there is room, and remove entries that were not used for long."""
    with suppress(OSError):
        file.parent.mkdir(mode=0o700, exist_ok=True)
        write_file(file, hashlib.sha256(content).digest() + content)
        file.chmod(0o600)  # independent of the umask, because a file that others may write is not reused
        earliest = time.time() - KEPT_FOR
        with os.scandir(file.parent) as others:
            for other in others:
                if other.is_file() and other.stat().st_mtime < earliest:
                    os.unlink(other)


def _run(command: Sequence[str], folder: Path, environment: Mapping[str, str]) -> None:
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, errors="replace", check=False
        )
    except OSError as error:
        raise BuildError(f"cannot run the compiler '{command[0]}': {error}") from error
    _check_status(command, done.returncode, done.stderr.strip() or done.stdout.strip())


def _check_status(command: Sequence[str], status: int, text: str) -> None:
    if status != 0:
        raise BuildError(f"the compiler failed (exit status {status}): {' '.join(command)}\n{text}")


def _run_confined(command: Sequence[str], folder: Path, environment: Mapping[str, str]) -> None:
    """Run zig in a process that reads only zig and the sources, and writes only its output and a cache of its own.

    A program that untrusted sources control cannot write into the cache of other builds.
    """
    cache = Path(environment["ZIG_GLOBAL_CACHE_DIR"]) / "untrusted"
    with suppress(OSError):  # without it the compiler fails, and says why
        cache.mkdir(mode=0o700, parents=True, exist_ok=True)
    environment = {**environment, "ZIG_GLOBAL_CACHE_DIR": str(cache)}
    ziglang = importlib.util.find_spec("ziglang")
    assert ziglang is not None and ziglang.origin is not None
    home = Path(ziglang.origin).parent
    command = [str(home / ("zig.exe" if sys.platform == "win32" else "zig")), *command[ZIG.index("cc") :]]
    folders = [folder, cache]
    with Child(_compile_in_child, command, home, folders, environment=environment) as child:
        try:
            status, text = json.loads(child.receive(MAX_COMPILER_TEXT, MAX_COMPILER_WAIT))
        except EOFError as error:
            raise BuildError(f"the compiler was ended: {error}") from error
    _check_status(command, status, text)


def _compile_in_child(pipe: Connection, command: Sequence[str], home: Path, folders: Sequence[Path]) -> None:
    confine_program(MAX_COMPILER_MEMORY, MAX_COMPILER_SECONDS, MAX_COMPILER_FILE, home, folders)
    done = subprocess.run(command, cwd=folders[0], capture_output=True, text=True, errors="replace", check=False)
    pipe.send_bytes(json.dumps([done.returncode, done.stderr.strip()[-MAX_COMPILER_TEXT // 8 :]]).encode())


def zig_cache(*, silent: bool = False) -> Path | None:
    """Return the folder in which zig caches its C library; None, with a warning, if the home folder has no room.

    Raises:
        BuildError: the folder in ``ZIG_GLOBAL_CACHE_DIR`` cannot be made.
    """
    named, fault = os.environ.get("ZIG_GLOBAL_CACHE_DIR"), ""
    try:
        home = named or os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
        cache = Path(home) if named else Path(home, "zig")
        cache.parent.mkdir(parents=True, exist_ok=True)
        cache.mkdir(mode=0o700, exist_ok=True)
        tempfile.TemporaryFile(dir=cache).close()
        if not _is_ours(cache) or not all(_is_ours(part, 0o002) for part in cache.iterdir()):
            fault = f"other users own its cache '{cache}' or a part of it, or can write there"
    except (OSError, RuntimeError) as error:  # RuntimeError: no home folder
        if named:
            reason = error.strerror if isinstance(error, OSError) else error
            raise BuildError(
                f"zig cannot use the cache '{named}' of ZIG_GLOBAL_CACHE_DIR: {reason}; name another folder"
            ) from error
        fault = f"it has no folder for its cache ({error})"
    if fault and not silent:
        LOG.warning("zig compiles the C library each time: %s; name another folder in ZIG_GLOBAL_CACHE_DIR", fault)
    return None if fault else cache


def _is_ours(path: Path, writers: int = 0o022) -> bool:
    """Return whether only this user and root can write a file or folder.

    Zig makes its folders in a cache by the umask, which may let the user's own group write.
    """
    state = path.stat()
    return state.st_uid == os.geteuid() and not state.st_mode & writers
