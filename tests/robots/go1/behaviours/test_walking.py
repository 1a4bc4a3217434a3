"""Where the box is pushed, and whether that turns it the right way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amhe_cli.control.controller import Plan
from amhe_cli.control.mpopi import MpopiStep
from amhe_cli.core import rotations
from amhe_cli.core.rotations import yaw_of
from amhe_cli.robots.go1.behaviours.gait import Gait, box_friction, neutral_feet, walk
from amhe_cli.robots.go1.behaviours.objective import BUMPER, Course, Reference
from amhe_cli.robots.go1.behaviours.walking import (
    SPEED,
    Helm,
    Insisting,
    Pacing,
    Reflex,
    Retreat,
    Steering,
    Stepping,
    Walking,
)
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.model import Box, home, layout, plant_model
from amhe_cli.robots.go1.state import GRAVITY, Body, State, wrapped

FEW = settings(max_examples=25, deadline=None)

HALF_LENGTH, HALF_WIDTH = 0.15, 0.25
LINE = Course((0.6, 0.0), 0.0, 3.0)
ARC = Course((0.6, 0.0), 0.3, 4.0, 1.0 / 1.5)


def helm(path: Course = LINE) -> Helm:
    return Helm(path, (2.0 * HALF_LENGTH, 2.0 * HALF_WIDTH, 0.3))


def body(x: float, y: float, yaw: float) -> Body:
    turn = rotations.exp(np.array([0.0, 0.0, yaw]))
    return Body(np.array([x, y, 0.2]), turn, np.zeros(3), np.zeros(3))


def behind(x: float, y: float, yaw: float, gap: float = 0.0, left: float = 0.0, lead: float = 0.0) -> State:
    """The box at a place; the bumper so far behind its face and left of its middle, `lead` more turned."""
    back = -(HALF_LENGTH + gap)
    c, s = np.cos(yaw), np.sin(yaw)
    bumper = np.array([x + c * back - s * left, y + s * back + c * left])
    trunk = bumper - BUMPER * np.array([np.cos(yaw + lead), np.sin(yaw + lead)])
    return State(5.0, body(*trunk, yaw + lead), body(x, y, yaw), HOME, np.zeros(12))


def along(path: Course, progress: float, astray: float = 0.0, turn: float = 0.0, **robot: float) -> State:
    """The box so far along and left of its path and turned from it; the robot as in `behind`."""
    heading = path.heading + path.curvature * progress
    x, y = path.points(np.array(progress)) + astray * np.array([-np.sin(heading), np.cos(heading)])
    return behind(float(x), float(y), heading + turn, **robot)


def test_on_the_line_it_goes_straight_on() -> None:
    at = helm().reference(along(LINE, 1.0))
    for name in ("heading", "yaw", "box_yaw", "turn", "offset"):
        assert getattr(at, name) == pytest.approx(0.0, abs=1e-12), name
    assert at.pushing == 1.0
    assert at.speed >= SPEED
    assert at.time == 5.0
    assert at.origin[1] == pytest.approx(0.0)


def test_a_box_that_is_larger_than_stated_is_touched_earlier() -> None:
    larger = along(LINE, 1.0, gap=0.02)
    assert helm().reference(larger).pushing == 0.0
    assert helm().reference(larger, overlap=-0.02).pushing == 1.0


def test_on_a_curve_it_steps_aside_as_a_part_of_the_box_would() -> None:
    """Trunk and box turn about the path's centre as one body: v + omega x r."""
    for path in (LINE, ARC):
        state = along(path, 1.0)
        move = Walking(helm(path)).move(state, {"box_mass": 4.0, "floor_friction": 0.4})
        behind = np.linalg.norm(state.box.position - state.trunk.position)
        steering = max(move.reference.offset, -0.08)  # it pushes beside the middle, to turn the box
        assert move.command[1] == pytest.approx(steering - move.reference.turn * behind, abs=1e-12)
    assert move.command[1] < steering - 0.05


@pytest.mark.parametrize("path", [LINE, ARC])
def test_a_box_that_creeps_aside_comes_back_to_its_path(path: Course) -> None:
    """It goes 0.055 rad beside where it is headed, as one did that came to rest 5 cm beside its goal."""
    steered, left, far = helm(path), 0.0, []
    for progress in np.arange(0.0, 2.4, 0.004):
        at = steered.reference(along(path, float(progress), left))
        ahead = path.heading + path.curvature * progress
        left += 0.004 * float(wrapped(at.heading - path.curvature * Steering().ahead - ahead) - 0.055)
        far.append(abs(left))
    assert max(far) < 0.03, "feedback of the distance alone leaves 0.055 / 1.5 = 3.7 cm"
    assert far[-1] < 0.9 * max(far), "it comes back"


def test_noise_of_a_box_that_stands_turns_nobody() -> None:
    steered, rng = helm(), np.random.default_rng(0)
    places = [1.0, *(1.0 - 0.004 * rng.random(1000)), 1.0]
    first, *_, last = (steered.reference(along(LINE, place, 0.03)).heading for place in places)
    assert last == first


def test_what_the_task_asks_for_is_the_path_and_its_speed() -> None:
    at = helm().on_path(along(LINE, 1.0, astray=0.3, turn=0.2))
    assert (at.speed, at.heading, at.yaw, at.box_yaw, at.offset) == (SPEED, 0.0, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(at.origin, [1.6, 0.0], atol=1e-12)
    bent = helm(ARC).on_path(along(ARC, 2.0, astray=0.3, turn=0.2))
    assert float(wrapped(bent.heading - 0.3 - 2.0 / 1.5)) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(bent.origin, ARC.points(np.array(2.0)), atol=1e-12)


@FEW
@given(turn=st.floats(0.02, 0.5), sign=st.sampled_from([-1.0, 1.0]))
def test_a_box_turned_left_is_pushed_left_of_its_middle(turn: float, sign: float) -> None:
    """That turns it right, back to the line."""
    at = helm().reference(along(LINE, 1.0, turn=sign * turn))
    assert np.sign(at.offset) == sign
    assert abs(at.offset) < HALF_WIDTH
    assert at.heading == pytest.approx(0.0, abs=1e-12)
    assert -1e-12 <= sign * at.yaw < turn, "the robot's yaw leads the box's back to the line"


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_push_there_turns_a_box_in_the_simulation_back(sign: float) -> None:
    turn = sign * 0.3
    box = Box(position=(5.0, 0.0), yaw=turn)
    path = Course((5.0, 0.0), 0.0, 3.0)
    offset = helm(path).reference(behind(5.0, 0.0, turn)).offset

    def yaw_after(left: float) -> float:
        model = plant_model(box)
        data, at = mujoco.MjData(model), layout(model)
        data.qpos[:] = home(model)
        data.ctrl[at.servos] = HOME
        body_id = model.body("box").id
        for _ in range(200):
            mujoco.mj_forward(model, data)
            to_world = data.xmat[body_id].reshape(3, 3)
            point = data.xpos[body_id] + to_world @ [-HALF_LENGTH, left, 0.0]
            data.qfrc_applied[:] = 0.0
            mujoco.mj_applyFT(
                model, data, to_world @ [25.0, 0.0, 0.0], np.zeros(3), point, body_id, data.qfrc_applied
            )
            mujoco.mj_step(model, data)
        return float(yaw_of(data.qpos[at.box][3:]))

    assert sign * yaw_after(offset) < 0.3 - 0.03
    assert sign * yaw_after(-offset) > 0.3 + 0.03


@FEW
@given(left=st.floats(0.01, 0.5), sign=st.sampled_from([-1.0, 1.0]), progress=st.floats(0.5, 2.5))
def test_beside_the_path_it_heads_back(left: float, sign: float, progress: float) -> None:
    """Left of it the heading turns right, and the box is pushed left of its middle to turn right."""
    for path in (LINE, ARC):
        on = helm(path).reference(along(path, progress))
        at = helm(path).reference(along(path, progress, astray=sign * left))
        assert sign * float(wrapped(at.heading - on.heading)) < 0.0
        assert sign * (at.offset - on.offset) >= 0.0
        assert sign * at.offset > 0.0 or path is ARC
        assert float(wrapped(at.box_yaw - at.heading)) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("curvature", [0.5, -0.5])
def test_in_a_bend_the_references_turn_with_the_path(curvature: float) -> None:
    path = Course((0.6, 0.0), 0.0, 4.0, curvature)
    at = helm(path).reference(along(path, 1.0))
    assert at.turn == pytest.approx(at.speed * curvature)
    assert np.sign(at.offset) == -np.sign(curvature), "outside of the middle turns the box inwards"


@pytest.mark.parametrize("path", [LINE, ARC, Course((0.6, 0.0), 0.0, 4.0, -1.0 / 1.5)])
@pytest.mark.parametrize(("left", "turn"), [(0.2, 0.0), (-0.2, 0.3), (0.0, -0.4)])
def test_a_box_that_turns_as_it_is_pushed_comes_to_its_path(path: Course, left: float, turn: float) -> None:
    """On paper: it moves along its own heading and turns by 10 rad a metre and metre of offset."""
    pilot, step = helm(path), 0.005
    state = along(path, 0.0, left, turn)
    for _ in range(round((path.length - 0.3) / step)):
        at = pilot.reference(state)
        assert not pilot.retreating
        x, y, _ = state.box.position
        yaw = float(yaw_of(state.box.orientation))
        state = behind(
            x + step * np.cos(yaw), y + step * np.sin(yaw), yaw - 10.0 * at.offset * step, left=at.offset
        )
    assert abs(path.place(state.box.position[:2]).left) < 0.05


@pytest.mark.parametrize(
    "lost", [{"left": HALF_WIDTH + 0.05}, {"left": -HALF_WIDTH - 0.05}, {"lead": 0.8}, {"lead": -0.8}]
)
def test_a_lost_face_is_left_and_found_again(lost: dict[str, float]) -> None:
    pilot, retreat = helm(), Retreat()
    at = pilot.reference(along(LINE, 1.0, **lost))
    assert pilot.retreating
    assert at.speed == -retreat.speed < 0.0
    assert (at.pushing, at.turn) == (0.0, 0.0)

    at = pilot.reference(along(LINE, 1.0, gap=0.01))
    assert pilot.retreating and at.speed < 0.0, "in line, but too near to turn round"
    at = pilot.reference(along(LINE, 1.0, gap=1.1 * retreat.clear, left=2.0 * retreat.aligned_left))
    assert pilot.retreating and at.speed == 0.0, "clear, but not in line: steps aside there"
    at = pilot.reference(along(LINE, 1.0, gap=1.1 * retreat.clear, left=0.5 * retreat.aligned_left))
    assert not pilot.retreating and at.speed > 0.0
    at = pilot.reference(along(LINE, 1.0))
    assert not pilot.retreating and at.pushing == 1.0


def test_the_planner_s_aim_creeps_to_the_goal_and_ends_there() -> None:
    steering = Steering()
    speeds = {left: helm().reference(along(LINE, 3.0 - left)).speed for left in (1.0, 0.1, 0.02)}
    assert speeds[1.0] == pytest.approx(steering.lead * SPEED)
    assert speeds[1.0] >= speeds[0.1] >= speeds[0.02] > 0.0
    assert helm().reference(along(LINE, 3.0 - 1.1 * steering.enough)).speed == pytest.approx(steering.creep)
    for left in (0.9 * steering.enough, 0.0, -0.3):
        assert helm().reference(along(LINE, 3.0 - left)).speed == 0.0


@FEW
@given(
    yaw=st.floats(-3.0, 3.0), x=st.floats(-4.0, 4.0), astray=st.floats(-0.3, 0.3), turn=st.floats(-0.5, 0.5),
    progress=st.sampled_from([0.0, 0.7, 1.9, 2.95, 3.9]), beside=st.floats(-0.2, 0.2),
    gap=st.sampled_from([0.0, 0.004, 0.05, 0.2]),
)  # fmt: skip
def test_it_does_not_matter_which_way_the_world_lies(
    yaw: float, x: float, astray: float, turn: float, progress: float, beside: float, gap: float
) -> None:
    q, shift = rotations.exp(np.array([0.0, 0.0, yaw])), np.array([x, 1.0 - x, 0.0])

    def point(xy: np.ndarray) -> np.ndarray:
        return (rotations.rotate(q, np.array([*xy, 0.0])) + shift)[:2]

    def moved(body: Body) -> Body:
        return replace(
            body,
            position=rotations.rotate(q, body.position) + shift,
            orientation=rotations.multiply(q, body.orientation),
        )

    for path in (LINE, ARC):
        state = along(path, progress, astray, turn, left=beside, gap=gap)
        start = point(np.array(path.start))
        path_there = replace(path, start=(float(start[0]), float(start[1])), heading=path.heading + yaw)
        there = replace(state, trunk=moved(state.trunk), box=moved(state.box))
        for before, after in (
            (helm(path).reference(state), helm(path_there).reference(there)),
            (helm(path).on_path(state), helm(path_there).on_path(there)),
        ):
            assert_same_but_turned(before, after, yaw)
            np.testing.assert_allclose(after.origin, point(before.origin), atol=1e-9)


def assert_same_but_turned(before: Reference, after: Reference, yaw: float) -> None:
    for name in ("time", "speed", "turn", "offset", "pushing"):
        assert getattr(after, name) == pytest.approx(getattr(before, name), abs=1e-9), name
    for name in ("heading", "yaw", "box_yaw"):
        difference = getattr(after, name) - getattr(before, name) - yaw
        assert float(wrapped(difference)) == pytest.approx(0.0, abs=1e-9), name


def test_a_box_that_stands_is_pushed_harder_until_it_moves() -> None:
    insisting, shares = Insisting(), []
    for cycle in range(400):
        pulsing = 0.2 * (1.0 + np.sin(cycle)) if cycle >= 200 else 0.0  # it gives way after four seconds
        insisting.update(0.02 * cycle, pulsing, 0.2)
        shares.append(insisting.share)
    assert shares[199] == pytest.approx(0.8)
    assert shares[-1] < 0.01
    insisting.update(1000.0, 0.0, 0.2)
    assert insisting.share < 0.03, "a pause counts for nothing"
    still = helm()
    pushed = [still.reference(replace(along(LINE, 1.0), time=0.02 * cycle)) for cycle in range(150)]
    assert pushed[-1].harder > 0.3
    assert pushed[-1].speed > 1.3 * pushed[0].speed


@pytest.mark.parametrize("speed", [0.0, 0.1])
def test_a_box_that_stands_is_pushed_although_its_face_seems_to_be_farther(speed: float) -> None:
    """As that of a box that is larger than stated, to which the robot never comes nearer."""
    steered = helm()
    for cycle in range(150):
        state = along(LINE, 1.0 + speed * 0.02 * cycle, gap=0.02)
        at = steered.reference(replace(state, time=0.02 * cycle))
        assert cycle > 25 or (at.pushing == at.harder == 0.0)
    stands = speed == 0.0
    assert (at.harder > 0.3 and at.pushing == at.harder) if stands else (at.harder == at.pushing == 0.0)
    far = steered.reference(replace(along(LINE, 1.0, gap=0.05), time=3.0))
    assert far.pushing == 0.0, "it has lost the box"


PERIOD = 0.02


def resisted(
    reflex: Reflex,
    believed: float,
    true: float,
    *,
    pushing: Callable[[int], float] = lambda cycle: 1.0,
    slower: float = 0.0,
    noise: float = 0.0,
    knows: int = 999,
    missed: int = 999,
    horizon: int = 16,
) -> list[float]:
    """Forces [N] of the beliefs that are planned under, while a box of 4 kg resists otherwise than believed.

    Plans push as hard as they believe the box to resist, and to come up to 0.2 m/s; they expect the robot
    to be faster than it can be by `slower`. From cycle `knows` on the estimator knows the truth; in cycle
    `missed` no plan is made.
    """
    rng, speed, forces, last = np.random.default_rng(0), 0.2, [], None
    belief = {"box_mass": 4.0, "floor_friction": believed / 4.0 / GRAVITY}
    for cycle in range(200):
        now = behind(0.0, 0.0, 0.0)
        seen = np.array([speed + noise * rng.standard_normal(), 0.0, 0.0])
        state = replace(now, time=cycle * PERIOD, trunk=replace(now.trunk, velocity=seen))
        if cycle != missed:
            newest = belief if cycle < knows else belief | {"floor_friction": true / 4.0 / GRAVITY}
            used = reflex(state, last, newest)
            coming = SPEED + slower - (SPEED - speed) * np.exp(-PERIOD * np.arange(horizon + 1) / 0.12)
            places = np.zeros((1, horizon, 26))
            places[0, :, reflex.at.trunk.start] = np.cumsum(PERIOD * coming)[:horizon]
            aim = Reference(0.0, 0.0, np.zeros(2), 0.0, 0.0, 0.0, pushing=pushing(cycle))
            step = MpopiStep(np.zeros(1), np.ones(1), 1, 0, 1.0, 0.0, 0.0, {})
            targets = np.zeros((horizon, 12))
            last = Plan(state.time + PERIOD, PERIOD, targets, aim, None, step, places, belief=used)
        forces.append(box_friction(used))
        speed += PERIOD * ((forces[-1] - true) / (reflex.mass + 4.0) + (SPEED - speed) / 0.12)
    return forces


def reflex(**numbers: float) -> Reflex:
    return Reflex(layout(plant_model(Box())), **numbers)


@pytest.mark.parametrize(("believed", "true"), [(8.0, 24.0), (24.0, 8.0)])
def test_half_of_what_a_box_resists_otherwise_than_believed_is_noticed_in_a_tenth_of_a_second(
    believed: float, true: float
) -> None:
    forces = resisted(reflex(), believed, true)
    assert forces[:6] == pytest.approx([believed] * 6), "nothing is compared yet"
    assert forces[6:12] == pytest.approx([0.5 * (believed + true)] * 6, abs=1.5)
    assert forces[40:] == pytest.approx([true] * 160, abs=1.5), "it lasts until the estimator knows"


def test_a_box_that_was_pushed_for_long_must_differ_by_more() -> None:
    first, later = (resisted(reflex(wrong=wrong), 8.0, 17.0)[6] for wrong in (1.0, 0.0))
    assert first > 10.0
    assert later == pytest.approx(8.0, abs=0.1)


def test_a_speed_as_expected_changes_no_belief() -> None:
    never = resisted(reflex(), 8.0, 24.0, pushing=lambda cycle: 0.0)
    assert never == pytest.approx([8.0] * 200), "nothing is touched"
    noisy = resisted(reflex(), 8.0, 8.0, noise=0.02)
    assert np.std(noisy[60:]) < 0.5, "the noise alone is 2.8 N"


def test_the_correction_ends_when_the_estimator_knows() -> None:
    forces = resisted(reflex(), 8.0, 24.0, knows=15)
    assert max(forces) < 27.0, "estimate and correction do not add up"
    assert forces[21:] == pytest.approx([24.0] * 179, abs=0.1)


def test_a_missed_plan_or_a_lost_touch_leaves_single_plans_uncorrected() -> None:
    missed = resisted(reflex(), 8.0, 24.0, missed=30)
    assert [cycle for cycle in range(25, 60) if missed[cycle] < 20.0] == [36], "its speed is not known"
    lost = resisted(reflex(), 8.0, 24.0, pushing=lambda cycle: float(cycle != 30))
    assert [cycle for cycle in range(25, 60) if lost[cycle] < 19.0] == [31, 36]


def test_a_robot_that_stays_slower_than_its_plans_is_pushed_harder_but_not_without_end() -> None:
    forces = resisted(reflex(), 16.0, 16.0, slower=0.06)
    assert 16.0 < max(forces) <= 16.0 + reflex().most + 1e-9


def test_a_horizon_that_ends_before_the_comparison_corrects_nothing() -> None:
    assert resisted(reflex(), 8.0, 24.0, horizon=4) == pytest.approx([8.0] * 200)


def paced(pacing: Pacing, efficiency: float, seconds: float, pulse: float = 0.0, start: float = 0.0) -> float:
    """Share asked for by the end, of a robot that reaches so much of what it is asked, in pulses."""
    for k in range(round(seconds / PERIOD)):
        time = start + k * PERIOD
        reached = efficiency * (1.0 + pacing.share) + pulse * np.sin(2.0 * np.pi * time / 0.4)
        pacing.update(time, 1.0 - reached)
    return pacing.share


def test_a_slow_robot_is_asked_for_more_until_it_is_nearly_fast_enough() -> None:
    pacing = Pacing()
    share = paced(pacing, 0.75, 30.0)
    assert 0.75 * (1.0 + share) == pytest.approx(1.0 - pacing.free, abs=0.01)
    assert paced(Pacing(), 0.3, 60.0) == Pacing().limit


def test_the_pulse_of_a_trot_is_no_missing_speed() -> None:
    assert abs(paced(Pacing(), 0.98, 20.0, pulse=0.4)) < 0.01


def test_what_was_asked_too_much_is_taken_back() -> None:
    pacing = Pacing(share=0.2)
    assert paced(pacing, 1.0, 20.0) < 0.02


def test_a_pause_counts_for_nothing() -> None:
    pacing = Pacing()
    pacing.update(0.0, 1.0)
    pacing.update(1000.0, 1.0)
    assert pacing.share < 0.01


STANDS = np.array([True, False, False, True])


def after(stepping: Stepping, drift: float, steps: int = 20) -> np.ndarray:
    for k in range(steps):
        left = stepping.update(0.02 * k, drift, STANDS)
    return left


def test_a_flying_foot_goes_to_the_side_of_the_drift_and_a_standing_one_stays() -> None:
    left = after(Stepping(gain=0.1), 0.3)
    np.testing.assert_allclose(left[~STANDS], 0.03, rtol=1e-3)
    np.testing.assert_array_equal(left[STANDS], 0.0)


def test_what_a_foot_landed_with_it_keeps() -> None:
    stepping = Stepping(gain=0.1)
    landed = after(stepping, 0.3)
    later = stepping.update(0.5, -0.3, np.ones(4, dtype=bool))
    np.testing.assert_array_equal(later, landed)


@given(st.floats(-50.0, 50.0))
def test_never_further_than_the_limit(drift: float) -> None:
    stepping = Stepping()
    assert np.abs(after(stepping, drift)).max() <= stepping.limit


def test_the_gait_puts_its_feet_there() -> None:
    gait, left = Gait(), np.array([0.0, 0.02, -0.01, 0.05])
    there, neutral = walk(gait, 0.1, np.zeros(3), left=left), walk(gait, 0.1, np.zeros(3))
    np.testing.assert_allclose(there.feet - neutral.feet, np.outer(left, [0.0, 1.0, 0.0]), atol=1e-12)
    assert neutral_feet(gait)[1, 1] == pytest.approx(neutral.feet[1, 1])
