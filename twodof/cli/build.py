"""Verb build: build an FMU from a URDF."""

import argparse
import logging
from functools import partial
from pathlib import Path

from ..errors import InputError
from .help import Parser
from .info import controlled
from .options import (
    CommandLineError,
    add_options,
    add_output,
    check_company,
    given_options,
    links,
    not_empty,
    output_file,
    parse_locks,
    parse_settings,
    robots,
)
from .printing import busy, print_next, print_table, quote, say, written


def add(build: Parser) -> None:
    option, flag = build.add_argument, partial(build.add_argument, action="store_true")
    add_output(build, "FILE.fmu", "output file (<name>.fmu); - is the standard output", output_file)
    option("robot", nargs="?", type=Path, metavar="URDF", help="URDF or xacro file (the default arm)")
    text = "robot of an installed package, such as panda; --list-robots prints them"
    option("--robot", dest="stock", type=not_empty, metavar="NAME", help=text, completer=robots)
    flag("--list-robots", help="print the names of these robots")
    option("--urdf", type=Path, metavar="FILE", help="same as the argument URDF")
    option("--mesh-dir", type=Path, metavar="FOLDER", help="folder of the URDF's packages or meshes")
    flag("--no-meshes", help="omit the URDF's meshes from the FMU")
    text = "controlled link (EndEffector, or the last link, if there is only one)"
    option("--frame", type=not_empty, metavar="LINK", help=text, completer=links)
    add_options(build, "--lock")
    option("--axes", help="task axes, letters of xyz (xy for the default arm, else xyz)")
    text = "gravity, m/s2 in the root frame (0 -9.81 0 for the default arm, else 0 0 -9.81)"
    option("--gravity", nargs=3, type=float, metavar=("X", "Y", "Z"), help=text)
    option("--q-start", nargs="+", type=float, metavar="Q", help="start positions, rad or m")
    text = "control law: target of the frame, target of each joint, or efforts (%(default)s)"
    option("--control", choices=("task", "joint", "effort"), default="task", help=text)
    text = "robot with its controller, or the controller alone, as a native FMU (%(default)s)"
    option("--part", choices=("all", "controller"), default="all", help=text)
    text = "give the controller an input clock, for tools with event mode (--part controller --fmi 3)"
    flag("--clocked", help=text)
    text = "build plant and controller as two native FMUs, connected in an SSP file"
    option("--split", action="store_const", dest="part", const="split", help=text)
    text = "add outputs: mass matrix M, nonlinear effects h, Jacobian J, drift dJ/dt v, orientation quat, angular"
    text += " velocity omega"
    names = ("M", "h", "J", "drift", "quat", "omega")
    option("--with", dest="outputs", nargs="+", choices=names, default=[], help=text)
    text = "make a parameter an input, with derivatives (--native): gravity, payload, payload_com, 'friction[*]',"
    text += " 'damping[*]', 'armature[*]', mass:LINK, com:LINK, inertia:LINK; repeatable"
    build.add_repeatable("--free", metavar="PATTERN", help=text)
    flag("--orientation", help="also control the orientation of the frame")
    add_options(build, "--set")
    option("--name", type=not_empty, help="name of the model (the URDF's file name, TwoDof for the default arm)")
    flag("--overwrite", help="replace an existing file (without it, only the default arm's FMU is replaced)")
    flag("--link-environment", help="store the paths of this Python's packages in a Python FMU")
    _add_native(build)


def _add_native(build: Parser) -> None:
    """Add the options of native FMUs."""
    option, flag = build.add_argument, partial(build.add_argument, action="store_true")
    flag("--native", help="build the FMU as compiled C, which needs no Python")
    build.add_repeatable(
        "--platform",
        dest="platforms",
        metavar="NAME",
        help="platform of a native FMU: linux64, win64, darwin64, with --fmi 3 x86_64-linux, aarch64-linux,"
        " x86_64-windows, x86_64-darwin, aarch64-darwin, or all; repeatable (this machine's)",
    )
    option("--fmi", type=int, choices=(2, 3), help="FMI version of a native FMU (2; 3 on Linux aarch64)")
    flag("--reference", help="add experiments with reference trajectories, for 'twodof check'")
    text = "declare a scalar for each element of a vector, for FMI 3 tools without arrays"
    flag("--scalars", help=text)


def call(options: argparse.Namespace) -> int:
    if options.list_robots:
        from ..export.stock_robots import SOURCE, stock_robots

        robots = stock_robots()
        if not robots:
            raise InputError(f"there are no installed robots; {SOURCE}")
        print_table(*((name, str(path.parent)) for name, path in robots.items()))
        return 0
    if options.stock and (options.urdf or options.robot):
        raise CommandLineError("--robot names an installed robot; leave out the URDF, or --robot")
    if options.urdf and options.robot:
        raise CommandLineError("a URDF is given twice, as an argument and with --urdf")
    check_company(options, needs={"--mesh-dir": "a URDF"}, excludes={"--no-meshes": "--mesh-dir"})
    if options.orientation and options.control != "task":
        raise CommandLineError(f"--orientation needs --control task, not {options.control}")
    if options.part == "split" and (options.output or "").endswith(".fmu"):
        raise CommandLineError(f"'{options.output}': the name of a system of FMUs ends in .ssp")
    if options.scalars and options.fmi != 3:
        raise CommandLineError("--scalars needs --native --fmi 3")
    with busy("building", silent=True):
        path = _build(options)
    if not path.is_file():  # a pipe, from which nothing is read back
        return 0
    if options.part == "split":
        print_table(("system", written(path)))
        print_next(f"twodof run {quote(path)}", f"twodof info {quote(path)}")
        return 0
    from ..fmu import load_any_fmu

    fmu = load_any_fmu(path)
    print_table(
        ("FMU", written(path, *fmu.platforms)),
        ("robot", f"{fmu.robot}: {', '.join(fmu.joints)}"),
        ("controlled", controlled(fmu)),
    )
    if path.suffix != ".fmu":
        say("note: most FMI tools open only files whose name ends in .fmu", error=True)
    here = fmu.platform in fmu.platforms
    if options.part == "controller":
        return 0
    print_next(f"twodof run {quote(path)}" if here else "twodof build --native", f"twodof info {quote(path)}")
    return 0


def _build(options: argparse.Namespace) -> Path:
    """Build the FMU of the options; return its path."""
    from ..export.compiler import PLATFORMS
    from ..export.fmu_options import FmuOptions
    from ..export.package import build_fmu
    from ..export.stock_robots import stock_robot

    platforms = PLATFORMS[options.fmi or 2] if "all" in options.platforms else options.platforms
    lock = parse_locks(options.locks)
    stock = stock_robot(options.stock, lock) if options.stock else FmuOptions(lock=lock)
    chosen = FmuOptions(
        urdf=stock.urdf or options.urdf or options.robot,
        name=options.name or "",
        lock=stock.lock,
        meshes=not options.no_meshes,
        gravity=options.gravity and tuple(options.gravity),
        q_start=tuple(options.q_start) if options.q_start else stock.q_start,
        mesh_dir=options.mesh_dir or stock.mesh_dir,
        frame=options.frame or stock.frame,
        control="pose" if options.orientation else options.control,
        settings=parse_settings(options.settings),
        arrays=not options.scalars,
        outputs=tuple(options.outputs),
        free=tuple(dict.fromkeys(name.removesuffix("[*]") for name in options.free)),
        platforms=tuple(dict.fromkeys(platforms)),
        **given_options(options, "axes", "link_environment", "native", "fmi", "reference", "part", "clocked"),
    )
    logging.getLogger("twodof.export").setLevel(logging.INFO)  # each platform's takes time
    return build_fmu(options.output, chosen, overwrite=options.overwrite)
