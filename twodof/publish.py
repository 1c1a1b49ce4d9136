"""A run on a ROS 2 network: the messages of the bag over DDS, and targets that others ask for.

Names, types, qualities of service and environment variables are those of ROS 2 (REP 2011's type
hashes, rmw_cyclonedds and rcl of Jazzy), so that its tools see the run as they see any node's.
Cyclone DDS is all here.
"""

from __future__ import annotations

import functools
import logging
import os
import re
import socket
import sys
from collections.abc import Callable, Mapping
from math import isfinite
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

from rosbags.interfaces import Nodetype, Qos, QosDurability

from .bag.messages import SCENE_TOPICS, STORE, STREAM, Messages, Serialised
from .errors import PublishError, SimulationError
from .files import temporary_folder
from .inputs import Setting
from .master import Experiment, Sample, Sink, at_rest

try:
    from cyclonedds import core, domain, idl, pub, qos, sub, topic
except ImportError as missing:
    raise PublishError(
        f"cannot publish: {missing}; install the package 'cyclonedds' (the extra 'ros')"
    ) from missing

LOG = logging.getLogger(__name__)
POINT = SCENE_TOPICS["/target"].type
COMMANDS = ("/target_command", "/clicked_point")
RANGES = ("LOCALHOST", "SUBNET", "OFF", "SYSTEM_DEFAULT")
LAST_DOMAIN = 232  # the ports of later ones are beyond 65535
LOOPBACK = {"lo": "127.0.0.1"}
LONGEST_NAME = 80  # of a frame, that is told
MOST_PARTICIPANTS = 32  # of one host, that are looked for; as rmw_cyclonedds
NO_NETWORK = (
    "<CycloneDDS><Domain><General><Transport>none</Transport></General></Domain></CycloneDDS>"
)
ANNOUNCED = 1  # s between two announcements to participants of this host


class Network(NamedTuple):
    """Where a run is published.

    Attributes:
        domain: ROS_DOMAIN_ID.
        range: how far participants look for each other, ROS_AUTOMATIC_DISCOVERY_RANGE.
        peers: other hosts that are told of us, ROS_STATIC_PEERS.
        loopback: on the loopback interface alone, ROS_LOCALHOST_ONLY.
        custom: configuration that has the last word, CYCLONEDDS_URI.
    """

    domain: int = 0
    range: str = "LOCALHOST"
    peers: tuple[str, ...] = ()
    loopback: bool = False
    custom: str = ""

    @property
    def reach(self) -> str:
        """Who can hear, in words."""
        if self.loopback:
            return "loopback alone (ROS_LOCALHOST_ONLY)"
        words = {"LOCALHOST": "this host alone; --subnet opens it", "OFF": "nobody"}
        return f"range {self.range} ({words.get(self.range, 'other hosts too')})"

    def configuration(self, trace: str, own: Mapping[str, str] | None = None) -> str:
        """What Cyclone DDS is told, as rmw_cyclonedds of Jazzy does.

        LOCALHOST looks for others by messages to this host's own addresses, and so is heard by
        nobody else. Unlike there it keeps doing so each second: a participant that starts later,
        and announces itself by multicast alone, else would find us after half a minute or never.
        And it uses the loopback interface too: Fast DDS speaks to its own host there, and Cyclone
        DDS drops what comes by an interface that it does not use.

        Args:
            trace: file for the account of what was configured.
            own: addresses by interface, those to use; None: what Cyclone DDS chooses.
        """
        off, localhost = self.range == "OFF", self.range == "LOCALHOST"
        general, discovery = "", ""
        if (off or localhost) and not self.loopback:  # which nothing leaves; older nodes need it
            general += "<AllowMulticast>false</AllowMulticast>"
        if own:
            named = "".join(f"<NetworkInterface name={quoteattr(name)}/>" for name in own)
            general += f"<Interfaces>{named}</Interfaces>"
        if off:
            discovery = "<ParticipantIndex>none</ParticipantIndex>"  # ports that nobody guesses
        elif self.range != "SYSTEM_DEFAULT":
            discovery = (
                "<ParticipantIndex>auto</ParticipantIndex>"
                f"<MaxAutoParticipantIndex>{MOST_PARTICIPANTS}</MaxAutoParticipantIndex>"
            )
            peers = "".join(f"<Peer Address={quoteattr(peer)}/>" for peer in self.peers)
            if localhost:
                discovery += f"<SPDPInterval>{ANNOUNCED} s</SPDPInterval>"
                for address in (own or {"": "localhost"}).values():
                    peers += f'<Peer Address="{address}" PruneDelay="inf"/>'
            discovery += f"<Peers>{peers}</Peers>"
        tracing = f"<Category>config</Category><OutputFile>{trace}</OutputFile>"
        return (
            f"<CycloneDDS><Domain><General>{general}</General><Discovery>{discovery}</Discovery>"
            f"<Tracing>{tracing}</Tracing></Domain></CycloneDDS>,{self.custom}"
        )


def network(variables: Mapping[str, str] = os.environ, *, subnet: bool = False) -> Network:
    """The network that the environment variables of ROS 2 ask for.

    Unlike ROS 2, whose default range is SUBNET, nothing leaves the host unless asked for.

    Args:
        variables: the environment.
        subnet: range SUBNET, whatever they say.

    Raises:
        PublishError: naming the variable that is at fault.
    """
    number = variables.get("ROS_DOMAIN_ID") or "0"
    if not re.fullmatch("[0-9]{1,9}", number) or int(number) > LAST_DOMAIN:
        raise PublishError(f"ROS_DOMAIN_ID is '{number}', not a number from 0 to {LAST_DOMAIN}")
    custom = variables.get("CYCLONEDDS_URI", "")
    if subnet:
        return Network(int(number), "SUBNET", _peers(variables), custom=custom)
    local = variables.get("ROS_LOCALHOST_ONLY") or "0"
    if local not in ("0", "1"):
        raise PublishError(f"ROS_LOCALHOST_ONLY is '{local}', not 0 or 1")
    if local == "1":
        return Network(int(number), loopback=True, custom=custom)
    reach = variables.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or RANGES[0]
    if reach not in RANGES:
        raise PublishError(
            f"ROS_AUTOMATIC_DISCOVERY_RANGE is '{reach}', not one of {', '.join(RANGES)}"
        )
    return Network(int(number), reach, _peers(variables), custom=custom)


def _peers(variables: Mapping[str, str]) -> tuple[str, ...]:
    peers = tuple(filter(None, variables.get("ROS_STATIC_PEERS", "").split(";")))
    for peer in peers:
        try:
            socket.getaddrinfo(peer, None)  # Cyclone DDS would end the process
        except (OSError, UnicodeError) as error:
            raise PublishError(f"ROS_STATIC_PEERS: '{peer}' is not found: {error}") from error
    return peers


class Carrier:
    """What every DDS type does with its messages: carry them serialised.

    What the bytes mean is rosbags' business.
    """

    def __init__(self, cdr: Serialised) -> None:
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
    made = idl.make_idl_struct(
        f"{kind}_", f"{package}.msg.dds_.{kind}_", fields, dataclassify=False
    )
    for method in ("__init__", "serialize", "deserialize", "deserialize_key"):
        setattr(made, method, vars(Carrier)[method])  # a base would be part of the type
    return made


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


def open_domain(place: Network) -> tuple[Any, str]:
    """A DDS domain, and the names of the interfaces that it uses.

    Raises:
        PublishError: saying what Cyclone DDS says.
    """
    own = LOOPBACK if place.loopback else None
    opened, used, said = _try_to_open(place, own)
    if opened and place.range == "LOCALHOST" and not used.keys() & LOOPBACK:
        del opened  # which closes it
        opened, both, said = _try_to_open(place, {**used, **LOOPBACK})
        if opened:
            used = both
        else:  # CYCLONEDDS_URI names interfaces, and none may be named twice
            opened, used, said = _try_to_open(place, own)
    interfaces = ", ".join(used) or "an interface of CYCLONEDDS_URI"
    if opened is None and "failed to find interfaces" in said:
        LOG.warning("there is no network interface: nobody can hear what is published")
        interfaces = "no interface"
        opened = domain.Domain(place.domain, NO_NETWORK)
    elif opened is None:
        names = ", ".join(name for _, name in socket.if_nameindex())
        blame = f"; correct CYCLONEDDS_URI (interfaces here: {names})" if place.custom else ""
        raise PublishError(f"DDS domain {place.domain} cannot be opened: {said}{blame}")
    elif said:
        LOG.warning("Cyclone DDS: %s", said)
    return opened, interfaces


def _try_to_open(place: Network, own: Mapping[str, str] | None) -> tuple[Any, dict[str, str], str]:
    """A domain or None, the addresses of the interfaces in use by name, and what went wrong.

    Cyclone DDS tells interfaces in its trace, and reasons of a failure on the standard error alone.
    """
    with temporary_folder() as folder:
        trace, errors = folder / "trace", folder / "errors"
        trace.touch()
        sys.stderr.flush()
        kept = os.dup(2)
        try:
            with errors.open("wb") as file:
                os.dup2(file.fileno(), 2)
            opened = domain.Domain(place.domain, place.configuration(str(trace), own))
        except (core.DDSException, UnicodeEncodeError):
            opened = None
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        account = trace.read_text("utf-8", "replace")
        lines = errors.read_text("utf-8", "replace").splitlines()
    present = dict(
        re.findall(r"(\S+) udp/([\d.]+)", "".join(re.findall(": interfaces: .*", account)))
    )
    chosen = re.findall(r"(\S+) \(index", "".join(re.findall("selected interfaces: .*", account)))
    # each line of an error begins with time, domain and program
    said = "; ".join(re.sub(r"^[\d.]+ \[\d*\] +\S+: ", "", line) for line in lines)
    return opened, {name: present.get(name, "localhost") for name in chosen}, said


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
                sub.DataReader(self._participant, self._topic(name, POINT), dds_qos(STREAM, POINT))
                for name in self.commands
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
        self._publish(self._messages.of(sample))

    def _publish(self, messages: list[tuple[str, Serialised]]) -> None:
        for name, cdr in messages:
            writer = self._writers[name]
            try:
                writer.write(writer.data_type(cdr))
            except core.DDSException as error:
                self._warn_once(name, f"messages on {name} are lost: {error}")

    def command(self) -> dict[str, tuple[float, ...]] | None:
        """The target that was asked for since the last call, as inputs of the FMU, if one was.

        Points are in the frame of the robot's root, which an empty frame_id means too. One in
        another frame, or whose numbers are not finite, is ignored.
        """
        target = None
        for name, reader in zip(self.commands, self._readers):
            for message in reader.take(STREAM.depth):
                if message.sample_info.valid_data:
                    target = self._target(name, message.cdr) or target
        return None if target is None else {"x_des": target}

    def resume(self, sample: Sample, error: SimulationError) -> Mapping[str, Setting] | None:
        """What a run goes on with where a step was discarded: who asks for targets ends no run."""
        rest = at_rest(self._fmu, sample) if self.commands else None
        if rest is not None:
            self._warn_once("rest", f"{error}: the robot is stopped, and its target is where it is")
        return rest

    def _target(self, name: str, cdr: Serialised) -> tuple[float, ...] | None:
        try:
            message: Any = STORE.deserialize_cdr(cdr, POINT)
        except Exception as error:  # the bytes are anybody's
            self._warn_once("bytes", f"a point on {name} cannot be read ({error}): ignored")
            return None
        frame, point = message.header.frame_id, message.point
        if frame not in ("", self._root):
            told = f"{frame[:LONGEST_NAME]!r}, not in '{self._root}'"
            self._warn_once("frame", f"a point on {name} is in frame {told}: ignored")
            return None
        if not all(map(isfinite, (point.x, point.y, point.z))):
            self._warn_once("finite", f"a point on {name} is not finite: ignored")
            return None
        return tuple(getattr(point, axis) for axis in self._axes)

    def _warn_once(self, kind: str, text: str) -> None:
        if kind not in self._warned:
            self._warned.add(kind)
            LOG.warning("%s; there may be more like it", text)

    def __exit__(self, *exception: object) -> None:
        # entities are deleted with their last reference, writers after waiting for readers
        del self._readers, self._writers, self._participant, self._domain
