"""build: an FMU from a URDF."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .common import CommandLineError, controlled, print_next, print_table, quote
from .options import add_output, check_company, not_empty


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    build = verbs.add_parser("build", help="build an FMU from a URDF")
    add_output(build, "FILE.fmu", "default: <name>.fmu")
    build.add_argument(
        "robot", nargs="?", type=Path, metavar="URDF",
        help="or a xacro file; default: the shipped planar 2-DoF arm",
    )  # fmt: skip
    build.add_argument("--urdf", type=Path, metavar="U", help="the same")
    build.add_argument(
        "--mesh-dir", type=Path, metavar="M", help="folder of the URDF's packages or meshes"
    )
    build.add_argument(
        "--no-meshes", action="store_true", help="leave the URDF's meshes out of the FMU"
    )
    build.add_argument(
        "--frame", type=not_empty, help="controlled link (EndEffector, or the only last link)"
    )
    build.add_argument(
        "--lock", dest="locks", action="append", default=[], metavar="JOINT[=VALUE]",
        help="fix joints, names or shell patterns, at a position (0), rad or m",
    )  # fmt: skip
    build.add_argument("--axes", help="task axes of xyz (xy for the shipped arm, else xyz)")
    build.add_argument(
        "--gravity", nargs=3, type=float, metavar=("X", "Y", "Z"),
        help="m/s2 in the root frame (0 -9.81 0 for the shipped arm, else 0 0 -9.81)",
    )  # fmt: skip
    build.add_argument(
        "--q-start", nargs="+", type=float, metavar="Q", help="start positions, rad or m"
    )
    build.add_argument(
        "--control", choices=("task", "joint", "effort"), default="task",
        help="what drives the robot: a target of the frame, one for each joint, or efforts"
        " (%(default)s)",
    )  # fmt: skip
    build.add_argument(
        "--orientation", action="store_true",
        help="of the frame too: a target orientation beside the position",
    )  # fmt: skip
    build.add_argument("--name", default="TwoDof", help="name of the model (%(default)s)")
    build.add_argument(
        "--link-environment", action="store_true",
        help="remember in the FMU where this Python's packages are",
    )  # fmt: skip
    _add_native_options(build)
    build.set_defaults(call=call)


def _add_native_options(build: argparse.ArgumentParser) -> None:
    build.add_argument(
        "--native", action="store_true", help="compiled C, which needs no Python where it runs"
    )
    build.add_argument(
        "--no-live-documentation", action="store_true",
        help="leave the arm that runs in a browser out of a native FMU's documentation",
    )  # fmt: skip
    build.add_argument(
        "--platform", dest="platforms", action="append", default=[], metavar="P",
        help="of a native FMU: linux64, win64, darwin64, with --fmi 3 x86_64-linux, aarch64-linux,"
        " x86_64-windows, x86_64-darwin, aarch64-darwin, or all; repeatable (this machine's)",
    )  # fmt: skip
    build.add_argument(
        "--fmi", type=int, choices=(2, 3),
        help="version of a native FMU (2; 3 on machines that 2 has no name for)",
    )  # fmt: skip
    build.add_argument(
        "--scalars", action="store_true",
        help="in FMI 3 each element of a vector is a variable, for tools that know no arrays",
    )  # fmt: skip


def call(options: argparse.Namespace) -> int:
    """Do it; the exit status."""
    if options.urdf and options.robot:
        raise CommandLineError("a URDF is given twice, by its place and with --urdf")
    check_company(
        options,
        needs={"--no-live-documentation": "--native", "--mesh-dir": "a URDF"},
        excludes={"--no-meshes": "--mesh-dir"},
    )
    if options.orientation and options.control != "task":
        raise CommandLineError(f"--orientation goes with --control task, not {options.control}")
    if options.scalars and options.fmi != 3:
        raise CommandLineError("--scalars goes with --native --fmi 3")
    from ..export.options import FmuOptions
    from ..export.package import build_fmu

    chosen = FmuOptions(
        urdf=options.urdf or options.robot,
        mesh_dir=options.mesh_dir,
        frame=options.frame,
        lock=_locks(options.locks),
        meshes=not options.no_meshes,
        axes=options.axes,
        gravity=options.gravity and tuple(options.gravity),
        q_start=options.q_start and tuple(options.q_start),
        control="pose" if options.orientation else options.control,
        name=options.name,
        link_environment=options.link_environment,
        native=options.native,
        fmi=options.fmi,
        arrays=not options.scalars,
        live_documentation=not options.no_live_documentation,
        platforms=_platforms(options.platforms, options.fmi or 2),
    )
    logging.getLogger("twodof.export").setLevel(logging.INFO)  # each platform's takes time
    path = build_fmu(options.output, chosen)
    from ..fmu import load_fmu

    fmu = load_fmu(path)
    print_table(
        ("FMU", f"{path} ({path.stat().st_size / 1024:.0f} KB, {', '.join(fmu.platforms)})"),
        ("robot", f"{fmu.robot}: {', '.join(fmu.joints)}"),
        ("controlled", controlled(fmu)),
    )
    here = fmu.platform in fmu.platforms
    print_next(
        f"twodof run {quote(path)}" if here else "twodof build --native",
        f"twodof info {quote(path)}",
    )
    return 0


def _locks(texts: Sequence[str]) -> dict[str, float]:
    locks: dict[str, float] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        try:
            locks[name] = float(value) if equals else 0.0
        except ValueError:
            raise CommandLineError(f"--lock {text}: '{value}' is not a number") from None
    return locks


def _platforms(chosen: Sequence[str], fmi: int) -> tuple[str, ...]:
    from ..export.compiler import PLATFORMS

    return PLATFORMS[fmi] if "all" in chosen else tuple(dict.fromkeys(chosen))
