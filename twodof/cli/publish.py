"""publish: an FMU in real time on a ROS 2 network."""

from __future__ import annotations

import argparse
import math
import sys
from typing import TYPE_CHECKING, Any

from .common import (
    INTERRUPTED,
    CommandLineError,
    asked_to_stop,
    bag_of,
    experiment_of,
    in_options,
    print_next,
    print_summary,
    print_table,
    quote,
)
from .options import add_run_options

if TYPE_CHECKING:
    from ..ros.publisher import Publisher


def add(verbs: Any) -> None:
    """Add the verb and its options."""
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
    add_run_options(publish)
    publish.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Do it; the exit status."""
    from ..master import RealTime
    from ..ros.network import network
    from ..ros.publisher import publish

    if not 0.0 < options.rate < math.inf:
        raise CommandLineError(f"--rate {options.rate:g}: not a number of steps a second")
    if options.output is None and (options.overwrite or options.fsync):
        raise CommandLineError("--overwrite and --fsync are for a bag; name it with -o")
    place = network(subnet=options.subnet)
    endless = options.stop_time is None
    run = experiment_of(options, math.inf if endless else options.stop_time, 1.0 / options.rate)
    bag = bag_of(options, options.output) if options.output else None
    pace = RealTime()
    with asked_to_stop() as asked:
        summary = publish(
            run, *filter(None, [bag]), place=place, scene=options.scene, effort=options.effort,
            opened=_print_network, pace=pace, stop=asked,
        )  # fmt: skip
    print_summary(options, run, bag, summary, pace)
    if bag is not None and not options.json:
        print_next(f"twodof plot {quote(bag.path)}", f"ros2 bag play {quote(bag.path)}")
    return INTERRUPTED if summary.stopped else 0


def _print_network(wire: Publisher) -> None:
    place = wire.place
    print_table(
        ("topics", ", ".join(wire.topics)),
        ("network", f"DDS domain {place.domain} on {wire.interface}, {in_options(place.reach)}"),
        ("targets", f"from {', '.join(wire.commands)}" if wire.commands else "fixed"),
        ("end", "Ctrl-C"),
    )
    print_next("ros2 topic echo /joint_states")
    sys.stdout.flush()
