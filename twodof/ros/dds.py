"""DDS types and topics for serialised messages, under ROS 2's type names.

Names, types and qualities of service are those of ROS 2 (type hashes of REP 2011, rmw_cyclonedds of Jazzy). Therefore
ROS 2's tools treat the run like any node.
"""

import functools
from typing import Any

from rosbags.interfaces import Nodetype, Qos, QosDurability

from ..errors import PublishError
from ..version import needing
from .messages import store_of

with needing(PublishError, "publish", "ros"):
    from cyclonedds import domain, idl, qos, topic


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
