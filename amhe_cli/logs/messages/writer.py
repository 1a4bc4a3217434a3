"""Write logs of robots that any ROS 2 tool and viewer opens, without ROS."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.core import rotations
from amhe_cli.logs.messages.mcap_writer import McapWriter

#: Levels of a diagnostic_msgs/DiagnosticStatus.
OK, WARN, ERROR = 0, 1, 2
#: First number of a covariance that is not known.
_UNKNOWN = (-1.0, *(8 * (0.0,)))


class LogWriter(McapWriter):
    """A log in the making, with methods for the usual messages; use it as a context manager.

    The file appears under its name when the block ends, whole and with checksums over every byte. It is
    also closed and kept when the block ends by an exception: the log of a failed run shows why it failed.
    If it cannot be written any more, as on a full disk, one call raises; what was written is kept, and
    readers recover it.

    Args:
        path: The .mcap file to write; an existing one is replaced at the end.
        metadata: Metadata of the log. `system` is the name of the system that commands then take;
            `truth`, `seed` and any other text is shown and kept.
    """

    def joint_state(
        self,
        topic: str,
        stamp_ns: int,
        names: Iterable[str],
        position: ArrayLike = (),
        velocity: ArrayLike = (),
        effort: ArrayLike = (),
    ) -> None:
        """Write a sensor_msgs/JointState: position [rad or m], velocity, effort [N m or N]; (n,) or ()."""
        numbers = {"position": position, "velocity": velocity, "effort": effort}
        self.write(topic, "sensor_msgs/msg/JointState", stamp_ns, {"name": list(names), **numbers})

    def odometry(
        self,
        topic: str,
        stamp_ns: int,
        position: ArrayLike,
        orientation: ArrayLike,
        linear_velocity: ArrayLike = (0.0, 0.0, 0.0),
        angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
        *,
        frame: str = "world",
        child_frame: str = "body",
    ) -> None:
        """Write a nav_msgs/Odometry.

        Args:
            topic: Topic, as in `write`.
            stamp_ns: Stamp [ns], as in `write`.
            position: Position in the world [m], shape (3,).
            orientation: Unit quaternion w, x, y, z of the body in the world.
            linear_velocity: Velocity in the world [m/s], shape (3,); stored in the child frame, as ROS wants
                it.
            angular_velocity: Angular velocity in the body's frame [rad/s], shape (3,).
            frame: Name of the world.
            child_frame: Name of the body.
        """
        turn = np.asarray(orientation, dtype=np.float64)
        linear = rotations.rotate(rotations.conjugate(turn), np.asarray(linear_velocity, dtype=np.float64))
        content = {
            "header": {"frame_id": frame},
            "child_frame_id": child_frame,
            "pose": {"pose": (position, _xyzw(turn))},
            "twist": {"twist": (linear, angular_velocity)},
        }
        self.write(topic, "nav_msgs/msg/Odometry", stamp_ns, content)

    def pose(
        self, topic: str, stamp_ns: int, position: ArrayLike, orientation: ArrayLike, *, frame: str = "world"
    ) -> None:
        """Write a geometry_msgs/PoseStamped: position [m] (3,), unit quaternion w, x, y, z (4,)."""
        content = {"header": {"frame_id": frame}, "pose": (position, _xyzw(orientation))}
        self.write(topic, "geometry_msgs/msg/PoseStamped", stamp_ns, content)

    def transform(
        self,
        topic: str,
        stamp_ns: int,
        poses: Mapping[str, tuple[ArrayLike, ArrayLike]],
        *,
        frame: str = "world",
    ) -> None:
        """Write a tf2_msgs/TFMessage: child frame -> position [m] (3,), unit quaternion w, x, y, z (4,)."""
        header = {"stamp": divmod(stamp_ns, 10**9), "frame_id": frame}
        transforms = [
            {"header": header, "child_frame_id": child, "transform": (position, _xyzw(orientation))}
            for child, (position, orientation) in poses.items()
        ]
        self.write(topic, "tf2_msgs/msg/TFMessage", stamp_ns, {"transforms": transforms})

    def imu(
        self,
        topic: str,
        stamp_ns: int,
        orientation: ArrayLike | None,
        angular_velocity: ArrayLike,
        linear_acceleration: ArrayLike,
        *,
        frame: str = "imu",
    ) -> None:
        """Write a sensor_msgs/Imu; orientation None is marked as unknown, as ROS wants it."""
        content: dict[str, Any] = {
            "header": {"frame_id": frame},
            "orientation": _xyzw((1.0, 0.0, 0.0, 0.0) if orientation is None else orientation),
            "angular_velocity": angular_velocity,
            "linear_acceleration": linear_acceleration,
        }
        if orientation is None:
            content["orientation_covariance"] = _UNKNOWN
        self.write(topic, "sensor_msgs/msg/Imu", stamp_ns, content)

    def wrench(
        self, topic: str, stamp_ns: int, force: ArrayLike, torque: ArrayLike, *, frame: str = "sensor"
    ) -> None:
        """Write a geometry_msgs/WrenchStamped: force [N] (3,), torque [N m] (3,)."""
        content = {"header": {"frame_id": frame}, "wrench": (force, torque)}
        self.write(topic, "geometry_msgs/msg/WrenchStamped", stamp_ns, content)

    def numbers(self, topic: str, stamp_ns: int, values: ArrayLike) -> None:
        """Write a std_msgs/Float64MultiArray of any numbers, shape (n,)."""
        self.write(
            topic, "std_msgs/msg/Float64MultiArray", stamp_ns, {"data": np.asarray(values).reshape(-1)}
        )

    def diagnostics(
        self, stamp_ns: int, level: int, text: str, values: Mapping[str, str], of: str = "controller"
    ) -> None:
        """Write a diagnostic_msgs/DiagnosticArray on /diagnostics with the status of one component.

        Args:
            stamp_ns: Stamp [ns], as in `write`.
            level: `OK`, `WARN` or `ERROR`.
            text: The status in words.
            values: Numbers that go with it, by name.
            of: Name of the component.
        """
        status = {"level": level, "name": f"amhe: {of}", "message": text, "values": list(values.items())}
        self.write("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", stamp_ns, {"status": [status]})


def _xyzw(orientation: ArrayLike) -> tuple[float, ...]:
    """A quaternion w, x, y, z as ROS has it."""
    w, x, y, z = np.asarray(orientation).tolist()
    return x, y, z, w
