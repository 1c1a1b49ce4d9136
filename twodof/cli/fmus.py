"""The FMU that a command line names, built on demand."""

import argparse
import grp
import os
import pwd
import stat
from contextlib import suppress
from pathlib import Path

from ..errors import BuildError
from ..files import names_of
from .options import CommandLineError
from .printing import busy, quote, say


def is_robot(path: str | None) -> bool:
    """Return whether a name is that of a URDF or xacro file, and not of an FMU."""
    return bool(path) and Path(str(path)).suffix in (".urdf", ".xacro")


def chosen_fmu(options: argparse.Namespace) -> Path:
    """Return the named FMU, or build and return that of the URDF or of the default arm."""
    of_urdf = is_robot(options.fmu)
    if getattr(options, "robot", "") and not options.fmu:
        build = f"twodof build --robot {quote(options.robot)}"
        raise CommandLineError(
            f"--robot names a component of a system; name the system, or build a robot with '{build}'"
        )
    if options.frame is not None and not of_urdf:
        raise CommandLineError("--frame applies to a URDF; name one, or leave it out")
    if options.fmu and not of_urdf:
        if options.native:
            raise CommandLineError("--native builds the default arm's FMU; leave it out with an FMU")
        return Path(options.fmu)
    from ..export.compiler import host_platform

    native = options.native or host_platform() != "linux64"
    if native and not options.native:
        say("a Python FMU needs Linux x86-64: building a native FMU", error=True)
    if not of_urdf:
        return _default_arm(options.verb, native=native)
    overwrite = getattr(options, "overwrite", False)
    return _built(Path(options.fmu), options.frame, native=native, overwrite=overwrite)


def fast_fmu(options: argparse.Namespace) -> Path:
    """Return the named FMU, or the default arm's FMU, which is native if a compiler is installed."""
    if options.fmu:
        return Path(options.fmu)
    try:
        return _default_arm(options.verb, native=True)
    except BuildError as error:
        say(f"{error}; running the Python FMU, which is slower", error=True)
        return _default_arm(options.verb)


def _default_arm(verb: str, *, native: bool = False) -> Path:
    """Return the default arm's FMU, built on demand; raise if the folder has only other FMUs."""
    from ..export.package import is_default_arm, is_fmu

    there = [path for path in sorted(Path().glob("*.fmu")) if is_fmu(path)]
    own = f"TwoDof{'-native' * native}.fmu"
    taken = there if len(there) == 1 else [path for path in there if path.name == own]
    if taken and not is_default_arm(taken[0]):
        raise CommandLineError(
            f"no FMU is named, and '{taken[0]}' is here, which is not the FMU of the default arm:"
            f" type 'twodof {verb} {quote(taken[0])}' to use it, or build the default arm's with"
            f" 'twodof build{' --native' * native} -o arm.fmu'"
        )
    path = _built(native=native)
    say(f"no FMU is named: using {path}, the default planar arm", error=True)
    return path


def _built(urdf: Path | None = None, frame: str | None = None, *, native: bool, overwrite: bool = False) -> Path:
    robot = urdf.name if urdf else "the default arm"
    with busy(f"building the FMU of {robot}; a compiler may take a minute"):
        from ..export.fmu_options import FmuOptions
        from ..export.package import build_fmu

        path = build_fmu(None, FmuOptions(urdf=urdf, frame=frame, native=native), overwrite=overwrite)
    _check_own(path)
    return path


def _check_own(path: Path) -> None:
    """Refuse a file that another user could change or replace between its build and its use."""
    own = {os.geteuid(), 0}
    for name in names_of(path):
        folder, file = name.parent.stat(), name.lstat()
        shared = _is_shared(folder) and not folder.st_mode & stat.S_ISVTX
        if not {folder.st_uid, file.st_uid} <= own or shared or (_is_shared(file) and not name.is_symlink()):
            raise CommandLineError(
                f"other users can change or replace '{name}', and an FMU is a program:"
                " work in a folder of your own, or name an FMU that you trust"
            )


def _is_shared(state: os.stat_result) -> bool:
    """Return whether other users may write; a group with the user's name is the user's own."""
    with suppress(KeyError):
        if grp.getgrgid(state.st_gid).gr_name == pwd.getpwuid(os.geteuid()).pw_name:
            return bool(state.st_mode & stat.S_IWOTH)
    return bool(state.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
