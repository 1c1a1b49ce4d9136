"""Step FMUs in real time on a ROS 2 network."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, TypedDict

from ..errors import InputError
from ..fmu import Fmu
from ..signatures import ignore, never, with_keywords_of
from ..simulation.experiments import Experiment, ExperimentOptions, experiment
from ..simulation.master import Member, Steer, simulate, simulate_together
from ..simulation.pace import RealTime
from ..simulation.run_summary import Summary
from ..simulation.sample import Sink
from ..simulation.stepping import as_experiment
from .messages import check_name
from .network import Network, network_of_environment, open_domain
from .publisher import Publisher

if TYPE_CHECKING:
    from typing_extensions import Unpack


@with_keywords_of(experiment)
def publish(
    run: Experiment | Fmu | str | Path,
    *sinks: Sink,
    publisher: Publisher | None = None,
    pace: RealTime | None = None,
    stop: Callable[[], bool] = never,
    steer: Steer = ignore,
    **options: Unpack[ExperimentOptions],
) -> Summary:
    """Step an FMU in real time on a ROS 2 network until its stop time, or until ``stop`` returns true.

    Args:
        run: an experiment, or an FMU together with options of ``experiment``; without a stop time, the run
            has no end.
        sinks: further consumers of the samples, for example a bag.
        publisher: the publisher; None: a publisher of joint states.
        pace: as in ``simulate``; None: real time, or in lockstep as fast as commands arrive.
        stop, steer: as in ``simulate``; commands from the network take precedence.

    Raises:
        FmuError, InputError, PublishError: before the first sample.
        PublishError: in lockstep no command arrived in time.
        SimulationError: the FMU refused or failed a call.
    """
    run = as_experiment(run, options, {"stop_time": inf})
    publisher = publisher or Publisher()
    if pace is None and not publisher.lockstep:
        pace = RealTime()
    return simulate(run, publisher, *sinks, pace=pace, stop=stop, steer=steer)


class PublisherOptions(TypedDict, total=False):
    """Keywords of ``Publisher`` that ``publish_together`` passes on to each publisher."""

    scene: bool
    effort: bool
    state_topic: str
    command_topic: str | None
    lockstep: bool
    timeout: float | None
    on_timeout: str | None
    opened: Callable[[Publisher], None]


@with_keywords_of(Publisher)
def publish_together(
    robots: Mapping[str, Experiment],
    *,
    sinks: Mapping[str, Sequence[Sink]] = MappingProxyType({}),
    network: Network | None = None,
    clock: bool = False,
    namespace: str = "",
    pace: RealTime | None = None,
    stop: Callable[[], bool] = never,
    **options: Unpack[PublisherOptions],
) -> dict[str, Summary]:
    """Step several FMUs in one loop on a ROS 2 network, each in its own namespace.

    Args:
        robots: experiments by namespace, with equal times; they share the first stamp. A single robot may have the
            namespace "".
        sinks: further consumers of samples, by namespace.
        network, clock, namespace, and all others: as in ``Publisher``; the robots share one clock and pause together.
        pace, stop: as in ``publish``.

    Raises:
        FmuError, InputError, PublishError, SimulationError: as ``publish``.
    """
    if pace is None and not options.get("lockstep"):
        pace = RealTime()
    if not robots:
        raise InputError("there are no robots to publish")
    for name in sinks.keys() - robots.keys():
        raise InputError(f"`sinks` names '{name}', but the robots are {', '.join(robots)}")
    if len(robots) > 1 and str(options.get("state_topic", "")).startswith("/"):
        raise InputError("several robots publish on one `state_topic`; leave out its first '/'")
    for name in robots:
        check_name("robots", name)
    shared, now, members = open_domain(network or network_of_environment()), time.time(), list[Member]()
    for name, run in robots.items():
        space = "/".join(filter(None, (namespace, name)))
        publisher = Publisher(shared, clock=clock and not members, namespace=space, **options)
        if len(robots) > 1 and run.stamp_start is None:
            run = replace(run, stamp_start=now)
        members.append(Member(run, (publisher, *sinks.get(name, ()))))
    return dict(zip(robots, simulate_together(members, pace=pace, stop=stop)))
