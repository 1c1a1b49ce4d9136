"""Receive commands, their senders, and requests to pause from a ROS 2 network."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TypeVar

from ..simulation.experiments import NANOSECONDS, Experiment
from ..simulation.pace import RealTime
from ..simulation.sample import Sample
from .commands import LONGEST_NAME, Command, CommandError, Commands, deserialise, warner
from .messages import JOINT_STATE, POINT, POSE, STREAM
from .network import dds_qos, dds_topic

# isort: split
from cyclonedds import builtin, core, domain, sub  # network raises if it is missing

LOG = logging.getLogger(__name__)
ORDERS = {"/pause": "std_msgs/msg/Bool", "/step": "std_msgs/msg/UInt32"}
LOOK = 100_000_000  # ns between two checks of `stop`
UNREAD = core.SampleState.NotRead | core.ViewState.Any | core.InstanceState.Any
WHAT = {JOINT_STATE: "a command", POINT: "a point", POSE: "a pose"}
Read = TypeVar("Read")
MOST_COMMANDERS = 20  # recorded nodes
MOST_READ = 10_000  # nodes or writers of the network, past ones included
AT_ONCE = 1.0  # s within which commands of two nodes conflict
PROPERTIES = {
    "host": ("__Hostname", "fastdds.physical_data.host"),
    "process": ("__ProcessName", "fastdds.physical_data.process"),
}
"""Facts of a participant, and their names in Cyclone DDS and Fast DDS."""


class Commanders:
    """Recorder of the nodes that command the robot, in its experiment, with a warning of conflicts."""

    def __init__(self, participant: domain.DomainParticipant, run: Experiment) -> None:
        # readers that keep what they have received, because a node may leave before its command is read
        self._participants = builtin.BuiltinDataReader(participant, builtin.BuiltinTopicDcpsParticipant)
        self._writers = builtin.BuiltinDataReader(participant, builtin.BuiltinTopicDcpsPublication)
        self._run, self._names = run, dict[int, str]()
        self._latest, self._since = "", 0.0
        self._warn = warner(LOG)

    def note(self, writer: int, t: float) -> None:
        """Register the writer of a command, by its handle, at a time of the run, s."""
        if writer not in self._names:
            self._names[writer] = self._record(writer, t)
        name, now = self._names[writer], time.monotonic()
        if self._latest not in ("", name) and now - self._since < AT_ONCE:
            both = f"{self._latest} and {name}"
            self._warn("two", f"two nodes command the robot at once, {both}: the newest wins")
        self._latest, self._since = name, now

    def _record(self, writer: int, t: float) -> str:
        """Return the GUID of a writer's participant, and record its host and process."""
        endpoint = next(
            (one for one in self._writers.read(MOST_READ) if one.sample_info.instance_handle == writer), None
        )
        if endpoint is None:
            return f"writer {writer:x}"
        facts = {"guid": str(endpoint.participant_key)}
        for one in self._participants.read(MOST_READ):
            if one.key == endpoint.participant_key and one.qos is not None:
                properties = {p.key: p.value for p in one.qos if isinstance(p, core.Policy.Property)}
                names = ((fact, key) for fact, keys in PROPERTIES.items() for key in keys)
                facts |= {fact: properties[key][:LONGEST_NAME] for fact, key in names if key in properties}
        known = [fact for _, fact in self._run.commanders]
        if facts not in known and len(known) < MOST_COMMANDERS:
            self._run.commanders.append((t, facts))
        return facts["guid"]


class Listener:
    """Readers of commands, and of requests to pause and to step.

    Args:
        received: topics and types of commands.
        orders: receive /pause and /step.
        oldest: largest age of a joint command's stamp relative to the sample, s; None: any age.
    """

    def __init__(
        self,
        participant: domain.DomainParticipant,
        follows: Commands,
        received: Mapping[str, str],
        *,
        orders: bool,
        oldest: float | None,
        run: Experiment,
    ) -> None:
        self._commanders = Commanders(participant, run)
        self._follows, self._topics, self._oldest = follows, received, oldest
        self._readers = {
            name: sub.DataReader(participant, dds_topic(participant, name, kind), dds_qos(STREAM, kind))
            for name, kind in {**received, **(ORDERS if orders else {})}.items()
        }
        self._news = core.WaitSet(participant)
        for reader in self._readers.values():
            self._news.attach(core.ReadCondition(reader, UNREAD))
        self._orders, self._paused, self._steps = orders, False, 0
        self._warn = warner(LOG)

    def wait(self) -> bool:
        """Wait until data has arrived, or briefly; return whether it has."""
        return bool(self._news.wait(LOOK))

    def is_matched(self, name: str) -> bool:
        """Return whether a topic has a publisher."""
        return bool(self._readers[name].get_matched_publications())

    def commands(self, sample: Sample) -> Iterator[Command]:
        """Yield received commands; log one warning for each kind of invalid message."""
        for name, kind in self._topics.items():

            def read(cdr: bytes, kind: str = kind) -> Command:
                command = self._follows.read(kind, cdr)
                late = (sample.stamp - command.stamp) / NANOSECONDS
                if kind == JOINT_STATE and self._oldest and command.stamp and late > self._oldest:
                    raise CommandError("stamp", f"has a stamp {late:.3g} s older than its sample")
                return command

            for command, writer in self._come(name, read, WHAT[kind]):
                self._commanders.note(writer, sample.t)
                if command.unknown_joints:
                    reason = f"a command on {name} names joints that this robot does not have"
                    names = ", ".join(command.unknown_joints)[:LONGEST_NAME]
                    self._warn("unknown_joints", f"{reason}, {names!r}: they are left out")
                yield command

    def await_go(self, stop: Callable[[], bool], pace: RealTime | None) -> None:
        """Wait while the run is paused, except for requested steps, until ``stop`` returns True; restart the pace."""
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
            for order, _ in self._come(name, partial(deserialise, kind), "an order"):
                if name == "/pause":
                    self._paused, self._steps = bool(order.data), 0
                else:
                    self._steps += order.data

    def _come(self, name: str, read: Callable[[bytes], Read], what: str) -> Iterator[tuple[Read, int]]:
        """Yield the latest messages of a topic, decoded by ``read``, and their writers."""
        for message in self._readers[name].take(STREAM.depth):
            if message.sample_info.valid_data:
                try:
                    yield read(message.cdr), message.sample_info.publication_handle
                except CommandError as error:
                    self._warn(error.kind, f"{what} on {name} {error}: ignored")
