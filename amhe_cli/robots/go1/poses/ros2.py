"""PoseStamped or Odometry of ROS 2 over DDS (package `cyclonedds`), without a ROS install; estimates back.

The bodies' names are their topics, such as /mocap/go1/pose. The ROS side must use a DDS middleware
(CycloneDDS, Fast DDS) in the same domain.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from amhe_cli.robots.go1.poses.ros2_messages import headed, joint_state_type, pose_types
from amhe_cli.robots.go1.poses.source import PoseError, Sighting, sighting

_STEP = 0.001
#: Where estimates are published: the topic that logs have too.
ESTIMATES = "/amhe/params"


class Ros2:
    """See `source.PoseSource`.

    Args:
        topics: Topics of the bodies.
        domain: ROS_DOMAIN_ID.
    """

    def __init__(self, topics: list[str], domain: int) -> None:
        self._topics, self._domain = topics, domain
        self._readers: list[tuple[str, Any]] = []
        self._writer: Any = None

    def connect(self) -> None:
        """See `PoseSource`."""
        try:
            from cyclonedds.core import Policy, Qos  # pyright: ignore[reportMissingImports]
            from cyclonedds.domain import DomainParticipant  # pyright: ignore[reportMissingImports]
            from cyclonedds.pub import DataWriter  # pyright: ignore[reportMissingImports]
            from cyclonedds.sub import DataReader  # pyright: ignore[reportMissingImports]
            from cyclonedds.topic import Topic  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise PoseError("`pose=ros2` needs the package cyclonedds: pip install 'amhe[mocap]'") from None
        participant = DomainParticipant(self._domain)
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


def _read(name: str, message: Any) -> Sighting | None:
    pose = getattr(message.pose, "pose", message.pose)
    at, turn, stamp = pose.position, pose.orientation, message.header.stamp
    return sighting(
        name, (at.x, at.y, at.z), (turn.w, turn.x, turn.y, turn.z), stamp.sec + 1e-9 * stamp.nanosec
    )
