"""What is heard on a ROS 2 network: commands, and whether the run is paused."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, TypeVar

from ..simulation.experiments import NANOSECONDS
from ..simulation.pace import RealTime
from ..simulation.sample import Sample
from .commands import LONGEST_NAME, Command, CommandError, Commands, deserialise, warner
from .dds import dds_qos, dds_topic
from .messages import JOINT_STATE, POINT, POSE, STREAM

# isort: split
from cyclonedds import core, sub  # where missing, dds says so

LOG = logging.getLogger(__name__)
ORDERS = {"/pause": "std_msgs/msg/Bool", "/step": "std_msgs/msg/UInt32"}
LOOK = 100_000_000  # ns after which it is asked whether to go on
UNREAD = core.SampleState.NotRead | core.ViewState.Any | core.InstanceState.Any
WHAT = {JOINT_STATE: "a command", POINT: "a point", POSE: "a pose"}
Read = TypeVar("Read")


class Listener:
    """Readers of commands, and of orders to pause and to step.

    Args:
        participant: of the DDS domain.
        follows: what messages ask of the FMU.
        heard: topics and types of commands.
        orders: hear /pause and /step.
        oldest: s before a sample that joint commands for it may be stamped; None: any time.
    """

    def __init__(
        self, participant: Any, follows: Commands, heard: Mapping[str, str], *,
        orders: bool, oldest: float | None,
    ) -> None:  # fmt: skip
        self._follows, self._heard, self._oldest = follows, heard, oldest
        self._readers = {
            name: sub.DataReader(
                participant, dds_topic(participant, name, kind), dds_qos(STREAM, kind)
            )
            for name, kind in {**heard, **(ORDERS if orders else {})}.items()
        }
        self._news = core.WaitSet(participant)
        for reader in self._readers.values():
            self._news.attach(core.ReadCondition(reader, UNREAD))
        self._orders, self._paused, self._steps = orders, False, 0
        self._warn = warner(LOG)

    def wait(self) -> bool:
        """Wait until something has come, or a while; whether it has."""
        return bool(self._news.wait(LOOK))

    def is_matched(self, name: str) -> bool:
        """Whether somebody publishes on a topic."""
        return bool(self._readers[name].get_matched_publications())

    def commands(self, sample: Sample) -> Iterator[Command]:
        """Commands that have come; what is none is ignored with a warning a kind."""
        for name, kind in self._heard.items():

            def read(cdr: bytes, kind: str = kind) -> Command:
                command = self._follows.read(kind, cdr)
                late = (sample.stamp - command.stamp) / NANOSECONDS
                if kind == JOINT_STATE and self._oldest and command.stamp and late > self._oldest:
                    text = f"is stamped {late:.3g} s before the sample that it is for"
                    raise CommandError("stamp", text)
                return command

            for command in self._come(name, read, WHAT[kind]):
                if command.strangers:
                    reason = f"a command on {name} is of joints that this robot has not"
                    names = ", ".join(command.strangers)[:LONGEST_NAME]
                    self._warn("strangers", f"{reason}, {names!r}: they are left out")
                yield command

    def await_go(self, stop: Callable[[], bool], pace: RealTime | None) -> None:
        """Wait while the run is paused, but for the steps that are asked for.

        Args:
            stop: asked while it waits; True ends that.
            pace: begins anew after it.
        """
        if not self._orders:
            return
        self._take_orders()
        while self._paused and not self._steps and not stop():
            self.wait()
            self._take_orders()
            if pace is not None:
                pace.restart()
        self._steps -= min(1, self._steps)

    def _take_orders(self) -> None:
        for name, kind in ORDERS.items():
            for order in self._come(name, partial(deserialise, kind), "an order"):
                if name == "/pause":
                    self._paused, self._steps = bool(order.data), 0
                else:
                    self._steps += order.data

    def _come(self, name: str, read: Callable[[bytes], Read], what: str) -> Iterator[Read]:
        """What has come on a topic, the last few at most, as it is read."""
        for message in self._readers[name].take(STREAM.depth):
            if message.sample_info.valid_data:
                try:
                    yield read(message.cdr)
                except CommandError as error:
                    self._warn(error.kind, f"{what} on {name} {error}: ignored")
