"""How ROS 2 names topics and types on its transports, and which of those that are offered are read."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.limits import limits
from amhe_cli.core.signals import Signal
from amhe_cli.logs.containers.raw import Connection
from amhe_cli.logs.live.transport import Transport
from amhe_cli.logs.messages.definitions import Definitions

#: Hash of a type's definition where a sender does not give it, as Humble does not.
UNKNOWN = "TypeHashNotSupported"


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
        signals: The signals.
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
        if digest in ("", UNKNOWN, own):
            return text
        self.note(
            f"topic {topic!r} is not read: its sender has another version of {msgtype}; give the folder of "
            "its .msg files with `msg_path`"
        )
        return ""
