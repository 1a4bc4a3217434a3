"""Packets: golden vectors, round trips, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from amhe_cli.robots.go1.link.packets import (
    DAMPED,
    SERVO,
    LinkError,
    MotorCommand,
    PacketError,
    crc32,
    decode_command,
    decode_state,
    encode_command,
    encode_state,
    encrypted,
    pressed,
    pressing,
    seal,
)
from tests.robots.go1.link.puppet import a_state

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
