"""Write MCAP logs that any ROS 2 tool and viewer opens, without ROS."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import ArrayLike
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from amhe_cli import __version__
from amhe_cli.core import rotations
from amhe_cli.core.files import whole
from amhe_cli.logs.containers.raw import Batch, Connection
from amhe_cli.logs.containers.table_file import ENCODING as TABLE
from amhe_cli.logs.messages.json_rows import rows_as_json

logger = logging.getLogger(__name__)

#: Levels of a diagnostic_msgs/DiagnosticStatus.
OK, WARN, ERROR = 0, 1, 2


class LogWriter:
    """A log in the making; use it as a context manager.

    The file appears under its name when the block ends, whole and with checksums over every byte. It is
    also closed and kept when the block ends by an exception: the log of a failed run shows why it failed.
    If it cannot be written any more, as on a full disk, one call raises; what was written is kept, and
    readers recover it.

    Args:
        path: The .mcap file to write; an existing one is replaced at the end.
        metadata: What the log says of itself. `system` is the name of the system that commands then take;
            `truth`, `seed` and any other text is shown and kept.
    """

    def __init__(self, path: str | Path, metadata: Mapping[str, str] | None = None) -> None:
        self.path = Path(path)
        self._metadata = dict(metadata or {})
        self._store = get_typestore(Stores.LATEST)
        self._channels: dict[str, tuple[int, str]] = {}
        self._schemas: dict[str, int] = {}
        self._sequence: dict[int, int] = {}
        self._copied: dict[Connection, int] = {}
        self._full = False

    def __enter__(self) -> LogWriter:
        self._file = ExitStack()
        file = self._file.enter_context(whole(self.path, keep=True))
        self._mcap = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)  # type: ignore[arg-type]
        self._mcap.start(profile="ros2", library=f"amhe {__version__}")
        self._mcap.add_metadata("amhe", self._metadata)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._full:
            with self._file:
                self._mcap.finish()

    # -- any message ----------------------------------------------------------------------------------

    def define(self, msgtype: str, definition: str) -> None:
        """Define a message type that ROS does not have; `definition` is the text of its .msg file."""
        self._store.register(get_types_from_msg(definition, msgtype))

    def prepare(self, msgtypes: Iterable[str]) -> None:
        """Prepare the serialisers now, so that the first message of each type is not slow."""
        for msgtype in msgtypes:
            self._store.get_msgdef(msgtype)
            self._schema(msgtype)

    def message(self, msgtype: str, **fields: Any) -> Any:
        """An instance of a message type."""
        return self._store.types[msgtype](**fields)

    def write(self, topic: str, msgtype: str, stamp_ns: int, message: Any) -> None:
        """Append a message; its header, where it has one, gets the same stamp.

        Args:
            topic: Name of the topic, for instance '/joint_states'.
            msgtype: Type such as 'sensor_msgs/msg/JointState'; one topic has one type.
            stamp_ns: Time at which it was measured or sent [ns].
            message: An instance made by one of the methods here.
        """
        if hasattr(message, "header"):
            message.header.stamp = self.time(stamp_ns)
        channel, known = self._channels.get(topic) or self._channel(topic, msgtype)
        if known != msgtype:
            raise ValueError(f"topic {topic!r} carries {known}, not {msgtype}")
        data = self._store.serialize_cdr(message, msgtype)
        self._add(channel, stamp_ns, bytes(data), stamp_ns)

    def _add(self, channel: int, log_ns: int, data: bytes, publish_ns: int) -> None:
        """Append a message; nothing once the file could not be written, for which one call raises OSError."""
        if self._full:
            return
        self._sequence[channel] = self._sequence.get(channel, -1) + 1
        with self._keeping():
            self._mcap.add_message(channel, log_ns, data, publish_ns, self._sequence[channel])

    @contextmanager
    def _keeping(self) -> Iterator[None]:
        """Close the file where it cannot be written any more, and keep what was written."""
        try:
            yield
        except OSError:
            self._full = True
            with self._file:
                raise

    def copy(self, batch: Batch) -> None:
        """Append messages of another log as they are; the rows of a table become JSON messages."""
        batch = rows_as_json(batch) if batch.connection.encoding == TABLE else batch
        connection = batch.connection
        if connection not in self._copied:
            schema = self._mcap.register_schema(*_schema(connection))
            self._copied[connection] = self._mcap.register_channel(
                connection.topic, connection.encoding, schema
            )
        channel = self._copied[connection]
        stamps = (ns.view(np.uint64).tolist() for ns in (batch.log_ns, batch.publish_ns))
        ends = (batch.starts + batch.lengths).tolist()
        for log_ns, publish_ns, start, end in zip(*stamps, batch.starts.tolist(), ends, strict=True):
            self._add(channel, log_ns, batch.buffer[start:end].tobytes(), publish_ns)

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file, for instance the configuration or the model."""
        with self._keeping():
            self._mcap.add_attachment(0, 0, name, media_type, data)

    def _channel(self, topic: str, msgtype: str) -> tuple[int, str]:
        channel = self._mcap.register_channel(topic, "cdr", self._schema(msgtype))
        self._channels[topic] = channel, msgtype
        return self._channels[topic]

    def _schema(self, msgtype: str) -> int:
        if msgtype not in self._schemas:
            text, _ = self._store.generate_msgdef(msgtype, ros_version=2)
            self._schemas[msgtype] = self._mcap.register_schema(msgtype, "ros2msg", text.encode())
        return self._schemas[msgtype]

    # -- the common ones ------------------------------------------------------------------------------

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

    def time(self, stamp_ns: int) -> Any:
        """A builtin_interfaces/Time of a stamp [ns]."""
        seconds, nanoseconds = divmod(int(stamp_ns), 10**9)
        return self.message("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)

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


def _schema(connection: Connection) -> tuple[str, str, bytes]:
    """Name, encoding and data of the MCAP schema of a connection."""
    binary = connection.encoding == "protobuf"
    data = connection.definition.encode("latin-1" if binary else "utf-8")
    name = connection.type.replace("/msg/", "/") if connection.encoding == "ros1" else connection.type
    usual = {"json": "jsonschema", "protobuf": "protobuf", "cdr": "ros2msg", "ros1": "ros1msg"}
    return name, connection.definition_format or usual.get(connection.encoding, ""), data
