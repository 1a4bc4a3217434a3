"""The measures, on episodes that are made up."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.robots.go1.judge import Judge, has_fallen
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.state import Body, State
from amhe_cli.robots.go1.tasks import find_task

PERIOD = 0.02
T1, T2, T5 = find_task("t1"), find_task("t2"), find_task("t5")
GOAL = np.array([3.0, 0.0])
STILL = np.zeros(3)


def price(state: State) -> dict[str, float]:
    """A running cost: one, and the trunk's height."""
    return {"one": 1.0, "height": float(state.trunk.position[2])}


def judge(task=T1, longest: float = 40.0) -> Judge:
    return Judge(task, price, PERIOD, longest)


def state(
    time: float,
    box: FloatArray,
    speed: float = 0.0,
    yaw: float = 0.0,
    lean: float = 0.0,
    height: float = 0.25,
) -> State:
    """Upright and still where nothing else is said; it walks along its own heading."""
    turn = rotations.exp(np.array([0.0, 0.0, yaw]))
    q = rotations.multiply(turn, rotations.exp(np.array([0.6 * lean, 0.8 * lean, 0.0])))
    velocity = rotations.rotate(turn, np.array([speed, 0.3, 0.0]))
    trunk = Body(np.array([0.0, 0.0, height]), q, velocity, STILL)
    there = Body(np.array([*box, 0.15]), rotations.exp(STILL), STILL, STILL)
    return State(time, trunk, there, HOME, np.zeros(12))


def times(until: float) -> Iterable[float]:
    return (PERIOD * k for k in range(1, round(until / PERIOD) + 1))


def watched(by: Judge, at: Callable[[float], State], until: float = 41.0) -> float:
    """The time at which the judge says that it is over."""
    for time in times(until):
        if by.watch(at(time)):
            return time
    raise AssertionError("it never ended")


def arriving(at: float, off: float = 0.0) -> Callable[[float], State]:
    return lambda t: state(t, GOAL - [0.0, off] if t >= at - 1e-9 else GOAL - [1.0, 0.0])


def test_periods_without_a_state_are_charged_to_the_next_one() -> None:
    whole, late = judge(), judge()
    for k, time in enumerate(times(4.0)):
        at = state(PERIOD * (3 * (k // 3) + 3), GOAL - [1.0, 0.0], speed=0.01 * (k // 3))
        whole.watch(replace(at, time=time))
        if k % 3 == 2:
            late.watch(replace(at, time=time))
    for name in ("cost", "speed_rmse", "path_rmse_m"):
        assert getattr(late.measures(), name) == pytest.approx(getattr(whole.measures(), name), rel=0.02)


@pytest.mark.parametrize("off", [0.0, 0.049, 0.051])
def test_arrival_is_half_a_second_within_five_centimetres_of_the_goal(off: float) -> None:
    by, near = judge(longest=5.0), off < 0.05
    assert watched(by, arriving(3.0, off)) == pytest.approx(3.5 if near else 5.0)
    found = by.measures()
    assert by.arrived == found.on_time == near and found.success and not found.fell
    assert found.time_s == pytest.approx(3.5 if near else 5.0)
    assert found.goal_error_m == pytest.approx(off)


def test_who_leaves_the_goal_begins_the_half_second_again() -> None:
    def passing(t: float) -> State:
        ahead = -2.0 if t < 3.0 - 1e-9 else 0.06 if 3.4 < t < 3.43 else 0.0
        return state(t, GOAL + np.array([ahead, 0.0]))

    assert watched(judge(), passing) == pytest.approx(3.44 + 0.5)


@pytest.mark.parametrize(("off", "success"), [(0.149, True), (0.151, False)])
def test_success_is_fifteen_centimetres_at_the_end(off: float, success: bool) -> None:
    by = judge(longest=2.0)
    watched(by, arriving(0.5, off))
    assert by.measures().success == success
    assert by.measures().goal_error_m == pytest.approx(off)


@pytest.mark.parametrize(("at", "on_time"), [(14.5, True), (14.52, False)])
def test_on_time_is_within_one_and_a_quarter_of_the_nominal_time(at: float, on_time: bool) -> None:
    """12 s: the half second of holding still counts."""
    by = judge()
    watched(by, arriving(at))
    assert by.measures().success
    assert by.measures().on_time == on_time


def test_an_episode_lasts_forty_seconds_at_most() -> None:
    by = judge()
    assert watched(by, lambda t: state(t, GOAL - [1.0, 0.0])) == pytest.approx(40.0)
    found = by.measures()
    assert (found.success, found.on_time, found.fell, found.time_s) == (False, False, False, 40.0)
    assert found.cost == pytest.approx(1.25 * 2000), "every period once"


@pytest.mark.parametrize(
    ("lean", "height", "fell"),
    [(59.0, 0.25, False), (61.0, 0.25, True), (0.0, 0.121, False), (0.0, 0.119, True)],
)
@pytest.mark.parametrize("yaw", [0.0, 2.5])
def test_a_fall_is_sixty_degrees_or_twelve_centimetres(
    lean: float, height: float, fell: bool, yaw: float
) -> None:
    last = state(1.0, GOAL, yaw=yaw, lean=np.radians(lean), height=height)
    assert has_fallen(last) == fell
    by = judge()
    assert by.watch(state(0.98, GOAL)) is False
    assert by.watch(last) == fell
    assert by.measures().fell == fell
    assert by.measures().success == (not fell)


def half_circle(left: float) -> Callable[[float], State]:
    """The box goes along the path of T2; half way it is so far left of it for an instant."""

    def at(t: float) -> State:
        angle = np.pi * min(1.0, t / 4.0)
        radius = 1.5 - (left if abs(t - 2.0) < 0.01 else 0.0)
        return state(t, np.array([0.6 + radius * np.sin(angle), 1.5 - radius * np.cos(angle)]))

    return at


@pytest.mark.parametrize("left", [0.39, 0.41, -0.39, -0.41])
def test_in_the_bend_the_box_may_never_be_four_decimetres_off(left: float) -> None:
    by = judge(T2)
    watched(by, half_circle(left))
    assert by.arrived
    assert by.measures().success == by.measures().on_time == (abs(left) < 0.4)


def test_path_error_is_the_root_mean_square_distance() -> None:
    by = judge(longest=1.0)
    watched(by, lambda t: state(t, np.array([1.0, 0.3 if t < 0.51 else -0.1])))
    assert by.measures().path_rmse_m == pytest.approx(np.sqrt(0.5 * (0.09 + 0.01)))


def test_speed_is_judged_from_one_second_until_the_taper() -> None:
    """Wild before and after; in between 0.05 m/s too fast, at its first and last instant 0.25 m/s."""

    def at(t: float) -> State:
        if t < 1.0 - 1e-9:
            return state(t, np.array([0.6, 0.0]), speed=5.0)
        if t < 2.0 - 1e-9:
            speed = 0.25 if 1.01 < t < 1.97 else 0.45
            return state(t, np.array([2.0 if t < 1.5 else 2.79, 0.0]), speed=speed, yaw=3.0 * t)
        return state(t, np.array([2.81 if t < 2.1 else 2.5, 0.0]), speed=7.0)

    by = judge(longest=3.0)
    watched(by, at)
    assert by.measures().speed_rmse == pytest.approx(np.sqrt((48 * 0.05**2 + 2 * 0.25**2) / 50))


def test_with_one_leg_speed_is_judged_from_the_lift_off_to_the_end() -> None:
    lift_off, goal = T5.judged_from, T5.path.goal

    def at(t: float) -> State:
        return state(t, goal - [0.0, -0.1], speed=5.0 if t < lift_off - 1e-9 else 0.03)

    by = judge(T5, longest=lift_off + 2.0)
    watched(by, at)
    assert by.measures().speed_rmse == pytest.approx(0.03)


def test_who_falls_at_once_was_not_judged_by_speed() -> None:
    by = judge()
    assert by.watch(state(0.02, GOAL, lean=2.0))
    assert by.measures().speed_rmse is None


def test_after_arrival_nothing_is_charged() -> None:
    by = judge()
    end = watched(by, arriving(3.0))
    found = by.measures()
    assert found.cost == pytest.approx(1.25 * end / PERIOD)
    assert found.terms == pytest.approx({"one": end / PERIOD, "height": 0.25 * end / PERIOD})


def test_after_a_fall_its_state_is_charged_to_the_end() -> None:
    by = judge()
    end = watched(by, lambda t: state(t, GOAL - [1.0, 0.0], height=0.1 if t > 9.99 else 0.25))
    assert end == pytest.approx(10.0)
    found = by.measures()
    assert found.cost == pytest.approx(499 * 1.25 + 1501 * 1.1)
    assert sum(found.terms.values()) == pytest.approx(499 * 1.25 + 1.1)
    assert found.time_s == 40.0


def test_who_is_stopped_is_charged_up_to_there() -> None:
    by = judge()
    assert not any(by.watch(state(t, GOAL - [1.0, 0.0])) for t in times(2.0))
    found = by.measures()
    assert found.time_s == pytest.approx(2.0)
    assert found.cost == pytest.approx(1.25 * 100)


def test_a_fall_at_the_moment_of_arrival_is_a_fall() -> None:
    by = judge()
    watched(by, lambda t: state(t, GOAL, height=0.1 if t > 0.51 else 0.25))
    found = by.measures()
    assert found.fell and not found.success and not by.arrived
    assert found.cost == pytest.approx(25 * 1.25 + 1975 * 1.1)
    assert found.time_s == 40.0


@pytest.mark.parametrize("name", ["t1", "t2", "t5"])
def test_the_real_running_cost_is_by_the_fixed_path(name: str) -> None:
    """Off the path the steering would ask for another heading; the cost must not."""
    task = find_task(name)
    behaviour = task.behaviour()
    x, y = task.path.start
    heading = task.path.heading
    left = 0.1 * np.array([-np.sin(heading), np.cos(heading)])
    on = behaviour.running_cost(state(5.0, np.array([x, y])))
    off = behaviour.running_cost(state(5.0, np.array([x, y]) + left))
    assert off["box_left"] > on["box_left"] == pytest.approx(0.0, abs=1e-12)
    for term in ("box_speed", "box_yaw", "robot_speed", "height", "tilt"):
        assert off[term] == pytest.approx(on[term], abs=1e-9), term
    by = Judge(task, behaviour.running_cost, PERIOD, 40.0)
    by.watch(replace(state(0.02, np.array([x, y])), time=0.02))
    assert set(by.measures().terms) == set(on)
