"""The robot as a target: checks before anything moves, and measurements on the run's own clock."""

from __future__ import annotations

import os
import signal
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from amhe_cli.control.controller import Plan
from amhe_cli.control.mpopi import MpopiStep
from amhe_cli.core.errors import OperatorStopError
from amhe_cli.core.log import Samples, merged
from amhe_cli.core.rotations import exp
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.link.link import Link
from amhe_cli.robots.go1.link.mail import Followed, SenderReport, StoppedError
from amhe_cli.robots.go1.link.packets import pressing
from amhe_cli.robots.go1.link.process import Clock
from amhe_cli.robots.go1.link.target import Go1Target
from amhe_cli.robots.go1.model import Box
from amhe_cli.robots.go1.poses.feed import PoseFeed
from amhe_cli.robots.go1.poses.sources import PoseError
from amhe_cli.robots.go1.settings import Go1Settings, deviations
from tests.robots.go1.link.test_link import QUICK
from tests.robots.go1.stand_ins import TRUNK, Puppet, Stage, damps, free_port

pytestmark = pytest.mark.realtime

PERIOD = 0.02
BOX = np.array([0.6, 0.0, 0.15])
#: A busy machine may hold plans and poses up.
PATIENT = QUICK.trips.model_copy(update={"plan_age": 0.5, "pose_age": 1.0, "state_age": 0.5})
SETTINGS = QUICK.model_copy(update={"arm": "auto", "trips": PATIENT})


@contextmanager
def a_target(puppet: Puppet, settings: Go1Settings = SETTINGS, **stage) -> Iterator[tuple[Go1Target, Stage]]:
    clock, port = Clock(), free_port()
    patient = settings.model_copy(update={"connect_time": 2.0})
    with Stage(port, **stage) as cameras:
        target = Go1Target(
            Link("127.0.0.1", puppet.port, settings, clock),
            PoseFeed("udp", "127.0.0.1", port, patient), settings, clock, PERIOD, Box(),
        )  # fmt: skip
        with target:
            yield target, cameras


@contextmanager
def begun(puppet: Puppet, settings: Go1Settings = SETTINGS) -> Iterator[tuple[Go1Target, Stage]]:
    """A target whose run has begun."""
    with a_target(puppet, settings) as (target, cameras):
        target.check()
        target.begin(lambda text: None)
        yield target, cameras


def exchange(target: Go1Target, plan: Plan) -> tuple[float, Samples]:
    target.play(plan)
    return target.measure()


@pytest.fixture
def puppet() -> Iterator[Puppet]:
    with Puppet() as it:
        yield it


@pytest.mark.medium
def test_a_check_says_what_it_found_and_moves_nothing(puppet: Puppet) -> None:
    with a_target(puppet) as (target, _):
        found = target.check()
    assert found["battery"] == "80 %"
    assert found["box"] == "at (0.60, 0.00, 0.15) m of the task's frame"
    assert puppet.idle


@pytest.mark.medium
def test_what_has_no_real_time_priority_is_one_note(puppet: Puppet) -> None:
    with a_target(puppet) as (target, _):
        target.check()
        assert (target.notes == []) == (os.sched_getscheduler(0) == os.SCHED_FIFO)
        watch = target._link._watch
        assert watch is not None
        watch.realtime = target._feed.realtime = target._realtime = False
        words = "watch, poses, planner; they may be late when the computer is busy"
        assert target.notes[0].endswith(words)
        late = Mock(report=SenderReport(realtime=False), realtime=False)
        assert Link.late.fget(Mock(report=late.report, _watch=late)) == ["sender", "watch"]  # type: ignore[misc]


@pytest.mark.medium
def test_what_is_not_by_default_is_reported_before_arming(puppet: Puppet) -> None:
    assert deviations(Go1Settings()) == ""
    settings = Go1Settings.model_validate({"kd": (2, 3, 4), "trips": {"tilt": 1.2}})
    assert deviations(settings) == "go1.kd [2, 3, 4] ([2, 3, 3]), go1.trips.tilt 1.2 (0.9)"
    texts: list[str] = []

    def hear(text: str) -> None:
        texts.append(text)
        if "Enter" in text:
            puppet.change = lambda sent: replace(sent, remote=pressing("R2"))

    with a_target(puppet, SETTINGS.model_copy(update={"arm": "operator"})) as (target, _):
        found = target.check()
        target.begin(hear)
    for text in (found["not by default"], texts[-1]):
        assert "go1.stand_speed 3 (0.5)" in text
        assert "go1.trips.pose_age 1 (0.19)" in text


@pytest.mark.medium
@pytest.mark.parametrize(
    ("stage", "message"),
    [
        ({"names": ("box", "go1")}, "each other's name"),
        ({"turn": exp(np.array([-np.pi / 2, 0.0, 0.0]))}, "Up Axis: Z"),
        ({"box": (1.2, 0.0, 0.15)}, "the task wants it"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_moves(puppet: Puppet, stage: dict, message: str) -> None:
    with a_target(puppet, **stage) as (target, _), pytest.raises(PoseError, match=message):
        target.check()
    assert puppet.idle


@pytest.mark.medium
def test_a_run_measures_on_its_own_clock_and_plays_its_plans(puppet: Puppet) -> None:
    with begun(puppet) as (target, cameras):
        seen = [target.measure()]
        waited = target.misses  # until poses came; a plan was not asked for yet
        for _ in range(30):
            start = seen[-1][0] + PERIOD
            seen.append(exchange(target, Plan(start, PERIOD, np.tile(HOME + 0.05, (16, 1)))))
            np.testing.assert_allclose(target.in_force(seen[-1][0]), HOME + 0.05)
    times = np.array([time for time, _ in seen])
    np.testing.assert_allclose(times / PERIOD, np.round(times / PERIOD), atol=1e-9)
    assert target.misses - waited == round((times[-1] - times[0]) / PERIOD) - (len(seen) - 1)
    samples = merged([measured for _, measured in seen])
    robot, followed = samples["command.position"]
    assert np.median(np.diff(samples["joints.position"][0])) == pytest.approx(0.002, abs=2e-4)
    np.testing.assert_allclose(np.diff(robot), 0.004, atol=1e-9)
    np.testing.assert_allclose(followed[-1], HOME + 0.05, atol=1e-4)
    assert np.ptp(followed, axis=0).min() > 0.01, "it stood first, and was blended into the plan"
    (poses, places), (_, boxes) = samples["trunk.position"], samples["box.position"]
    assert 20 < len(poses) == len(boxes)
    np.testing.assert_allclose(places[:, :2], 0.0, atol=1e-6)  # the frame is the trunk's own
    np.testing.assert_allclose(boxes, np.tile(BOX, (len(boxes), 1)), atol=1e-6)
    assert abs(poses[-1] - times[-1]) < 0.3
    assert any(np.allclose(command.position, HOME + 0.05, atol=1e-4) for _, command in puppet.received)
    assert target.report.trip == ""
    assert cameras.trunk is TRUNK


@pytest.mark.medium
def test_the_delay_of_poses_counts_for_their_age(puppet: Puppet, monkeypatch: pytest.MonkeyPatch) -> None:
    handed: list[float] = []
    with begun(puppet, SETTINGS.model_copy(update={"pose_delay": 0.2})) as (target, _):
        time, measured = target.measure()
        monkeypatch.setattr(target._link, "play", lambda plan, pose_time: handed.append(pose_time))
        target.play(Plan(time + PERIOD, PERIOD, np.tile(HOME, (16, 1))))
    assert handed[0] - target._start == pytest.approx(measured["trunk.position"][0][-1], abs=0.1)


@pytest.mark.medium
@pytest.mark.parametrize(("gone", "message"), [("box", "the task wants it"), ("poses", "does not begin")])
def test_box_and_poses_are_looked_at_again_before_it_begins(puppet: Puppet, gone: str, message: str) -> None:
    trips = PATIENT.model_copy(update={"pose_age": 0.5 if gone == "poses" else 1.0})
    with a_target(puppet, SETTINGS.model_copy(update={"trips": trips, "gain_time": 1.0})) as (
        target,
        cameras,
    ):
        target.check()

        def change(text: str) -> None:
            if gone == "box":
                cameras.move_box((0.5, 0.0, 0.0))
            cameras.silent = gone == "poses"

        with pytest.raises(PoseError, match=message):
            target.begin(change)
    driven = [got.position for _, got in puppet.received if got.kp[0] > 0]
    np.testing.assert_allclose(driven[-1], np.tile([0.0, 1.2, -2.6], 4), atol=0.05)  # it has sat down again


@pytest.mark.medium
@pytest.mark.parametrize("lost", ["poses", "robot", "feed dies", "feed hangs"])
def test_a_fault_during_the_run_stops_it_and_says_why(puppet: Puppet, lost: str) -> None:
    with begun(puppet) as (target, cameras):
        time, _ = target.measure()
        feed = target._feed._child
        assert feed is not None
        message = "no pose of trunk or box"
        if lost == "poses":
            cameras.silent = True
        elif lost == "feed hangs":
            feed.process.send_signal(signal.SIGSTOP)
        elif lost == "feed dies":
            feed.process.kill()
            message = "the pose source udp has died"
        else:
            puppet.change = lambda sent: replace(sent, remote=pressing("select"))
            message = "remote control"
        with pytest.raises((StoppedError, OperatorStopError, PoseError), match=message):
            for _ in range(200):
                plan = Plan(time + PERIOD, PERIOD, np.tile(HOME, (16, 1)))
                time, _ = exchange(target, plan)
        if target.stop is None:
            target._link._send(stop="asked to stop")
        puppet.wait(damps)


@pytest.mark.medium
def test_rollouts_that_diverge_sit_the_robot_down(puppet: Puppet) -> None:
    """More than a quarter of them in five cycles in a row; four are forgiven."""
    with begun(puppet) as (target, _):
        time, _ = target.measure()

        def play(diverged: int) -> None:
            nonlocal time
            step = MpopiStep(np.zeros(1), np.zeros(8), 8, diverged, 1.0, 0.0, 0.0, {})
            target.play(Plan(time + PERIOD, PERIOD, np.tile(HOME, (16, 1)), step=step))
            time, _ = target.measure()

        for diverged in (3, 3, 3, 3, 2, 3, 3, 3, 3):
            play(diverged)
        assert target.stop is None
        with pytest.raises(StoppedError, match="trip diverged: 3 of 8 rollouts"):
            play(3)
        assert target.stop is not None
    driven = [got.position for _, got in puppet.received if got.kp[0] > 0]
    np.testing.assert_allclose(driven[-1], np.tile([0.0, 1.2, -2.6], 4), atol=0.05)


@pytest.mark.medium
def test_a_rehearsal_measures_on_the_runs_clock_and_sends_nothing(puppet: Puppet) -> None:
    with a_target(puppet) as (target, _):
        target.check()
        target.rehearse()
        time, measured = target.measure()
        assert target.deadline is not None
        assert target.deadline - clock.monotonic() < PERIOD
        for _ in range(3):
            time, measured = exchange(target, Plan(time + PERIOD, PERIOD, np.tile(HOME + 0.3, (16, 1))))
            assert measured["joints.position"][0].size
    assert puppet.idle


@pytest.mark.medium
def test_many_poses_that_cannot_be_true_let_the_robot_down(puppet: Puppet) -> None:
    with begun(puppet) as (target, cameras):
        now, _ = target.measure()
        with pytest.raises(StoppedError, match="of the last 100 poses of 'box' cannot be true: it steps"):
            for cycle in range(105):
                now, _ = exchange(target, Plan(now + PERIOD, PERIOD, np.tile(HOME, (16, 1))))
                if cycle == 5:
                    cameras.shift_box(30)
        puppet.wait(damps)
    assert target.report.trip == "pose_doubt"


def test_commands_are_those_that_the_robot_followed() -> None:
    """A late plan begins late: what was sent is what the model must be driven with."""
    commands = Followed()
    parts = []
    for cycle in range(1, 11):
        sent = 0.02 * (cycle - 1) + 0.002 * np.arange(1, 11)
        parts.append(commands.take(0.02 * cycle, np.zeros(12), sent, np.tile(sent[:, None], 12)))
    times, values = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    assert values.shape == (times.size, 12)
    assert len(times) > 40, "every 4 ms, not every 20 ms"
    np.testing.assert_allclose(np.diff(times), 0.004, atol=1e-9, err_msg="on the steps of the reader's clock")
    # each is held for 4 ms: it is what was followed in the middle of them, not at their beginning
    np.testing.assert_allclose(values[1:, 0], times[1:] + 0.002, atol=1e-6)
