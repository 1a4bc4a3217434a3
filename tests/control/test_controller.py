"""One control cycle with rollouts that are made up: what is asked of the engine, and when it is refined."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from amhe_cli.control.controller import Controller, Plan, RolloutPace
from amhe_cli.control.protocols import Behaviour
from amhe_cli.control.settings import ControlSettings
from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.engine.rollout import Rollouts

#: Six rollouts in each cycle, refined or not.
SETTINGS = ControlSettings(samples=6, loops=2, horizon=5, knots=2, substeps=3, period=0.02)
HOME = np.array([0.1, -0.2])
LOWER, UPPER = np.array([-0.5, -1.0]), np.array([0.5, 1.0])
BELIEF = {"friction": 0.4, "mass": 3.0}
NAMES = ("mass", "friction")


@dataclass(frozen=True)
class Pose:
    """State of a cart with an arm of two joints."""

    time: float
    x: float
    joints: FloatArray


class Cart:
    """A robot of its own kind; the servo of its second joint comes first in the engine's input."""

    lower, upper = LOWER, UPPER
    servos = np.array([1, 0])

    def coordinates(self, state: Pose) -> tuple[FloatArray, FloatArray]:
        return np.array([state.x, *state.joints]), np.zeros(3)

    def state_of(self, time: float, qpos: FloatArray, qvel: FloatArray) -> Pose:
        return Pose(time, float(qpos[0]), qpos[1:])

    def bodies(self, qpos: FloatArray, qvel: FloatArray) -> FloatArray:
        return qpos[..., 0]


STATE, LATER = Pose(1.0, 0.0, HOME), Pose(1.02, 0.0, HOME)


class Call(NamedTuple):
    theta: FloatArray
    qpos: FloatArray
    inputs: FloatArray
    lengths: IntArray


@dataclass
class Gliding:
    """An engine in which the cart glides a centimetre a step, and what starts beyond `wall` diverges."""

    wall: float = np.inf
    calls: list[Call] = field(default_factory=list)

    def rollout(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray, lengths: IntArray
    ) -> Rollouts:
        self.calls.append(Call(theta.copy(), np.array(qpos), inputs.copy(), lengths))
        count, steps = inputs.shape[:2]
        out = np.tile(qpos, (count, steps, 1))
        out[..., 0] += 0.01 * np.arange(1, steps + 1)
        return Rollouts(out, np.tile(qvel, (count, steps, 1)), None, np.full(count, qpos[0] < self.wall))


@dataclass
class Still:
    """A move: stand as at home; cost by the first channel alone, least at 0.5."""

    reference: float
    command: FloatArray
    commands: FloatArray | None = None
    times: FloatArray | None = None
    bodies: FloatArray | None = None

    def targets(self, times: FloatArray, commands: FloatArray) -> FloatArray:
        self.commands = commands
        return np.tile(HOME, (len(commands), times.size, 1)) + commands[:, None, 1:2]

    def terms(self, times: FloatArray, bodies: FloatArray) -> dict[str, FloatArray]:
        assert self.commands is not None
        self.times, self.bodies = times, bodies
        off = (self.commands[: len(bodies), 0] - 0.5) ** 2
        return {"off": np.tile(off[:, None], times.size)}


class Standing:
    """A behaviour whose contact mode switches at a given time; it has what the controller needs, no more."""

    channel_sigma = np.array([0.1, 0.01])
    knot_weight = 0.0

    def __init__(self, switch: float = np.inf, side: float = 0.0) -> None:
        self.switch, self.side = switch, side
        self.started: list[tuple[Pose, Mapping[str, float]]] = []
        self.made: list[Still] = []

    def switches(self, start: float, end: float) -> bool:
        return start < self.switch <= end

    def move(self, state: Pose, belief: Mapping[str, float]) -> Still:
        self.started.append((state, belief))
        self.made.append(Still(state.time, np.array([0.3, self.side])))
        return self.made[-1]


@dataclass
class Slow(Gliding):
    """An engine with a clock: each rollout takes so long [s]."""

    each: float = 0.001
    now: float = 50.0

    def rollout(self, *call: Any) -> Rollouts:
        done = super().rollout(*call)
        self.now += self.each * len(done.completed)
        return done


def controller(
    behaviour: Behaviour, engine: Any, pace: RolloutPace | None = None, **changes: object
) -> Controller:
    settings = SETTINGS.model_copy(update=changes)
    sigma, rng = np.full(2, 0.01), np.random.default_rng(0)
    return Controller(behaviour, Cart(), sigma, engine, settings, NAMES, rng, pace)


def planned(by: Controller) -> Plan:
    return by.plan(STATE, HOME + 0.1, BELIEF)


def test_it_plans_from_where_the_targets_in_force_will_have_led() -> None:
    behaviour, engine = Standing(), Gliding()
    plan = planned(controller(behaviour, engine, refine="never"))
    ahead, planning = engine.calls
    assert ahead.inputs.shape == (1, 3, 2)
    np.testing.assert_array_equal(ahead.inputs[..., Cart.servos], np.tile(HOME + 0.1, (1, 3, 1)))
    (start, belief) = behaviour.started[0]
    assert start.time == pytest.approx(1.02) and belief == BELIEF
    assert start.x == pytest.approx(0.03)
    assert planning.qpos[0] == pytest.approx(0.03)
    assert plan.start == pytest.approx(1.02)
    assert plan.targets.shape == (5, 2)


def test_rollouts_hold_each_target_for_a_period_under_the_belief() -> None:
    behaviour, engine = Standing(side=0.02), Gliding()
    planned(controller(behaviour, engine, refine="never"))
    call = engine.calls[1]
    np.testing.assert_array_equal(call.theta, np.tile([3.0, 0.4], (6, 1)))
    np.testing.assert_array_equal(call.lengths, np.full(6, 15))
    periods = call.inputs.reshape(6, 5, 3, 2)
    np.testing.assert_array_equal(periods, periods[:, :, :1].repeat(3, axis=2))
    bare = call.inputs[2][:, Cart.servos]  # the plan without noise and channels
    np.testing.assert_allclose(bare, np.tile(HOME + 0.02, (15, 1)))
    assert behaviour.made[0].times is not None
    np.testing.assert_allclose(behaviour.made[0].times, 1.02 + 0.02 * np.arange(1, 6))
    assert behaviour.made[0].bodies is not None
    np.testing.assert_allclose(behaviour.made[0].bodies, np.tile(0.03 + 0.03 * np.arange(1, 6), (6, 1)))


def test_with_time_enough_a_plan_is_that_of_lock_step_to_the_bit() -> None:
    waited, hurried = (controller(Standing(), Gliding(), refine="always", samples=12) for _ in range(2))
    for state in (STATE, LATER):
        plans = [waited.plan(state, HOME, BELIEF), hurried.plan(state, HOME, BELIEF, np.inf)]
        np.testing.assert_array_equal(plans[0].targets, plans[1].targets)
        assert plans[0].step is not None and plans[1].step is not None
        np.testing.assert_array_equal(plans[0].step.weights, plans[1].step.weights)


@pytest.mark.parametrize("each", [0.0001, 0.001, 0.002, 0.004, 0.02])
def test_a_plan_keeps_its_time_and_uses_it(each: float) -> None:
    engine = Slow(each=each)
    by = controller(Standing(), engine, RolloutPace(lambda: engine.now), samples=12)
    for number in range(4):
        deadline = engine.now + 0.02
        plan = by.plan(replace(STATE, time=1.0 + 0.02 * number), HOME, BELIEF, deadline)
        assert plan.step is not None
        made, fit = plan.step.rollouts, int(0.02 / each + 1e-6) - 1  # one rollout predicts the state
        assert made == len(plan.step.weights)
        assert np.isfinite(plan.targets).all()
        if fit < 4:
            assert made == 4
        else:
            assert engine.now <= deadline + 1e-9
            assert made >= min(fit - 1, 12)


def test_rollouts_that_turn_out_slow_are_noticed_before_the_plan_is_late() -> None:
    engine = Slow(each=0.0005)
    by = controller(Standing(), engine, RolloutPace(lambda: engine.now), samples=12)
    made = []
    for number, each in enumerate((0.0005, 0.0005, 0.002, 0.002, 0.0005, 0.0005)):
        engine.each, deadline = each, engine.now + 0.02
        plan = by.plan(replace(STATE, time=1.0 + 0.02 * number), HOME, BELIEF, deadline)
        assert engine.now <= deadline + 1e-9
        made.append(plan.step.rollouts if plan.step else 0)
    assert made[:2] == [12, 12] and max(made[2:4]) < 10 and made[-1] == 12


def test_of_rollouts_there_is_no_time_for_the_best_plan_so_far_is_never_one() -> None:
    engine = Slow(each=0.02)
    by = controller(Standing(), engine, RolloutPace(lambda: engine.now), samples=12)
    first = by.plan(STATE, HOME, BELIEF)
    assert first.step is not None
    plan = by.plan(LATER, HOME, BELIEF, engine.now)
    assert plan.step is not None and plan.step.rollouts == 4
    assert plan.step.best <= first.step.best + 1e-12, "the best of twelve is one of the four"


def test_a_plan_keeps_the_states_of_its_sampled_plans() -> None:
    engine, kept = Gliding(), 30
    plan = planned(controller(Standing(), engine, refine="never", samples=kept))
    assert plan.candidates is not None
    assert plan.candidates.shape == (kept, 5, engine.calls[1].qpos.size)
    glided = 0.03 * np.arange(2, 7)  # by three steps in each period, the one before the plan included
    np.testing.assert_allclose(plan.candidates[..., 0], np.tile(glided, (kept, 1)))


def test_targets_stay_within_the_joints_limits() -> None:
    for side in (-9.0, 9.0):
        engine = Gliding()
        plan = planned(controller(Standing(side=side), engine, refine="never"))
        inputs = engine.calls[1].inputs[..., Cart.servos]
        np.testing.assert_array_equal(inputs, np.broadcast_to(LOWER if side < 0 else UPPER, inputs.shape))
        expected = np.tile(LOWER if side < 0 else UPPER, (5, 1))
        np.testing.assert_allclose(
            plan.targets, expected, rtol=1e-12
        )  # a weighted mean, rounded as the processor does


def cycles(refine: str, switch: float) -> list[FloatArray]:
    """Joint targets that are rolled out in plans that start at 1.02 s and 1.04 s; not the predictions."""
    engine = Gliding()
    by = controller(Standing(switch), engine, refine=refine)
    for state in (STATE, LATER):
        plan = by.plan(state, HOME + 0.1, BELIEF)
        assert plan.step is not None and plan.step.rollouts == 6
    assert [len(call.inputs) for call in engine.calls] == [1, 6, 1, 6]
    return [call.inputs for call in engine.calls[1::2]]


@pytest.mark.parametrize(
    ("refine", "switch", "refined"),
    [
        ("always", np.inf, True),
        ("never", 1.01, False),
        ("switch", 1.01, True),
        ("switch", 1.02, True),
        ("switch", 0.99, False),
        ("switch", 1.03, False),
    ],
)
def test_it_refines_always_never_or_where_contacts_switch(refine: str, switch: float, refined: bool) -> None:
    """Within the period before the plan's start at 1.02 s; seen by what the next plan samples."""
    (first, second), (plain_first, plain_second) = cycles(refine, switch), cycles("never", np.inf)
    np.testing.assert_array_equal(first, plain_first)
    assert np.array_equal(second, plain_second) is not refined


def test_channels_move_the_command_to_where_it_costs_least() -> None:
    by = controller(Standing(), Gliding(), refine="never")
    for _ in range(60):
        plan = planned(by)
    assert plan.command is not None and plan.command[0] == pytest.approx(0.5, abs=0.05)


def test_where_the_prediction_diverges_it_plans_from_now() -> None:
    behaviour = Standing()
    plan = planned(controller(behaviour, Gliding(wall=-1.0), refine="never"))
    np.testing.assert_array_equal(behaviour.started[0][0].joints, STATE.joints)
    assert plan.step is not None and plan.step.diverged == 6
    np.testing.assert_allclose(plan.targets, np.tile(HOME, (5, 1)), err_msg="the bare reference")
