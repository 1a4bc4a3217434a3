"""The state machine without sockets: time and inbox in, commands out."""

from __future__ import annotations

import re
from collections.abc import Callable
from copy import deepcopy
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.robots.go1.emulator import Faults
from amhe_cli.robots.go1.kinematics import HOME, TORQUE_LIMIT
from amhe_cli.robots.go1.link.machine import TRIPS, Machine
from amhe_cli.robots.go1.link.mail import HIGHEST, LOWEST, Inbox, Phase, Sent, Targets, allowed
from amhe_cli.robots.go1.link.packets import SERVO, MotorCommand, pressing
from amhe_cli.robots.go1.link.sender import Contact, next_tick
from amhe_cli.robots.go1.model import layout, planner_model
from amhe_cli.robots.go1.settings import Go1Settings, TripSettings
from tests.robots.go1.stand_ins import FOLDED, a_state

TICK = 0.002


class Robot:
    """An ideal robot under a machine, by a clock that runs as fast as we turn it."""

    def __init__(self, **settings) -> None:
        self.machine = Machine(Go1Settings.model_validate(settings))
        self.inbox, self.now = Inbox(stand=True), 100.0
        self.joints, self.tick = np.array(FOLDED), 0
        self.change: dict = {}
        self.silent = self.no_plans = self.no_poses = False
        self.plan: Targets | None = None
        self.offset = 0.1
        self.commands: list[MotorCommand] = []

    def step(self) -> MotorCommand:
        self.now += TICK
        self.tick += 2
        box = self.inbox
        if not self.silent:
            # encoders: not the angle itself, which a joint without drive keeps
            state = a_state(tick=self.tick, joints=self.joints)
            box.state, box.state_time = replace(state, **self.change), self.now
        if self.machine.phase == Phase.RUN:
            if not self.no_plans:
                standing = Targets(self.now, 0.02, np.tile(HOME + self.offset, (16, 1)))
                box.plan, box.plan_time = self.plan or standing, self.now
            if not self.no_poses:
                box.pose_time = self.now
        got = self.machine.step(self.now, box)
        if got.kp[0] > 0:
            self.joints = np.array(got.position)
        self.commands.append(got)
        return got

    def until(self, phase: Phase, longest: float = 60.0) -> list[MotorCommand]:
        first = len(self.commands)
        end = self.now + longest
        while self.machine.phase != phase:
            assert self.now < end, f"still in {self.machine.phase.name}"
            self.step()
        return self.commands[first:]

    def for_a_while(self, seconds: float) -> list[MotorCommand]:
        return [self.step() for _ in range(round(seconds / TICK))]


def running(**settings) -> Robot:
    robot = Robot(**{"gain_time": 0.2, "stand_speed": 3.0, **settings})
    robot.inbox.arm = True
    robot.until(Phase.RUN)
    robot.for_a_while(0.5)
    assert robot.machine.phase == Phase.RUN
    return robot


def is_damping(got: MotorCommand) -> bool:
    return got.mode == SERVO and got.kp.max() == 0.0 and got.kd.min() == 3.0


def test_standing_up_is_slow_and_smooth_from_where_the_robot_lies() -> None:
    robot = Robot()
    commands = robot.until(Phase.READY)
    driven = [command for command in commands if command.kp[0] > 0]
    gains = np.array([command.kp[0] for command in driven])
    assert gains[0] < 0.2
    assert (np.diff(gains) >= 0).all()
    assert gains[-1] == 60.0
    targets = np.array([command.position for command in driven])
    assert np.abs(targets[0] - FOLDED).max() < 0.03 + 1e-9  # no further than the limit of commands
    assert np.abs(np.diff(targets, axis=0)).max() <= 0.5 * TICK + 1e-9
    np.testing.assert_allclose(robot.step().position, HOME)


def test_it_waits_for_the_operator_and_then_for_the_first_plan() -> None:
    robot = Robot()
    robot.until(Phase.READY)
    robot.for_a_while(3.0)
    assert robot.machine.phase == Phase.READY
    robot.change = {"remote": pressing("R2")}
    robot.no_plans = robot.no_poses = True
    robot.until(Phase.RUN, 0.1)
    robot.change = {}
    for got in robot.for_a_while(1.5):
        np.testing.assert_allclose(got.position, HOME)
    robot.no_plans = robot.no_poses = False
    np.testing.assert_allclose(robot.for_a_while(0.5)[-1].position, HOME + 0.1, atol=1e-3)
    assert robot.machine.phase == Phase.RUN


@pytest.mark.medium
def test_fifty_armings_on_a_busy_computer_begin_smoothly() -> None:
    """The first plan comes late, in the midst of a stride, and the next ones come late too."""
    rng = np.random.default_rng(0)
    standing = Robot(gain_time=0.2, stand_speed=3.0)
    standing.until(Phase.READY)
    fastest = 0.61 * 2 * np.pi * 2.0
    for _ in range(50):
        robot, phase = deepcopy(standing), rng.uniform(0.0, 2 * np.pi)
        robot.inbox.arm, robot.no_plans = True, True
        robot.until(Phase.RUN, 0.1)
        due = robot.now + rng.uniform(0.0, 0.3)
        end = due + 0.45
        while robot.now < end:
            if robot.now >= due:
                times = robot.now + 0.02 * np.arange(17)
                stride = np.zeros((17, 12))
                stride[:, 2] = -0.61 * np.abs(np.sin(phase + 2 * np.pi * 2.0 * (times - 100.0)))
                robot.inbox.plan, robot.inbox.plan_time = Targets(robot.now, 0.02, HOME + stride), robot.now
                due += rng.uniform(0.02, 0.07)
            robot.step()
        assert robot.machine.trip == ""
        sent = np.array([command.position for command in robot.commands if command.kp[0] > 0])
        assert np.abs(np.diff(sent, axis=0)).max() < (fastest + 1.5 * 0.61 / 0.3) * TICK + 2e-3
        np.testing.assert_allclose(robot.machine._planned, sent[-1], atol=1e-9)


def test_a_key_of_the_remote_that_is_held_all_the_time_does_not_arm() -> None:
    robot = Robot()
    robot.change = {"remote": pressing("R2")}
    robot.until(Phase.READY)
    robot.for_a_while(0.5)
    assert robot.machine.phase == Phase.READY
    robot.change = {"remote": pressing("start")}  # that enters low-level mode, with others
    robot.for_a_while(0.5)
    assert robot.machine.phase == Phase.READY
    robot.change = {"remote": pressing("R2")}
    robot.until(Phase.RUN, 0.1)


def test_an_end_as_planned_sits_down_and_damps() -> None:
    robot = running()
    robot.inbox.finish = True
    commands = robot.until(Phase.OVER)
    np.testing.assert_allclose(commands[1200].position, np.tile([0.0, 1.2, -2.6], 4), atol=0.01)
    assert sum(map(is_damping, commands)) == pytest.approx(1.5 / TICK, abs=3)
    assert commands[-1].kd.max() == 0.0
    assert robot.machine.trip == ""


@pytest.mark.parametrize("phase", [Phase.HOLD, Phase.STAND])
def test_an_end_before_it_stands_damps_and_throws_nothing_up(phase: Phase) -> None:
    """Sitting down begins with all feet under a robot that stands: one that lies would jump there."""
    robot = Robot()
    robot.until(phase)
    robot.for_a_while(0.1)
    robot.inbox.finish = True
    assert is_damping(robot.step())
    assert all(got.kp.max() == 0.0 for got in robot.until(Phase.OVER))
    assert robot.machine.trip == ""


CHANGES: dict[str, Callable[[Robot], None]] = {
    "order": lambda robot: setattr(robot.inbox, "stop", "SIGINT"),
    "remote": lambda robot: robot.change.update(remote=pressing("select")),
    "stalled": lambda robot: setattr(robot, "now", robot.now + 0.021),
    "state_lost": lambda robot: setattr(robot, "silent", True),
    "damaged": lambda robot: setattr(robot.inbox, "bad_packets", 25),
    "share": lambda robot: setattr(robot.inbox, "share", 0.75),
    "not_a_number": lambda robot: robot.change.update(gyro=np.array([0.0, np.nan, 0.0])),
    "tilt": lambda robot: robot.change.update(quaternion=np.array([np.cos(0.5), 0.0, np.sin(0.5), 0.0])),
    "speed": lambda robot: robot.change.update(joint_rates=np.array([0.0] * 11 + [-19.0])),
    "power": lambda robot: robot.change.update(joint_rates=np.full(12, 6.0), torques=np.full(12, 10.0)),
    "temperature": lambda robot: robot.change.update(temperatures=np.array([30.0] * 11 + [76.0])),
    "motor_mode": lambda robot: robot.change.update(modes=np.array([10] * 11 + [8])),
    "battery": lambda robot: robot.change.update(charge=14),
    "range": lambda robot: robot.change.update(joints=np.tile([0.0, 0.9, -2.8], 4)),
    "target_jump": lambda robot: setattr(robot, "offset", 0.7),
    "pose_false": lambda robot: setattr(
        robot.inbox, "contradiction", "cameras and legs contradict each other"
    ),
    "plan_lost": lambda robot: setattr(robot, "no_plans", True),
    "pose_doubt": lambda robot: setattr(robot.inbox, "doubt", "10 of the last 100 poses cannot be true"),
    "pose_lost": lambda robot: setattr(robot, "no_poses", True),
}
#: From the fault to damping, at most [s]; what lets the robot sit first takes as long as sitting.
LATEST = {
    "state_lost": 0.05,
    "pose_doubt": 0.3 + 2.5,
    "plan_lost": 0.1 + 0.3 + 2.5,
    "pose_lost": 0.2 + 0.3 + 2.5,
    "power": 0.012,
}


def test_every_trip_is_tested() -> None:
    assert set(CHANGES) == set(TRIPS)


@pytest.mark.parametrize("trip", TRIPS)
def test_every_trip_ends_in_damped_motors_in_time(trip: str) -> None:
    robot = running()
    CHANGES[trip](robot)
    since = robot.now
    commands = robot.until(Phase.DAMP, 5.0)
    assert robot.machine.trip == trip
    assert robot.machine.reason
    assert robot.now - since <= LATEST.get(trip, TICK) + 5 * TICK
    assert is_damping(commands[-1])
    # whatever it was, it is over: even a robot that is well again is not driven any more
    robot.change, robot.silent, robot.no_plans, robot.no_poses, robot.inbox.stop = {}, False, False, False, ""
    robot.inbox.doubt = ""
    robot.inbox.arm = robot.inbox.stand = True
    assert all(command.kp.max() == 0.0 for command in robot.for_a_while(3.0))


@pytest.mark.parametrize("trip", ["plan_lost", "pose_lost"])
def test_lost_plans_or_poses_hold_then_sit(trip: str) -> None:
    robot = running()
    CHANGES[trip](robot)
    robot.until(Phase.PAUSE)
    held = robot.until(Phase.SIT)
    assert len(held) * TICK == pytest.approx(0.1, abs=0.01)
    np.testing.assert_allclose([command.position for command in held[:-1]], [HOME + 0.1] * (len(held) - 1))
    commands = robot.until(Phase.DAMP)
    assert np.abs(np.diff([command.position for command in commands[:-1]], axis=0)).max() < 0.003


@pytest.mark.parametrize(("trip", "age"), [("plan_lost", 0.09), ("pose_lost", 0.19)])
def test_the_first_packet_after_the_threshold_holds_the_targets_of_the_one_before(
    trip: str, age: float
) -> None:
    robot = running()
    sway = np.linspace(0.0, 0.5, 101)[:, None]  # it moves all the time: what rests is held
    robot.inbox.plan = robot.plan = Targets(robot.now, 0.02, HOME + 0.1 + sway)
    CHANGES[trip](robot)
    since, commands = robot.now, robot.until(Phase.PAUSE)
    assert age < robot.now - since <= age + TICK + 1e-9
    targets = [command.position for command in commands]
    assert (np.abs(targets[-2] - targets[-3]) > 1e-5).all()
    np.testing.assert_array_equal(targets[-1], targets[-2])


def test_a_worse_fault_while_sitting_damps_at_once() -> None:
    robot = running()
    CHANGES["plan_lost"](robot)
    robot.until(Phase.SIT)
    CHANGES["temperature"](robot)
    assert is_damping(robot.step())
    assert robot.machine.trip == "plan_lost"  # the first cause


@pytest.mark.parametrize(("value", "trip"), [(1.5, "target_jump"), (np.nan, "not_a_number")])
def test_a_plan_is_looked_at_as_a_whole_when_it_comes(value: float, trip: str) -> None:
    robot = running()
    rows = np.tile(HOME + 0.1, (16, 1))
    rows[12:, 4] += value
    robot.plan = Targets(robot.now + TICK, 0.02, rows)
    assert is_damping(robot.step())
    assert robot.machine.trip == trip


def test_targets_that_are_no_numbers_damp() -> None:
    """Whatever led to them: they were taken for where the joints are."""
    robot = running()
    robot.machine._blend = (robot.now, np.full(12, np.nan))
    robot.inbox.plan = robot.plan = robot.machine._playing
    assert is_damping(robot.step())
    assert robot.machine.trip == "not_a_number"


def test_short_power_is_no_trip() -> None:
    robot = running()
    CHANGES["power"](robot)
    robot.for_a_while(4 * TICK)
    robot.change = {}
    robot.for_a_while(0.1)
    assert robot.machine.phase == Phase.RUN


def test_folded_calves_beyond_the_limits_are_no_trip_before_it_stands() -> None:
    robot = Robot()
    robot.joints = np.tile([0.0, 1.3, -2.79], 4)
    robot.until(Phase.READY)
    assert robot.machine.trip == ""


@pytest.mark.parametrize("phase", [Phase.HOLD, Phase.STAND, Phase.READY])
def test_an_order_to_stop_damps_in_every_phase(phase: Phase) -> None:
    robot = Robot()
    robot.until(phase)
    robot.inbox.stop = "SIGTERM"
    assert is_damping(robot.step())


def test_nothing_moves_before_it_is_to_stand() -> None:
    robot = Robot()
    robot.inbox.stand = False
    robot.inbox.arm = True
    for got in robot.for_a_while(0.5):
        assert got.kp.max() == got.kd.max() == np.abs(got.torque).max() == 0.0
    robot.inbox.finish = True
    robot.step()
    assert robot.machine.phase == Phase.OVER


def test_a_plan_that_begins_with_a_step_is_blended_into() -> None:
    robot = running()
    robot.offset = 0.5
    targets = np.array([command.position for command in robot.for_a_while(0.5)])
    assert robot.machine.phase == Phase.RUN
    assert np.abs(np.diff(targets, axis=0)).max() <= 0.05
    np.testing.assert_allclose(targets[-1], allowed(HOME + 0.5, targets[-2], 60.0, 0.7), atol=1e-3)


def test_targets_stay_within_joints_and_torques() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        joints = rng.uniform(LOWEST, HIGHEST)
        targets = allowed(rng.uniform(-5.0, 5.0, 12), joints, 60.0, 0.7)
        assert (targets >= LOWEST - 1e-12).all()
        assert (targets <= HIGHEST + 1e-12).all()
        assert (np.abs(60.0 * (targets - joints)) <= 0.7 * TORQUE_LIMIT + 1e-9).all()


def test_a_joint_outside_of_its_limits_is_led_back_by_no_more_torque() -> None:
    joints = np.where(np.arange(12) % 3 == 2, LOWEST - 0.5, HOME)
    targets = allowed(np.array(HOME), joints, 60.0, 0.7)
    np.testing.assert_allclose(60.0 * (targets - joints)[2::3], 0.7 * TORQUE_LIMIT[2::3])
    assert (targets[2::3] < LOWEST[2::3]).all()


def test_the_gains_are_those_of_the_planners_model() -> None:
    """Of other gains an identification makes another box, and the planner another motion."""
    model, got = planner_model(), running().step()
    at = layout(model)
    np.testing.assert_allclose(got.kp, model.actuator_gainprm[at.servos, 0])
    servos = -model.actuator_biasprm[at.servos, 2]
    np.testing.assert_allclose(got.kd, servos + model.dof_damping[at.joints_v])


@pytest.mark.parametrize(
    ("late", "pause"), [(0.0, 0.002), (0.0005, 0.0015), (0.0019, 0.001), (0.002, 0.001), (0.1, 0.001)]
)
def test_a_late_packet_is_followed_by_none_at_once(late: float, pause: float) -> None:
    assert next_tick(5.0, 5.0 + late, TICK) - (5.0 + late) == pytest.approx(pause)


def test_what_was_sent_by_a_time() -> None:
    sent, rows = Sent(HOME), np.arange(3.0)[:, None] + HOME
    for time, row in zip((1.0, 1.002, 1.004), rows, strict=True):
        sent.add(time, row)
    times = (0.5, 1.0019, 1.0021, 1.0021, 9.0)
    for time, expected in zip(times, (HOME, rows[0], rows[1], rows[1], rows[2]), strict=True):
        np.testing.assert_array_equal(sent.by(time), expected)


def test_plans_are_smooth_and_not_late_on_average() -> None:
    rows = np.outer(np.arange(8.0), np.ones(12))
    plan = Targets(10.0, 0.02, rows)
    times = 10.0 + np.arange(0.01, 0.15, 0.002)
    played = np.array([plan.at(time)[0] for time in times])
    np.testing.assert_allclose(played, (times - 10.01) / 0.02, atol=1e-9)
    assert plan.at(9.0)[0] == 0.0
    assert plan.at(20.0)[0] == 7.0


PAGE = (Path(__file__).parents[4] / "docs" / "go1.md").read_text(encoding="utf-8")


def test_every_trip_and_every_threshold_is_explained() -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \|.*\| ([^|]+) \|$", PAGE, re.MULTILINE))
    for name, then in TRIPS.items():
        assert rows[name].startswith("damp" if then == Phase.DAMP else "hold"), name
    for name in TripSettings.model_fields:
        assert f"`{name}`" in PAGE, name


def test_every_fault_is_explained() -> None:
    section = PAGE.split("## What can go wrong on the emulator")[1].split("\n## ")[0]
    documented = set(re.findall(r"`(\w+)`", section.split("| sort |")[1]))
    assert documented == {fault.name for fault in fields(Faults)}


@pytest.mark.parametrize("pace", [1.0, 0.5])
@pytest.mark.parametrize("waited", [False, True])
def test_a_computer_that_once_stands_still_does_not_change_the_robots_pace(pace: float, waited: bool) -> None:
    """For 0.5 s states wait for it, or the robot's clock stands still with it, as an emulator's does."""
    contact = Contact()
    for tick in range(3000):
        time = 0.001 * tick / pace
        late = max(1.7 - time, 0.0) if waited else 0.5
        contact._see_pace(tick, time + late * (time > 1.2))
        if time > 1.0:
            assert contact.pace == pytest.approx(pace, rel=0.02)
            assert contact.in_step == (pace == 1.0)
