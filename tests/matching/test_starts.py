"""First states of windows: smoothed positions, and velocities that are slopes of them."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from amhe_cli.core import rotations
from amhe_cli.core.log import Log, Window
from amhe_cli.core.signals import Series
from amhe_cli.matching.starts import first_states
from amhe_cli.matching.windows import prepare
from amhe_cli.system.description.data import Channel
from amhe_cli.system.system import System

HOME = np.zeros(1)


def with_slope(system: System, slope: float) -> System:
    channels = (replace(c, slope=slope * (c.source == "qvel")) for c in system.channels)
    return replace(system, channels=tuple(channels))


def lagging(log: Log, rows: int) -> Log:
    series = log["state.velocity"]
    late = np.roll(series.values, rows, axis=0)
    return replace(log, series={**log.series, "state.velocity": replace(series, values=late)})


def velocities(system: System, log: Log, starts: np.ndarray) -> np.ndarray:
    return first_states(system, [Window(log, int(start), 20) for start in starts], HOME, 0.0)[1][:, 0]


def test_a_slope_does_not_lag_as_the_recorded_velocity_does(cart, drive) -> None:
    log, starts = drive(3.0, noise=1e-4), np.arange(100, 500, 25)
    true = log["state.velocity"].values[starts, 0]
    seen = lagging(log, 14)
    recorded, sloped = (velocities(with_slope(cart, s), seen, starts) - true for s in (0.0, 0.03))
    assert np.sqrt((sloped**2).mean()) < 0.2 * np.sqrt((recorded**2).mean())


def test_where_too_little_was_measured_the_recorded_velocity_stays(cart, drive) -> None:
    log = drive(1.0)
    series = log["state.position"]
    sampled = series.sampled.copy()
    sampled[80:120] = False
    sparse = replace(log, series={**log.series, "state.position": replace(series, sampled=sampled)})
    at = np.array([0, 100])
    np.testing.assert_array_equal(
        velocities(with_slope(cart, 0.05), sparse, at), log["state.velocity"].values[at, 0]
    )


def test_the_slope_of_an_orientation_is_the_rate_in_the_bodys_own_frame(cart, drive) -> None:
    rate, dt = np.array([0.3, -0.7, 1.1]), drive(0.1).dt
    start = np.array([0.9, 0.1, -0.3, 0.2])
    times = dt * np.arange(41)
    turning = rotations.multiply(
        np.tile(rotations.normalised(start), (41, 1)), rotations.exp(times[:, None] * rate)
    )
    ones = np.ones(41, dtype=bool)
    series = {
        "body.orientation": Series(turning, ones, ones, tuple("wxyz")),
        "body.angular_velocity": Series(np.zeros((41, 3)), ones, ones, tuple("xyz")),
    }
    channel = Channel("body.angular_velocity", "linear", "qvel", (0, 1, 2), 0.1, ("rad/s",), False, 0.05)
    system = replace(cart, channels=(channel,))
    window = Window(Log(dt, series, "a turning body"), 20, 10)
    wide = replace(system, model=_WithThree())  # type: ignore[arg-type]
    assert first_states(wide, [window], HOME, 0.0)[1][0] == pytest.approx(rate, abs=1e-4)


def test_a_joint_that_follows_another_starts_where_that_one_demands_it() -> None:
    finger = "<body><joint name='{0}' type='slide'/><geom size='0.1'/></body>"
    system = System.from_model(
        mujoco.MjSpec.from_string(
            f"<mujoco><worldbody>{finger.format('left')}{finger.format('right')}</worldbody><equality>"
            "<joint joint1='right' joint2='left' polycoef='0.01 -0.5 0 0 0'/></equality></mujoco>"
        ),
        parameters={"damping": {"nominal": 1.0, "targets": [{"joint": "left", "set": "damping"}]}},
        signals={"hand": {"joints": ["left"], "noise": {"position": 0.001, "velocity": 0.1}}},
    )
    ones = np.ones(2, dtype=bool)
    series = {
        "hand.position": Series(np.full((2, 1), 0.04), ones, ones, ("left",)),
        "hand.velocity": Series(np.full((2, 1), 0.2), ones, ones, ("left",)),
    }
    window = Window(Log(system.dt, series, "a gripper"), 0, 1)
    qpos, qvel = first_states(system, [window], np.zeros(2), 0.0)
    np.testing.assert_allclose(qpos, [[0.04, 0.01 - 0.5 * 0.04]])
    np.testing.assert_allclose(qvel, [[0.2, -0.1]])


class _WithThree:
    nv = 3
    eq_type = eq_active0 = eq_obj2id = tendon_limited = tendon_stiffness = np.empty(0)


def test_each_clip_has_what_its_own_log_measured_in_whatever_order(cart, drive) -> None:
    """A differentiated velocity is compared with nothing, and starts a clip less well than a measured one."""
    channels = tuple(
        replace(c, noise=0.02, compared=True) if c.source == "qvel" else c for c in cart.channels
    )
    system, full = replace(cart, channels=channels), drive(1.0, noise=1e-3)
    velocity = full["state.velocity"]
    encoders = replace(full, series={**full.series, "state.velocity": replace(velocity, derived=True)})
    windows = [Window(full, 20, 60), Window(encoders, 20, 60)]
    alone = [prepare(system, [window], {}) for window in windows]
    assert alone[0].starts.first_sd[0, 1] != pytest.approx(alone[1].starts.first_sd[0, 1], rel=0.2)
    for order in ([0, 1], [1, 0]):
        both = prepare(system, [windows[i] for i in order], {})
        np.testing.assert_array_equal(both.counts, [alone[i].counts[0] for i in order])
        np.testing.assert_array_equal(both.starts.first_sd, [alone[i].starts.first_sd[0] for i in order])
        (measured,) = (o for o in both.observed if o.channel.key == "state.velocity")
        assert measured.mask.any(axis=1).tolist() == [i == 0 for i in order]


def test_a_state_that_was_measured_exactly_is_a_first_state_like_any_other(cart, drive) -> None:
    """The errors of all logs are numbered alike: one that has no noise does not change what they mean."""
    exact = drive(1.0)
    channels = tuple(replace(channel, noise=None) for channel in cart.channels)
    starts = prepare(replace(cart, channels=channels), [Window(exact, 0, 60)], {}).starts
    assert starts.first_index.tolist() == [0, 1] and (starts.first_sd > 0.0).all()
