"""The packets of a Go1, byte by byte: commands to its motors, states that it reports, and their checksums.

Little endian, packed, no padding. Every offset was checked against Unitree's own library in both directions
(tests/robots/go1/link/test_codec.py does it again). Twenty motors fit into a packet; a Go1 has
the first twelve.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field
from math import asin, atan2
from typing import Any, Literal

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray, sealed
from amhe_cli.core.errors import AmheError

HEAD, LOW_LEVEL = b"\xfe\xef", 0xFF
#: Joints of a Go1, in the order of `kinematics.JOINTS`; motors that a packet has room for.
MOTORS, SLOTS = 12, 20
#: Modes of a motor: follow commands; no drive, but damped; switched off by itself, too hot.
SERVO, DAMPED, OVERHEATED = 0x0A, 0x00, 0x08
#: Position and velocity that mean "this loop is off".
POSITION_OFF, VELOCITY_OFF = 2.146e9, 16000.0
#: Counts of a packet's whole numbers: per N m, per N m/rad, per N m s/rad.
TORQUE, KP, KD = 256, 32, 16

_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_ENCRYPTION = 0xEDCAB9DE
CrcForm = Literal["plain", "encrypted"]


class PacketError(AmheError):
    """A datagram is not the packet that it should be."""


class LinkError(AmheError):
    """The robot cannot be reached or used, or a command does not fit into a packet."""


def _record(*fields: tuple[Any, ...]) -> Any:
    """A packed little-endian record."""
    return np.dtype(list(fields)).newbyteorder("<")


_HEADER = (
    ("head", "S2"), ("level", "u1"), ("frame_reserve", "u1"),
    ("serial", "u4", 2), ("version", "u4", 2), ("band_width", "u2"),
)  # fmt: skip
_BATTERY = _record(
    ("version", "u1", 2), ("status", "u1"), ("charge", "u1"), ("current", "i4"), ("cycles", "u2"),
    ("cell_temperature", "i1", 2), ("board_temperature", "i1", 2), ("cells", "u1", 10),
)  # fmt: skip
_MOTOR_COMMAND = _record(
    ("mode", "u1"), ("position", "f4"), ("velocity", "f4"), ("torque", "i2"), ("kp", "i2"), ("kd", "i2"),
    ("reserve", "u4", 3),
)  # fmt: skip
_MOTOR_STATE = _record(
    ("mode", "u1"), ("position", "f4"), ("velocity", "f4"), ("acceleration", "i2"), ("torque", "i2"),
    ("raw_position", "f4"), ("raw_velocity", "f4"), ("raw_acceleration", "i2"), ("temperature", "i1"),
    ("reserve", "u4", 2),
)  # fmt: skip

#: Packet to the robot, 614 bytes. `battery_off` is 0xA5 to cut the robot's power: nothing here ever sets it.
COMMAND = _record(
    *_HEADER, ("motors", _MOTOR_COMMAND, SLOTS), ("battery_off", "u1"), ("battery_reserve", "u1", 3),
    ("remote", "u1", 40), ("reserve", "u4"), ("crc", "u4"),
)  # fmt: skip
#: Packet from the robot, 807 bytes. Quaternion w, x, y, z; feet FR FL RR RL; cells in 32 mV; tick in ms.
STATE = _record(
    *_HEADER,
    ("quaternion", "f4", 4), ("gyro", "f4", 3), ("accelerometer", "f4", 3), ("rpy", "f4", 3),
    ("imu_temperature", "i1"),
    ("motors", _MOTOR_STATE, SLOTS), ("battery", _BATTERY),
    ("foot_force", "i2", 4), ("foot_force_estimate", "i2", 4), ("tick", "u4"),
    ("remote", "u1", 40), ("reserve", "u4"), ("crc", "u4"),
)  # fmt: skip


def blank(layout: Any) -> Any:
    """A packet of zeros but for its head, as a record that can be written to."""
    record: Any = np.zeros((), dtype=layout)
    record["head"], record["level"] = HEAD, LOW_LEVEL
    return record


def fields(packet: bytearray, layout: Any) -> Any:
    """A packet as a record: writing to it writes into the packet."""
    return np.frombuffer(packet, dtype=layout)[0]


def seal(packet: bytearray, form: CrcForm = "plain") -> bytes:
    """The packet with its checksum written: over all words but the last, which ends before the checksum."""
    crc = _checksum(packet)
    packet[-4:] = (crc if form == "plain" else encrypted(crc)).to_bytes(4, "little")
    return bytes(packet)


def opened(datagram: bytes, layout: Any, encrypted_too: bool = False) -> Any:
    """A datagram as a record of `layout`, read-only.

    Args:
        datagram: Bytes as they were received.
        layout: Expected layout, `COMMAND` or `STATE`.
        encrypted_too: Whether an encrypted checksum is accepted as well.

    Raises:
        PacketError: Length, head, level or checksum is wrong.
    """
    if len(datagram) != layout.itemsize:
        raise PacketError(f"{len(datagram)} bytes, not {layout.itemsize}")
    if datagram[:2] != HEAD:
        raise PacketError(f"begins with {datagram[:2].hex()}, not {HEAD.hex()}")
    if datagram[2] != LOW_LEVEL:
        raise PacketError(f"of level {datagram[2]:#04x}, not {LOW_LEVEL:#04x}")
    sent, crc = int.from_bytes(datagram[-4:], "little"), _checksum(datagram)
    of = f"checksum of {len(datagram)}-byte {'states' if layout is STATE else 'commands'}"
    if sent not in (crc, encrypted(crc)):
        raise PacketError(f"{of} is wrong")
    if sent != crc and not encrypted_too:
        raise PacketError(f"{of} is encrypted (`go1.crc=encrypted`)")
    return np.frombuffer(datagram, dtype=layout)[0]


def _checksum(packet: bytes | bytearray) -> int:
    return crc32(bytes(packet[: 4 * (len(packet) // 4 - 1)]))


def crc32(words: bytes) -> int:
    """Checksum of Go1 packets, over bytes whose number is a multiple of four.

    CRC-32 with polynomial 0x04C11DB7, all ones at the start, not reflected, no final xor, over little-endian
    32-bit words, most significant bit first. `zlib.crc32` is the reflected one over bytes: with the bits of
    each byte reversed and the bytes of each word swapped it computes the same, 50 times faster than a Python
    loop.
    """
    swapped = np.frombuffer(words, dtype=">u4").astype("<u4").tobytes()
    reflected = zlib.crc32(swapped.translate(_REVERSED)) ^ 0xFFFFFFFF
    return int.from_bytes(reflected.to_bytes(4, "little").translate(_REVERSED), "big")


def encrypted(crc: int) -> int:
    """A plain checksum in the form that some firmware expects: xor, then rotated right by a byte."""
    value = crc ^ _ENCRYPTION
    return (value >> 8) | ((value & 0xFF) << 24)


_LARGEST_COUNT, _LARGEST_FLOAT = 32767, float(np.finfo(np.float32).max)
_SCALES = np.array([[TORQUE], [KP], [KD]], dtype=np.float32)
_MOTORS, _MOTORS_AT = COMMAND["motors"].base, COMMAND.fields["motors"][1]


_NOTHING, _NO_POSITION, _NO_VELOCITY = (
    sealed(np.full(MOTORS, value)) for value in (0.0, POSITION_OFF, VELOCITY_OFF)
)


@dataclass(frozen=True, slots=True, eq=False)
class MotorCommand:
    """What the twelve motors are to do: torque + kp (position - q) + kd (velocity - dq); each shape (12,).

    The defaults do nothing at all.

    Args:
        mode: Mode of all motors: `SERVO` or `DAMPED`.
        position: Target angles [rad]; `POSITION_OFF`: no position loop.
        velocity: Target velocities [rad/s]; `VELOCITY_OFF`: no velocity loop.
        torque: Torques that are added to those of the loops [N m].
        kp: Gains of the position loop [N m/rad].
        kd: Gains of the velocity loop [N m s/rad].
    """

    mode: int = SERVO
    position: FloatArray = field(default_factory=lambda: _NO_POSITION)
    velocity: FloatArray = field(default_factory=lambda: _NO_VELOCITY)
    torque: FloatArray = field(default_factory=lambda: _NOTHING)
    kp: FloatArray = field(default_factory=lambda: _NOTHING)
    kd: FloatArray = field(default_factory=lambda: _NOTHING)


def encode_command(command: MotorCommand, crc: CrcForm = "plain") -> bytes:
    """The packet of a command, 614 bytes; numbers are cut as the firmware cuts them, towards zero.

    Raises:
        LinkError: A number is not finite, or so large that its 16 bits would wrap: the robot would do the
            opposite of what was meant.
    """
    packet = bytearray(_NO_COMMAND)
    motors: Any = np.ndarray(MOTORS, _MOTORS, packet, _MOTORS_AT)
    motors["mode"] = command.mode
    motors["position"], motors["velocity"] = _targets(command)
    motors["torque"], motors["kp"], motors["kd"] = _counts(command)
    return seal(packet, crc)


@np.errstate(invalid="ignore")  # a signalling NaN is a matter for the trips
def decode_command(datagram: bytes) -> MotorCommand:
    """The command in a packet, with either form of checksum, as the robot reads it.

    The packet has a mode for each motor; that of the first stands for all, as `encode_command` writes it.

    Raises:
        PacketError: The datagram is not a command.
    """
    motors = opened(datagram, COMMAND, encrypted_too=True)["motors"][:MOTORS]
    return MotorCommand(
        int(motors["mode"][0]),
        motors["position"].astype(np.float64),
        motors["velocity"].astype(np.float64),
        motors["torque"] / TORQUE,
        motors["kp"] / KP,
        motors["kd"] / KD,
    )


def _targets(command: MotorCommand) -> FloatArray:
    """Position and velocity that the packet holds, shape (2, 12)."""
    targets = np.array((command.position, command.velocity))
    if not np.abs(targets).max() < _LARGEST_FLOAT:  # not >=: nothing is less than NaN
        raise LinkError("a command's position or velocity is not finite")
    return targets


def _counts(command: MotorCommand) -> Any:
    """Torque, kp and kd as the packet's whole numbers, shape (3, 12)."""
    # the firmware multiplies in single precision
    counts = np.array((command.torque, command.kp, command.kd), dtype=np.float32) * _SCALES
    if not np.abs(counts).max() < _LARGEST_COUNT + 1:
        row = int(np.argmin((np.abs(counts) < _LARGEST_COUNT + 1).all(axis=1)))
        worst = float(np.abs(counts[row]).max() / _SCALES[row, 0])
        most = _LARGEST_COUNT / float(_SCALES[row, 0])
        raise LinkError(
            f"a command's {('torque', 'kp', 'kd')[row]} of {worst:g} does not fit; the most is {most:g}"
        )
    return counts.astype(np.int16)  # cuts towards zero


def _template() -> bytes:
    """A packet that does nothing, all twenty motors idle: the vendor's, but for the checksum."""
    packet = blank(COMMAND)
    packet["motors"]["mode"] = SERVO
    packet["motors"]["position"] = POSITION_OFF
    packet["motors"]["velocity"] = VELOCITY_OFF
    return packet.tobytes()


_NO_COMMAND = _template()


#: Bits of the remote control's keys.
_KEYS = (
    "R1", "L1", "start", "select", "R2", "L2", "F1", "F2", "A", "B", "X", "Y", "up", "right", "down", "left",
)  # fmt: skip


def pressed(remote: bytes) -> set[str]:
    """Keys of the remote control that are held down, in its 40 bytes; none where there is no remote."""
    word = int.from_bytes(remote[2:4], "little")
    return {name for bit, name in enumerate(_KEYS) if word >> bit & 1} if word else set()


def pressing(*keys: str) -> bytes:
    """The inverse of `pressed`."""
    return bytes(2) + sum(1 << _KEYS.index(key) for key in keys).to_bytes(2, "little") + bytes(36)


@dataclass(frozen=True, slots=True, eq=False)
class RobotState:
    """What we read of a packet of the robot; joints in the order of `kinematics.JOINTS`.

    Args:
        tick: The robot's own clock [ms].
        quaternion: Trunk by the IMU, w, x, y, z, shape (4,).
        gyro: Angular velocity in the trunk's frame [rad/s], shape (3,).
        accelerometer: Specific force in the trunk's frame [m/s^2], shape (3,).
        modes: Modes of the motors, shape (12,).
        joints: Joint angles [rad], shape (12,).
        joint_rates: Joint velocities [rad/s], shape (12,).
        torques: Torques that the motors estimate [N m], shape (12,).
        temperatures: Temperatures of the motors [deg C], shape (12,).
        charge: Charge of the battery [%].
        remote: The remote control's 40 bytes.
    """

    tick: int
    quaternion: FloatArray
    gyro: FloatArray
    accelerometer: FloatArray
    modes: IntArray
    joints: FloatArray
    joint_rates: FloatArray
    torques: FloatArray
    temperatures: FloatArray
    charge: int
    remote: bytes = bytes(40)


@np.errstate(invalid="ignore")  # a signalling NaN is a matter for the trips
def decode_state(datagram: bytes, crc: CrcForm = "plain") -> RobotState:
    """The state of a packet.

    Args:
        datagram: Bytes as they were received.
        crc: Form of the robot's checksums. If it is 'plain', an encrypted one is rejected, as by the vendor's
            own library; else either is accepted, since nobody knows what such a robot sends.

    Raises:
        PacketError: It is not a state.
    """
    record = opened(datagram, STATE, encrypted_too=crc == "encrypted")
    motors = record["motors"][:MOTORS]
    imu = np.frombuffer(datagram, "<f4", 10, _IMU_AT).astype(np.float64)  # three fields at once
    return RobotState(
        int(record["tick"]),
        imu[:4],
        imu[4:7],
        imu[7:],
        motors["mode"].astype(np.int64),
        motors["position"].astype(np.float64),
        motors["velocity"].astype(np.float64),
        motors["torque"] / TORQUE,
        motors["temperature"].astype(np.float64),
        int(record["battery"]["charge"]),
        record["remote"].tobytes(),
    )


def encode_state(state: RobotState, crc: CrcForm = "plain") -> bytes:
    """The packet of a state, 807 bytes, as a robot in low-level mode sends it.

    Torques and temperatures are clipped to what fits.
    """
    packet = bytearray(_NO_STATE)
    record = fields(packet, STATE)
    record["quaternion"], record["gyro"] = state.quaternion, state.gyro
    record["accelerometer"], record["rpy"] = state.accelerometer, _rpy(state.quaternion)
    motors = record["motors"][:MOTORS]
    motors["mode"] = state.modes
    motors["position"] = motors["raw_position"] = state.joints
    motors["velocity"] = motors["raw_velocity"] = state.joint_rates
    motors["torque"] = np.minimum(np.maximum(np.trunc(state.torques * TORQUE), -32768), 32767)
    motors["temperature"] = np.minimum(np.maximum(state.temperatures, -128), 127)
    record["battery"]["charge"], record["battery"]["status"] = state.charge, 1
    record["tick"] = state.tick % 2**32
    record["remote"] = np.frombuffer(state.remote, dtype=np.uint8)
    return seal(packet, crc)


def _rpy(q: FloatArray) -> tuple[float, float, float]:
    """Roll, pitch and yaw [rad] of a unit quaternion."""
    w, x, y, z = q.tolist()
    return (
        atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x)))),
        atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


_IMU_AT = STATE.fields["quaternion"][1]
_NO_STATE = blank(STATE).tobytes()
