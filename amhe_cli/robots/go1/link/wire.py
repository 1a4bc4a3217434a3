"""The layout of both packets, byte by byte, and what makes a datagram one of them.

Little endian, packed, no padding. Every offset was checked against Unitree's own library in both directions
(tests/robots/go1/link/test_vendor.py does it again). Twenty motors fit into a packet; a Go1 has
the first twelve.
"""

from __future__ import annotations

import zlib
from typing import Any, Literal

import numpy as np

from amhe_cli.core.errors import AmheError

HEAD, LOW_LEVEL = b"\xfe\xef", 0xFF
#: Joints of a Go1, in the order of `legs.JOINTS`; motors that a packet has room for.
JOINTS, SLOTS = 12, 20
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
