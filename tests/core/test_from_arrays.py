"""Logs from arrays: the same as logs from files, and mistakes are named."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from amhe_cli.core.bundled import bundled_root
from amhe_cli.core.errors import LogError
from amhe_cli.core.log import Log, sampled
from amhe_cli.logs import read_log
from amhe_cli.system.system import System

PENDULUM = System.load("pendulum")
TIME = np.arange(0.0, 2.0, 0.01)


def arrays(**changes: Any) -> dict[str, Any]:
    joints = {"time": TIME, "position": np.sin(TIME)}
    return {"joints": joints, "command": {"time": TIME[::2], "position": np.zeros(100)}} | changes


def test_arrays_make_the_log_that_the_file_makes() -> None:
    read = read_log(bundled_root() / "examples" / "logs" / "pendulum.mcap", PENDULUM)
    given: dict[str, Any] = {}
    for key, (time, values) in sampled(read).items():
        signal, quantity = key.split(".")
        given.setdefault(signal, {"time": time})[quantity] = values
    made = Log.from_arrays(given, PENDULUM)
    assert made.steps == read.steps
    for key, series in read.series.items():
        np.testing.assert_allclose(made[key].values, series.values, atol=1e-12, err_msg=key)
        np.testing.assert_array_equal(made[key].valid, series.valid)
        np.testing.assert_array_equal(made[key].sampled, series.sampled)
        assert made[key].columns == series.columns


def test_a_velocity_that_is_missing_is_differentiated() -> None:
    log = Log.from_arrays(arrays(), PENDULUM)
    velocity = log["joints.velocity"]
    assert velocity.derived and not log["joints.position"].derived
    time = log.dt * np.arange(log.steps)
    np.testing.assert_allclose(velocity.values[20:-20, 0], np.cos(time[20:-20]), atol=1e-3)


def test_masked_values_are_not_measured() -> None:
    """Masked garbage had been fitted."""
    wrong = (TIME > 0.5) & (TIME < 0.6)
    position = np.where(wrong, 1e6, np.sin(TIME))
    masked = Log.from_arrays(
        arrays(joints={"time": TIME, "position": np.ma.masked_array(position, wrong)}), PENDULUM
    )
    missing = np.where(wrong, np.nan, position)
    same = Log.from_arrays(arrays(joints={"time": TIME, "position": missing}), PENDULUM)
    for key in ("joints.position", "joints.velocity"):
        np.testing.assert_array_equal(masked[key].values, same[key].values)
        np.testing.assert_array_equal(masked[key].valid, same[key].valid)
    assert np.abs(masked["joints.position"].values).max() < 1.0


def test_commands_are_held_or_lie_on_the_line_to_the_next() -> None:
    ramp = {"time": TIME[::2], "position": 3.0 * TIME[::2]}
    signals = tuple(replace(s, hold=not s.is_input) for s in PENDULUM.signals)
    held = Log.from_arrays(arrays(command=ramp), PENDULUM)
    line = Log.from_arrays(arrays(command=ramp), replace(PENDULUM, signals=signals))
    time = (held.dt * np.arange(held.steps))[line["command.position"].valid]
    found = line["command.position"].values[: len(time), 0]
    np.testing.assert_allclose(found, 3.0 * time, atol=1e-9)
    steps = held["command.position"].values[: len(time), 0]
    np.testing.assert_allclose(steps, 3.0 * 0.02 * np.floor(time / 0.02 + 1e-6), atol=1e-9)


def test_a_silence_is_a_gap_and_nan_was_not_measured() -> None:
    keep = (TIME < 0.5) | (TIME > 1.0)
    joints = {"time": TIME[keep], "position": np.sin(TIME[keep])}
    gap = Log.from_arrays(arrays(joints=joints), PENDULUM)["joints.position"]
    position = np.where(keep, np.sin(TIME), np.nan)
    same = Log.from_arrays(arrays(joints={"time": TIME, "position": position}), PENDULUM)["joints.position"]
    middle = round(0.75 / PENDULUM.dt)
    assert not gap.valid[middle] and not same.valid[middle]
    assert gap.valid[10] and same.valid[10]


def test_signals_may_begin_at_different_times() -> None:
    command = {"time": 0.3037 + TIME, "position": np.zeros(TIME.size)}
    log = Log.from_arrays(arrays(command=command), PENDULUM)
    assert log.start_ns == 304_000_000  # the first instant of the joints' clock at which both are known
    assert log["joints.position"].values[0, 0] == pytest.approx(np.sin(0.304), abs=1e-5)


def joints(**changes: Any) -> dict[str, Any]:
    return arrays(joints={"time": TIME, "position": np.sin(TIME)} | changes)


@pytest.mark.medium
@pytest.mark.parametrize(
    ("given", "message"),
    [
        (arrays(joint={}), "arrays: no signal 'joint' (did you mean 'joints'?); there is: command, joints"),
        ({"command": arrays()["command"]}, "the system 'pendulum' needs the signal joints too"),
        (
            arrays(joints=np.sin(TIME)),
            "signal 'joints': give a dictionary with `time` and position, velocity",
        ),
        (joints(time=TIME[:, None]), "signal 'joints': time has the shape (200, 1); it must be (n,)"),
        (joints(time=TIME[::-1]), "time must increase; at row 1 it goes from 1.99 to 1.98 s"),
        (joints(time=np.where(TIME == 0.5, np.nan, TIME)), "time is not finite at row 50"),
        (
            joints(time=1.7e18 + 1e9 * TIME),
            "signal 'joints': time reaches 1.7e+18 s: time must be in seconds",
        ),
        (
            joints(position=np.zeros(200, complex)),
            "position is no array of numbers but of complex128; give real",
        ),
        (joints(position=np.zeros(200, object)), "position is no array of numbers but of object; give real"),
        (joints(position=np.full(200, "1.0")), "position is no array of numbers but of <U3"),
        (joints(position=[[0.0], [0.0, 1.0]]), "position is no array of numbers"),
        (joints(time=np.ma.masked_array(TIME, TIME == 0.5)), "time is not finite at row 50"),
        (joints(time=["a"] * 200), "signal 'joints': time is no array of numbers"),
        (
            joints(position=np.zeros((200, 2))),
            "position has the shape (200, 2); it must be (200,) or (200, 1)",
        ),
        (joints(position=np.zeros(199)), "position has the shape (199,); it must be (200,) or "),
        (joints(position=np.full(200, np.inf)), "position is infinite somewhere; write NaN"),
        (joints(positon=TIME), "no quantity 'positon' (did you mean 'position'?); there is: position, time"),
        (arrays(joints={"time": TIME, "velocity": TIME}), "signal 'joints': position is missing"),
        (arrays(command={"time": 9 + TIME, "position": TIME}), "do not overlap in time: joints 0 to 1.99 s"),
    ],
)
def test_mistakes_are_named(given: dict[str, Any], message: str) -> None:
    with pytest.raises(LogError) as error:
        Log.from_arrays(given, PENDULUM)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_orientations_must_be_unit_quaternions() -> None:
    system = System.load("cube_toss")
    name = next(signal.name for signal in system.signals)
    pose = {"time": TIME, "position": np.zeros((200, 3)), "orientation": np.tile([1.0, 0, 0, 0], (200, 1))}
    log = Log.from_arrays({name: pose}, system)
    assert log[f"{name}.angular_velocity"].derived
    with pytest.raises(LogError, match="no unit quaternion at row 0"):
        Log.from_arrays({name: pose | {"orientation": np.ones((200, 4))}}, system)
