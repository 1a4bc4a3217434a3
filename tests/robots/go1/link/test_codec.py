"""Packets, held against the maker's own library."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from amhe_cli.robots.go1.link.packets import (
    DAMPED,
    HEAD,
    SERVO,
    STATE,
    LinkError,
    MotorCommand,
    PacketError,
    crc32,
    decode_command,
    decode_state,
    encode_command,
    encode_state,
    encrypted,
    opened,
    pressed,
    pressing,
    seal,
)
from tests.robots.go1.stand_ins import a_state

FIELDS = {"position": 1e6, "velocity": 1e4, "torque": 127.9, "kp": 1023.0, "kd": 2047.0}
#: Counts of what is sent as a whole number.
SCALES = {"torque": 256, "kp": 32, "kd": 16}


def single(size: float, width: int = 12) -> st.SearchStrategy:
    return arrays(np.float64, width, elements=st.floats(-size, size, width=32))


COMMANDS = st.builds(
    MotorCommand,
    mode=st.sampled_from([SERVO, DAMPED]),
    **{name: single(float(np.float32(size))) for name, size in FIELDS.items()},
)


def test_the_checksum_is_the_published_one() -> None:
    assert crc32(b"12345678") == 0xFEFC54F9
    assert encrypted(0) == 0xDEEDCAB9


def test_a_command_that_does_nothing_is_the_vendors_byte_for_byte() -> None:
    packet = encode_command(MotorCommand())
    assert len(packet) == 614
    assert packet[:3].hex() == "feefff"
    assert packet[22:31].hex() == "0ab9d2ff4e00007a46"
    assert packet[-4:].hex() == "e2f07f34"


@pytest.mark.parametrize(
    ("field", "offset", "value", "golden"),
    [
        ("torque", 9, 0.65, "a600"), ("torque", 9, -0.65, "5aff"), ("torque", 9, 23.7, "b317"),
        ("kp", 11, 5.0, "a000"), ("kp", 11, 20.0, "8002"), ("kp", 11, 35.5, "7004"), ("kp", 11, 55.0, "e006"),
        ("kd", 13, 1.0, "1000"), ("kd", 13, 3.0, "3000"), ("kd", 13, 0.5, "0800"), ("kd", 13, 0.05, "0000"),
        ("position", 1, 0.5, "0000003f"),
    ],
)  # fmt: skip
def test_numbers_are_cut_as_the_firmware_cuts_them(field, offset, value, golden) -> None:
    values = np.zeros(12)
    values[3] = value
    packet = encode_command(MotorCommand(**{field: values}))
    at = 22 + 27 * 3 + offset
    assert packet[at : at + len(golden) // 2].hex() == golden


@settings(deadline=None, max_examples=50)
@given(COMMANDS, st.sampled_from(["plain", "encrypted"]))
def test_a_command_comes_back_cut_to_the_firmwares_steps(sent: MotorCommand, form) -> None:
    read = decode_command(encode_command(sent, form))
    assert read.mode == sent.mode
    for name in FIELDS:
        expected = np.asarray(getattr(sent, name), dtype=np.float32)
        if name in SCALES:
            expected = np.trunc(expected * SCALES[name]) / SCALES[name]
        np.testing.assert_array_equal(getattr(read, name), expected)


@settings(deadline=None, max_examples=50)
@given(COMMANDS)
def test_no_command_can_switch_the_battery_off(sent: MotorCommand) -> None:
    packet = encode_command(sent)
    assert packet[562:610] == bytes(48)
    assert packet[22 + 27 * 12 : 562] == encode_command(MotorCommand())[22 + 27 * 12 : 562]


@pytest.mark.parametrize(
    ("field", "value"), [("torque", 128.0), ("torque", -200.0), ("kp", 1024.0), ("kd", 2048.0)]
)
def test_what_would_wrap_is_refused(field: str, value: float) -> None:
    values = np.zeros(12)
    values[5] = value
    with pytest.raises(LinkError, match=rf"{field} of {abs(value):g} does not fit"):
        encode_command(MotorCommand(**{field: values}))


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_refused(field: str, value: float) -> None:
    values = np.zeros(12)
    values[11] = value
    with pytest.raises(LinkError):
        encode_command(MotorCommand(**{field: values}))


@settings(deadline=None, max_examples=50)
@given(single(10.0), single(30.0), single(40.0), single(1.0, 4), single(20.0, 3), st.integers(0, 2**32 - 1))
def test_a_state_comes_back(joints, rates, torques, quaternion, gyro, tick) -> None:
    sent = a_state(
        tick=tick, joints=joints, joint_rates=rates, torques=torques, quaternion=quaternion, gyro=gyro,
        remote=pressing("L2", "B"),
    )  # fmt: skip
    read = decode_state(encode_state(sent))
    assert (read.tick, read.charge, read.remote) == (tick, sent.charge, sent.remote)
    for name in ("joints", "joint_rates", "quaternion", "gyro", "modes", "temperatures"):
        np.testing.assert_array_equal(getattr(read, name), np.float32(getattr(sent, name)))
    np.testing.assert_array_equal(read.torques, np.trunc(torques * 256) / 256)


@settings(deadline=None, max_examples=100)
@given(st.data())
def test_one_wrong_bit_is_noticed_wherever_the_checksum_reaches(data) -> None:
    for packet, decode, covered in (
        (encode_command(MotorCommand()), decode_command, 608),
        (encode_state(a_state()), decode_state, 800),
    ):
        position = data.draw(st.integers(0, covered - 1))
        broken = bytearray(packet)
        broken[position] ^= 1 << data.draw(st.integers(0, 7))
        with pytest.raises(PacketError):
            decode(bytes(broken))


@settings(deadline=None, max_examples=100)
@given(st.binary(max_size=1200))
def test_rubbish_is_a_bad_packet_and_nothing_else(datagram: bytes) -> None:
    for decode in (decode_command, decode_state):
        with pytest.raises(PacketError):
            decode(datagram)


def test_the_robots_side_takes_either_checksum_and_ours_only_the_plain_one() -> None:
    packet = encode_command(MotorCommand(), "encrypted")
    assert decode_command(packet).mode == SERVO
    sealed = seal(bytearray(encode_state(a_state())), "encrypted")
    with pytest.raises(PacketError, match="checksum"):
        decode_state(sealed)


def test_keys_of_the_remote() -> None:
    assert int.from_bytes(pressing("L2", "B")[2:4], "little") == 0x0220
    assert pressed(pressing("L2", "B")) == {"L2", "B"}
    assert pressed(bytes(40)) == set()


@pytest.mark.filterwarnings("error")
def test_a_signalling_nan_is_read_as_one_without_a_word() -> None:
    record = bytearray(encode_state(a_state()))
    record[22:26] = bytes.fromhex("010080ff")
    assert np.isnan(decode_state(seal(record)).quaternion[0])


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
