"""A run on a ROS 2 network: the messages of the bag over DDS, and targets that others ask for.

Names, types and qualities of service are those of ROS 2 (REP 2011's type hashes, rmw_cyclonedds of
Jazzy), so that its tools see the run as they see any node's.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Mapping
from math import inf, isfinite
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype, Qos, QosDurability

from ..errors import PublishError, SimulationError
from ..experiments import Experiment, Setting, experiment
from ..fmu import Fmu
from ..master import RealTime, Sample, Sink, Summary, at_rest, simulate
from .cdr import Rows
from .messages import POINT, POSE, STORE, STREAM, Messages
from .network import Network, network, open_domain

# isort: split
from cyclonedds import core, domain, idl, pub, qos, sub, topic  # where missing, network says so

LOG = logging.getLogger(__name__)
COMMANDS = ("/target_command", "/clicked_point")
LONGEST_NAME = 80  # of a frame, that is told


class Carrier:
    """What every DDS type does with its messages: carry them serialised.

    What the bytes mean is rosbags' business.
    """

    def __init__(self, cdr: bytes) -> None:
        self.cdr = cdr

    def serialize(self, **_options: object) -> bytes:
        """The bytes, as Cyclone DDS asks for them."""
        return bytes(self.cdr)

    @classmethod
    def deserialize(cls, cdr: bytes) -> Carrier:
        """A message that has come."""
        return cls(cdr)

    @classmethod
    def deserialize_key(cls, _key: bytes) -> None:
        """A notice without a message, that a writer has left."""


@functools.cache
def dds_type(name: str) -> Any:
    """The DDS type of a ROS 2 message type, with the names that rosidl_generator_dds_idl gives."""
    package, _, kind = name.split("/")
    fields = {f"{field}_": _field_type(*of) for field, of in STORE.fielddefs[name][1]}
    struct = idl.make_idl_struct(
        f"{kind}_", f"{package}.msg.dds_.{kind}_", fields, dataclassify=False
    )
    for method in ("__init__", "serialize", "deserialize", "deserialize_key"):
        setattr(struct, method, vars(Carrier)[method])  # a base would be part of the type
    return struct


def _field_type(node: Nodetype, of: Any) -> Any:
    if node is Nodetype.NAME:
        return dds_type(of)
    if node is Nodetype.SEQUENCE:
        return idl.types.sequence[_field_type(*of[0])]
    return str if of[0] == "string" else getattr(idl.types, of[0])


def dds_qos(offered: Qos, type_name: str) -> Any:
    """Quality of service of a writer or reader.

    A write never waits for a reader: one that does not keep up misses messages.
    """
    latched = offered.durability is QosDurability.TRANSIENT_LOCAL
    return qos.Qos(
        qos.Policy.Reliability.Reliable(max_blocking_time=0),
        qos.Policy.Durability.TransientLocal if latched else qos.Policy.Durability.Volatile,
        qos.Policy.History.KeepLast(offered.depth),
        qos.Policy.DataRepresentation(use_cdrv0_representation=True),
        qos.Policy.Userdata(f"typehash={STORE.hash_rihs01(type_name)};".encode()),
    )


class Publisher(Sink):
    """A sink that publishes each sample, and hears of targets.

    Args:
        place: the network; None: what the environment asks for.
        scene: also the robot description, transforms, target and end effector.
        effort: put the control effort into JointState.effort.
        opened: told when the network is open.

    Attributes:
        place: the network.
        interface: names of the network interfaces in use, known when it is open.
        topics: what is published.
        commands: the topics on which targets are heard of; none where the FMU has no inputs
            x_des[k], or does not say which axes of which frame they are. Known when it has begun.

    Raises:
        PublishError: the network cannot be used as asked for.
    """

    def __init__(
        self,
        place: Network | None = None,
        *,
        scene: bool = False,
        effort: bool = False,
        opened: Callable[[Publisher], None] = lambda publisher: None,
    ) -> None:
        self._opened = opened
        self.place = network() if place is None else place
        self.interface = ""
        self._scene, self._effort = scene, effort
        self._begun = False
        self._warned: set[str] = set()

    def begin(self, run: Experiment) -> Publisher:
        """Take the experiment whose samples come.

        Raises:
            BagError: the FMU has not what is asked for.
        """
        self._fmu, self._axes, self._root = run.fmu, run.fmu.axes, run.fmu.root
        self._messages = Messages(run, scene=self._scene, effort=self._effort)
        self.topics = tuple(self._messages.topics)
        self.commands = COMMANDS if self._axes and run.fmu.vector("x_des") else ()
        turns = bool(run.fmu.vector("quat_des"))
        self._heard = dict(zip(self.commands, (POSE if turns else POINT, POINT)))
        return self

    def __enter__(self) -> Publisher:
        self._domain, self.interface = open_domain(self.place)
        try:
            self._participant = domain.DomainParticipant(self.place.domain)
            self._writers = {
                name: pub.DataWriter(
                    self._participant, self._topic(name, said.type), dds_qos(said.qos, said.type)
                )
                for name, said in self._messages.topics.items()
            }
            self._readers = [
                sub.DataReader(self._participant, self._topic(name, kind), dds_qos(STREAM, kind))
                for name, kind in self._heard.items()
            ]
        except core.DDSException as error:
            raise PublishError(f"DDS domain {self.place.domain} fails: {error}") from error
        self._opened(self)
        return self

    def _topic(self, name: str, type_name: str) -> Any:
        return topic.Topic(self._participant, f"rt{name}", dds_type(type_name))

    def write(self, sample: Sample) -> None:
        """Publish one sample: one JointState, and the scene's messages."""
        if not self._begun:
            self._begun = True
            self._publish(self._messages.latched(sample.stamp))
        self._publish(self._messages.of(self._messages.numbers(sample))[1])

    def _publish(self, messages: Mapping[str, Rows]) -> None:
        for name, rows in messages.items():
            writer = self._writers[name]
            try:
                writer.write(writer.data_type(rows.tobytes()))
            except core.DDSException as error:
                self._warn_once(name, f"messages on {name} are lost: {error}")

    def command(self) -> dict[str, tuple[float, ...]] | None:
        """The target that was asked for since the last call, as inputs of the FMU, if one was.

        Points and poses are in the frame of the robot's root, which an empty frame_id means too.
        One in another frame, or whose numbers are not finite or no orientation, is ignored.
        """
        target: dict[str, tuple[float, ...]] = {}
        for (name, kind), reader in zip(self._heard.items(), self._readers):
            for message in reader.take(STREAM.depth):
                if message.sample_info.valid_data:
                    target |= self._target(name, kind, message.cdr)
        return target or None

    def resume(self, sample: Sample, error: SimulationError) -> Mapping[str, Setting] | None:
        """What a run goes on with where a step was discarded: who asks for targets ends no run."""
        rest = at_rest(self._fmu, sample) if self.commands else None
        if rest is not None:
            self._warn_once("rest", f"{error}: the robot is stopped, and its target is where it is")
        return rest

    def _target(self, name: str, kind: str, cdr: bytes) -> dict[str, tuple[float, ...]]:
        """What a message asks for, as inputs of the FMU; nothing where it is ignored."""
        what = "a pose" if kind == POSE else "a point"
        try:
            message: Any = STORE.deserialize_cdr(cdr, kind)
        except Exception as error:  # the bytes are anybody's
            self._warn_once("bytes", f"{what} on {name} cannot be read ({error}): ignored")
            return {}
        frame = message.header.frame_id
        point = message.pose.position if kind == POSE else message.point
        turn = message.pose.orientation if kind == POSE else None
        quat = () if turn is None else (turn.x, turn.y, turn.z, turn.w)
        if frame not in ("", self._root):
            told = f"{frame[:LONGEST_NAME]!r}, not in '{self._root}'"
            self._warn_once("frame", f"{what} on {name} is in frame {told}: ignored")
            return {}
        if not all(map(isfinite, (point.x, point.y, point.z, *quat))):
            self._warn_once("finite", f"{what} on {name} is not finite: ignored")
            return {}
        if quat and not any(quat):
            self._warn_once("turn", f"{what} on {name} has the orientation 0, 0, 0, 0: ignored")
            return {}
        place = {"x_des": tuple(getattr(point, axis) for axis in self._axes)}
        return place | ({"quat_des": quat} if quat else {})

    def _warn_once(self, kind: str, text: str) -> None:
        if kind not in self._warned:
            self._warned.add(kind)
            LOG.warning("%s; there may be more like it", text)

    def __exit__(self, *exception: object) -> None:
        # entities are deleted with their last reference, writers after waiting for readers
        del self._readers, self._writers, self._participant, self._domain


def publish(
    run: Experiment | Fmu | str | Path,
    *sinks: Sink,
    place: Network | None = None,
    scene: bool = False,
    effort: bool = False,
    opened: Callable[[Publisher], None] = lambda publisher: None,
    pace: RealTime | None = None,
    stop: Callable[[], bool] = lambda: False,
    **options: Any,
) -> Summary:
    """Step an FMU in real time on a ROS 2 network, until it is asked to stop.

    Args:
        run: an experiment, or an FMU for which ``options`` are those of ``experiment``; without
            a stop time it has no end.
        sinks: what consumes the samples too, a bag for instance.
        place, scene, effort, opened: as of ``Publisher``.
        pace, stop: as of ``simulate``.

    Raises:
        FmuError, InputError, PublishError: before the first sample.
        SimulationError: the FMU refused or failed a call.
    """
    if not isinstance(run, Experiment):
        run = experiment(run, **{"stop_time": inf, **options})
    wire = Publisher(place, scene=scene, effort=effort, opened=opened)
    return simulate(
        run, wire, *sinks, pace=pace or RealTime(), stop=stop, steer=wire.command,
        resume=wire.resume,
    )  # fmt: skip
