"""Verb publish: step an FMU in real time on a ROS 2 network."""

from __future__ import annotations

import argparse
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from .help import Parser
from .options import OF_A_RUN, CommandLineError, add_options, add_output, check_company, given_options
from .printing import in_options, print_json, print_next, print_table, quote, say
from .run import bag_of, experiment_of, facts_of, print_summary
from .signals import INTERRUPTED, asked_to_stop

if TYPE_CHECKING:
    from ..pages.foxglove import Foxglove
    from ..ros.publisher import Publisher
    from ..simulation.experiments import Experiment


def add(publish: Parser) -> None:
    publish.description = (
        "Step an FMU in real time and publish each step as sensor_msgs/JointState over DDS, until"
        " Ctrl-C. Received commands drive the robot: joint states on /joint_commands, or points"
        " on /target_command and /clicked_point, depending on the FMU's control law. Honours ROS_DOMAIN_ID,"
        " ROS_AUTOMATIC_DISCOVERY_RANGE, ROS_STATIC_PEERS, ROS_LOCALHOST_ONLY and CYCLONEDDS_URI."
    )
    option, flag = publish.add_argument, partial(publish.add_argument, action="store_true")
    text = "FMUs to step together, each in its namespace NAME (TwoDof.fmu, built if it is missing)"
    option("robots", nargs="*", metavar="[NAME=]FMU|URDF", help=text)
    add_output(publish, "BAG", "also record a bag, one for all robots")
    add_options(publish, "--frame")
    option("--stop-time", type=float, metavar="S", help="stop time, s (until Ctrl-C)")
    option("--rate", type=float, default=100.0, metavar="HZ", help="communication steps per second (%(default)g)")
    flag("--subnet", help="also publish to other hosts of the subnet")
    flag("--foxglove", help="also serve the run to Foxglove, on this machine only")
    option("--foxglove-port", "--port", type=int, metavar="PORT", help="port for Foxglove (8765)")
    flag("--foxglove-control", help="allow Foxglove to set the gains")
    add_options(publish, "--namespace")
    option("--state-topic", default="joint_states", metavar="TOPIC", help="topic of the joint states (%(default)s)")
    text = "topic of received commands (joint_commands or target_command, by the control law)"
    option("--command-topic", metavar="TOPIC", help=text)
    flag("--lockstep", help="wait before each step for the command with the stamp of the latest state")
    text = "time without a command, s, until --on-timeout applies (0.5) or a lockstep run ends (10)"
    option("--timeout", type=float, metavar="S", help=text)
    text = "at the time-out, hold the last command, or ramp efforts to 0 (hold for targets, ramp for efforts)"
    option("--on-timeout", choices=("hold", "ramp"), help=text)
    flag("--clock", help="publish /clock, and subscribe to /pause and /step")
    option("--speed", type=float, metavar="FACTOR", help="simulated seconds per second (1; in lockstep no limit)")
    add_options(publish, *OF_A_RUN)
    publish.set_defaults(storage=None)


def call(options: argparse.Namespace) -> int:
    from ..ros.messages import has_sensors
    from ..ros.network import network_of_environment
    from ..ros.realtime import PublisherOptions, publish_together
    from ..simulation.pace import RealTime

    if not 0.0 < options.rate < math.inf:
        raise CommandLineError(f"--rate {options.rate:g}: not a number of steps a second")
    of_a_bag = ("--overwrite", "--fsync", "--storage", "--meshes")
    of_foxglove = dict.fromkeys(("--foxglove-port", "--foxglove-control"), "--foxglove")
    check_company(options, needs={**dict.fromkeys(of_a_bag, "-o"), **of_foxglove})
    options.storage = options.storage or "mcap"
    robots = _robots(options)
    measured = any(map(has_sensors, robots.values())) and all(run.fmu.vector("q_meas") for run in robots.values())
    bag = bag_of(options, options.output, measured=measured) if options.output else None
    bags = {}
    if bag is not None:  # each robot has a part of the bag, in its namespace
        space = options.namespace
        bags = {name: bag.of(f"{space}/{name}") if name else bag for name in robots}
    viewers = [_foxglove(options)] if options.foxglove else []
    sinks = {name: [*viewers, *filter(None, [bags.get(name)])] for name in robots}
    publisher = given_options(options, "clock", "namespace", *PublisherOptions.__optional_keys__ - {"opened"})
    publisher["network"] = network_of_environment(subnet=options.subnet)
    if not options.json:
        publisher["opened"] = partial(_print_network, options.stop_time)
    speed = 1.0 if options.speed is None and not options.lockstep else options.speed
    pace = None if speed is None else RealTime(speed)
    with asked_to_stop() as asked:
        summaries = publish_together(robots, sinks=sinks, pace=pace, stop=asked, **publisher)
    if options.json:
        facts = {name: facts_of(robots[name], bags.get(name), summary, pace) for name, summary in summaries.items()}
        print_json(**facts.get("", facts))
    else:
        for name, summary in summaries.items():
            print_summary(options, robots[name], bags.get(name), summary, pace)
        if bag is not None:
            print_next(f"twodof plot {quote(bag.path)}", f"ros2 bag play {quote(bag.path)}")
    return INTERRUPTED if any(summary.stopped for summary in summaries.values()) else 0


def _robots(options: argparse.Namespace) -> dict[str, Experiment]:
    """Return the FMUs by namespace; a single FMU needs no namespace."""
    from ..export.fmu_options import identifier
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
            raise CommandLineError(f"two robots are named '{name}'; give one another name, NAME={options.fmu}")
        run = robots[name] = experiment_of(options, stop_time, 1.0 / options.rate)
        fmus = [robot.fmu for robot in robots.values() if robot.fmu.path == run.fmu.path]
        if any(fmu.members != run.fmu.members for fmu in fmus):
            reason = f"would be '{run.fmu.path}' as the robot before it is; rename a URDF"
            raise CommandLineError(f"the FMU of '{options.fmu}' {reason}")
    if options.foxglove and "" not in robots:
        raise CommandLineError("--foxglove serves one robot")
    return robots


def _foxglove(options: argparse.Namespace) -> Foxglove:
    from ..pages.foxglove import Foxglove

    def tell(server: Foxglove) -> None:
        say(f"open  Foxglove, Open connection, Foxglove WebSocket: {server.url}")

    port = {} if options.foxglove_port is None else {"port": options.foxglove_port}
    return Foxglove(**port, scene=options.scene, effort=options.effort, set_gains=options.foxglove_control, opened=tell)


def _print_network(stop_time: float | None, publisher: Publisher) -> None:
    network = publisher.network
    print_table(
        ("topics", ", ".join(publisher.topics)),
        ("network", f"DDS domain {network.domain} on {publisher.interface}, {in_options(network.reach)}"),
        ("commands", f"from {', '.join(publisher.commands)}" if publisher.commands else "none"),
        ("end", "Ctrl-C" if stop_time is None else f"after {stop_time:g} s, or Ctrl-C"),
    )
    print_next(f"ros2 topic echo {publisher.topics[0]}")
