"""PoseStamped or Odometry of ROS 2 over DDS (package `cyclonedds`), without a ROS install.

The bodies' names are their topics, such as /mocap/go1/pose. The ROS side must use a DDS middleware
(CycloneDDS, Fast DDS) in the same domain.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from amhe_cli.poses.source import PoseError, Sighting, sighting

_STEP = 0.001


class Ros2:
    """See `source.PoseSource`.

    Args:
        topics: Of the bodies.
        domain: ROS_DOMAIN_ID.
    """

    def __init__(self, topics: list[str], domain: int) -> None:
        self._topics, self._domain = topics, domain
        self._readers: list[tuple[str, Any]] = []

    def connect(self) -> None:
        """See `PoseSource`."""
        try:
            from cyclonedds.core import Policy, Qos  # pyright: ignore[reportMissingImports]
            from cyclonedds.domain import DomainParticipant  # pyright: ignore[reportMissingImports]
            from cyclonedds.sub import DataReader  # pyright: ignore[reportMissingImports]
            from cyclonedds.topic import Topic  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise PoseError("--pose ros2 needs the package cyclonedds: pip install 'amhe[mocap]'") from None
        participant = DomainParticipant(self._domain)
        # best effort matches both kinds of publishers; only the newest counts
        qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(10))
        for name in self._topics:
            for kind in message_types():
                topic = Topic(participant, f"rt/{name.lstrip('/')}", kind, qos=qos)
                self._readers.append((name, DataReader(participant, topic, qos=qos)))

    def wait(self, seconds: float) -> list[Sighting]:
        """See `PoseSource`."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            seen = [
                one
                for name, reader in self._readers
                for told in reader.take(10)
                if (one := _read(name, told))
            ]
            if seen:
                return seen
            time.sleep(_STEP)
        return []

    def close(self) -> None:
        """See `PoseSource`."""
        self._readers.clear()


def message_types() -> tuple[Any, Any]:
    """PoseStamped and Odometry as DDS knows them."""
    from cyclonedds.idl import IdlStruct  # pyright: ignore[reportMissingImports]
    from cyclonedds.idl.types import array, float64, int32, uint32  # pyright: ignore[reportMissingImports]

    def struct(name: str, **fields: Any) -> Any:
        package, message = name.split("/")
        made = type(
            message + "_",
            (IdlStruct,),
            {"__annotations__": fields},
            typename=f"{package}::msg::dds_::{message}_",
        )
        return dataclass(made)

    stamp = struct("builtin_interfaces/Time", sec=int32, nanosec=uint32)
    header = struct("std_msgs/Header", stamp=stamp, frame_id=str)
    point = struct("geometry_msgs/Point", x=float64, y=float64, z=float64)
    turn = struct("geometry_msgs/Quaternion", x=float64, y=float64, z=float64, w=float64)
    pose = struct("geometry_msgs/Pose", position=point, orientation=turn)
    vector = struct("geometry_msgs/Vector3", x=float64, y=float64, z=float64)
    twist = struct("geometry_msgs/Twist", linear=vector, angular=vector)
    spread = array[float64, 36]
    posed = struct("geometry_msgs/PoseWithCovariance", pose=pose, covariance=spread)
    twisted = struct("geometry_msgs/TwistWithCovariance", twist=twist, covariance=spread)
    return (
        struct("geometry_msgs/PoseStamped", header=header, pose=pose),
        struct("nav_msgs/Odometry", header=header, child_frame_id=str, pose=posed, twist=twisted),
    )


def _read(name: str, told: Any) -> Sighting | None:
    pose = getattr(told.pose, "pose", told.pose)
    at, turn, stamp = pose.position, pose.orientation, told.header.stamp
    return sighting(
        name, (at.x, at.y, at.z), (turn.w, turn.x, turn.y, turn.z), stamp.sec + 1e-9 * stamp.nanosec
    )
