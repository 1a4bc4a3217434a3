"""Write logs of robots that any ROS 2 tool and viewer opens, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import ArrayLike
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from amhe_cli import __version__
from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.files import whole
from amhe_cli.core.log import Samples
from amhe_cli.core.signals import Signal
from amhe_cli.logs.containers.raw import Batch, Connection

#: Levels of a diagnostic_msgs/DiagnosticStatus.
OK, WARN, ERROR = 0, 1, 2
#: First number of a covariance that is not known.
_UNKNOWN = (-1.0, *(8 * (0.0,)))
#: Numbers that numpy calls otherwise.
_DTYPES = {"byte": "uint8", "octet": "uint8", "char": "uint8"}
#: What a message holds: its fields, nested; or, in their order, all of them.
Content = dict[str, Any] | Sequence[Any] | np.ndarray


class LogWriter:
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

    def __init__(self, path: str | Path, metadata: Mapping[str, str] | None = None) -> None:
        self.path = Path(path)
        self._metadata = dict(metadata or {})
        self._store = get_typestore(Stores.LATEST)
        self._channels: dict[str, tuple[int, str]] = {}
        self._schemas: dict[str, int] = {}
        self._makers: dict[str, Callable[[Content], Any]] = {}
        self._sequence: dict[int, int] = {}
        self._copied: dict[Connection, int] = {}
        self._full = False
        #: Called with topic, type and bytes of each message that `write` appends, to send it on.
        self.also: Sequence[Callable[[str, str, bytes], None]] = ()

    def __enter__(self) -> Self:
        self._file = ExitStack()
        file = self._file.enter_context(whole(self.path, keep=True))
        self._mcap = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)  # type: ignore[arg-type]
        self._mcap.start(profile="ros2", library=f"amhe {__version__}")
        self._mcap.add_metadata("amhe", self._metadata)
        return self

    def __exit__(self, *_: object) -> None:
        if not self._full:
            with self._file:
                self._mcap.finish()

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

    # -- messages of any type --------------------------------------------------------------------------

    def define(self, msgtype: str, definition: str) -> None:
        """Define a message type that ROS does not have; `definition` is the text of its .msg file."""
        self._store.register(get_types_from_msg(definition, msgtype))

    def prepare(self, msgtypes: Iterable[str]) -> None:
        """Prepare the serialisers now, so that the first message of each type is not slow."""
        for msgtype in msgtypes:
            self._store.get_msgdef(msgtype)
            self._schema(msgtype)

    def write(self, topic: str, msgtype: str, stamp_ns: int, content: dict[str, Any]) -> None:
        """Append a message; its header, where it has one, gets the same stamp.

        Args:
            topic: Name of the topic, for instance '/joint_states'.
            msgtype: Type such as 'sensor_msgs/msg/JointState'; one topic has one type.
            stamp_ns: Time at which it was measured or sent [ns].
            content: Its fields, such as {"header": {"frame_id": "world"}, "point": (0, 0, 1)}: messages in it
                as mappings, or as their fields in order. What is left out is zero or empty.
        """
        if topic not in self._channels:
            self._channels[topic] = self._mcap.register_channel(topic, "cdr", self._schema(msgtype)), msgtype
        channel, known = self._channels[topic]
        if known != msgtype:
            raise ValueError(f"topic {topic!r} carries {known}, not {msgtype}")
        if "header" in [name for name, _ in self._store.fielddefs[msgtype][1]]:
            content = {**content, "header": {**content.get("header", {}), "stamp": divmod(stamp_ns, 10**9)}}
        message = self._maker(msgtype)(content)
        data = bytes(self._store.serialize_cdr(message, msgtype))
        self._add(channel, stamp_ns, data, stamp_ns)
        for send in self.also:
            send(topic, msgtype, data)

    def _maker(self, msgtype: str) -> Callable[[Content], Any]:
        """Makes an instance of a message type of its content."""
        if msgtype not in self._makers:
            fields = {name: self._field(*form) for name, form in self._store.fielddefs[msgtype][1]}
            kind = self._store.types[msgtype]

            def make(content: Content) -> Any:
                given = content if isinstance(content, dict) else dict(zip(fields, content, strict=True))
                return kind(
                    **{n: of(given[n]) if n in given else absent for n, (of, absent) in fields.items()}
                )

            self._makers[msgtype] = make
        return self._makers[msgtype]

    def _field(self, kind: int, detail: Any) -> tuple[Callable[[Any], Any], Any]:
        """Makes a field's value of what is given; and the value where nothing is."""
        if kind == Nodetype.NAME:
            make = self._maker(detail)
            return make, make({})
        if kind == Nodetype.BASE:
            plain = str if detail[0] == "string" else float if detail[0].startswith("float") else int
            return plain, plain()
        (inner, name), size = detail
        if inner == Nodetype.NAME:
            make = self._maker(name)
            return lambda given: [make(one) for one in given], []
        if name[0] == "string":
            return list, []
        dtype = _DTYPES.get(name[0], name[0])
        empty = np.zeros(size if kind == Nodetype.ARRAY else 0, dtype)
        return lambda given: np.array(given, dtype).reshape(-1), empty

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
        """Append messages as they are, in the encoding that they came in."""
        connection = batch.connection
        if connection not in self._copied:
            binary = connection.encoding == "protobuf"
            kind = connection.definition_format or ("protobuf" if binary else "jsonschema")
            text = connection.definition.encode("latin-1" if binary else "utf-8")
            schema = self._mcap.register_schema(connection.type, kind, text)
            self._copied[connection] = self._mcap.register_channel(
                connection.topic, connection.encoding, schema
            )
        stamps = (ns.view(np.uint64).tolist() for ns in (batch.log_ns, batch.publish_ns))
        for log_ns, publish_ns, data in zip(*stamps, batch.payloads(), strict=True):
            self._add(self._copied[connection], log_ns, data, publish_ns)

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Attach a file, for instance the configuration or the model."""
        with self._keeping():
            self._mcap.add_attachment(0, 0, name, media_type, data)

    def _schema(self, msgtype: str) -> int:
        if msgtype not in self._schemas:
            text, _ = self._store.generate_msgdef(msgtype, ros_version=2)
            self._schemas[msgtype] = self._mcap.register_schema(msgtype, "ros2msg", text.encode())
        return self._schemas[msgtype]


def _xyzw(orientation: ArrayLike) -> tuple[float, ...]:
    """A quaternion w, x, y, z as ROS has it."""
    w, x, y, z = np.asarray(orientation).tolist()
    return x, y, z, w


def write_samples(
    log: LogWriter, signals: Sequence[Signal], samples: Samples, stamp: Callable[[float], int]
) -> None:
    """Write one message for each time at which a signal was sampled, in the order of time.

    Args:
        log: The log to write to, open.
        signals: Signals to write, where there are samples of them; see `message_type`.
        samples: Samples of these signals, and perhaps of others.
        stamp: Turns a time [s] into a stamp [ns].

    Raises:
        ConfigError: A signal is of a message type that is not written here.
    """
    for time, signal, values in sorted(_messages(signals, samples), key=lambda message: message[0]):
        _WRITERS[message_type(signal)](log, signal, stamp(time), values)


def message_type(signal: Signal) -> str:
    """Name of the message that carries a signal, without its package: its own type, or the usual one.

    Raises:
        ConfigError: A signal is of a message type that is not written here.
    """
    name = (signal.type or _usual(signal)).split("/")[-1]
    if name not in _WRITERS or signal.fields:
        raise ConfigError(
            f"signal {signal.name!r} is of type {signal.type}; what can be written: {', '.join(_WRITERS)}"
        )
    return name


def _usual(signal: Signal) -> str:
    """The message that carries the quantities of a signal."""
    has = set(signal.quantities)
    if "value" in has:
        return "Float64MultiArray"
    if signal.names:
        return "JointState"
    if has & {"force", "torque"}:
        return "WrenchStamped"
    if "linear_acceleration" in has:
        return "Imu"
    return "PoseStamped" if has == {"position"} else "Odometry"


def _messages(
    signals: Sequence[Signal], samples: Samples
) -> Iterator[tuple[float, Signal, dict[str, FloatArray]]]:
    """Time [s], signal and its values, one signal after the other."""
    for signal in signals:
        known = {q: samples[signal.key(q)] for q in signal.quantities if signal.key(q) in samples}
        times = next(iter(known.values()))[0].tolist() if known else []
        for row, time in enumerate(times):
            yield time, signal, {quantity: values[row] for quantity, (_, values) in known.items()}


_ZERO, _UPRIGHT = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
_WRITERS: Mapping[str, Callable[[LogWriter, Signal, int, Mapping[str, FloatArray]], None]] = {
    "JointState": lambda log, signal, stamp_ns, values: log.joint_state(
        signal.topic, stamp_ns, signal.names, **values
    ),
    "Odometry": lambda log, signal, stamp_ns, values: log.odometry(
        signal.topic, stamp_ns, **{"position": _ZERO, "orientation": _UPRIGHT, **values},
        child_frame=signal.child_frame or signal.name,
    ),
    "PoseStamped": lambda log, signal, stamp_ns, values: log.pose(
        signal.topic, stamp_ns, values.get("position", _ZERO), values.get("orientation", np.zeros(4))
    ),
    "WrenchStamped": lambda log, signal, stamp_ns, values: log.wrench(
        signal.topic, stamp_ns, values.get("force", _ZERO), values.get("torque", _ZERO)
    ),
    "Imu": lambda log, signal, stamp_ns, values: log.imu(
        signal.topic, stamp_ns, values.get("orientation"), values.get("angular_velocity", _ZERO),
        values.get("linear_acceleration", _ZERO), frame=signal.child_frame or "imu",
    ),
    "Float64MultiArray": lambda log, signal, stamp_ns, values: log.numbers(
        signal.topic, stamp_ns, np.concatenate(list(values.values()))
    ),
}  # fmt: skip
