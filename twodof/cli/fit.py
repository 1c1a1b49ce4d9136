"""Verb fit: fit a robot's masses and friction to bags of its motion."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from ..files import free_name
from ..version import install
from .fmus import is_robot
from .help import Parser
from .options import (
    CommandLineError,
    add_options,
    add_output,
    given_options,
    links,
    not_empty,
    parse_locks,
    parse_settings,
)
from .printing import plain, print_json, print_next, print_table, quote, say
from .signals import INTERRUPTED


def add(fit: Parser) -> None:
    fit.description = (
        "Fit masses, friction and other parameters of a URDF to bags with positions and efforts. Writes robot.urdf,"
        " fit.json and fit.html, a page with its curves, into a folder. The last fifth of each bag is held out."
        " With --design, write a motion to record instead."
    )
    option = fit.add_argument
    option("robot", type=Path, metavar="URDF", help="URDF or xacro file with the initial values")
    bags = option("bags", nargs="+", type=not_empty, metavar="BAG", help="bags of the robot")
    bags.required = False  # with nargs="*", bags after an option would be refused
    fit.add_repeatable(
        "--free",
        metavar="PATTERN",
        help="free parameters, by name or shell pattern: friction[*], damping[*], armature[*], mass:LINK, com:LINK,"
        " inertia:LINK, payload, payload_com, gravity, offset:JOINT, gain:JOINT, bias:JOINT; repeatable",
    )
    text = "without bags: write a motion of S seconds to record, for the most precise fit"
    option("--design", type=float, metavar="S", help=text)
    add_output(fit, "PATH", "folder of the fitted robot (fitted), or motion: a .csv file (excite.csv) or a bag")
    text = "link of the payload (the last link, if there is only one)"
    option("--frame", type=not_empty, metavar="LINK", help=text, completer=links)
    text = "gravity, m/s2 in the root frame (the run's, else 0 0 -9.81)"
    option("--gravity", nargs=3, type=float, metavar=("X", "Y", "Z"), help=text)
    text = "gains of joint control, for bags of /joint_commands without efforts: Kp=100; repeatable"
    option("--set", dest="settings", metavar="NAME=VALUE", help=text, action="append", default=[])
    add_options(fit, "--lock", "--json")


def call(options: argparse.Namespace) -> int:
    if not options.free:
        raise CommandLineError("name the free parameters with --free, for example --free 'friction[*]' --free payload")
    if bool(options.bags) == (options.design is not None):
        raise CommandLineError("name bags of the robot, or a motion to record with --design S, and not both")
    if options.design is not None:
        return _design(options)
    if options.robot.is_dir() and (urdf := next(filter(is_robot, map(str, options.bags)), None)):
        raise CommandLineError(f"the URDF comes first: twodof fit {quote(Path(urdf))} {quote(options.robot)}")
    from ..identification.fitting import fit
    from ..simulation.progress import counting

    output = Path(options.output or "fitted")
    with counting(f"fitting {plain(options.robot.name)}", "step", shown=sys.stderr.isatty()) as progress:
        result = fit(
            options.robot,
            options.bags,
            options.free,
            output=output,
            lock=parse_locks(options.locks),
            settings=parse_settings(options.settings),
            progress=progress,
            **given_options(options, "frame", "gravity"),
        )
    status = INTERRUPTED if result.interrupted else 0
    if options.json:
        print_json(output=str(output), **result.facts)
        return status
    print_table(*result.rows)
    for remark in result.remarks:
        say(f"note: {remark}")
    given = {name: ",".join(map(repr, values)) for name, values in result.settings.items() if name != "gravity"}
    settings = "".join(f" --set {name}={value}" for name, value in given.items())
    same = _same(options, result.settings.get("gravity"))
    page = output / "fit.html"
    say(f"page: {page}" if page.exists() else f"no page: {install('view')}")
    print_next(f"twodof build {quote(output / 'robot.urdf')}{same}{settings}")
    return status


def _design(options: argparse.Namespace) -> int:
    from ..identification.excitation import FINE, excite
    from ..simulation.progress import counting

    output = Path(options.output) if options.output else free_name("excite", ".csv")
    given = given_options(options, "frame", "gravity") | {"lock": parse_locks(options.locks), "output": output}
    with counting("designing", "step", shown=sys.stderr.isatty()) as progress:
        result = excite(options.robot, options.design, options.free, progress=progress, **given)
    if options.json:
        print_json(output=str(output), factor=result.factor)
        return 0
    gain = f"intervals {result.factor:.3g} times narrower than with random motions within the same limits"
    say(f"motion: {output}, {gain}")
    say("note: collisions are not checked: look at the motion in a simulation before a robot follows it")
    start, same = ",".join(f"{q:.9g}" for q in result.q[0]), _same(options, options.gravity)
    print_next(
        f"twodof build {quote(options.robot)}{same} --control joint --set q_start={start} -o Robot.fmu",
        f"twodof run Robot.fmu --input {quote(output)} --stop-time {options.design:g} --step {FINE:g} --effort",
    )
    return 0


def _same(options: argparse.Namespace, gravity: Sequence[float] | None) -> str:
    """Return the options that a build of the same robot needs."""
    same = "".join(f" --lock {quote(lock)}" for lock in options.locks or ())
    same += f" --frame {quote(options.frame)}" if options.frame else ""
    return same + (f" --gravity {' '.join(map(repr, gravity))}" if gravity else "")
