"""Commands to the motors, and their packet."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.robots.go1.link import wire
from amhe_cli.robots.go1.link.wire import JOINTS, LinkError

_LARGEST_COUNT, _LARGEST_FLOAT = 32767, float(np.finfo(np.float32).max)
_SCALES = np.array([[wire.TORQUE], [wire.KP], [wire.KD]], dtype=np.float32)
_MOTORS, _MOTORS_AT = wire.COMMAND["motors"].base, wire.COMMAND.fields["motors"][1]


def _off(value: float) -> FloatArray:
    off = np.full(JOINTS, value)
    off.setflags(write=False)
    return off


_NOTHING, _NO_POSITION, _NO_VELOCITY = _off(0.0), _off(wire.POSITION_OFF), _off(wire.VELOCITY_OFF)


@dataclass(frozen=True, slots=True, eq=False)
class MotorCommand:
    """What the twelve motors are to do: torque + kp (position - q) + kd (velocity - dq); each shape (12,).

    The defaults do nothing at all.

    Args:
        mode: Mode of all motors: `wire.SERVO` or `wire.DAMPED`.
        position: Target angles [rad]; `wire.POSITION_OFF`: no position loop.
        velocity: Target velocities [rad/s]; `wire.VELOCITY_OFF`: no velocity loop.
        torque: Torques that are added to those of the loops [N m].
        kp: Gains of the position loop [N m/rad].
        kd: Gains of the velocity loop [N m s/rad].
    """

    mode: int = wire.SERVO
    position: FloatArray = field(default_factory=lambda: _NO_POSITION)
    velocity: FloatArray = field(default_factory=lambda: _NO_VELOCITY)
    torque: FloatArray = field(default_factory=lambda: _NOTHING)
    kp: FloatArray = field(default_factory=lambda: _NOTHING)
    kd: FloatArray = field(default_factory=lambda: _NOTHING)


def encode(command: MotorCommand, crc: wire.CrcForm = "plain") -> bytes:
    """The packet of a command, 614 bytes; numbers are cut as the firmware cuts them, towards zero.

    Raises:
        LinkError: A number is not finite, or so large that its 16 bits would wrap: the robot would do the
            opposite of what was meant.
    """
    packet = bytearray(_TEMPLATE)
    motors: Any = np.ndarray(JOINTS, _MOTORS, packet, _MOTORS_AT)
    motors["mode"] = command.mode
    motors["position"], motors["velocity"] = _targets(command)
    motors["torque"], motors["kp"], motors["kd"] = _counts(command)
    return wire.seal(packet, crc)


@np.errstate(invalid="ignore")  # a signalling NaN is a matter for the trips
def decode(datagram: bytes) -> MotorCommand:
    """The command in a packet, with either form of checksum, as the robot reads it.

    The packet has a mode for each motor; that of the first stands for all, as `encode` writes it.

    Raises:
        PacketError: The datagram is not a command.
    """
    motors = wire.opened(datagram, wire.COMMAND, encrypted_too=True)["motors"][:JOINTS]
    return MotorCommand(
        int(motors["mode"][0]),
        motors["position"].astype(np.float64),
        motors["velocity"].astype(np.float64),
        motors["torque"] / wire.TORQUE,
        motors["kp"] / wire.KP,
        motors["kd"] / wire.KD,
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
    packet = wire.blank(wire.COMMAND)
    packet["motors"]["mode"] = wire.SERVO
    packet["motors"]["position"] = wire.POSITION_OFF
    packet["motors"]["velocity"] = wire.VELOCITY_OFF
    return packet.tobytes()


_TEMPLATE = _template()
