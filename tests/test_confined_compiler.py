"""The sources in an FMU are compiled for a page by a confined compiler: they include no file of the user's."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from twodof.errors import BuildError
from twodof.export import compiler
from twodof.export.compiler import compile_web_module

pytestmark = pytest.mark.needs("linux")
EXPORTED = '__attribute__((export_name("leak"))) const unsigned char *leak(void) { return secret; }\n'
LONG = "".join(f"#define A{i + 1} A{i} A{i}\n" for i in range(40))


def embedded(file: Path) -> str:
    return f'static const unsigned char secret[] = {{\n#embed "{file}"\n}};\n{EXPORTED}'


def test_a_file_of_the_sources_is_compiled(tmp_path: Path) -> None:
    """The attacks below fail for their file alone: this one, of the FMU, is in the module."""
    module = compile_web_module({"page.c": embedded(Path("own.h")).encode(), "own.h": b"own file 4711"}, ["page.c"])
    assert b"own file 4711" in module


@pytest.mark.parametrize(
    "attack",
    [
        embedded,
        lambda file: embedded(Path(os.path.relpath(file, Path.cwd()))),
        lambda file: f'#include "{file}"\n',
        lambda file: f'__asm__(".section .rodata.x,\\"\\",@\\n.incbin \\"{file}\\"\\n");\n',
        lambda file: '#include "/dev/zero"\n',
    ],
)
def test_no_other_file_is_read(tmp_path: Path, attack: object) -> None:
    secret = tmp_path / "secret"
    secret.write_text("int secret_4711;\n")
    assert callable(attack)
    with pytest.raises(BuildError, match="the compiler failed"):
        compile_web_module({"page.c": attack(secret).encode()}, ["page.c"])


def test_the_cache_of_other_builds_is_not_written(tmp_path: Path) -> None:
    """Untrusted sources could otherwise leave a library there, which a later build would take."""
    cache, source = tmp_path / "cache", tmp_path / "sources/a.c"
    for folder in (cache, source.parent):
        folder.mkdir()
    source.write_text("int a;\n")
    environment = {**os.environ, "ZIG_GLOBAL_CACHE_DIR": str(cache), "ZIG_LOCAL_CACHE_DIR": str(source.parent)}
    command = [*compiler.ZIG, "wasm32-freestanding", "-c", str(source), "-o"]
    compiler._run_confined([*command, str(source.parent / "a.o")], source.parent, environment)
    assert (source.parent / "a.o").exists()
    with pytest.raises(BuildError, match="the compiler failed"):
        compiler._run_confined([*command, str(cache / "planted.o")], source.parent, environment)
    assert not (cache / "planted.o").exists()


def test_a_module_is_not_larger_than_a_page_holds() -> None:
    with pytest.raises(BuildError, match="the compiler failed"):
        compile_web_module({"page.c": b"__attribute__((used)) char a[100000000] = {1};"}, ["page.c"])


def zigs(folder: Path) -> set[str]:
    """Return the processes of zig that have a cache in the folder."""
    found = set()
    for process in Path("/proc").glob("[0-9]*"):
        try:
            own = str(folder).encode() in (process / "environ").read_bytes()
            name = (process / "comm").read_text().strip()
        except OSError:  # it has ended
            continue
        found |= {process.name} if own and name == "zig" else set()
    return found


def awaits(folder: Path, running: bool) -> None:
    """Wait until zig runs, or no longer does; the compiler's memory would end it after 40 s."""
    for _ in range(600 if running else 100):
        if bool(zigs(folder)) is running:
            return
        time.sleep(0.1)
    raise AssertionError(f"zig {'does not start' if running else 'goes on'}")


def test_the_compiler_ends_with_its_user(tmp_path: Path) -> None:
    call = (
        "import sys; from twodof.export.compiler import *; compile_web_module({'a.c': sys.argv[1].encode()}, ['a.c'])"
    )
    endless = f"#define A0 1,\n{LONG}static const char big[] = {{A40 0}};\n"
    environment = {**os.environ, "ZIG_GLOBAL_CACHE_DIR": str(tmp_path / "cache")}
    with subprocess.Popen([sys.executable, "-c", call, endless], env=environment) as process:
        awaits(tmp_path, True)
        process.send_signal(signal.SIGKILL)
    awaits(tmp_path, False)
