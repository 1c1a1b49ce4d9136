"""Options that several verbs share, and completion of their values in the shell."""

from __future__ import annotations

import argparse
import os
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Collection, Iterable
from fcntl import F_GETFL, fcntl
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from ..plant.numerals import number, whole_number
from .help import Parser

if TYPE_CHECKING:
    from ..simulation.input_values import Setting


class CommandLineError(InputError):
    """An option is invalid, or conflicts with another."""


def not_empty(text: str) -> str:
    """Reject an empty string, for example an unset shell variable."""
    if not text:
        raise argparse.ArgumentTypeError("it is empty")
    return text


def folder(text: str) -> str:
    """Return the path of an output folder, which cannot be the standard output."""
    if text == "-":
        raise argparse.ArgumentTypeError("it is a folder, and cannot be the standard output; ./- is a folder named '-'")
    return not_empty(text)


STANDARD_OUTPUT = "/dev/stdout"


def output_file(text: str) -> str:
    """Return the path of an output file; "-" is the standard output."""
    if text == "-" and fcntl(1, F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise argparse.ArgumentTypeError("the standard output is closed")
    return STANDARD_OUTPUT if text == "-" else not_empty(text)


def _file(options: argparse.Namespace) -> Path | None:
    """Return the FMU, URDF or first bag on an incomplete command line."""
    names = (getattr(options, name, None) for name in ("fmu", "urdf", "robot", "bag", "bags", "robots"))
    first = next((name for name in names if name), None)
    return Path(first[0] if isinstance(first, list) else first) if first else None


def robots(**_: object) -> list[str]:
    """Complete a robot of an installed package."""
    from ..export.stock_robots import stock_robots

    return [*stock_robots()]


def variables(parsed_args: argparse.Namespace, **_: object) -> list[str]:
    """Complete an FMU's inputs and parameters."""
    path = _file(parsed_args)
    if path is None or path.suffix != ".fmu":
        return []
    from ..fmu import load_fmu

    fmu = load_fmu(path)
    return [f"{group}=" for causality in ("input", "parameter") for group in fmu.groups(causality)]


def links(parsed_args: argparse.Namespace, **_: object) -> list[str]:
    """Complete the links of a URDF or of a bag's robot."""
    return [str(link.get("name")) for link in _robot(parsed_args).iterfind("link")]


def joints(parsed_args: argparse.Namespace, **_: object) -> list[str]:
    """Complete the moving joints of a URDF or of a bag's robot."""
    found = _robot(parsed_args).iterfind("joint")
    return [str(joint.get("name")) for joint in found if joint.get("type") != "fixed"]


def _robot(options: argparse.Namespace) -> ET.Element:
    path = _file(options)
    if path is None:
        return ET.Element("robot")
    from ..plant.urdf import parse_robot

    if path.suffix in (".urdf", ".xacro"):
        from ..export.urdf_source import read_text

        return parse_robot(read_text(path, None))
    from ..bag.provenance import read_provenance, robot_in

    return parse_robot(str(read_provenance(*robot_in(path))["urdf"]))


Keywords = dict[str, Any]
Table = dict[str, Keywords]
OF_A_RUN: Table = {
    "--native": dict(action="store_true", help="build and run a native FMU of the URDF or of the default arm"),
    "--set": dict(
        dest="settings",
        metavar="NAME=VALUE",
        help="start value of an input or parameter: Kp=80, x_des=0.25,0.1, limit_effort=true",
        completer=variables,
        action="append",
        default=[],
    ),
    "--input": dict(
        metavar="CSV|BAG[:TOPIC]",
        help="inputs over time: a CSV with a column 'time' and one for each input, or the commands of a bag",
    ),
    "--storage": dict(choices=("mcap", "sqlite3"), default="mcap", help="storage plugin of the bag (mcap)"),
    "--compress": dict(choices=("zstd",), default="", help="compress the chunks of an MCAP bag"),
    "--scene": dict(action="store_true", help="add robot description, tf, target and end effector"),
    "--meshes": dict(action="store_true", help="record a scene with the robot's meshes, stored in the bag's folder"),
    "--effort": dict(action="store_true", help="add the control effort to the joint states"),
    "--stamp-start": dict(type=float, metavar="S", help="time stamp of the first sample, s since the epoch (now)"),
    "--overwrite": dict(action="store_true", help="replace an existing bag, or the FMU of a URDF"),
    "--json": dict(action="store_true", help="print the results as JSON, in SI units"),
    "--fsync": dict(action="store_true", help="flush to the disk twice a second, against power loss"),
}
"""Options of verbs that may write a bag, without the FMU."""
OF_A_PAGE: Table = {
    "--host": dict(help="address to listen on (127.0.0.1: this machine only)"),
    "--port": dict(type=int, help="port (8080); 0: any free port"),
    "--no-browser": dict(action="store_true", help="do not open a browser"),
}
OPTIONS: Table = {
    "--cost": dict(metavar="EXPRESSION", help="cost that ranks the runs, such as 'settling + 0.1*peak_effort'"),
    "--frame": dict(type=not_empty, metavar="LINK", help="controlled link of a URDF (its last link)", completer=links),
    "--lock": dict(
        dest="locks",
        metavar="JOINT[=VALUE]",
        help="joint to fix, a name or shell pattern, and its position, rad or m (0)",
        completer=joints,
        action="append",
        default=[],
    ),
    "--robot": dict(default="", metavar="NAME", help="component of a system (SSP file) that is the robot"),
    "--stop-time": dict(type=float, metavar="S", help="stop time, s (the FMU's default)"),
    "--step": dict(type=float, metavar="S", help="communication step, s (the FMU's default)"),
    "--namespace": dict(default="", metavar="NS", help="namespace of the topics"),
    **OF_A_RUN,
    **OF_A_PAGE,
}

SAME = {"-o": ("output",), "--platform": ("platforms",), "a URDF": ("robot", "urdf"), "--range": ("ranges",)}
"""Names of options in argparse's namespace that differ from the option."""


def add_options(parser: Parser, *names: str) -> None:
    """Add options from the table."""
    for name in names:
        parser.add_argument(name, **OPTIONS[name])


def add_fmu(parser: Parser, default: str, metavar: str = "FMU|URDF") -> None:
    """Add the optional FMU or URDF to run."""
    parser.add_argument("fmu", nargs="?", type=not_empty, metavar=metavar, help=f"model to use ({default})")


def add_output(parser: Parser, metavar: str, text: str, kind: Callable[[str], str] = folder) -> None:
    """Add the option for the output: a folder, or of kind ``output_file`` a file."""
    parser.add_argument("-o", dest="output", type=kind, metavar=metavar, help=text)


def add_robot_options(parser: Parser) -> None:
    """Add the options for the robot of a third-party bag."""
    parser.add_argument("--urdf", type=not_empty, metavar="FILE", help="URDF of the robot, for a bag without one")
    text = "end-effector link in this URDF"
    parser.add_argument("--frame", type=not_empty, metavar="LINK", help=text, completer=links)


def given_options(options: argparse.Namespace, *names: str) -> Keywords:
    """Return options as keyword arguments of the library."""
    return {name: getattr(options, name) for name in names}


def check_company(
    options: argparse.Namespace, needs: dict[str, str] | None = None, excludes: dict[str, str] | None = None
) -> None:
    """Refuse an option that has no effect without another one, or together with it; name both."""
    for option, other in (needs or {}).items():
        if _given(options, option) and not _given(options, other):
            raise CommandLineError(f"{option} has no effect without {other}")
    for option, other in (excludes or {}).items():
        if _given(options, option) and _given(options, other):
            raise CommandLineError(f"{option} has no effect with {other}; leave one out")


def _given(options: argparse.Namespace, option: str) -> bool:
    """Return whether an option is on the command line; such options have no default of their own."""
    names = SAME.get(option, (option.lstrip("-").replace("-", "_"),))
    return any(v is not None and v is not False and v != [] for v in given_options(options, *names).values())


def parse_settings(texts: Iterable[str], option: str = "--set", words: Collection[str] = ()) -> dict[str, Setting]:
    """Parse NAME=VALUE texts: ``Kp=80``, ``x_des=0.25,0.1``, ``limit_effort=true``; values of ``words`` stay text."""
    settings: dict[str, Setting] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        name = name.strip()
        if not equals or not name:
            raise CommandLineError(f"{option} {text}: expected NAME=VALUE")
        if name in settings:
            raise CommandLineError(f"{option} {name} is given twice")
        value = value.strip()
        settings[name] = value if name in words else _parse_value(f"{option} {name}", value)
    return settings


def _parse_value(name: str, text: str) -> Setting:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        numbers = [_parse_number(part) for part in text.split(",")]
    except ValueError:
        raise CommandLineError(
            f"{name}={text}: '{text}' is not a number; write numbers as 0.2,0.1 without units, or true or false"
        ) from None
    return numbers[0] if len(numbers) == 1 else numbers


def _parse_number(text: str) -> float:
    """Return a number; whole numbers that a float cannot represent are exact."""
    parsed = number(text)
    return whole_number(text) if 2.0**53 <= abs(parsed) < 2.0**64 and text.strip(" +-").isdigit() else parsed


def parse_locks(texts: Iterable[str]) -> dict[str, float]:
    """Parse JOINT[=VALUE] texts: the position, rad or m, of each locked joint or pattern."""
    locks: dict[str, float] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        try:
            locks[name] = number(value) if equals else 0.0
        except ValueError:
            raise CommandLineError(f"--lock {text}: '{value}' is not a number") from None
    return locks


def dated(stem: str) -> Path:
    """Return the default name of a run's output."""
    from ..files import free_name

    return free_name(time.strftime(f"{stem}_%Y_%m_%d-%H_%M_%S"))
