"""Topics of ROS 2, and of Unitree's robots, over DDS (package `cyclonedds`), without a ROS install.

It reaches Fast DDS and Cyclone DDS. Messages stay in CDR, as they came: they are decoded as those of logs.
"""

from __future__ import annotations

import re
import time
from collections.abc import Collection, Sequence
from typing import Any
from xml.sax.saxutils import quoteattr

from rosbags.interfaces import Nodetype

from amhe_cli.core.errors import ConfigError
from amhe_cli.logs.containers.raw import Batch, Connection, batch_of
from amhe_cli.logs.live.ros import RosTransport, dds_type, ros_type
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.layout import Types

#: Messages of a topic that wait for us; older ones are dropped.
_DEPTH = 1000
#: Time between two looks at what is offered [s].
_LOOK = 0.25
#: A topic that is offered for so long [s] without being matched cannot be.
_MATCHING = 2.0


class Dds(RosTransport):
    """The topics of a DDS domain.

    Args:
        topics: Topics that are wanted; None: all.
        definitions: Definitions of message types.
        domain: ROS_DOMAIN_ID.
        interface: Address of the one network interface to use; None: DDS chooses.
        peers: Addresses of other computers to look for participants on; none: by multicast.

    Raises:
        ConfigError: The package is missing, or the domain cannot be opened.
    """

    def __init__(
        self,
        topics: Collection[str] | None,
        definitions: Definitions,
        domain: int,
        interface: str | None = None,
        peers: Sequence[str] = (),
    ) -> None:
        try:
            from cyclonedds import builtin  # pyright: ignore[reportMissingImports]
            from cyclonedds.core import DDSException  # pyright: ignore[reportMissingImports]
            from cyclonedds.domain import Domain, DomainParticipant  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise ConfigError("`source=ros2` needs cyclonedds: pip install 'amhe[ros2]'") from None
        about = f"DDS domain {domain}{f' on {interface}' if interface else ''}"
        super().__init__(f"{about}, not signed", topics, definitions)
        try:
            self._opened = Domain(domain, configuration(interface, peers)) if interface or peers else None
            self._participant: Any = DomainParticipant(domain)
        except DDSException as error:
            raise ConfigError(f"`source=ros2`: {about} does not open: {error}") from None
        self._look: Any = builtin.BuiltinDataReader(self._participant, builtin.BuiltinTopicDcpsPublication)
        self._looked_at = 0.0
        self._readers: dict[str, tuple[Connection, Any]] = {}
        self._writers: dict[str, tuple[Any, Any]] = {}
        self._made: dict[str, tuple[Any, Any]] = {}
        #: Endpoint -> topic, the time since which it is offered [s], and its QoS.
        self._senders: dict[Any, tuple[str, float, str]] = {}

    def receive(self) -> list[Batch]:
        """See `Transport`."""
        if time.monotonic() - self._looked_at > _LOOK:
            self._look_around()
        found, arrival = [], time.time_ns()
        for connection, reader in self._readers.values():
            samples = [one for one in reader.take(_DEPTH) if one.sample_info.valid_data]
            sent = [max(one.sample_info.source_timestamp, 0) for one in samples]
            if samples:
                payloads = [one.cdr for one in samples]
                found.append(batch_of(connection, [arrival] * len(samples), sent, payloads))
        return found

    def announce(self, topic: str, msgtype: str) -> None:
        """See `Transport`: reliable, and kept for who comes later, which matches every subscriber."""
        from cyclonedds.core import Policy, Qos  # pyright: ignore[reportMissingImports]
        from cyclonedds.pub import DataWriter  # pyright: ignore[reportMissingImports]

        if topic in self._writers:
            return
        durable = Policy.Durability.TransientLocal
        qos = Qos(Policy.Reliability.Reliable(0), durable, Policy.History.KeepLast(1))
        kind, where = self._topic(f"rt{topic}", msgtype)
        self._writers[topic] = kind, DataWriter(self._participant, where, qos=qos)

    def publish(self, topic: str, msgtype: str, message: bytes) -> None:
        """See `Transport`."""
        self.announce(topic, msgtype)
        kind, writer = self._writers[topic]
        writer.write(kind(message))

    def close(self) -> None:
        """See `Transport`."""
        self._readers.clear()
        self._writers.clear()
        self._made.clear()
        self._look = self._participant = self._opened = None

    def _look_around(self) -> None:
        """Read the topics that have appeared, and note what does not match."""
        from cyclonedds.core import InstanceState  # pyright: ignore[reportMissingImports]

        self._looked_at = now = time.monotonic()
        for found in self._look.take(_DEPTH):
            alive = found.sample_info.instance_state == InstanceState.Alive
            name, kind = str(found.topic_name), ros_type(str(found.type_name))
            if not alive or not name.startswith("rt/"):
                self._senders.pop(found.key, None)
            elif (connection := self.offered(name[2:], kind, _digest(found.qos))) is not None:
                if len(self._senders) < _DEPTH:
                    self._senders.setdefault(found.key, (name[2:], now, str(found.qos)))
                if name[2:] not in self._readers:
                    self._readers[name[2:]] = connection, self._reader(name, kind)
        for topic, (_, reader) in self._readers.items():
            offers = [sender for sender in self._senders.values() if sender[0] == topic]
            if len(offers) > 1:
                self.note(f"topic {topic!r} has several publishers; their messages are mixed")
            old = [qos for _, since, qos in offers if now - since > _MATCHING]
            if old and not reader.get_matched_publications():
                self.note(f"topic {topic!r}: its publisher's QoS cannot be matched: {old[0][:300]}")

    def _reader(self, name: str, msgtype: str) -> Any:
        """Best effort and volatile, which matches any publisher."""
        from cyclonedds.core import Policy, Qos  # pyright: ignore[reportMissingImports]
        from cyclonedds.sub import DataReader  # pyright: ignore[reportMissingImports]

        kept = Policy.History.KeepLast(_DEPTH)
        qos = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, kept)
        return DataReader(self._participant, self._topic(name, msgtype)[1], qos=qos)

    def _topic(self, name: str, msgtype: str) -> tuple[Any, Any]:
        """A topic whose messages hold CDR (`cdr`), neither parsed nor checked, and their type."""
        from cyclonedds.topic import Topic  # pyright: ignore[reportMissingImports]

        if name in self._made:
            return self._made[name]
        kind: Any = struct_type(msgtype, self.definitions.types)
        kind.__init__ = lambda self, cdr: setattr(self, "cdr", bytes(cdr))
        kind.serialize = lambda self, **_: self.cdr
        kind.deserialize = classmethod(lambda cls, cdr, **_: kind(cdr))
        self._made[name] = kind, Topic(self._participant, name, kind)
        return self._made[name]


def _digest(qos: Any) -> str:
    """Hash of the sender's definition, which ROS 2 puts into the user data since Iron; '' where it is not."""
    for policy in qos:
        if type(policy).__name__ == "Userdata":
            found = re.search(rb"typehash=(RIHS01_[0-9a-f]{64});", policy.data)
            return found[1].decode() if found else ""
    return ""


def configuration(interface: str | None, peers: Sequence[str]) -> str:
    """CycloneDDS's configuration: one interface, or any; no multicast, and participants at these addresses.

    Without `peers` participants are looked for on the interface itself.
    """
    own = [interface] if interface else []
    uses = "".join(f"<NetworkInterface address={quoteattr(each)}/>" for each in own)
    others = "".join(f"<Peer Address={quoteattr(each)}/>" for each in (*own, *peers))
    return (
        f"<CycloneDDS><Domain Id='any'><General><Interfaces>{uses}</Interfaces><AllowMulticast>false"
        f"</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex><Peers>{others}"
        "</Peers></Discovery></Domain></CycloneDDS>"
    )


def struct_type(name: str, types: Types) -> Any:
    """The structure of a type of ROS 2, for `cyclonedds`; `types` are those that it consists of, and it."""
    from cyclonedds.idl import make_idl_struct  # pyright: ignore[reportMissingImports]

    fields = {field: _field(kind, types) for field, kind in types[name]}
    return make_idl_struct(f"{name.split('/')[-1]}_", dds_type(name), fields)


def _field(description: Any, types: Types) -> Any:
    from cyclonedds.idl import types as idl  # pyright: ignore[reportMissingImports]

    kind, detail = description
    if kind == Nodetype.NAME:
        return struct_type(detail, types)
    if kind == Nodetype.BASE:
        base, bound = detail
        text = idl.bounded_str[bound] if bound else str
        return {"string": text, "bool": bool, "octet": idl.byte}.get(base) or getattr(idl, base)
    element, size = detail
    inner = _field(element, types)
    if kind == Nodetype.ARRAY:
        return idl.array[inner, size]
    return idl.sequence[inner, size] if size else idl.sequence[inner]
