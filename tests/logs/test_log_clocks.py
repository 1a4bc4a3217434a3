"""Clocks that lie, the uniform clock of a trajectory, and velocities from positions."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.core import rotations
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.resample import angular_velocity, derivative, resample
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs import clocks, read_signals, survey
from amhe_cli.logs.clocks import increasing, timeline
from amhe_cli.logs.messages.decode import SignalSamples
from tests.logs.log_makers import DT, JS, ROS2, SETTINGS, T0, Message, joint_state, write_mcap

S = 10**9
JOINT = Signal("j", "/js", ("position",))


def log_of(
    path: Path, header_ns: list[int], log_ns: list[int], topic: str = "/js", values: list[float] | None = None
) -> Path:
    """Joint states whose header and recorder stamps are given; position i in message i."""
    values = values or [float(i) for i in range(len(log_ns))]
    messages = [
        Message(topic, JS, log, joint_state(ROS2, max(header, 0), ("a",), [value]))
        for header, log, value in zip(header_ns, log_ns, values, strict=True)
    ]
    return write_mcap(path, messages)


def times(n: int, start: int = T0, period: float = DT) -> list[int]:
    return [start + round(i * period * S) for i in range(n)]


def read(
    path: Path, *signals: Signal, dt: float = DT, settings: LogSettings = SETTINGS, **options: Any
) -> Any:
    return read_signals(path, signals or (JOINT,), dt, settings, **options)


def warnings(caplog: pytest.LogCaptureFixture) -> str:
    return "\n".join(record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING)


def test_header_stamps_are_the_default_and_agree_silently(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = log_of(tmp_path / "a", times(50), [t + 3_000_000 for t in times(50)])
    trajectory = read(path)
    assert trajectory.start_ns == T0
    assert not warnings(caplog)


def test_unset_headers_fall_back_and_say_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    trajectory = read(log_of(tmp_path / "a", [0] * 50, times(50)))
    assert trajectory.start_ns == T0 and trajectory.steps == 50
    assert "header stamps cannot be used (50 of 50 are not set)" in warnings(caplog)
    assert "publish stamps are used" in warnings(caplog)


@pytest.mark.parametrize("wild", [1, 5 * S, T0 - 40_000 * 86400 * S // 100, T0 + 3 * 365 * 86400 * S])
@pytest.mark.parametrize("place", [0, 20, 49])
def test_one_wild_stamp_costs_one_message(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, wild: int, place: int
) -> None:
    header = times(50)
    header[place] = wild
    trajectory = read(log_of(tmp_path / "a", header, times(50)))
    assert 49 <= trajectory.steps <= 50
    first = (trajectory.start_ns - T0) / S / DT
    np.testing.assert_allclose(
        trajectory["j.position"].values[:, 0], first + np.arange(trajectory.steps), atol=1e-6
    )
    assert trajectory["j.position"].sampled.sum() == 49
    assert "1 message " in warnings(caplog)


def test_repeated_stamps_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    header = times(100)
    for i in (10, 20, 30):
        header[i] = header[i - 1]
    trajectory = read(log_of(tmp_path / "a", header, times(100)))
    assert (~trajectory["j.position"].sampled).sum() == 3
    assert "3 with a repeated stamp" in warnings(caplog)


def test_a_clock_that_is_set_back_falls_to_the_recorder(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    header = times(50) + times(50, T0 - 3 * S)
    trajectory = read(log_of(tmp_path / "a", header, times(100)))
    assert trajectory.steps == 100
    assert "its header clock jumps by -3.500 s" in warnings(caplog)


def stepping_log(path: Path, steps: dict[int, int], n: int = 400) -> Path:
    """/js, whose header clock is set by `steps` [ns] at these messages, and /cmd; position i at step i."""
    messages = []
    shift, rng = 0, np.random.default_rng(1)
    for i, log in enumerate(times(n)):
        shift += steps.get(i, 0)
        late = log + int(rng.uniform(0, 4e6))
        state = joint_state(ROS2, log + shift, ("a",), [float(i)])
        messages.append(Message("/js", JS, late, state))
        messages.append(Message("/cmd", JS, late, joint_state(ROS2, log, ("a",), [float(i)])))
    return write_mcap(path, messages)


@pytest.mark.parametrize("step", [50 * S, S // 2, 60_000_000, -60_000_000, -3 * S])
def test_a_header_clock_that_steps_gives_way_to_the_recorders_for_all_topics(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, step: int
) -> None:
    path = stepping_log(tmp_path / "a", {200: step})
    trajectory = read(path, JOINT, Signal("c", "/cmd", ("position",), is_input=True))
    assert trajectory.steps >= 399
    off = trajectory["j.position"].values - trajectory["c.position"].values
    assert np.abs(off).max() < 1.5, "no command is moved against the states"
    words = f"its header clock jumps by {step / S:+.3f} s, 2.00 s after its first message"
    assert "'/js': " + words in warnings(caplog)
    js, cmd = sorted(survey(path).topics, key=lambda topic: topic.name != "/js")
    assert js.notes[0].startswith(words)
    assert js.clock == cmd.clock == "log" and not cmd.notes
    assert js.longest_gap < 0.02, "the gap on the stamps that are used"


def test_several_steps_and_a_forced_header_clock(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = stepping_log(tmp_path / "a", {100: S // 2, 250: -S // 5})
    trajectory = read(path, settings=LogSettings(stamp="header"))
    assert trajectory.start_ns == T0
    assert "jumps by +0.500 s, 1.00 s after its first message (the largest of 2 jumps)" in warnings(caplog)
    assert "`logs.stamp=log`" in warnings(caplog)


def test_late_messages_stalls_of_the_recorder_silences_and_drift_are_no_steps(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    header = times(600)
    header[400:] = [t + 2 * S for t in header[400:]]  # silence
    log = [t + (t - T0) // 1000 for t in header]  # 1000 ppm
    log[100] += 300_000_000  # one message held up
    log[200:260] = [max(t, log[260]) for t in log[200:260]]  # all at once after a stall
    log[500:] = [t + S for t in log[500:]]  # the recorder's own clock is set
    trajectory = read(log_of(tmp_path / "a", header, log))
    assert trajectory.start_ns == T0
    assert "jumps" not in warnings(caplog)


def test_messages_written_out_of_order_are_sorted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    stamps = times(50)
    order = np.random.default_rng(0).permutation(50).tolist()
    shuffled = [stamps[i] for i in order]
    trajectory = read(log_of(tmp_path / "a", shuffled, shuffled, values=[float(i) for i in order]))
    np.testing.assert_allclose(trajectory["j.position"].values[:, 0], np.arange(50))
    assert not warnings(caplog)


def test_headerless_commands_join_the_header_clock_of_a_simulation(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    array = ROS2.types["std_msgs/msg/Float64MultiArray"]
    layout = ROS2.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    messages = []
    for i, log in enumerate(times(50)):
        state = joint_state(ROS2, 132 * S + i * 10_000_000, ("a",), [float(i)])
        messages.append(Message("/js", JS, log, state))
        command = array(layout=layout, data=np.array([float(i)]))
        messages.append(Message("/u", "std_msgs/msg/Float64MultiArray", log, command))
    path = write_mcap(tmp_path / "a", messages)
    trajectory = read(path, JOINT, Signal("u", "/u", ("value",), is_input=True))
    assert trajectory.steps == 50 and trajectory.start_ns == 132 * S
    np.testing.assert_allclose(trajectory["u.value"].values, trajectory["j.position"].values)
    assert "onto the header clock" in warnings(caplog)


def offset_log(path: Path, offset_ns: int = 12_000_000) -> Path:
    """/late is stamped 12 ms later than /early although both were logged at once."""
    messages = []
    for log in times(100):
        for topic, shift in (("/early", 0), ("/late", offset_ns)):
            header = log + shift
            value = (header - shift - T0) / S  # what happened at log time
            messages.append(Message(topic, JS, log, joint_state(ROS2, header, ("a",), [value])))
    return write_mcap(path, messages)


def test_clock_offsets_are_put_in_words_and_corrected_on_request(tmp_path: Path) -> None:
    path = offset_log(tmp_path / "a")
    assert survey(path).offsets == (
        "topic '/late' is stamped 12 ms later than '/early' (judged by when the recorder got them)",
    )
    signals = (Signal("e", "/early", ("position",)), Signal("l", "/late", ("position",)))
    apart = read(path, *signals)
    gap = apart["e.position"].values - apart["l.position"].values
    np.testing.assert_allclose(gap[5:-5], 0.012, atol=1e-9)
    together = read(path, *signals, settings=LogSettings(align=True))
    gap = together["e.position"].values - together["l.position"].values
    np.testing.assert_allclose(gap[5:-5], 0.0, atol=1e-9)
    logged = read(path, signals[0], Signal("l", "/late", ("position",), offset=-0.012))
    np.testing.assert_allclose(
        (logged["e.position"].values - logged["l.position"].values)[5:-5], 0.0, atol=1e-9
    )


def test_only_offsets_that_no_transport_explains_are_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    early, late = Signal("e", "/early", ("position",)), Signal("l", "/late", ("position",))
    large = offset_log(tmp_path / "a", 300_000_000)
    read(offset_log(tmp_path / "b"), early, late)
    read(large, early, late, settings=LogSettings(align=True))
    read(large, early, Signal("l", "/late", ("position",), offset=-0.3))
    assert not warnings(caplog)
    read(large, early, late)
    assert "topic '/late' is stamped 300 ms later than '/early'" in warnings(caplog)
    assert "`logs.align=true`" in warnings(caplog)


@given(st.lists(st.integers(-50, 50), min_size=1, max_size=40))
def test_the_increasing_subset_is_increasing_and_none_is_larger(stamps: list[int]) -> None:
    array = np.array(stamps)
    keep = increasing(array)
    assert np.all(np.diff(array[keep]) > 0)
    longest = [1] * len(stamps)  # by the quadratic textbook recursion
    for i, stamp in enumerate(stamps):
        longest[i] = 1 + max((longest[j] for j in range(i) if stamps[j] < stamp), default=0)
    assert keep.sum() == max(longest)


# -- the uniform clock ------------------------------------------------------------------------------------


def test_the_grid_starts_when_all_have_begun_in_phase_with_the_slowest_state(tmp_path: Path) -> None:
    messages = [Message("/a", JS, t, joint_state(ROS2, t, ("a",), [0.0])) for t in times(100)]
    messages += [
        Message("/b", JS, t, joint_state(ROS2, t, ("a",), [0.0])) for t in times(50, T0 + 203_000_000)
    ]
    messages += [
        Message("/u", JS, t, joint_state(ROS2, t, ("a",), [1.0])) for t in times(50, T0 + 316_000_000)
    ]
    path = write_mcap(tmp_path / "a", messages)
    a, b = Signal("a", "/a", ("position",)), Signal("b", "/b", ("position",))
    command = Signal("u", "/u", ("position",), is_input=True)
    assert read(path, a, b).start_ns == T0 + 203_000_000
    trajectory = read(path, a, b, command)
    assert trajectory.start_ns == T0 + 323_000_000
    assert trajectory["u.position"].valid[0]
    part = read(path, a, b, start=0.1, end=0.2)
    assert part.start_ns == T0 + 303_000_000 and part.steps == 11
    with pytest.raises(ConfigError, match="no part of it"):
        read(path, a, b, start=30.0)


def test_topics_that_do_not_overlap_are_reported_with_their_spans(tmp_path: Path) -> None:
    messages = [Message("/a", JS, t, joint_state(ROS2, t, ("a",), [0.0])) for t in times(10)]
    late = T0 + 60 * S
    messages += [Message("/u", JS, late, joint_state(ROS2, late, ("a",), [0.0]))]
    path = write_mcap(tmp_path / "a", messages)
    with pytest.raises(LogError, match=r"do not overlap.*/a 0.000 to 0.090 s.*/u 60.000 to 60.000 s"):
        read(path, Signal("a", "/a", ("position",)), Signal("u", "/u", ("position",), is_input=True))


def test_absurdly_long_trajectories_are_refused(tmp_path: Path) -> None:
    path = log_of(tmp_path / "a", [T0, T0 + 9000 * S], [T0, T0 + 9000 * S])
    with pytest.raises(LogError, match="rows for 2 samples"):
        read(path, dt=1e-4)


def test_gaps_are_not_bridged_and_commands_are_held() -> None:
    stamps = np.concatenate([np.arange(10) * 0.01, 1.0 + np.arange(10) * 0.01])
    values = np.arange(20.0)[:, None]
    grid = np.arange(0, 120) * 0.01
    state = resample(stamps, values, ("a",), grid, bridge=0.2)
    np.testing.assert_array_equal(np.flatnonzero(state.valid), [*range(10), *range(100, 110)])
    command = resample(stamps, values, ("a",), grid, bridge=0.2, hold=True)
    assert command.valid[:29].all() and not command.valid[30:100].any() and command.valid[100:].all()
    assert command.values[15, 0] == 9.0
    assert command.sampled.sum() == state.sampled.sum() == 20


def test_the_time_that_gaps_cost_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    stamps = times(1000)
    short = [t for i, t in enumerate(stamps) if not 400 < i < 440]
    read(log_of(tmp_path / "a", short, short))
    assert not warnings(caplog), "a small loss is none"
    gappy = [t for i, t in enumerate(stamps) if not 400 < i < 700 and not 800 < i < 830]
    read(log_of(tmp_path / "b", gappy, gappy))
    assert "topic '/js': no data of signal 'j' from 4.01 to 7.00 s (2.99 s), from 8.01" in warnings(caplog)
    assert "in all 3.28 of 10.00 s: no clip crosses it" in warnings(caplog)


def test_orientations_go_along_the_arc_whatever_their_signs() -> None:
    stamps = np.arange(11) * 0.1
    q = rotations.exp(np.outer(stamps, [0.0, 0.0, 2.0])) * np.where(np.arange(11) % 2, -1.0, 1.0)[:, None]
    grid = np.arange(0, 41) * 0.025
    found = resample(stamps, q, tuple("wxyz"), grid, bridge=1.0, rotation=True)
    expected = rotations.exp(np.outer(grid, [0.0, 0.0, 2.0]))
    assert np.abs(rotations.difference(found.values, expected)).max() < 1e-12


# -- velocities -------------------------------------------------------------------------------------------


def test_derivative_on_jittered_stamps_is_exact_for_parabolas_and_stops_at_gaps() -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.005, 0.015, 200))
    t[100:] += 1.0
    y = np.stack([3.0 * t, t * t], axis=1)
    np.testing.assert_allclose(derivative(t, y, 0.2), np.stack([np.full(200, 3.0), 2 * t], axis=1), atol=1e-8)
    broken = np.where(np.arange(200)[:, None] < 100, y, y + 50.0)
    np.testing.assert_allclose(derivative(t, broken, 0.2)[:, 0], 3.0, atol=1e-8)


def test_angular_velocity_is_in_the_body_frame() -> None:
    t = np.arange(300) * 0.005
    body = np.array([0.5, -1.0, 2.0])
    tilt = rotations.exp(np.array([0.4, 0.3, -0.2]))
    q = rotations.multiply(np.tile(tilt, (300, 1)), rotations.exp(np.outer(t, body)))
    np.testing.assert_allclose(angular_velocity(t, q, 0.2), np.tile(body, (300, 1)), atol=1e-6)


def test_too_few_samples_have_no_velocity() -> None:
    assert np.isnan(derivative(np.array([0.0, 0.1]), np.ones((2, 1)), 1.0)).all()
    lonely = derivative(np.array([0.0, 5.0, 5.1, 5.2, 9.0]), np.zeros((5, 1)), 1.0)
    np.testing.assert_array_equal(np.isnan(lonely[:, 0]), [True, False, False, False, True])


def test_one_stamp_out_of_order_is_looked_for_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not among all stamps of the log, in Python."""
    looked = Mock(wraps=clocks._longest_run)
    monkeypatch.setattr(clocks, "_longest_run", looked)
    stamps = 10 * np.arange(1000)
    stamps[500] += 25
    assert np.flatnonzero(~increasing(stamps)).tolist() == [500]
    assert all(len(call.args[0]) < 5 for call in looked.call_args_list)


def test_the_clock_that_is_off_is_the_one_that_is_named() -> None:
    log_ns = 10**18 + 10**7 * np.arange(20)
    zero = np.zeros_like(log_ns)
    samples = SignalSamples(log_ns, log_ns - 20 * 10**9, zero, zero, {}, {}, has_header=False)
    assert timeline(samples).notes == ("its publish stamps are 20 s behind the recorder's clock",)


def test_a_table_has_one_time_and_zero_is_one() -> None:
    """Nothing is said of stamps that are not set, or of another clock, where rows repeat their time."""
    times = np.array([0, 0, 10, 20, 20, 30, 40]) * 10**6
    zero = np.zeros_like(times)
    samples = SignalSamples(times, times, zero, zero, {}, {}, has_header=False)
    assert timeline(samples).notes == ("messages are dropped: 2 with a repeated stamp",)
    assert timeline(samples, "header").notes == timeline(samples).notes
    np.testing.assert_array_equal(timeline(samples).stamps_ns, np.arange(5) * 10**7)
