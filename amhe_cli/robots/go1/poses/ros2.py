"""PoseStamped or Odometry of ROS 2 over DDS (package `cyclonedds`), without a ROS install; estimates back.

The bodies' names are their topics, such as /mocap/go1/pose. The ROS side must use a DDS middleware
(CycloneDDS, Fast DDS) in the same domain.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element, SubElement, tostring

from amhe_cli.robots.go1.poses.source import PoseError, Sighting, sighting

_STEP = 0.001
#: Where estimates are published: the topic that logs have too.
ESTIMATES = "/amhe/params"


class Ros2:
    """See `source.PoseSource`.

    Args:
        topics: Topics of the bodies.
        domain: ROS_DOMAIN_ID.
        interface: Address of the network interface to use; others are not.
        peers: Addresses of other computers to look for participants on.
    """

    def __init__(
        self, topics: list[str], domain: int, interface: str = "127.0.0.1", peers: Sequence[str] = ()
    ) -> None:
        self._topics, self._domain, self._interface, self._peers = topics, domain, interface, peers
        self._readers: list[tuple[str, Any]] = []
        self._writer: Any = None

    @property
    def about(self) -> str:
        """See `PoseSource`."""
        others = f" and {', '.join(self._peers)}" if self._peers else ""
        return (
            f"DDS domain {self._domain} on {self._interface}{others}, not signed; it opens UDP ports from "
            f"{7400 + 250 * self._domain} on, on all addresses of this computer"
        )

    def connect(self) -> None:
        """See `PoseSource`."""
        try:
            from cyclonedds.core import DDSException, Policy, Qos  # pyright: ignore[reportMissingImports]
            from cyclonedds.domain import Domain, DomainParticipant  # pyright: ignore[reportMissingImports]
            from cyclonedds.pub import DataWriter  # pyright: ignore[reportMissingImports]
            from cyclonedds.sub import DataReader  # pyright: ignore[reportMissingImports]
            from cyclonedds.topic import Topic  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise PoseError("`pose=ros2` needs the package cyclonedds: pip install 'amhe[mocap]'") from None
        try:
            self._opened = Domain(self._domain, configuration(self._interface, self._peers))
            participant = DomainParticipant(self._domain)
        except DDSException as error:
            where = f"domain {self._domain} on {self._interface}"
            raise PoseError(f"DDS does not open {where}: {error}; see `go1.poses.interface`") from error
        # best effort matches both kinds of publishers; only the newest counts
        qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(10))
        for name in self._topics:
            for kind in pose_types():
                topic = Topic(participant, f"rt/{name.lstrip('/')}", kind, qos=qos)
                self._readers.append((name, DataReader(participant, topic, qos=qos)))
        # reliable and kept for who comes later: matches every subscriber
        kept = Qos(
            Policy.Reliability.Reliable(0), Policy.Durability.TransientLocal, Policy.History.KeepLast(1)
        )
        self._estimate = joint_state_type()
        topic = Topic(participant, f"rt{ESTIMATES}", self._estimate, qos=kept)
        self._writer = DataWriter(participant, topic, qos=kept)

    def wait(self, seconds: float) -> list[Sighting]:
        """See `PoseSource`."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            seen = [
                one
                for name, reader in self._readers
                for message in reader.take(10)
                if (one := _read(name, message))
            ]
            if seen:
                return seen
            time.sleep(_STEP)
        return []

    def publish(self, names: Sequence[str], values: Sequence[float], sd: Sequence[float]) -> None:
        """See `source.EstimateSink`: a JointState, values as `position` and their sd as `effort`."""
        numbers = {"position": list(values), "velocity": [], "effort": list(sd)}
        self._writer.write(headed(self._estimate, time.time(), name=list(names), **numbers))

    def close(self) -> None:
        """See `PoseSource`."""
        self._readers.clear()
        self._writer = None


def configuration(interface: str, peers: Sequence[str] = ()) -> str:
    """CycloneDDS's configuration: one interface, no multicast, participants at these addresses alone."""
    general, discovery = Element("General"), Element("Discovery")
    SubElement(SubElement(general, "Interfaces"), "NetworkInterface", address=interface)
    SubElement(general, "AllowMulticast").text = "false"
    SubElement(discovery, "ParticipantIndex").text = "auto"
    found = SubElement(discovery, "Peers")
    for peer in (interface, *peers):
        SubElement(found, "Peer", Address=peer)
    domain = Element("Domain", Id="any")
    domain.extend((general, discovery))
    whole = Element("CycloneDDS")
    whole.append(domain)
    return tostring(whole, encoding="unicode")


def _read(name: str, message: Any) -> Sighting | None:
    pose = getattr(message.pose, "pose", message.pose)
    at, turn, stamp = pose.position, pose.orientation, message.header.stamp
    return sighting(
        name, (at.x, at.y, at.z), (turn.w, turn.x, turn.y, turn.z), stamp.sec + 1e-9 * stamp.nanosec
    )


def pose_types() -> tuple[Any, Any]:
    """PoseStamped and Odometry."""
    from cyclonedds.idl.types import array, float64  # pyright: ignore[reportMissingImports]

    header, spread = _header(), array[float64, 36]
    point = _struct("geometry_msgs/Point", x=float64, y=float64, z=float64)
    turn = _struct("geometry_msgs/Quaternion", x=float64, y=float64, z=float64, w=float64)
    pose = _struct("geometry_msgs/Pose", position=point, orientation=turn)
    vector = _struct("geometry_msgs/Vector3", x=float64, y=float64, z=float64)
    twist = _struct("geometry_msgs/Twist", linear=vector, angular=vector)
    posed = _struct("geometry_msgs/PoseWithCovariance", pose=pose, covariance=spread)
    twisted = _struct("geometry_msgs/TwistWithCovariance", twist=twist, covariance=spread)
    return (
        _struct("geometry_msgs/PoseStamped", header=header, pose=pose),
        _struct("nav_msgs/Odometry", header=header, child_frame_id=str, pose=posed, twist=twisted),
    )


def joint_state_type() -> Any:
    """JointState, which every viewer plots by name."""
    from cyclonedds.idl.types import float64, sequence  # pyright: ignore[reportMissingImports]

    numbers = sequence[float64]
    return _struct(
        "sensor_msgs/JointState",
        header=_header(), name=sequence[str], position=numbers, velocity=numbers, effort=numbers,
    )  # fmt: skip


def headed(kind: Any, seconds: float, **fields: Any) -> Any:
    """A message with a header.

    Args:
        kind: Type of the message.
        seconds: Stamp of the header, on ROS's clock [s].
        fields: All other fields.
    """
    header = kind.__annotations__["header"]
    stamp = header.__annotations__["stamp"](int(seconds), int(1e9 * (seconds % 1.0)))
    return kind(header=header(stamp, ""), **fields)


def _header() -> Any:
    from cyclonedds.idl.types import int32, uint32  # pyright: ignore[reportMissingImports]

    stamp = _struct("builtin_interfaces/Time", sec=int32, nanosec=uint32)
    return _struct("std_msgs/Header", stamp=stamp, frame_id=str)


def _struct(name: str, /, **fields: Any) -> Any:
    from cyclonedds.idl import IdlStruct  # pyright: ignore[reportMissingImports]

    package, message = name.split("/")
    made = type(
        message + "_",
        (IdlStruct,),
        {"__annotations__": fields},
        typename=f"{package}::msg::dds_::{message}_",
    )
    return dataclass(made)
