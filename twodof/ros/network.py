"""ROS 2 network settings from environment variables, the DDS domain, and DDS types of serialised messages.

The variables are those of rcl and rmw_cyclonedds of Jazzy. Names, types and qualities of service are those of ROS 2
(type hashes of REP 2011). Therefore ROS 2's tools treat the run like any node.
"""

import ctypes
import functools
import logging
import os
import re
import socket
import stat
import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from ipaddress import ip_address
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

from rosbags.interfaces import Nodetype, Qos, QosDurability

from ..errors import PublishError
from ..files import temporary_folder
from ..version import needing
from .messages import store_of

with needing(PublishError, "publish", "ros"):
    from cyclonedds import core, domain, idl, qos, topic

LOG = logging.getLogger(__name__)
RANGES = ("LOCALHOST", "SUBNET", "OFF", "SYSTEM_DEFAULT")
LAST_DOMAIN = 232  # ports of larger domains would exceed 65535
LOOPBACK = {"lo": "127.0.0.1"}  # not localhost: Cyclone DDS aborts where no /etc/hosts resolves it
MOST_PARTICIPANTS = 32  # participants of one host that are searched, as in rmw_cyclonedds
NO_NETWORK = "<CycloneDDS><Domain><General><Transport>none</Transport></General></Domain></CycloneDDS>"
OPEN = """
import sys
from contextlib import suppress
sys.path[:] = sys.argv[3:]
with suppress(Exception):
    from cyclonedds.domain import Domain
    Domain(int(sys.argv[1]), sys.argv[2])
"""
ANNOUNCED = 1  # s between two announcements to participants of this host
SO_ATTACH_FILTER = 26  # on Linux, for all supported architectures
INTERFACE, SOURCE = 0xFFFFF008, 0xFFF0000C  # packet filter: offsets of interface and IPv4 source
LOAD, EQUAL, ACCEPT = 0x20, 0x15, 0x06  # instructions of a packet filter


class Network(NamedTuple):
    """Network settings of a publisher.

    Attributes:
        domain: ROS_DOMAIN_ID.
        range: discovery range, ROS_AUTOMATIC_DISCOVERY_RANGE.
        peers: other hosts to which the run is announced, ROS_STATIC_PEERS.
        loopback: use the loopback interface only, ROS_LOCALHOST_ONLY.
        custom: Cyclone DDS configuration that overrides ours, CYCLONEDDS_URI.
    """

    domain: int = 0
    range: str = "LOCALHOST"
    peers: tuple[str, ...] = ()
    loopback: bool = False
    custom: str = ""

    @property
    def reach(self) -> str:
        """Hosts that can receive, in words."""
        if self.loopback:
            return "loopback only (ROS_LOCALHOST_ONLY)"
        hosts = f"this host and {', '.join(self.peers)}" if self.peers else "this host only"
        words = {"LOCALHOST": f"{hosts}; `subnet=True` opens it", "OFF": "nobody"}
        return f"range {self.range} ({words.get(self.range, 'other hosts too')})"

    @contextmanager
    def guarded(self) -> Iterator[None]:
        """Limit the sockets that Cyclone DDS opens in this context to the hosts of ``reach``.

        Cyclone DDS listens on all addresses, whatever its interfaces, and answers any host that finds its ports.
        Therefore a kernel filter drops packets unless they come over the loopback interface, as all packets of this
        host do, or from a peer. Cyclone DDS sends only to hosts from which it has received packets.
        """
        before = _sockets()
        yield
        if self.range not in ("LOCALHOST", "OFF") and not self.loopback:
            return
        allowed = [] if self.range == "OFF" else [(INTERFACE, socket.if_nametoindex("lo"))]
        for peer in self.peers if self.range == "LOCALHOST" else ():
            found = socket.getaddrinfo(peer, None, socket.AF_INET, socket.SOCK_DGRAM)
            allowed += [(SOURCE, int(ip_address(address[0]))) for *_, address in found]
        rules = [
            (code, skipped, k)
            for field, value in allowed
            for code, skipped, k in ((LOAD, 0, field), (EQUAL, 1, value), (ACCEPT, 0, 0xFFFFFFFF))
        ]
        program = b"".join(struct.pack("HBBI", c, 0, n, k) for c, n, k in (*rules, (ACCEPT, 0, 0)))
        text = ctypes.create_string_buffer(program)
        attached = struct.pack("HL", len(program) // 8, ctypes.addressof(text))
        try:
            for number in _sockets() - before:
                with socket.socket(fileno=os.dup(number)) as one:
                    one.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, attached)
        except OSError as error:
            raise PublishError(f"cannot limit the network to {self.reach}: {error.strerror}") from error

    def configuration(self, trace: str, own: Mapping[str, str] | None = None) -> str:
        """Return the configuration of Cyclone DDS, equivalent to that of rmw_cyclonedds of Jazzy.

        With LOCALHOST, discovery messages go to this host's own addresses only. There are two differences from
        rmw_cyclonedds. The messages are repeated each second, because a participant that starts later and announces
        itself by multicast only would find this one after half a minute or never. The loopback interface is used too,
        because Fast DDS uses it on its own host, and Cyclone DDS drops packets from an interface that it does not use.

        Args:
            trace: file for Cyclone DDS's log of its configuration.
            own: addresses of the interfaces to use, by interface; None: Cyclone DDS chooses.
        """
        off, localhost = self.range == "OFF", self.range == "LOCALHOST"
        general, discovery = "", ""
        if (off or localhost) and not self.loopback:  # no packet leaves loopback, and older nodes need multicast there
            general += "<AllowMulticast>false</AllowMulticast>"
        if own:
            named = "".join(f"<NetworkInterface name={quoteattr(name)}/>" for name in own)
            general += f"<Interfaces>{named}</Interfaces>"
        if off:
            discovery = "<ParticipantIndex>none</ParticipantIndex>"  # random ports
        elif self.range != "SYSTEM_DEFAULT":
            discovery = (
                "<ParticipantIndex>auto</ParticipantIndex>"
                f"<MaxAutoParticipantIndex>{MOST_PARTICIPANTS}</MaxAutoParticipantIndex>"
            )
            peers = "".join(f"<Peer Address={quoteattr(peer)}/>" for peer in self.peers)
            if localhost:
                discovery += f"<SPDPInterval>{ANNOUNCED} s</SPDPInterval>"
                for address in (own or LOOPBACK).values():
                    peers += f'<Peer Address="{address}" PruneDelay="inf"/>'
            discovery += f"<Peers>{peers}</Peers>"
        tracing = f"<Category>config</Category><OutputFile>{trace}</OutputFile>"
        return (
            f"<CycloneDDS><Domain><General>{general}</General><Discovery>{discovery}</Discovery>"
            f"<Tracing>{tracing}</Tracing></Domain></CycloneDDS>,{self.custom}"
        )


def network_of_environment(variables: Mapping[str, str] = os.environ, *, subnet: bool = False) -> Network:
    """Return the network that ROS 2's environment variables select.

    The default range is LOCALHOST, not SUBNET as in ROS 2: nothing leaves the host without permission.

    With ``subnet``, the range is SUBNET, whatever the variables of the range are.
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
        raise PublishError(f"ROS_AUTOMATIC_DISCOVERY_RANGE is '{reach}', not one of {', '.join(RANGES)}")
    return Network(int(number), reach, _peers(variables), custom=custom)


def _sockets() -> set[int]:
    """Return file descriptors of this process that are internet sockets."""
    found = set()
    for name in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # closed meanwhile
            if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                with socket.socket(fileno=os.dup(int(name))) as one:
                    if one.family in (socket.AF_INET, socket.AF_INET6):
                        found.add(int(name))
    return found


def _peers(variables: Mapping[str, str]) -> tuple[str, ...]:
    peers = tuple(filter(None, variables.get("ROS_STATIC_PEERS", "").split(";")))
    for peer in peers:
        try:
            socket.getaddrinfo(peer, None, socket.AF_INET)  # otherwise Cyclone DDS would end the process
        except (OSError, UnicodeError) as error:
            raise PublishError(f"ROS_STATIC_PEERS: '{peer}' is not found as an IPv4 host: {error}") from error
    return peers


class OpenDomain(NamedTuple):
    """A DDS domain that closes with its last reference; several publishers may share it.

    ``interface`` has the names of the network interfaces in use.
    """

    network: Network
    interface: str
    handle: domain.Domain


def open_domain(network: Network) -> OpenDomain:
    """Open the DDS domain of a network; PublishError: Cyclone DDS cannot open it, with its reason."""
    own = LOOPBACK if network.loopback else None
    opened, used, messages = _try_to_open(network, own)
    if opened and network.range == "LOCALHOST" and not used.keys() & LOOPBACK:
        del opened  # closes the domain
        opened, both, messages = _try_to_open(network, {**used, **LOOPBACK})
        if opened:
            used = both
        else:  # CYCLONEDDS_URI names interfaces, which must not be named again
            opened, used, messages = _try_to_open(network, own)
    interfaces = ", ".join(used) or "an interface of CYCLONEDDS_URI"
    if opened is None and "failed to find interfaces" in messages:
        LOG.warning("there is no network interface: no other program can receive the run")
        interfaces = "no interface"
        opened = domain.Domain(network.domain, NO_NETWORK)
    elif opened is None:
        names = ", ".join(name for _, name in socket.if_nameindex())
        blame = f"; correct CYCLONEDDS_URI (interfaces here: {names})" if network.custom else ""
        raise PublishError(f"DDS domain {network.domain} cannot be opened: {messages}{blame}")
    elif messages:
        LOG.warning("Cyclone DDS: %s", messages)
    return OpenDomain(network, interfaces, opened)


def _try_to_open(network: Network, own: Mapping[str, str] | None) -> tuple[domain.Domain | None, dict[str, str], str]:
    """Return a domain or None, the addresses of the interfaces in use by name, and the error.

    Cyclone DDS reports interfaces only in its trace, and the reason for a failure only on the standard error.
    """
    with temporary_folder() as folder:
        trace, errors = folder / "trace", folder / "errors"
        trace.touch()
        sys.stderr.flush()
        kept = os.dup(2)
        try:
            with errors.open("wb") as file:
                os.dup2(file.fileno(), 2)
            configuration = network.configuration(str(trace), own)
            aborts = bool(network.custom) and _aborts(network.domain, configuration)
            with network.guarded():
                opened = None if aborts else domain.Domain(network.domain, configuration)
        except (core.DDSException, UnicodeEncodeError):
            opened = None
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        account = trace.read_text("utf-8", "replace")
        lines = errors.read_text("utf-8", "replace").splitlines()
    present = dict(re.findall(r"(\S+) udp/([\d.]+)", "".join(re.findall(": interfaces: .*", account))))
    chosen = re.findall(r"(\S+) \(index", "".join(re.findall("selected interfaces: .*", account)))
    # each line of an error begins with time, domain and program
    messages = dict.fromkeys(re.sub(r"^[\d.]+ \[\d*\] +\S+: ", "", line) for line in lines)
    return opened, {name: present.get(name, LOOPBACK["lo"]) for name in chosen}, "; ".join(messages)


def _aborts(number: int, configuration: str) -> bool:
    """Return whether Cyclone DDS aborts the process that opens this domain, as for addresses of another family."""
    command = [sys.executable, "-I", "-c", OPEN, str(number), configuration, *sys.path]
    return subprocess.run(command, stdin=subprocess.DEVNULL, check=False).returncode < 0


def _keep(self: Any, cdr: bytes) -> None:
    self.cdr = cdr


SERIALISED = {
    "__init__": _keep,
    "serialize": lambda self, **_options: self.cdr,
    "deserialize": classmethod(lambda cls, cdr: cls(cdr)),
    "deserialize_key": classmethod(lambda cls, _key: None),  # a sample without data: a writer has left
}
"""Methods of every DDS type; they pass messages that rosbags has serialised."""


@functools.cache
def dds_type(name: str) -> type:
    """Return the DDS type of a ROS 2 message type, named as rosidl_generator_dds_idl names it."""
    package, _, kind = name.split("/")
    fields = {f"{field}_": _field_type(*of) for field, of in store_of(name).fielddefs[name][1]}
    struct: type = idl.make_idl_struct(f"{kind}_", f"{package}.msg.dds_.{kind}_", fields, dataclassify=False)
    for name, method in SERIALISED.items():  # not a base class, which would be part of the type
        setattr(struct, name, method)
    return struct


def _field_type(node: Nodetype, of: Any) -> Any:
    if node is Nodetype.NAME:
        return dds_type(of)
    if node is Nodetype.SEQUENCE:
        return idl.types.sequence[_field_type(*of[0])]
    return {"string": str, "bool": bool}.get(of[0]) or getattr(idl.types, of[0])


def dds_qos(offered: Qos, type_name: str) -> qos.Qos:
    """Return the quality of service of a writer or reader.

    A write never waits for a reader; a slow reader misses messages.
    """
    latched = offered.durability is QosDurability.TRANSIENT_LOCAL
    return qos.Qos(
        qos.Policy.Reliability.Reliable(max_blocking_time=0),
        qos.Policy.Durability.TransientLocal if latched else qos.Policy.Durability.Volatile,
        qos.Policy.History.KeepLast(offered.depth),
        qos.Policy.DataRepresentation(use_cdrv0_representation=True),
        qos.Policy.Userdata(f"typehash={store_of(type_name).hash_rihs01(type_name)};".encode()),
    )


def dds_topic(participant: domain.DomainParticipant, name: str, type_name: str) -> topic.Topic:
    """Return a topic of ROS 2 in DDS."""
    return topic.Topic(participant, f"rt{name}", dds_type(type_name))
