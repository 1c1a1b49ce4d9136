"""The FMU that a command line asks for, built if need be."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import Any

from ..errors import BuildError
from .options import CommandLineError


def is_robot(path: str | None) -> bool:
    """Whether a URDF, or a xacro file, is named in place of an FMU."""
    return bool(path) and Path(str(path)).suffix in (".urdf", ".xacro")


def chosen_fmu(options: argparse.Namespace) -> Path:
    """The FMU that is named, else that of the URDF or of the default arm."""
    of_urdf = is_robot(options.fmu)
    if options.frame is not None and not of_urdf:
        what = "an FMU" if options.fmu else "none"
        raise CommandLineError(f"--frame is of a URDF that is given; leave it out beside {what}")
    if options.fmu and not of_urdf:
        if options.native:
            raise CommandLineError(
                "--native builds the default arm's FMU; leave it out beside an FMU"
            )
        return Path(options.fmu)
    from ..export.compiler import host_platform

    native = options.native or host_platform() != "linux64"
    if native and not options.native:
        print("the Python flavour is for Linux x86-64: building the native one", file=sys.stderr)
    if not of_urdf:
        return _built(native=native)
    robot = Path(options.fmu)
    return _built(urdf=robot, name=identifier(robot), frame=options.frame, native=native)


def fast_fmu(options: argparse.Namespace) -> Path:
    """The FMU that is named, else the default arm's, native where it can be built."""
    if options.fmu:
        return Path(options.fmu)
    try:
        return _built(native=True)
    except BuildError as error:
        print(f"{error}; running the Python flavour, which is slower", file=sys.stderr)
        return _built()


def _built(**what: Any) -> Path:
    from ..export.options import FmuOptions
    from ..export.package import build_fmu

    return build_fmu(None, FmuOptions(**what))


def identifier(robot: Path) -> str:
    """A robot's name for a program, from that of its file."""
    stem = robot.name.removesuffix(".xacro").removesuffix(".urdf").removesuffix(".fmu")
    name = re.sub(r"\W", "_", stem, flags=re.ASCII)
    return name if name.isidentifier() else f"robot_{name}"
