"""Compiling: refusals, the cache, and libraries for two processors in one file."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import pwd
import struct
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from native_models import model
from tools import needs

from twodof.errors import BuildError
from twodof.export import compiler
from twodof.export.compiler import compile_library, universal
from twodof.files import TEMPORARY


def test_compiler_errors():
    sources = model("twodof").sources()
    with pytest.raises(BuildError, match="there is no platform 'linux32'; there are linux64"):
        compile_library(sources, "linux32", "Arm")
    with pytest.raises(BuildError, match=r"(?s)compiler failed.*error"):
        compile_library({**sources, "plant.c": b"int main(void) { return x; }"}, "linux64", "Arm")


def test_equal_sources_give_equal_libraries():
    """In another folder, the compiler has no cached result."""
    sources = model("twodof").sources()
    first = compile_library(sources, "linux64", "Arm")
    assert compile_library({**sources, "elsewhere.h": b""}, "linux64", "Arm") == first
    assert not any(name in first for name in (b"/tmp", b"/zig", TEMPORARY.encode()))


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """The cache folder, empty except for the C library of zig."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "zig"
    cache = tmp_path / "cache"
    cache.mkdir(mode=0o700)  # independent of the umask, because a cache that others may write is not used
    for name in ("b", "h", "o", "tmp", "z"):
        (home / name).mkdir(parents=True, exist_ok=True)
        (cache / name).symlink_to(home / name)
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(cache))
    return cache / "twodof"


def answer(number):
    code = b'__attribute__((visibility("default"))) int answer(void) { return %d; }' % number
    return compile_library({"a.c": code}, "linux64", "Arm", units=["a.c"])


def test_a_library_is_kept_for_its_sources(kept):
    first = answer(1)
    (file,) = kept.iterdir()
    second = answer(2)
    assert first != second and len([*kept.iterdir()]) == 2
    file.write_bytes(hashlib.sha256(b"the same").digest() + b"the same")
    assert answer(1) == b"the same" and answer(2) == second
    file.write_bytes(file.read_bytes()[:-1])  # damaged
    assert answer(1) == first == answer(1)


@pytest.mark.parametrize("platform", ["linux64", "win64"])
def test_another_virtual_environment_takes_a_kept_library(kept, monkeypatch, platform):
    """A command has the path of Python, and for Windows that of zig's headers."""
    monkeypatch.setattr(compiler, "_run", copied)
    first = compile_library({"a.c": b"1"}, platform, "Arm", units=["a.c"])
    found = importlib.util.find_spec("ziglang")
    assert found is not None
    origin = str(found.origin).replace(sys.prefix, "/other")
    monkeypatch.setattr(compiler, "ZIG", ("/other/bin/python", *compiler.ZIG[1:]))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: SimpleNamespace(origin=origin))
    monkeypatch.setattr(sys, "prefix", "/other")
    monkeypatch.delattr(compiler, "_run")
    assert compile_library({"a.c": b"1"}, platform, "Arm", units=["a.c"]) == first


def test_without_zig_the_command_that_installs_it_is_printed(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(BuildError, match=r"for the browser: install the extra 'native': \S+ -m pip install "):
        compiler.compile_web_module({}, [])
    with pytest.raises(BuildError, match=r"for win64: .* only; install the extra 'native': \S+ -m pip install "):
        compile_library({}, "win64", "Arm", units=[])


def copied(command, folder, environment):
    """Copy the source in place of compiling it."""
    Path(command[-1]).write_bytes((folder / "a.c").read_bytes())


def test_libraries_that_are_not_used_are_not_kept(kept):
    answer(1)
    (used,) = kept.iterdir()
    answer(2)
    (unused,) = {*kept.iterdir()} - {used}
    month = time.time() - 31 * 86400
    os.utime(used, (month, month))
    os.utime(unused, (month, month))
    answer(1)
    answer(3)
    assert used.exists() and not unused.exists()


def given_away(path):
    needs("root")
    os.chown(path, 65534, 65534)


@pytest.mark.parametrize("change", [given_away, lambda path: path.chmod(0o777)])
@pytest.mark.parametrize("part", ["the cache", "its folder", "the file"])
def test_a_library_that_others_may_have_written_is_not_taken(kept, caplog, monkeypatch, change, part):
    """Otherwise their code would run in the next FMU, from the library or from zig's C library."""
    monkeypatch.setattr(compiler, "_run", copied)
    first = answer(1)
    (file,) = kept.iterdir()
    file.write_bytes(hashlib.sha256(b"evil").digest() + b"evil")
    assert answer(1) == b"evil"
    change({"the cache": kept.parent, "its folder": kept, "the file": file}[part])
    assert answer(1) == first
    whole = part != "the file"
    assert [str(kept.parent) in r.getMessage() for r in caplog.records] == [True] * whole
    assert (compiler.zig_cache() is None) == whole


def test_a_new_cache_is_for_its_user_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(tmp_path / "a" / "b"))
    before = os.umask(0o002)
    try:
        cache = compiler.zig_cache()
        assert cache is not None
        compiler.remember(cache / "twodof" / "key", b"content")
    finally:
        os.umask(before)
    modes = [path.stat().st_mode & 0o777 for path in (cache, *cache.rglob("*"))]
    assert modes == [0o700, 0o700, 0o600]
    assert compiler.remembered(cache / "twodof" / "key") == b"content"


def test_a_missing_home_for_the_cache_is_reported(monkeypatch, caplog):
    for name in ("HOME", "XDG_CACHE_HOME", "ZIG_GLOBAL_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", {}.__getitem__)  # a user without a name
    assert compiler.zig_cache() is None
    assert "ZIG_GLOBAL_CACHE_DIR" in caplog.text


def test_a_cache_that_cannot_be_is_named(monkeypatch):
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", "/proc/none")
    with pytest.raises(BuildError, match=r"'/proc/none' of ZIG_GLOBAL_CACHE_DIR"):
        compile_library({"a.c": b""}, "linux64", "Arm", units=["a.c"])


def test_universal_header():
    thin = [struct.pack("<III", 0xFEEDFACF, cpu, 3) + b"x" * size for cpu, size in ((0x1000007, 20000), (0x100000C, 5))]
    fat = universal(thin)
    magic, count = struct.unpack_from(">II", fat)
    assert (magic, count) == (0xCAFEBABE, 2)
    for i, library_ in enumerate(thin):
        cpu, _, offset, size, align = struct.unpack_from(">5I", fat, 8 + 20 * i)
        assert offset % 2**align == 0 and fat[offset : offset + size] == library_
        assert cpu == struct.unpack_from("<I", library_, 4)[0]
