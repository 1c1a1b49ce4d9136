"""publish: an FMU in real time on a ROS 2 network."""

from __future__ import annotations

import argparse
import math
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .common import (
    INTERRUPTED,
    CommandLineError,
    asked_to_stop,
    bag_of,
    experiment_of,
    facts_of,
    identifier,
    in_options,
    print_json,
    print_next,
    print_summary,
    print_table,
    quote,
)
from .options import add_frame_option, add_output, add_run_options, check_company

if TYPE_CHECKING:
    from ..ros.foxglove import Foxglove
    from ..ros.publisher import Publisher
    from ..simulation.experiments import Experiment


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    publish = verbs.add_parser(
        "publish", help="step an FMU in real time on a ROS 2 network",
        description="Step an FMU in real time and publish each step as sensor_msgs/JointState over"
        " DDS, until Ctrl-C. Commands from others drive the robot: joint states on /joint_commands,"
        " or points on /target_command and /clicked_point, as its control takes. Honours"
        " ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE, ROS_STATIC_PEERS, ROS_LOCALHOST_ONLY and"
        " CYCLONEDDS_URI.",
    )  # fmt: skip
    publish.add_argument(
        "robots", nargs="*", metavar="[NAME=]FMU|URDF",
        help="default: TwoDof.fmu, built if need be; several run in step, each in a namespace, NAME"
        " or its file's",
    )  # fmt: skip
    add_output(publish, "BAG", "record a bag too, one of all robots")
    add_frame_option(publish)
    publish.add_argument("--stop-time", type=float, metavar="S", help="s (none: until Ctrl-C)")
    publish.add_argument(
        "--rate", type=float, default=100.0, metavar="HZ", help="steps a second (%(default)g)"
    )
    publish.add_argument(
        "--subnet", action="store_true", help="for other hosts too, not for this one alone"
    )
    publish.add_argument(
        "--foxglove", action="store_true", help="serve Foxglove too, on this machine alone"
    )
    publish.add_argument("--foxglove-port", type=int, metavar="PORT", help="(8765)")
    _add_loop_options(publish)
    add_run_options(publish)
    publish.set_defaults(call=call, storage=None)


def _add_loop_options(publish: argparse.ArgumentParser) -> None:
    """Of a robot in the loop of a controller."""
    publish.add_argument("--namespace", default="", metavar="NS", help="of the topics")
    publish.add_argument(
        "--state-topic", default="joint_states", metavar="TOPIC", help="(%(default)s)"
    )
    publish.add_argument(
        "--command-topic", metavar="TOPIC",
        help="where commands are heard (joint_commands or target_command, as the control takes)",
    )  # fmt: skip
    publish.add_argument(
        "--lockstep", action="store_true", help="do a step when its command has come, by stamp"
    )
    publish.add_argument(
        "--timeout", type=float, metavar="S",
        help="s without a command until the robot is held (0.5), or in lockstep until the end (10)",
    )  # fmt: skip
    publish.add_argument(
        "--on-timeout", choices=("hold", "ramp"),
        help="hold the last command (targets), or ramp to zero (efforts)",
    )  # fmt: skip
    publish.add_argument(
        "--clock", action="store_true", help="publish /clock, and hear /pause and /step"
    )
    publish.add_argument(
        "--speed", type=float, metavar="FACTOR", help="of real time (1; in lockstep unlimited)"
    )


def call(options: argparse.Namespace) -> int:
    """Do it; the exit status."""
    from ..ros.network import network
    from ..ros.publisher import Publisher, publish, publish_together
    from ..simulation.pace import RealTime

    if not 0.0 < options.rate < math.inf:
        raise CommandLineError(f"--rate {options.rate:g}: not a number of steps a second")
    of_a_bag = ("--overwrite", "--fsync", "--storage")
    check_company(options, needs={**dict.fromkeys(of_a_bag, "-o"), "--foxglove-port": "--foxglove"})
    options.storage = options.storage or "mcap"
    robots = _robots(options)
    bag = bag_of(options, options.output) if options.output else None
    bags = {}
    if bag is not None:  # a part of it for each robot, in its namespace
        space = options.namespace
        bags = {name: bag.of(f"{space}/{name}") if name else bag for name in robots}
    wire: dict[str, Any] = dict(
        place=network(subnet=options.subnet), scene=options.scene, effort=options.effort,
        clock=options.clock, namespace=options.namespace, state_topic=options.state_topic,
        command_topic=options.command_topic, lockstep=options.lockstep, timeout=options.timeout,
        on_timeout=options.on_timeout,
        opened=(lambda _: None) if options.json else partial(_print_network, options.stop_time),
    )  # fmt: skip
    speed = 1.0 if options.speed is None and not options.lockstep else options.speed
    pace = None if speed is None else RealTime(speed)
    with asked_to_stop() as asked:
        if "" in robots:
            viewer = _foxglove(options) if options.foxglove else None
            summary = publish(
                robots[""], *filter(None, [viewer, *bags.values()]), wire=Publisher(**wire),
                pace=pace, stop=asked, steer=viewer.command if viewer else dict,
            )  # fmt: skip
            summaries = {"": summary}
        else:
            sinks = {name: [bag] for name, bag in bags.items()}
            summaries = publish_together(robots, sinks=sinks, pace=pace, stop=asked, **wire)
    if options.json:
        facts = {
            name: facts_of(robots[name], bags.get(name), summary, pace)
            for name, summary in summaries.items()
        }
        print_json(**facts.get("", facts))
    else:
        for name, summary in summaries.items():
            print_summary(options, robots[name], bags.get(name), summary, pace)
    if bag is not None and not options.json:
        print_next(f"twodof plot {quote(bag.path)}", f"ros2 bag play {quote(bag.path)}")
    return INTERRUPTED if any(summary.stopped for summary in summaries.values()) else 0


def _robots(options: argparse.Namespace) -> dict[str, Experiment]:
    """What is to be run, by namespace; what is alone needs none."""
    from ..ros.messages import check_name

    robots: dict[str, Experiment] = {}
    stop_time = math.inf if options.stop_time is None else options.stop_time
    for given in options.robots or [""]:
        name, equals, options.fmu = given.partition("=")
        if not equals or Path(given).exists():
            options.fmu = given
            name = identifier(Path(given)) if len(options.robots) > 1 else ""
        elif not name:
            raise CommandLineError(f"'{given}' names no robot")
        if not options.fmu and options.robots:
            raise CommandLineError(f"'{given}' names no FMU")
        check_name("robots", name)
        if name in robots:
            raise CommandLineError(f"two robots are '{name}'; call them NAME={options.fmu}")
        run = robots[name] = experiment_of(options, stop_time, 1.0 / options.rate)
        fmus = [robot.fmu for robot in robots.values() if robot.fmu.path == run.fmu.path]
        if any(fmu.members != run.fmu.members for fmu in fmus):
            reason = f"would be '{run.fmu.path}' as the robot before it is; rename a URDF"
            raise CommandLineError(f"the FMU of '{options.fmu}' {reason}")
    if options.foxglove and "" not in robots:
        raise CommandLineError("--foxglove serves one robot")
    return robots


def _foxglove(options: argparse.Namespace) -> Foxglove:
    from ..ros.foxglove import Foxglove

    def tell(server: Foxglove) -> None:
        print(f"open  Foxglove, Open connection, Foxglove WebSocket: {server.url}", flush=True)

    port = {} if options.foxglove_port is None else {"port": options.foxglove_port}
    return Foxglove(**port, scene=options.scene, effort=options.effort, opened=tell)


def _print_network(stop_time: float | None, wire: Publisher) -> None:
    place = wire.place
    print_table(
        ("topics", ", ".join(wire.topics)),
        ("network", f"DDS domain {place.domain} on {wire.interface}, {in_options(place.reach)}"),
        ("commands", f"from {', '.join(wire.commands)}" if wire.commands else "none"),
        ("end", "Ctrl-C" if stop_time is None else f"after {stop_time:g} s, or Ctrl-C"),
    )
    print_next(f"ros2 topic echo {wire.topics[0]}")
    sys.stdout.flush()
