"""Options that several verbs have."""

from __future__ import annotations

import argparse
from typing import Any

from .common import CommandLineError

SAME = {
    "-o": ("output",),
    "--platform": ("platforms",),
    "a URDF": ("robot", "urdf"),
    "--range": ("ranges",),
}
"""What options are called in the namespace, where that is not their own name."""


def check_company(
    options: argparse.Namespace,
    needs: dict[str, str] | None = None,
    excludes: dict[str, str] | None = None,
) -> None:
    """Refuse options that would do nothing: without another, or beside another.

    Raises:
        CommandLineError: naming both.
    """
    for option, other in (needs or {}).items():
        if _given(options, option) and not _given(options, other):
            raise CommandLineError(f"{option} does nothing without {other}")
    for option, other in (excludes or {}).items():
        if _given(options, option) and _given(options, other):
            raise CommandLineError(f"{option} does nothing beside {other}; leave one out")


def _given(options: argparse.Namespace, option: str) -> bool:
    """Whether an option is on the command line; such ones have no defaults of their own."""
    names = SAME.get(option, (option.lstrip("-").replace("-", "_"),))
    values = [getattr(options, name) for name in names]
    return any(value is not None and value is not False and value != [] for value in values)


def not_empty(text: str) -> str:
    """A text that is not empty, as that of a variable is which a shell does not know."""
    if not text:
        raise argparse.ArgumentTypeError("it is empty")
    return text


def add_output(parser: argparse.ArgumentParser, metavar: str, text: str) -> None:
    """Where what is made goes."""
    parser.add_argument("-o", dest="output", type=not_empty, metavar=metavar, help=text)


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Of a run that may leave a bag, but for what is run."""
    parser.add_argument(
        "--native", action="store_true", help="build and run the native default FMU instead"
    )
    add_set_option(parser)
    parser.add_argument(
        "--input", metavar="CSV|BAG[:TOPIC]",
        help="inputs over time: a column 'time' and one for each input; or a bag's commands",
    )  # fmt: skip
    parser.add_argument("--storage", choices=("mcap", "sqlite3"), default="mcap")
    parser.add_argument(
        "--scene", action="store_true", help="add robot description, tf, target and end effector"
    )
    parser.add_argument("--effort", action="store_true", help="add the control effort")
    parser.add_argument(
        "--stamp-start", type=float, metavar="S", help="first stamp, s since the epoch (now)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing bag")
    add_json_option(parser)
    parser.add_argument(
        "--fsync", action="store_true", help="wait for the disk twice a second, for a power loss"
    )


def add_fmu(parser: argparse.ArgumentParser) -> None:
    """What is run."""
    parser.add_argument(
        "fmu", nargs="?", type=not_empty, metavar="FMU|URDF",
        help="default: TwoDof.fmu, built if need be",
    )  # fmt: skip
    add_frame_option(parser)


def add_frame_option(parser: argparse.ArgumentParser) -> None:
    """Of a URDF that is run, for `chosen_fmu`."""
    parser.add_argument(
        "--frame",
        type=not_empty,
        metavar="LINK",
        help="of a URDF, the controlled link (its end)",
    )


def add_time_options(parser: argparse.ArgumentParser) -> None:
    """Stop time and step."""
    parser.add_argument("--stop-time", type=float, metavar="S", help="s (the FMU's own)")
    add_step_option(parser)


def add_step_option(parser: argparse.ArgumentParser) -> None:
    """Communication step."""
    parser.add_argument(
        "--step", type=float, metavar="S", help="communication step, s (the FMU's own)"
    )


def add_set_option(parser: argparse.ArgumentParser) -> None:
    """Start values."""
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="NAME=VALUE",
        help="start value of an input or parameter: Kp=80, x_des=0.25,0.1, limit_effort=true",
    )  # fmt: skip


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Facts for another program."""
    parser.add_argument("--json", action="store_true", help="print the facts as JSON, SI units")


def add_robot_options(parser: argparse.ArgumentParser) -> None:
    """Robot of a bag from elsewhere."""
    parser.add_argument(
        "--urdf", type=not_empty, metavar="U", help="the robot of a bag that carries none"
    )
    parser.add_argument("--frame", type=not_empty, metavar="LINK", help="its end effector")


def add_page_options(parser: argparse.ArgumentParser) -> None:
    """Where a page is served."""
    parser.add_argument("--host", help="address to listen on (127.0.0.1, this machine alone)")
    parser.add_argument("--port", type=int, help="(8080); 0: any that is free")
    parser.add_argument("--no-browser", action="store_true", help="open no browser")


def page_place(options: argparse.Namespace) -> dict[str, Any]:
    """Where a page is served, as far as the options say it."""
    given = {name: getattr(options, name) for name in ("host", "port")}
    return {name: value for name, value in given.items() if value is not None}
