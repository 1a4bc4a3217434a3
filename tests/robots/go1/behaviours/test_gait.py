"""Gait and sweeping."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from amhe_cli.robots.go1 import kinematics as legs
from amhe_cli.robots.go1.behaviours.gait import (
    CENTRE_OF_MASS,
    WEIGHT,
    Gait,
    contacts,
    neutral_feet,
    standing,
    switches,
    walk,
)
from amhe_cli.robots.go1.behaviours.objective import Course
from amhe_cli.robots.go1.behaviours.sweeping import FREE, SHIFT, Sweeping, SweepShape, stand_on_three
from amhe_cli.robots.go1.kinematics import joint_angles
from amhe_cli.robots.go1.model import Box, planner_model, plant_model
from amhe_cli.robots.go1.state import Body, State
from tests.robots.go1.playing import FAR, play

GAIT = Gait()
AHEAD = np.array([0.2, 0.0, 0.0])


def test_diagonal_legs_stand_together_for_their_share_of_the_time() -> None:
    standing_feet = contacts(GAIT, np.arange(0.0, 5.0, 1e-3))
    np.testing.assert_array_equal(standing_feet[:, 0], standing_feet[:, 3])
    np.testing.assert_array_equal(standing_feet[:, 1], standing_feet[:, 2])
    np.testing.assert_allclose(standing_feet.mean(axis=0), GAIT.duty, atol=1e-3)
    assert standing_feet.sum(axis=1).min() == 2


def test_the_mode_switches_in_the_cycles_in_which_a_foot_lifts_off_or_touches_down() -> None:
    ends = 0.02 * np.arange(1, 200)
    found = [end for end in ends if switches(GAIT, end - 0.02, end)]
    instants = np.add.outer(0.5 * np.arange(8), [0.05, 0.25, 0.3, 0.5]).ravel()
    np.testing.assert_allclose(found, 0.02 * np.ceil(instants[instants < ends[-1]] / 0.02 - 1e-6))
    assert not any(switches(standing(GAIT), end - 0.02, end) for end in ends)


@pytest.mark.parametrize("twist", [[0.3, 0.0, 0.0], [0.0, 0.2, 0.0], [0.1, -0.1, 0.5]])
def test_standing_feet_stay_on_the_floor_of_a_moving_trunk(twist: list[float]) -> None:
    """In the trunk's frame the floor moves by -(v + w x p); neutral places stand for p."""
    times, step = np.arange(0.0, 0.5, 0.01), 1e-5
    now, soon = walk(GAIT, times, twist), walk(GAIT, times + step, twist)
    velocity = (soon.feet - now.feet) / step
    vx, vy, w = twist
    neutral = neutral_feet(GAIT)
    expected = -np.stack((vx - w * neutral[:, 1], vy + w * neutral[:, 0], np.zeros(4)), axis=-1)
    stays = contacts(GAIT, times) & contacts(GAIT, times + step)
    np.testing.assert_allclose(velocity[stays], np.broadcast_to(expected, velocity.shape)[stays], atol=1e-6)


def test_swinging_feet_are_lifted_and_never_jump() -> None:
    times = np.arange(0.0, 1.0, 1e-3)
    reference = walk(GAIT, times, AHEAD)
    height = reference.feet[..., 2] - neutral_feet(GAIT)[:, 2]
    assert height.max() == pytest.approx(GAIT.swing, abs=1e-4)
    assert np.abs(np.diff(reference.feet, axis=0)).max() < 2e-3
    assert (height[contacts(GAIT, times)] == 0.0).all()


def test_forces_carry_the_weight_and_the_push_without_a_moment() -> None:
    push, height = np.array([20.0, -8.0]), 0.22
    reference = walk(standing(GAIT), 0.0, np.zeros(3), push)
    np.testing.assert_allclose(reference.forces.sum(axis=0), [*push, WEIGHT])
    floor = np.concatenate((reference.feet[:, :2], np.zeros((4, 1))), axis=1)
    moment = np.cross(floor, reference.forces).sum(axis=0)
    moment += np.cross([*CENTRE_OF_MASS, 0.0], [0.0, 0.0, -WEIGHT])
    moment += np.cross([0.0, 0.0, height], [*-push, 0.0])
    np.testing.assert_allclose(moment[:2], 0.0, atol=0.05)


def test_feet_in_the_air_carry_nothing() -> None:
    times = np.arange(0.0, 1.0, 7e-3)
    reference = walk(GAIT, times, AHEAD, (15.0, 0.0))
    assert (reference.forces[~contacts(GAIT, times)] == 0.0).all()
    assert (reference.forces[..., 2] >= 0.0).all()
    np.testing.assert_allclose(reference.forces[..., 2].sum(axis=-1), WEIGHT)


def test_it_walks_as_commanded_in_the_plant(plant: mujoco.MjModel) -> None:
    motion = play(plant, lambda t: walk(GAIT, t, AHEAD), 4.0)
    speed = (motion.trunk[-1, 0] - motion.trunk[0, 0]) / 4.0
    print(f"open-loop speed {speed:.3f} of 0.200 m/s")
    assert 0.16 < speed < 0.24
    assert motion.tilt.max() < np.radians(8.0)
    assert abs(motion.trunk[-1, 1]) < 0.12
    assert np.abs(motion.trunk[:, 2] - GAIT.height).max() < 0.02


def test_without_the_lead_it_walks_nowhere(plant: mujoco.MjModel) -> None:
    """Why targets are not joint angles: a servo that has arrived gives no force."""

    def bare(t: float):
        reference = walk(GAIT, t, AHEAD)
        return replace(reference, targets=reference.joints)

    motion = play(plant, bare, 2.0)
    assert motion.trunk[-1, 0] - motion.trunk[0, 0] < 0.1


@pytest.mark.parametrize(("twist", "way"), [([0.0, 0.1, 0.0], 1), ([-0.2, 0.0, 0.0], 0)])
def test_it_walks_sideways_and_back(plant: mujoco.MjModel, twist: list[float], way: int) -> None:
    motion = play(plant, lambda t: walk(GAIT, t, twist), 3.0)
    moved = (motion.trunk[-1] - motion.trunk[0])[:2]
    assert moved[way] == pytest.approx(3.0 * twist[way], rel=0.25)
    assert abs(moved[1 - way]) < 0.08


def test_it_turns(plant: mujoco.MjModel) -> None:
    motion = play(plant, lambda t: walk(GAIT, t, [0.0, 0.0, 0.4]), 3.0)
    assert motion.yaw == pytest.approx(1.2, rel=0.2)


def test_in_place_and_standing_hold_their_place(plant: mujoco.MjModel) -> None:
    for gait in (GAIT, standing(GAIT)):
        motion = play(plant, lambda t, gait=gait: walk(gait, t, np.zeros(3)), 4.0)
        assert np.abs(motion.trunk[-1, :2] - motion.trunk[0, :2]).max() < 0.05
        assert np.abs(motion.trunk[:, 2] - gait.height).max() < 0.01
        assert motion.tilt.max() < np.radians(3.0)


@pytest.mark.parametrize("timestep", [0.004, 0.01])
def test_the_planner_sees_the_same_walk(timestep: float) -> None:
    motion = play(planner_model(FAR, timestep=timestep), lambda t: walk(GAIT, t, AHEAD), 2.0)
    assert (motion.trunk[-1, 0] - motion.trunk[0, 0]) / 2.0 == pytest.approx(0.2, abs=0.04)
    assert motion.tilt.max() < np.radians(10.0)


@pytest.mark.medium
def test_a_push_as_strong_as_friction_moves_the_box_at_the_walk_s_speed() -> None:
    plant = plant_model(Box(mass=4.0, floor_friction=0.4))
    pushed = {f: play(plant, lambda t, f=f: walk(GAIT, t, AHEAD, (f, 0.0)), 5.0).box for f in (0.0, 20.0)}
    moved = {force: box[-1, 0] - box[0, 0] for force, box in pushed.items()}
    assert moved[20.0] > 0.6
    assert moved[20.0] > moved[0.0] + 0.1


def test_it_stands_on_three_legs_and_sweeps_with_the_fourth(plant: mujoco.MjModel) -> None:
    def sweep(t: float):
        out = -0.127 - np.clip(0.1 * (t - 2.5), 0.0, 0.1)
        return stand_on_three(GAIT, SweepShape(), t, [0.22, out, -0.14])

    last = sweep(6.0)
    assert (last.forces[FREE] == 0.0).all()
    assert (last.forces[1:, 2] > 0.0).all()
    motion = play(plant, sweep, 6.0)
    assert motion.tilt.max() < np.radians(5.0)
    assert motion.trunk[:, 2].min() > 0.25


def test_the_free_foot_s_push_is_held_by_the_other_three() -> None:
    reference = stand_on_three(GAIT, SweepShape(), 3.0, [0.22, -0.2, -0.14], push=[0.0, -10.0])
    np.testing.assert_allclose(reference.forces[0], [0.0, 10.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(reference.forces[1:].sum(axis=0), [0.0, -10.0, WEIGHT], atol=1e-9)


def test_turning_the_trunk_leaves_the_feet_where_they_are() -> None:
    turn, moved = 0.2, np.array([0.02, -0.01])
    reference = stand_on_three(GAIT, SweepShape(), 3.0, [0.22, -0.2, -0.14], trunk=[*moved, turn])
    c, s = np.cos(turn), np.sin(turn)
    back = reference.feet[:, :2] @ np.array([[c, s], [-s, c]]) + moved + SHIFT
    np.testing.assert_allclose(back[1:], neutral_feet(GAIT)[1:, :2], atol=1e-9)
    np.testing.assert_allclose(back[0], [0.22, -0.2], atol=1e-9)
    np.testing.assert_allclose(legs.feet(reference.joints), reference.feet, atol=1e-9)


REACH, HEIGHT = 0.25, 0.27
BELIEF = {"box_mass": 2.5, "floor_friction": 0.4}


def at_rest(position: tuple[float, float, float]) -> Body:
    return Body(np.array(position), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))


def stalled(time: float, slipped: float = 0.0) -> State:
    """The trunk has gone back over its feet; the free foot hangs 2 cm before its reach and does not move.

    Args:
        time: [s]; at 0 the trunk has not gone yet.
        slipped: So far ahead is the other front foot of where it was put [m].
    """
    back = 0.12 * (time > 0.0)
    feet = neutral_feet(Gait(height=HEIGHT)) + np.array([back, 0.0, 0.0])
    feet[0] += np.array([0.0, -(REACH - 0.02) - feet[0, 1], 0.14])
    feet[1, 0] += slipped
    trunk, box = at_rest((-back, 0.0, HEIGHT)), at_rest((0.1, -0.405, 0.15))
    return State(time, trunk, box, joint_angles(feet).ravel(), np.zeros(12))


def test_when_all_is_done_the_foot_is_set_down() -> None:
    """Given up after 8 s; back where it began, the foot goes down to the floor, and stays there."""
    sweeping = Sweeping(Course((0.1, -0.34), -0.5 * np.pi, 0.5), 0.15, shape=SweepShape(reach=2.0, sweeps=1))
    shape, heights = sweeping.shape, {}
    for time in (0.0, *np.arange(1.0, 20.0, 0.02)):
        heights[round(float(time), 2)] = sweeping.move(stalled(time), BELIEF).foot[2] + Gait().height
    assert heights[5.0] == heights[9.0] == pytest.approx(shape.height)
    assert any(0.0 < height < shape.height for time, height in heights.items() if time > 9.0)
    assert abs(heights[19.9]) < 1e-12


def test_a_box_beyond_the_leg_s_reach_is_walked_after_and_swept_again() -> None:
    """The box stands 0.1 m ahead and 0.4 m aside of the trunk at first, and 0.1 m farther after the sweep."""
    sweeping = Sweeping(Course((0.1, -0.34), -0.5 * np.pi, 0.5), 0.15, shape=SweepShape(reach=REACH))

    def left(time: float, there: bool = False) -> State:
        state = stalled(time)
        trunk = at_rest((0.0, -0.1, HEIGHT)) if there else state.trunk
        return replace(state, box=at_rest((0.1, -0.505, 0.15)), trunk=trunk)

    first = sweeping.move(stalled(0.0), BELIEF)
    times = np.arange(0.02, 13.0, 0.02)
    begun = next(time for time in times if sweeping.move(left(time), BELIEF) and sweeping.steps(time))
    move = sweeping.move(left(begun + 0.02), BELIEF)
    assert move.command[1] == pytest.approx(-sweeping.shape.aside)
    standing_feet = sweeping.standing(np.linspace(begun, begun + 0.4, 5))
    np.testing.assert_array_equal(standing_feet, contacts(GAIT, np.linspace(begun, begun + 0.4, 5)))
    assert sweeping.steps(begun + 0.3), "it goes on until it is there"
    ends = [begun + 0.04, begun + 0.8]
    again = [sweeping.move(left(time, there=True), BELIEF) for time in ends][-1]
    assert not sweeping.steps(ends[-1])
    np.testing.assert_allclose(again.foot, first.foot, atol=1e-9)


@pytest.mark.parametrize("ahead", [-0.03, 0.03])
def test_a_box_beside_its_path_is_turned_back_to_it(ahead: float) -> None:
    """A push to the right, ahead of the box's middle, turns it to the right, and so it goes back."""
    sweeping = Sweeping(Course((0.1, -0.34), -0.5 * np.pi, 0.5), 0.15)
    beside = replace(stalled(0.0), box=at_rest((0.1 + ahead, -0.405, 0.15)))
    assert (sweeping.move(beside, BELIEF).foot[0] - 0.1 - ahead) / ahead == pytest.approx(0.9)


def test_a_foot_that_has_slipped_is_taken_for_where_it_is() -> None:
    """In a second or so; the others stay, and so does the free one's place under its hip."""
    sweeping = Sweeping(
        Course((0.1, -0.34), -0.5 * np.pi, 0.5), 0.15, shape=SweepShape(reach=REACH, sweeps=1)
    )
    begin, planted = 1.6, {}
    for time in np.arange(0.0, 8.0, 0.02):
        planted[round(float(time), 2)] = sweeping.move(stalled(time, slipped=0.05), BELIEF).planted
    slips = {time: feet - neutral_feet(sweeping.gait) for time, feet in planted.items()}
    assert slips[begin - 0.02] == pytest.approx(0.0)
    assert slips[begin + 1.0][1, 0] == pytest.approx(0.05 * (1.0 - np.exp(-1.0)), rel=0.03)
    assert slips[7.98] == pytest.approx(np.array([[0, 0, 0], [0.05, 0, 0], [0, 0, 0], [0, 0, 0]]), abs=1e-3)
