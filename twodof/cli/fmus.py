"""The FMU that a command line names, built on demand."""

import argparse
from pathlib import Path
from typing import Any

from ..errors import BuildError
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
        say("the Python flavour is for Linux x86-64: building the native one", error=True)
    if not of_urdf:
        return _default_arm(options.verb, native=native)
    return _built(getattr(options, "overwrite", False), urdf=Path(options.fmu), frame=options.frame, native=native)


def fast_fmu(options: argparse.Namespace) -> Path:
    """Return the named FMU, or the default arm's FMU, which is native if a compiler is installed."""
    if options.fmu:
        return Path(options.fmu)
    try:
        return _default_arm(options.verb, native=True)
    except BuildError as error:
        say(f"{error}; running the Python flavour, which is slower", error=True)
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


def _built(overwrite: bool = False, **what: Any) -> Path:
    robot = what["urdf"].name if what.get("urdf") else "the default arm"
    with busy(f"building the FMU of {robot}; a compiler may take a minute"):
        from ..export.fmu_options import FmuOptions
        from ..export.package import build_fmu

        return build_fmu(None, FmuOptions(**what), overwrite=overwrite)
