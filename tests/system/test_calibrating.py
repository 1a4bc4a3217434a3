"""What may be said of a signal's calibration, and what is refused, in one line each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.matching.readings import reading_of
from amhe_cli.system.system import System

Write = Callable[..., Path]
MASS = "  p: {targets: [{body: box, set: mass}]}\n"
HIP = "{topic: /j, joints: [hip, knee], noise: {position: 0.01, effort: 0.1}"


def load(written: Write, signal: str, target: str = "", more: str = "") -> System:
    parameters = f"  p: {{targets: [{target}], bounds: [-1, 1]}}\n" if target else MASS
    return System.load(written(parameters, signals=f"signals:\n  s: {signal}\n{more}"), warn=False)


def test_numbers_are_those_of_the_file_until_a_parameter_sets_them(written: Write) -> None:
    system = load(
        written,
        HIP + ", bias: {effort: [0.3, 0.4]}, scale: {effort: 2}}",
        "{signal: s, set: bias, quantity: effort, joint: knee}",
    )
    assert system.space.nominal[0] == 0.4  # the file's own
    assert system.space.parameters[0].unit == "N m"
    reading = system.calibration.readings["s.effort"]
    numbers = system.edits.numbers(np.array([[0.4], [0.7]]))
    np.testing.assert_array_equal(numbers[:, list(reading.bias)], [[0.3, 0.4], [0.3, 0.7]])
    np.testing.assert_array_equal(numbers[:, list(reading.scale)], 2.0)
    assert "s.position" not in system.calibration.readings


def test_each_joint_may_have_a_torque_constant_of_its_own(written: Write) -> None:
    knee = "  p: {targets: [{signal: s, set: scale, quantity: effort, joint: knee}]}\n"
    system = System.load(written(knee, signals=f"signals:\n  s: {HIP}}}\n"), warn=False)
    reading = system.calibration.readings["s.effort"]
    numbers = system.edits.numbers(np.array([[0.5]]))
    np.testing.assert_array_equal(numbers[:, list(reading.scale)], [[1.0, 0.5]])
    (channel,) = (c for c in system.channels if c.key == "s.effort")
    shown = reading_of(channel, reading, numbers, np.array([[[3.0, 4.0]]]))
    np.testing.assert_array_equal(shown, [[[3.0, 2.0]]])


def test_the_zero_of_an_encoder_moves_stops_and_springs_along(written: Write) -> None:
    plain, moved = load(written, HIP + "}").model, load(written, HIP + ", bias: {position: [0.2, 0]}}").model
    hip = int(plain.joint("hip").qposadr[0])
    assert moved.qpos0[hip] - plain.qpos0[hip] == pytest.approx(0.2)
    assert moved.qpos_spring[hip] - plain.qpos_spring[hip] == pytest.approx(0.2)
    np.testing.assert_allclose(
        moved.jnt_range[plain.joint("hip").id] - plain.jnt_range[plain.joint("hip").id], 0.2
    )
    knee = int(plain.joint("knee").qposadr[0])
    assert moved.qpos0[knee] == plain.qpos0[knee]


@pytest.mark.parametrize(
    ("signal", "text"),
    [
        (HIP + ", bias: {effort: [1, 2, 3]}}", "bias of effort has 3 numbers; it needs 2"),
        (HIP + ", bias: {force: 1}}", "no quantity with a bias 'force'"),
        (HIP + ", scale: 0}", "scale is 0; a number above 0"),
        (HIP + ", frame: [0, 0, 0, 0, 0, 0]}", "frame of a body or site"),
        (HIP + ", frame: [0, 0, 0]}", "frame is [0, 0, 0]; world, body, or [x, y, z, roll, pitch, yaw]"),
        (HIP + ", frame: body}", "frame: body is for force_on"),
        (HIP + ", band: -1}", "band is -1; a number above 0"),
        (HIP + ", smooth: 0.1}", "smooth is for what drives the model"),
        (HIP + ", at: grip}", "at is for force_on"),
        (HIP + ", reaction: true}", "reaction is for forces and torques"),
        (HIP + ", active: 3}", "active is 3; times such as [[0.5, 3.0]], or a signal and its value"),
        (HIP + ", active: [[0, 1], [4, 1]]}", "active: a stretch from 4 to 1 s ends before it begins"),
        (HIP + ", active: {on: 1}}", "active: no signal that is only read 'on'"),
        (
            "{topic: /m, mocap: marker, scale: 2}",
            "scale is for what is compared with the model, and for force_on",
        ),
        ("{topic: /m, mocap: marker, band: 2}", "band is for numbers that are compared"),
        ("{topic: /f, force_on: box, at: s}", "the signal 's' must be only read, with quantity: position"),
        (
            "{topic: /i, site: imu, noise: {position: 1, force: 1}, frame: [0, 0, 0, 0, 0, 1]}",
            "in the world and in the site's own axes: split it in two",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(written: Write, signal: str, text: str) -> None:
    with pytest.raises(ConfigError) as raised:
        load(written, signal)
    (line,) = str(raised.value).splitlines()
    assert text in line and "system.yaml:" in line, line


def test_a_declared_zero_of_an_encoder_is_no_parameter_that_is_held(written: Write) -> None:
    system = load(
        written,
        HIP + ", bias: {position: 0.03}}",
        more="  c: {topic: /c, actuators: [hip_servo], quantity: position}\n",
    )
    assert list(system.edits.considered()) == []


@pytest.mark.parametrize(
    ("target", "text"),
    [
        ("{signal: t, set: bias}", "no signal 't'; there is: s"),
        ("{signal: s, set: bias}", "say which quantity: one of position, velocity, effort"),
        ("{signal: s, set: bias, quantity: effort, joint: hop}", "no joint or axis of this signal 'hop'"),
        ("{signal: s, set: band}", "give the signal a band of its own, such as band: 100"),
        ("{signal: s, set: frame, axis: yaw}", "frame of a body or site"),
        ("{signal: s, set: frame}", "needs axis: one of x, y, z, roll, pitch, yaw"),
        ("{signal: s, set: mass}", "target 'mass' needs body: NAME, not signal"),
        ("{joint: hip, set: bias}", "target 'bias' needs signal: NAME, not joint"),
    ],
)
def test_a_target_that_makes_no_sense_is_refused(written: Write, target: str, text: str) -> None:
    with pytest.raises(ConfigError) as raised:
        load(written, HIP + "}", target)
    (line,) = str(raised.value).splitlines()
    assert text in line and "system.yaml:" in line, line
