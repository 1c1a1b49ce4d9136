"""What can be typed on the command line: the verbs and their options."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from . import __version__


def parser() -> argparse.ArgumentParser:
    """The parser; what it gives has the verb's name as ``verb``."""
    program = argparse.ArgumentParser(
        prog="twodof",
        description="From a URDF to an FMU, and from a co-simulation to a ROS 2 bag.",
        epilog="'twodof run' alone builds the default arm's FMU, runs it for 5 s and leaves a bag.",
    )
    program.add_argument("--version", action="version", version=f"twodof {__version__}")
    verbs = program.add_subparsers(dest="verb", required=True, metavar="VERB")
    for add in (
        _add_build,
        _add_run,
        _add_publish,
        _add_info,
        _add_plot,
        _add_view,
        _add_live,
        _add_sweep,
        _add_recover,
    ):
        add(verbs)
    return program


def _add_build(verbs: Any) -> None:
    build = verbs.add_parser("build", help="build an FMU from a URDF")
    build.add_argument("-o", dest="output", metavar="FILE.fmu", help="default: <name>.fmu")
    build.add_argument("--urdf", type=Path, help="default: the shipped planar 2-DoF arm")
    build.add_argument(
        "--mesh-dir", type=Path, metavar="M", help="folder of the URDF's packages or meshes"
    )
    build.add_argument("--frame", default="EndEffector", help="controlled link (%(default)s)")
    build.add_argument("--axes", help="task axes of xyz (xy for the shipped arm, else xyz)")
    build.add_argument(
        "--gravity", nargs=3, type=float, metavar=("X", "Y", "Z"),
        help="m/s2 in the root frame (0 -9.81 0 for the shipped arm, else 0 0 -9.81)",
    )  # fmt: skip
    build.add_argument(
        "--q-start", nargs="+", type=float, metavar="Q", help="start positions, rad or m"
    )
    build.add_argument("--name", default="TwoDof", help="name of the model (%(default)s)")
    build.add_argument(
        "--link-environment", action="store_true",
        help="remember in the FMU where this Python's packages are",
    )  # fmt: skip
    build.add_argument(
        "--native", action="store_true", help="compiled C, which needs no Python where it runs"
    )
    build.add_argument(
        "--platform", dest="platforms", action="append", default=[], metavar="P",
        help="of a native FMU: linux64, win64, darwin64 or all; repeatable (this machine's)",
    )  # fmt: skip


def _add_run(verbs: Any) -> None:
    run = verbs.add_parser(
        "run", help="simulate an FMU and write a bag",
        description="Simulate an FMU and write each step as sensor_msgs/JointState into a bag.",
    )  # fmt: skip
    run.add_argument("-o", dest="output", metavar="BAG", help="default: rosbag2_<date and time>")
    _add_time_options(run)
    run.add_argument("--realtime", action="store_true", help="pace the run to the wall clock")
    _add_run_options(run)


def _add_publish(verbs: Any) -> None:
    publish = verbs.add_parser(
        "publish", help="step an FMU in real time on a ROS 2 network",
        description="Step an FMU in real time and publish each step as sensor_msgs/JointState over"
        " DDS, until Ctrl-C. Points on /target_command and /clicked_point move the target. Honours"
        " ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE, ROS_STATIC_PEERS, ROS_LOCALHOST_ONLY and"
        " CYCLONEDDS_URI.",
    )  # fmt: skip
    publish.add_argument("-o", dest="output", metavar="BAG", help="record a bag too")
    publish.add_argument("--stop-time", type=float, metavar="S", help="s (none: until Ctrl-C)")
    publish.add_argument(
        "--rate", type=float, default=100.0, metavar="HZ", help="steps a second (%(default)g)"
    )
    publish.add_argument(
        "--subnet", action="store_true", help="for other hosts too, not for this one alone"
    )
    _add_run_options(publish)


def _add_info(verbs: Any) -> None:
    info = verbs.add_parser("info", help="show what is in an FMU or a bag")
    info.add_argument("path", metavar="FMU|BAG", type=Path)


def _add_plot(verbs: Any) -> None:
    plot = verbs.add_parser(
        "plot", help="draw bags, or the map of a sweep, into one figure",
        description="Draw joint positions and velocities, the end effector's path and its error;"
        " of a sweep, each metric over the variables.",
    )  # fmt: skip
    plot.add_argument("bags", nargs="+", metavar="BAG|SWEEP", help="several bags are compared")
    plot.add_argument(
        "-o", dest="output", metavar="FILE", help=".png, .svg, .pdf or .html (a window)"
    )
    _add_robot_options(plot)


def _add_view(verbs: Any) -> None:
    view = verbs.add_parser(
        "view", help="replay a bag in the browser",
        description="Replay a bag in the browser, or write a page that replays it offline.",
    )  # fmt: skip
    view.add_argument("bag", metavar="BAG", type=Path)
    view.add_argument("--export", metavar="FILE.html", help="write one self-contained file instead")
    _add_robot_options(view)
    view.add_argument(
        "--mesh-dir", type=Path, metavar="M", help="folder of that URDF's packages or meshes"
    )
    view.add_argument("--fmu", metavar="FMU", help="where the robot's meshes are")
    _add_page_options(view)


def _add_live(verbs: Any) -> None:
    live = verbs.add_parser(
        "live", help="drive an FMU in the browser",
        description="Step an FMU in real time behind a page in the browser: drag the target.",
    )  # fmt: skip
    live.add_argument("fmu", nargs="?", metavar="FMU", help="default: the default arm's")
    live.add_argument("-o", dest="output", metavar="BAG", help="name of recordings")
    _add_step_option(live)
    _add_set_option(live)
    _add_page_options(live)


def _add_sweep(verbs: Any) -> None:
    sweep = verbs.add_parser(
        "sweep", help="run an FMU over many gains, and map what comes out",
        description="Run an FMU over a grid or random values of any of its inputs and parameters."
        " The native default FMU is built where none is named.",
    )  # fmt: skip
    sweep.add_argument("fmu", nargs="?", metavar="FMU", help="default: the default arm's")
    sweep.add_argument(
        "--grid", dest="grids", action="append", default=[], metavar="NAME=LOW:HIGH:COUNT",
        help="values evenly spaced; all combinations of several",
    )  # fmt: skip
    sweep.add_argument("--random", type=int, default=0, metavar="N", help="draws of each --range")
    sweep.add_argument(
        "--seed", type=int, default=0, metavar="S", help="of the draws (%(default)s)"
    )
    sweep.add_argument(
        "--range", dest="ranges", action="append", default=[], metavar="NAME=LOW:HIGH",
        help="values drawn uniformly",
    )  # fmt: skip
    _add_time_options(sweep)
    _add_set_option(sweep)
    sweep.add_argument("-o", dest="output", metavar="OUT", help="default: sweep_<date and time>")
    sweep.add_argument(
        "--resume", action="store_true", help="go on with OUT; what is done is not repeated"
    )
    sweep.add_argument("--bags", action="store_true", help="keep a bag of each run in OUT/bags")
    sweep.add_argument("--workers", type=int, metavar="N", help="local processes (one for a core)")
    sweep.add_argument("--scheduler", metavar="tcp://…", help="of a Dask cluster to use instead")


def _add_recover(verbs: Any) -> None:
    recover = verbs.add_parser(
        "recover", help="make a bag whose writer died complete",
        description="Make a bag whose writer died complete, so that every reader opens it.",
    )  # fmt: skip
    recover.add_argument("bag", metavar="BAG", type=Path)


# --- options of several verbs ---


def _add_run_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "fmu", nargs="?", metavar="FMU", help="default: TwoDof.fmu, built if need be"
    )
    parser.add_argument(
        "--native", action="store_true", help="build and run the native default FMU instead"
    )
    _add_set_option(parser)
    parser.add_argument(
        "--input", metavar="CSV", help="inputs over time: a column 'time' and one for each input"
    )
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")
    parser.add_argument(
        "--scene", action="store_true", help="add robot description, tf, target and end effector"
    )
    parser.add_argument("--effort", action="store_true", help="add the control effort")
    parser.add_argument(
        "--stamp-start", type=float, metavar="S", help="first stamp, s since the epoch (now)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing bag")
    parser.add_argument(
        "--fsync", action="store_true", help="wait for the disk twice a second, for a power loss"
    )


def _add_time_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--stop-time", type=float, default=5.0, metavar="S", help="s (%(default)s)")
    _add_step_option(parser)


def _add_step_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--step", type=float, default=0.01, metavar="S", help="communication step, s (%(default)s)"
    )


def _add_set_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="NAME=VALUE",
        help="start value of an input or parameter: Kp=80, x_des=0.25,0.1, limit_effort=true",
    )  # fmt: skip


def _add_robot_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--urdf", metavar="U", help="the robot of a bag that carries none")
    parser.add_argument("--frame", metavar="LINK", help="its end effector")


def _add_page_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (%(default)s, this machine alone)"
    )
    parser.add_argument("--port", type=int, default=8080, help="(%(default)s); 0: any that is free")
    parser.add_argument("--no-browser", action="store_true", help="open no browser")
