"""Who plays which plan when, in lock-step and by the clock."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from amhe_cli.control.controller import Plan
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Samples
from amhe_cli.live.target import SimTarget
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.model import plant_model
from amhe_cli.robots.go1.plant import Plant

PERIOD = 0.02
STAND = np.full(12, -1.0)


class Player:
    """A plant that only notes what it is told: (time, first joint's target)."""

    state: Any = None
    parameters: Any = None

    def __init__(self) -> None:
        self.played: list[tuple[float, float]] = []

    @property
    def time(self) -> float:
        return PERIOD * len(self.played)

    def advance(self, targets: FloatArray, duration: float) -> Samples:
        assert duration == PERIOD
        before = self.time
        self.played.append((before, float(targets[0])))
        own, seen = before + np.array([0.5, 1.0]) * PERIOD, np.array([self.time])
        return {"joints.position": (own, np.zeros((2, 12))), "box.position": (seen, np.zeros((1, 3)))}


class Clock:
    """Stands in for the module `time`; sleeping takes no time of ours."""

    def __init__(self) -> None:
        self.now, self.slept = 100.0, 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0.0
        self.now += seconds
        self.slept += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr("amhe_cli.live.target.time", clock)
    return clock


def plan_from(now: float, value: float, rows: int = 5) -> Plan:
    """As the controller makes it: from one period after the measurements; rows value, value + 1, ..."""
    targets = np.tile(value + np.arange(float(rows))[:, None], 12)
    return Plan(now + PERIOD, PERIOD, targets)


def exchange(target: SimTarget, plan: Plan) -> tuple[float, Samples]:
    target.play(plan)
    return target.measure()


def test_a_plan_takes_effect_one_period_after_its_measurements() -> None:
    plant = Player()
    target = SimTarget(plant, PERIOD, STAND)
    now, _ = target.measure()
    for value in (10.0, 20.0, 30.0):
        now, _ = exchange(target, plan_from(now, value))
    assert [value for _, value in plant.played] == [-1.0, -1.0, 10.0, 20.0]
    assert now == pytest.approx(4 * PERIOD)
    assert target.misses == 0


def test_what_is_in_force_while_a_plan_is_made_is_played_meanwhile() -> None:
    plant = Player()
    target = SimTarget(plant, PERIOD, STAND)
    now, _ = target.measure()
    for value in (10.0, 20.0, 30.0):
        expected = float(target.in_force(now)[0])
        now, _ = exchange(target, plan_from(now, value))
        assert plant.played[-1] == (pytest.approx(now - PERIOD), expected)


def test_without_a_new_plan_the_old_one_goes_on_and_its_end_is_held() -> None:
    plant = Player()
    target = SimTarget(plant, PERIOD, STAND)
    exchange(target, plan_from(target.measure()[0], 10.0, rows=3))
    for _ in range(5):
        target.measure()
    assert [value for _, value in plant.played[2:]] == [10.0, 11.0, 12.0, 12.0, 12.0]


def test_rows_of_a_plan_change_at_whole_periods() -> None:
    plan = Plan(0.3, PERIOD, np.tile(np.arange(3.0)[:, None], 12))
    for step, row in ((-1, 0), (0, 0), (1, 1), (2, 2), (3, 2), (100, 2)):
        assert plan.at(0.3 + step * PERIOD)[0] == row
        assert plan.at(0.3 + (step + 0.9) * PERIOD)[0] == row


def test_lock_step_does_not_look_at_the_clock(clock: Clock) -> None:
    target = SimTarget(Player(), PERIOD, STAND)
    for _ in range(3):
        clock.now += 1.0
        target.measure()
    assert (target.misses, clock.slept) == (0, 0.0)


def test_who_is_fast_enough_waits_for_the_clock(clock: Clock) -> None:
    plant = Player()
    target = SimTarget(plant, PERIOD, STAND, realtime=True)
    now, _ = target.measure()
    for _ in range(10):
        clock.now += 0.7 * PERIOD
        now, _ = exchange(target, plan_from(now, 1.0))
        assert clock.now - 100.0 == pytest.approx(now)
    assert target.misses == 0
    assert now == pytest.approx(11 * PERIOD)
    assert clock.slept == pytest.approx((1.0 + 10 * 0.3) * PERIOD)


def test_who_is_slow_finds_that_time_has_gone_on(clock: Clock) -> None:
    """2.5 periods of thought: two begin without a new plan, played by the old one; all are measured."""
    plant = Player()
    target = SimTarget(plant, PERIOD, STAND, realtime=True)
    now, _ = exchange(target, plan_from(target.measure()[0], 10.0))
    start = now
    plan = plan_from(now, 20.0)
    clock.now += 2.5 * PERIOD
    now, measured = exchange(target, plan)
    assert target.misses == 2
    assert now == pytest.approx(start + 3 * PERIOD)
    assert clock.now - 100.0 == pytest.approx(now)
    np.testing.assert_allclose(
        measured["joints.position"][0], start + PERIOD * np.array([0.5, 1.0, 1.5, 2.0, 2.5, 3.0])
    )
    np.testing.assert_allclose(measured["box.position"][0], start + PERIOD * np.array([1.0, 2.0, 3.0]))
    assert [value for _, value in plant.played[-3:]] == [10.0, 11.0, 12.0]
    times, commands = measured["command.position"]
    np.testing.assert_allclose(times, start + PERIOD * np.array([1.0, 2.0, 3.0]))
    assert commands[:, 0].tolist() == [11.0, 12.0, 22.0], "what was followed since then, and is followed now"
    target.measure()
    assert plant.played[-1][1] == 22.0, "the late plan is played from where it should be by now"
    assert target.misses == 2, "one late plan is counted once"


@pytest.mark.flaky(reruns=2)
def test_by_the_real_clock_time_is_kept() -> None:
    target = SimTarget(Player(), PERIOD, STAND, realtime=True)
    begun = time.monotonic()
    for _ in range(4):
        target.measure()
    assert time.monotonic() - begun >= 4 * PERIOD - 1e-3


def test_a_simulated_target_knows_the_truth() -> None:
    plant = Plant(plant_model(), [], np.random.default_rng(0))
    target = SimTarget(plant, PERIOD, HOME)
    now, _ = target.measure()
    assert target.truth.time == now
    np.testing.assert_array_equal(target.truth.joints, plant.state.joints)
    assert target.parameters == plant.parameters


def test_a_plan_is_due_a_period_after_its_measurements_by_the_clock_alone(clock: Clock) -> None:
    waiting, racing = (SimTarget(Player(), PERIOD, STAND, realtime) for realtime in (False, True))
    waiting.measure()
    assert waiting.deadline is None
    begun = clock.now
    racing.measure()
    assert racing.deadline == pytest.approx(begun + 2 * PERIOD)
