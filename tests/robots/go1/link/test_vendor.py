"""Field by field against Unitree's own library, in both directions, over loopback."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from amhe_cli.robots.go1.link.packets import (
    DAMPED,
    HEAD,
    SERVO,
    STATE,
    MotorCommand,
    PacketError,
    decode_command,
    decode_state,
    encode_command,
    encode_state,
    opened,
    pressing,
    seal,
)
from tests.robots.go1.link.puppet import a_state

sdk = pytest.importorskip(
    "unitree_legged_sdk.robot_interface",
    reason="unitree-legged-sdk has no wheel for this Python: pip install --no-deps unitree-legged-sdk",
)


class Vendor:
    """Their client, and a socket in the robot's place."""

    def __init__(self) -> None:
        self.robot = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.robot.bind(("127.0.0.1", 0))
        self.robot.settimeout(2.0)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.udp = sdk.UDP(0xFF, self.port, "127.0.0.1", self.robot.getsockname()[1])
        self.command, self.state = sdk.LowCmd(), sdk.LowState()
        self.udp.InitCmdData(self.command)

    def sends(self, encrypted: bool = False) -> bytes:
        self.udp.SetSend(self.command)
        if encrypted:
            self.udp.SetSend("[encryptCRC]")
        self.udp.Send()
        return self.robot.recv(2000)

    def reads(self, datagram: bytes) -> int:
        self.robot.sendto(datagram, ("127.0.0.1", self.port))
        result = self.udp.Recv()
        self.udp.GetRecv(self.state)
        return result


@pytest.fixture
def vendor() -> Iterator[Vendor]:
    it = Vendor()
    yield it
    it.robot.close()


def a_command(rng: np.random.Generator) -> MotorCommand:
    return MotorCommand(
        int(rng.choice([SERVO, DAMPED])),
        *(rng.uniform(-most, most, 12) for most in (3.0, 20.0, 40.0, 200.0, 20.0)),
    )


@pytest.mark.parametrize("form", ["plain", "encrypted"])
def test_our_commands_are_theirs_byte_for_byte(vendor: Vendor, form) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        ours = a_command(rng)
        for i, motor in enumerate(vendor.command.motorCmd[:12]):
            motor.mode = ours.mode
            motor.q, motor.dq, motor.tau = ours.position[i], ours.velocity[i], ours.torque[i]
            motor.Kp, motor.Kd = ours.kp[i], ours.kd[i]
        assert encode_command(ours, form) == vendor.sends(form == "encrypted")


def test_their_commands_are_read_as_they_are_meant(vendor: Vendor) -> None:
    for i, motor in enumerate(vendor.command.motorCmd[:12]):
        motor.q, motor.dq, motor.tau, motor.Kp, motor.Kd = 0.1 * i, -0.2 * i, 0.5 * i, 10.0 + i, 0.25 * i
    read, i = decode_command(vendor.sends()), np.arange(12)
    assert read.mode == SERVO
    for values, expected in (
        (read.position, 0.1 * i), (read.velocity, -0.2 * i), (read.torque, 0.5 * i),
        (read.kp, 10.0 + i), (read.kd, 0.25 * i),
    ):  # fmt: skip
        np.testing.assert_allclose(values, expected, atol=1e-6)


def test_they_read_of_our_states_what_we_wrote(vendor: Vendor) -> None:
    rng = np.random.default_rng(1)
    sent = a_state(
        tick=123456, quaternion=rng.normal(size=4), gyro=rng.normal(size=3), accelerometer=rng.normal(size=3),
        joints=rng.normal(size=12), joint_rates=rng.normal(size=12), torques=rng.uniform(-30, 30, 12),
        temperatures=np.arange(20.0, 32.0), charge=63, remote=pressing("L2", "B"),
    )  # fmt: skip
    assert vendor.reads(encode_state(sent)) == 0
    theirs = vendor.state
    assert (theirs.tick, theirs.bms.SOC) == (123456, 63)
    assert bytes(theirs.wirelessRemote) == sent.remote
    for ours, read in (
        (sent.quaternion, theirs.imu.quaternion), (sent.gyro, theirs.imu.gyroscope),
        (sent.accelerometer, theirs.imu.accelerometer),
        (sent.joints, [m.q for m in theirs.motorState[:12]]),
        (sent.joint_rates, [m.dq for m in theirs.motorState[:12]]),
        (np.trunc(sent.torques * 256) / 256, [m.tauEst for m in theirs.motorState[:12]]),
        (sent.temperatures, [m.temperature for m in theirs.motorState[:12]]),
        (sent.modes, [m.mode for m in theirs.motorState[:12]]),
    ):  # fmt: skip
        np.testing.assert_array_equal(np.float32(ours), np.float32(read))


def test_every_byte_of_a_state_means_the_same_to_them_and_to_us(vendor: Vendor) -> None:
    """Random bytes in every field: the whole layout, the fields that `RobotState` leaves out included."""
    rng = np.random.default_rng(2)
    packet = bytearray(rng.integers(0, 120, 807, dtype=np.uint8).tobytes())
    packet[:3] = HEAD + b"\xff"
    assert vendor.reads(seal(packet)) == 0
    ours, theirs = opened(bytes(packet), STATE), vendor.state
    battery, scales = theirs.bms, {"torque": 256}
    names = {
        "mode": "mode", "position": "q", "velocity": "dq", "acceleration": "ddq", "torque": "tauEst",
        "raw_position": "q_raw", "raw_velocity": "dq_raw", "raw_acceleration": "ddq_raw",
        "temperature": "temperature",
    }  # fmt: skip
    pairs: list[tuple[Any, Any]] = [
        (ours["quaternion"], theirs.imu.quaternion), (ours["gyro"], theirs.imu.gyroscope),
        (ours["accelerometer"], theirs.imu.accelerometer), (ours["rpy"], theirs.imu.rpy),
        (ours["imu_temperature"], theirs.imu.temperature), (ours["band_width"], theirs.bandWidth),
        (ours["foot_force"], theirs.footForce), (ours["foot_force_estimate"], theirs.footForceEst),
        (ours["tick"], theirs.tick), (ours["reserve"], theirs.reserve),
        (ours["remote"], theirs.wirelessRemote),
        (ours["battery"]["version"], [battery.version_h, battery.version_l]),
        (ours["battery"]["status"], battery.bms_status), (ours["battery"]["charge"], battery.SOC),
        (ours["battery"]["current"], battery.current), (ours["battery"]["cycles"], battery.cycle),
        (ours["battery"]["cell_temperature"], battery.BQ_NTC),
        (ours["battery"]["board_temperature"], battery.MCU_NTC),
        (32 * ours["battery"]["cells"].astype(int), battery.cell_vol),
        *(
            (ours["motors"][name] / scales.get(name, 1), [getattr(m, other) for m in theirs.motorState])
            for name, other in names.items()
        ),
    ]  # fmt: skip
    for mine, other in pairs:
        np.testing.assert_array_equal(np.float32(mine), np.float32(other))


def test_their_verdict_on_a_damaged_state_is_ours(vendor: Vendor) -> None:
    rng, good = np.random.default_rng(3), encode_state(a_state())
    verdicts = []
    for _ in range(2000):
        packet = bytearray(good)
        for position in rng.integers(0, 807, rng.integers(0, 3)):
            packet[position] = rng.integers(0, 256)
        verdicts.append((vendor.reads(bytes(packet)) == 0, _we_accept(bytes(packet))))
    theirs, ours = np.array(verdicts).T
    np.testing.assert_array_equal(ours, theirs)
    assert 100 < ours.sum() < 1900


def _we_accept(packet: bytes) -> bool:
    try:
        decode_state(packet)
    except PacketError:
        return False
    return True
