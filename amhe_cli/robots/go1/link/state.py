"""What the robot reports about itself, and the packet that carries it."""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, atan2

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.robots.go1.link import wire
from amhe_cli.robots.go1.link.wire import JOINTS

#: Bits of the remote control's keys.
_KEYS = (
    "R1", "L1", "start", "select", "R2", "L2", "F1", "F2", "A", "B", "X", "Y", "up", "right", "down", "left",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Remote:
    """Keys of the remote control that are held down, by name."""

    keys: frozenset[str] = frozenset()

    @staticmethod
    def of(raw: bytes) -> Remote:
        """Keys in the 40 bytes of a state; none where there is no remote control."""
        word = int.from_bytes(raw[2:4], "little")
        return Remote(
            frozenset(name for bit, name in enumerate(_KEYS) if word >> bit & 1) if word else frozenset()
        )

    def raw(self) -> bytes:
        """The inverse of `of`."""
        word = sum(1 << _KEYS.index(name) for name in self.keys)
        return bytes(2) + word.to_bytes(2, "little") + bytes(36)

    @property
    def stops(self) -> bool:
        """Whether L2 + B or select is pressed: motors are damped at once."""
        return {"L2", "B"} <= self.keys or "select" in self.keys

    @property
    def arms(self) -> bool:
        """Whether R2 is pressed: the run may begin."""
        return "R2" in self.keys


@dataclass(frozen=True, slots=True, eq=False)
class RobotState:
    """One packet of the robot; joints in the order of `legs.JOINTS`, feet FR FL RR RL.

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
        foot_force: Readings of the foot sensors in their own unit, shape (4,).
        charge: Charge of the battery [%].
        remote: The remote control's 40 bytes.
        serial: Two numbers that give kind and model.
        version: Versions of hardware and firmware, two numbers.
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
    foot_force: FloatArray
    charge: int
    remote: bytes = bytes(40)
    serial: tuple[int, int] = (0, 0)
    version: tuple[int, int] = (0, 0)


@np.errstate(invalid="ignore")  # a signalling NaN is a matter for the trips
def decode(datagram: bytes, crc: wire.CrcForm = "plain") -> RobotState:
    """The state of a packet.

    Args:
        datagram: Bytes as they were received.
        crc: Form of the robot's checksums. If it is 'plain', an encrypted one is rejected, as by the vendor's
            own library; else either is accepted, since nobody knows what such a robot sends.

    Raises:
        PacketError: It is not a state.
    """
    record = wire.opened(datagram, wire.STATE, encrypted_too=crc == "encrypted")
    motors = record["motors"][:JOINTS]
    imu = np.frombuffer(datagram, "<f4", 10, _IMU_AT).astype(np.float64)  # three fields at once
    return RobotState(
        int(record["tick"]),
        imu[:4],
        imu[4:7],
        imu[7:],
        motors["mode"].astype(np.int64),
        motors["position"].astype(np.float64),
        motors["velocity"].astype(np.float64),
        motors["torque"] / wire.TORQUE,
        motors["temperature"].astype(np.float64),
        record["foot_force"].astype(np.float64),
        int(record["battery"]["charge"]),
        record["remote"].tobytes(),
        (int(record["serial"][0]), int(record["serial"][1])),
        (int(record["version"][0]), int(record["version"][1])),
    )


def encode(state: RobotState, crc: wire.CrcForm = "plain") -> bytes:
    """The packet of a state, 807 bytes, as a robot in low-level mode sends it.

    Torques and temperatures are clipped to what fits.
    """
    packet = bytearray(_TEMPLATE)
    record = wire.fields(packet, wire.STATE)
    record["serial"], record["version"] = state.serial, state.version
    record["quaternion"], record["gyro"] = state.quaternion, state.gyro
    record["accelerometer"], record["rpy"] = state.accelerometer, _rpy(state.quaternion)
    motors = record["motors"][:JOINTS]
    motors["mode"] = state.modes
    motors["position"] = motors["raw_position"] = state.joints
    motors["velocity"] = motors["raw_velocity"] = state.joint_rates
    motors["torque"] = np.minimum(np.maximum(np.trunc(state.torques * wire.TORQUE), -32768), 32767)
    motors["temperature"] = np.minimum(np.maximum(state.temperatures, -128), 127)
    record["battery"]["charge"], record["battery"]["status"] = state.charge, 1
    record["foot_force"] = np.minimum(np.maximum(state.foot_force, -32768), 32767)
    record["tick"] = state.tick % 2**32
    record["remote"] = np.frombuffer(state.remote, dtype=np.uint8)
    return wire.seal(packet, crc)


def _rpy(q: FloatArray) -> tuple[float, float, float]:
    """Roll, pitch and yaw [rad] of a unit quaternion."""
    w, x, y, z = q.tolist()
    return (
        atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x)))),
        atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


_IMU_AT = wire.STATE.fields["quaternion"][1]
_TEMPLATE = wire.blank(wire.STATE).tobytes()
