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
        message = self.message(
            "sensor_msgs/msg/JointState",
            header=self.header(""),
            name=list(names),
            position=_numbers(position),
            velocity=_numbers(velocity),
            effort=_numbers(effort),
        )
        self.write(topic, "sensor_msgs/msg/JointState", stamp_ns, message)

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
        geometry = "geometry_msgs/msg/"
        twist = self.message(
            f"{geometry}Twist", linear=self.vector(linear), angular=self.vector(angular_velocity)
        )
        message = self.message(
            "nav_msgs/msg/Odometry",
            header=self.header(frame),
            child_frame_id=child_frame,
            pose=self.message(
                f"{geometry}PoseWithCovariance", pose=self.pose_of(position, turn), covariance=np.zeros(36)
            ),
            twist=self.message(f"{geometry}TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )
        self.write(topic, "nav_msgs/msg/Odometry", stamp_ns, message)

    def pose(
        self, topic: str, stamp_ns: int, position: ArrayLike, orientation: ArrayLike, *, frame: str = "world"
    ) -> None:
        """Write a geometry_msgs/PoseStamped: position [m] (3,), unit quaternion w, x, y, z (4,)."""
        name = "geometry_msgs/msg/PoseStamped"
        message = self.message(name, header=self.header(frame), pose=self.pose_of(position, orientation))
        self.write(topic, name, stamp_ns, message)

    def transform(
        self,
        topic: str,
        stamp_ns: int,
        poses: Mapping[str, tuple[ArrayLike, ArrayLike]],
        *,
        frame: str = "world",
    ) -> None:
        """Write a tf2_msgs/TFMessage: child frame -> position [m] (3,), unit quaternion w, x, y, z (4,)."""
        transforms = []
        for child, (position, orientation) in poses.items():
            transform = self.message(
                "geometry_msgs/msg/Transform",
                translation=self.vector(position),
                rotation=self.quaternion(orientation),
            )
            name = "geometry_msgs/msg/TransformStamped"
            head = self.header(frame, stamp_ns)
            transforms.append(self.message(name, header=head, child_frame_id=child, transform=transform))
        name = "tf2_msgs/msg/TFMessage"
        self.write(topic, name, stamp_ns, self.message(name, transforms=transforms))

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
        unknown = np.zeros(9)
        unknown[0] = -1.0
        message = self.message(
            "sensor_msgs/msg/Imu",
            header=self.header(frame),
            orientation=self.quaternion((1.0, 0.0, 0.0, 0.0) if orientation is None else orientation),
            orientation_covariance=unknown if orientation is None else np.zeros(9),
            angular_velocity=self.vector(angular_velocity),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self.vector(linear_acceleration),
            linear_acceleration_covariance=np.zeros(9),
        )
        self.write(topic, "sensor_msgs/msg/Imu", stamp_ns, message)

    def wrench(
        self, topic: str, stamp_ns: int, force: ArrayLike, torque: ArrayLike, *, frame: str = "sensor"
    ) -> None:
        """Write a geometry_msgs/WrenchStamped: force [N] (3,), torque [N m] (3,)."""
        wrench = self.message(
            "geometry_msgs/msg/Wrench", force=self.vector(force), torque=self.vector(torque)
        )
        name = "geometry_msgs/msg/WrenchStamped"
        self.write(topic, name, stamp_ns, self.message(name, header=self.header(frame), wrench=wrench))

    def numbers(self, topic: str, stamp_ns: int, values: ArrayLike) -> None:
        """Write a std_msgs/Float64MultiArray of any numbers, shape (n,)."""
        name = "std_msgs/msg/Float64MultiArray"
        layout = self.message("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        self.write(topic, name, stamp_ns, self.message(name, layout=layout, data=_numbers(values)))

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
        package = "diagnostic_msgs/msg/"
        status = self.message(
            f"{package}DiagnosticStatus",
            level=level,
            name=f"amhe: {of}",
            message=text,
            hardware_id="",
            values=[
                self.message(f"{package}KeyValue", key=key, value=value) for key, value in values.items()
            ],
        )
        name = f"{package}DiagnosticArray"
        message = self.message(name, header=self.header(""), status=[status])
        self.write("/diagnostics", name, stamp_ns, message)

    # -- their parts ----------------------------------------------------------------------------------

    def header(self, frame: str, stamp_ns: int = 0) -> Any:
        """A std_msgs/Header in `frame`; `write` sets the stamp of a message's own."""
        return self.message("std_msgs/msg/Header", stamp=self.time(stamp_ns), frame_id=frame)

    def vector(self, values: ArrayLike, name: str = "Vector3") -> Any:
        """A message of geometry_msgs with x, y, z: Vector3 or Point; values of shape (3,)."""
        x, y, z = _numbers(values).tolist()
        return self.message(f"geometry_msgs/msg/{name}", x=x, y=y, z=z)

    def quaternion(self, wxyz: ArrayLike) -> Any:
        """A geometry_msgs/Quaternion of w, x, y, z."""
        w, x, y, z = _numbers(wxyz).tolist()
        return self.message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def pose_of(self, position: ArrayLike, orientation: ArrayLike) -> Any:
        """A geometry_msgs/Pose of a position (3,) and a quaternion w, x, y, z."""
        point, turn = self.vector(position, "Point"), self.quaternion(orientation)
        return self.message("geometry_msgs/msg/Pose", position=point, orientation=turn)


def _numbers(values: ArrayLike) -> np.ndarray:
    return np.array(values, dtype=np.float64).reshape(-1)
