"""Topics of ROS 2 without a ROS install: over DDS, as those of Unitree's robots, or over Zenoh.

Messages stay in CDR, as they came: they are decoded as those of logs. DDS (package `cyclonedds`) reaches Fast
DDS and Cyclone DDS. Zenoh (`eclipse-zenoh`) is used as rmw_zenoh does: a topic is the key
DOMAIN/NAME/TYPE/HASH, a message's attachment has its number, its time and its sender, and whoever publishes
is announced by a liveliness token. docs/watch.md says which releases were tried.
"""

from __future__ import annotations

import json
import re
import struct
import time
from collections import deque
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from itertools import count
from typing import Any
from uuid import uuid4
from xml.sax.saxutils import quoteattr

from rosbags.interfaces import Nodetype

from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.limits import limits
from amhe_cli.core.signals import Signal
from amhe_cli.logs.containers.raw import Batch, Connection, batch_of
from amhe_cli.logs.live.messages import Transport
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.layout import Types

#: Hash of a type's definition where a sender does not give it, as Humble does not.
_UNKNOWN = "TypeHashNotSupported"
#: DDS: messages of a topic that wait for us; older ones are dropped.
_DEPTH = 1000
#: Time between two looks at what is offered, and time after which what is offered must match [s].
_OFFERS, _MATCHING = 0.25, 2.0
#: Zenoh: messages that wait for us, and their bytes; what comes when there are more is dropped.
_MOST, _HELD = 10_000, 64 * 2**20
#: The router is waited for so long [ms].
_PATIENCE = 5000
#: Time between two looks for it [s], and the time that one takes at most where it has gone [ms].
_LOOK, _STEP = 2.0, 300
#: Where all are announced: DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NAME/TOPIC/TYPE/HASH/QOS.
_TOKENS = "@ros2_lv"


def dds_type(name: str) -> str:
    """'sensor_msgs::msg::dds_::JointState_' of 'sensor_msgs/msg/JointState'."""
    *packages, last = name.split("/")
    return "::".join((*packages, "dds_", f"{last}_"))


def ros_type(name: str) -> str:
    """'sensor_msgs/msg/JointState' of 'sensor_msgs::msg::dds_::JointState_'."""
    return "/".join(part for part in name.removesuffix("_").split("::") if part != "dds_")


def renamed(signals: Sequence[Signal], rules: Sequence[str]) -> list[Signal]:
    """Signals with their topics as rules name them, each `FROM:=TO`.

    Args:
        rules: As those after `--ros-args -r`; `__ns:=/arm` puts topics that no other rule names into /arm.

    Raises:
        ConfigError: A rule is none.
    """
    pairs = [rule.partition(":=") for rule in rules]
    for (old, sign, new), rule in zip(pairs, rules, strict=True):
        if not (old and sign and new):
            raise ConfigError(f"`live.remap`: {rule!r} is no rule; write /joint_states:=/arm/joint_states")
    names = {old: new for old, _, new in pairs}
    space = names.pop("__ns", "").rstrip("/")
    return [replace(one, topic=names.get(one.topic, f"{space}{one.topic}")) for one in signals]


class RosTransport(Transport):
    """Messages of ROS 2 in CDR.

    Args:
        about: Whom it listens to, in words.
        topics: Topics that are wanted; None: all.
        definitions: Definitions of message types.
    """

    def __init__(self, about: str, topics: Collection[str] | None, definitions: Definitions) -> None:
        super().__init__(about)
        self.definitions, self._topics = definitions, topics
        self._known: dict[tuple[str, str], Connection] = {}

    def offered(self, topic: str, msgtype: str, digest: str) -> Connection | None:
        """The connection of a topic that is wanted and can be read; else None, and perhaps a note.

        Args:
            topic: Name of the topic.
            msgtype: Type of its messages.
            digest: Hash of the sender's definition of the type; '' where it gives none.
        """
        key = topic, msgtype
        if key not in self._known:
            if len(self._known) >= limits().topics:
                self.note(f"more than {limits().topics} topics are offered: the others are not looked at")
                return None
            wanted = self._topics is None or topic in self._topics
            text = self._definition(topic, msgtype, digest) if wanted else ""
            self._known[key] = Connection(topic, msgtype, "cdr", text, "ros2msg")
            self.connections.append(self._known[key])
        return self._known[key] if self._known[key].definition else None

    def _definition(self, topic: str, msgtype: str, digest: str) -> str:
        """Text of a type's definition; '', and a note, where it is not the sender's."""
        try:
            text, own = self.definitions.described(msgtype)
        except LogError as error:
            self.note(f"topic {topic!r}: {error}")
            return ""
        if digest in ("", _UNKNOWN, own):
            return text
        self.note(
            f"topic {topic!r} is not read: its sender has another version of {msgtype}; give the folder of "
            "its .msg files with `msg_path`"
        )
        return ""


# -- DDS


class Dds(RosTransport):
    """The topics of a DDS domain.

    Args:
        topics, definitions: See `RosTransport`.
        domain: ROS_DOMAIN_ID.
        interface: Address of the one network interface to use; None: DDS chooses.
        peers: Addresses of other computers to look for participants on; none: by multicast, but on loopback.

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
            self._dds: Any = import_module("cyclonedds")
            for name in ("builtin", "core", "domain", "pub", "sub", "topic"):
                import_module(f"cyclonedds.{name}")
        except ImportError:
            raise ConfigError("`source=ros2` needs cyclonedds: pip install 'amhe[ros2]'") from None
        about = f"DDS domain {domain}{f' on {interface}' if interface else ''}"
        super().__init__(f"{about}, not signed", topics, definitions)
        try:
            chosen = configuration(interface, peers)
            self._opened = self._dds.domain.Domain(domain, chosen) if interface or peers else None
            self._participant: Any = self._dds.domain.DomainParticipant(domain)
        except self._dds.core.DDSException as error:
            raise ConfigError(f"`source=ros2`: {about} does not open: {error}") from None
        builtin = self._dds.builtin
        self._look: Any = builtin.BuiltinDataReader(self._participant, builtin.BuiltinTopicDcpsPublication)
        self._looked_at = 0.0
        self._readers: dict[str, tuple[Connection, Any]] = {}
        self._writers: dict[str, tuple[Any, Any]] = {}
        self._made: dict[str, tuple[Any, Any]] = {}
        #: Endpoint -> topic, the time since which it is offered [s], and its QoS.
        self._senders: dict[Any, tuple[str, float, str]] = {}

    def receive(self) -> list[Batch]:
        """See `Transport`."""
        if time.monotonic() - self._looked_at > _OFFERS:
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
        if topic not in self._writers:
            policy, (kind, where) = self._dds.core.Policy, self._topic(f"rt{topic}", msgtype)
            kept = policy.Durability.TransientLocal, policy.History.KeepLast(1)
            qos = self._dds.core.Qos(policy.Reliability.Reliable(0), *kept)
            self._writers[topic] = kind, self._dds.pub.DataWriter(self._participant, where, qos=qos)

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
        self._looked_at = now = time.monotonic()
        for found in self._look.take(_DEPTH):
            alive = found.sample_info.instance_state == self._dds.core.InstanceState.Alive
            name, kind = str(found.topic_name), ros_type(str(found.type_name))
            own = name[2:] in self._writers and name[2:] not in (self._topics or ())
            if not alive or not name.startswith("rt/") or own:
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
        policy = self._dds.core.Policy
        kept = policy.Durability.Volatile, policy.History.KeepLast(_DEPTH)
        qos = self._dds.core.Qos(policy.Reliability.BestEffort, *kept)
        return self._dds.sub.DataReader(self._participant, self._topic(name, msgtype)[1], qos=qos)

    def _topic(self, name: str, msgtype: str) -> tuple[Any, Any]:
        """A topic whose messages hold CDR (`cdr`), neither parsed nor checked, and their type."""
        if name not in self._made:
            kind: Any = struct_type(msgtype, self.definitions.types)
            kind.__init__ = lambda self, cdr: setattr(self, "cdr", bytes(cdr))
            kind.serialize = lambda self, **_: self.cdr
            kind.deserialize = classmethod(lambda cls, cdr, **_: kind(cdr))
            self._made[name] = kind, self._dds.topic.Topic(self._participant, name, kind)
        return self._made[name]


def _digest(qos: Any) -> str:
    """Hash of the sender's definition, which ROS 2 puts into the user data since Iron; '' where it is not."""
    said = b"".join(policy.data for policy in qos if type(policy).__name__ == "Userdata")
    found = re.search(rb"typehash=(RIHS01_[0-9a-f]{64});", said)
    return found[1].decode() if found else ""


def configuration(interface: str | None, peers: Sequence[str]) -> str:
    """CycloneDDS's configuration: one interface, or any; participants at these addresses, or by multicast.

    Loopback has no multicast: without `peers` participants are looked for on the interface itself.
    """
    uses = f"<NetworkInterface address={quoteattr(interface)}/>" if interface else ""
    alone = bool(peers) or (interface or "").startswith(("127.", "::1"))
    others = "".join(f"<Peer Address={quoteattr(each)}/>" for each in (interface, *peers) if each and alone)
    return (
        f"<CycloneDDS><Domain Id='any'><General><Interfaces>{uses}</Interfaces><AllowMulticast>"
        f"{str(not alone).lower()}</AllowMulticast></General><Discovery><ParticipantIndex>auto"
        f"</ParticipantIndex><Peers>{others}</Peers></Discovery></Domain></CycloneDDS>"
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


# -- Zenoh


class Zenoh(RosTransport):
    """The topics behind a Zenoh router.

    Args:
        topics, definitions: See `RosTransport`.
        domain: ROS_DOMAIN_ID.
        connect: Endpoint of the router.

    Raises:
        ConfigError: The package is missing, or there is no router.
    """

    def __init__(
        self, topics: Collection[str] | None, definitions: Definitions, domain: int, connect: str
    ) -> None:
        try:
            self._zenoh: Any = import_module("zenoh")
        except ImportError:
            raise ConfigError("`source=zenoh` needs eclipse-zenoh: pip install 'amhe[zenoh]'") from None
        super().__init__(f"zenoh {connect}, domain {domain}, not signed", topics, definitions)
        self._domain, self._connect, self._gid = domain, connect, uuid4().bytes
        self._waiting: deque[tuple[str, int, int, bytes]] = deque(maxlen=_MOST)
        self._held = 0
        self._keys: dict[str, tuple[str, Iterator[int]]] = {}
        try:
            self._open(_PATIENCE)
        except self._zenoh.ZError as error:
            why = str(error).split(" at ")[0]
            raise ConfigError(
                f"`source=zenoh`: no router at {connect} ({why}); start one with `ros2 run rmw_zenoh_cpp "
                "rmw_zenohd`, or name another with `connect`"
            ) from None

    def _open(self, patience: int) -> None:
        """Reach the router within so long [ms], and listen."""
        config = self._zenoh.Config()
        chosen = {
            "mode": "client", "connect/endpoints": [self._connect], "connect/timeout_ms": patience,
            "scouting/multicast/enabled": False, "transport/link/rx/max_message_size": _HELD // 4,
        }  # fmt: skip
        for key, value in chosen.items():
            config.insert_json5(key, json.dumps(value))
        self._session: Any = self._zenoh.open(config)
        self._looked_at = time.monotonic()
        keys = ["**"] if self._topics is None else [f"{topic.strip('/')}/*/*" for topic in self._topics]
        live, tokens = self._session.liveliness(), f"{_TOKENS}/{self._domain}/**"
        self._declared = [
            self._session.declare_subscriber(f"{self._domain}/{key}", self._take) for key in keys
        ]
        self._declared += [live.declare_subscriber(tokens, self._take, history=True)]
        self._keys.clear()  # publishers are announced again

    def _look(self) -> None:
        """Where the router has gone, reach it again: a client does not by itself."""
        self._looked_at = time.monotonic()
        if self._session.is_closed() or not self._session.info.routers_zid():
            self.note(f"{self.about}: the router is gone; waiting for it")
            with suppress(Exception):  # zenoh's own error, while there is none
                self._session.close()
                self._open(_STEP)

    def receive(self) -> list[Batch]:
        """See `Transport`."""
        if time.monotonic() - self._looked_at > _LOOK:
            self._look()
        found: dict[str, list[tuple[int, int, bytes]]] = {}
        for _ in range(len(self._waiting)):
            key, arrival, sent, message = self._waiting.popleft()
            self._held -= len(message)
            found.setdefault(key, []).append((arrival, sent, message))
        batches = []
        for key, rows in found.items():
            connection = self._connection(key.split("/"))
            if connection is not None and not key.startswith(_TOKENS):
                batches.append(batch_of(connection, *map(list, zip(*rows, strict=True))))
        return batches

    def publish(self, topic: str, msgtype: str, message: bytes) -> None:
        """See `Transport`; while the router is gone, nothing is sent."""
        if self._session.is_closed():
            return
        if topic not in self._keys:
            kind, digest = dds_type(msgtype), self.definitions.described(msgtype)[1]
            self._keys[topic] = f"{self._domain}/{topic.strip('/')}/{kind}/{digest}", count(1)
            publisher = f"{self._session.zid()}/0/{len(self._keys)}/MP/%/%/amhe/{topic.replace('/', '%')}"
            token = f"{_TOKENS}/{self._domain}/{publisher}/{kind}/{digest}/::,10:,:,:,,"  # QoS: defaults
            self._declared.append(self._session.liveliness().declare_token(token))
        key, numbers = self._keys[topic]
        about = struct.pack("<qqB", next(numbers), time.time_ns(), len(self._gid)) + self._gid
        self._session.put(key, message, attachment=about)

    def close(self) -> None:
        """See `Transport`."""
        self._session.close()

    def _take(self, sample: Any) -> None:
        """Hold a message, or a token; called in a thread of Zenoh's."""
        message, arrival = sample.payload.to_bytes(), time.time_ns()
        if self._held + len(message) > _HELD or len(self._waiting) == _MOST:
            self.note(f"{self.about}: messages come faster than they are read, and are dropped")
            return
        self._held += len(message)
        about = sample.attachment.to_bytes() if sample.attachment else b""
        sent = struct.unpack_from("<q", about, 8)[0] if len(about) >= 16 else arrival
        self._waiting.append((str(sample.key_expr), arrival, max(sent, 0), message))

    def _connection(self, parts: list[str]) -> Connection | None:
        """Of a message's key, or of the token of a publisher."""
        if parts[0] != _TOKENS and len(parts) > 3:
            return self.offered(f"/{'/'.join(parts[1:-2])}", ros_type(parts[-2]), parts[-1])
        if parts[0] == _TOKENS and len(parts) > 11 and parts[5] == "MP":
            return self.offered(parts[9].replace("%", "/"), ros_type(parts[10]), parts[11])
        return None
