"""Objectives: of tasks, and of pushing to probe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import yaw_of
from amhe_cli.robots.go1.behaviours.gait import Gait
from amhe_cli.robots.go1.behaviours.objective import (
    BUMPER,
    Course,
    PushWeights,
    Reference,
    SweepWeights,
    bumper_from_box,
    push_terms,
    sweep_terms,
    tilt_squared,
)
from amhe_cli.robots.go1.behaviours.walking import Walking
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.probing.motions import (
    FASTEST,
    MOTIONS,
    WIDEST_OFFSET,
    Motion,
    MotionHelm,
    Segment,
    named_motion,
)
from amhe_cli.robots.go1.state import Body, State, wrapped
from amhe_cli.robots.go1.tasks import find_task

FEW = settings(max_examples=25, deadline=None)

PUSH, SWEEP = PushWeights(), SweepWeights()
SPEED, HEIGHT, HALF = 0.2, 0.28, 0.15
ANGLE = st.floats(-3.0, 3.0)
X, Y, Z = np.eye(3)
Scene = tuple[Body, Body]


def turned(angle: float, axis: FloatArray = Z) -> FloatArray:
    return rotations.exp(angle * axis)


def scene() -> Scene:
    """The robot pushes the box ahead along x, as it should."""
    velocity, still, upright = SPEED * X, np.zeros(3), turned(0.0)
    trunk = Body(np.array([1.0 - HALF - BUMPER, 0.0, HEIGHT]), upright, velocity, still)
    return trunk, Body(np.array([1.0, 0.0, 0.15]), upright, velocity, still)


def reference() -> Reference:
    return Reference(0.0, SPEED, np.array([0.3, 0.0]), heading=0.0, yaw=0.0, box_yaw=0.0)


def in_world(body: Body, yaw: float, shift: FloatArray) -> Body:
    q = turned(yaw)
    return Body(
        rotations.rotate(q, body.position) + shift,
        rotations.multiply(q, body.orientation),
        rotations.rotate(q, body.velocity),
        body.rate,
    )


def reference_in_world(at: Reference, yaw: float, shift: FloatArray) -> Reference:
    origin = rotations.rotate(turned(yaw), np.array([*at.origin, 0.0])) + shift
    return replace(
        at, origin=origin[:2], heading=at.heading + yaw, yaw=at.yaw + yaw, box_yaw=at.box_yaw + yaw
    )


def pushing(trunk: Body, box: Body, at: Reference, elapsed: float = 0.0) -> dict:
    return push_terms(PUSH, trunk, box, HEIGHT, at, np.array(elapsed))


def about(body: Body, point: FloatArray, angle: float) -> Body:
    """Turned about a vertical line; its speed ahead stays in its own heading."""
    q = turned(angle)
    return replace(
        body,
        position=point + rotations.rotate(q, body.position - point),
        orientation=rotations.multiply(q, body.orientation),
    )


def robot_turned(trunk: Body, box: Body, e: float) -> Scene:
    there = about(trunk, trunk.position + BUMPER * X, e)
    return replace(there, velocity=rotations.rotate(turned(e), trunk.velocity)), box


def box_turned(trunk: Body, box: Body, e: float) -> Scene:
    """The robot stays in front of the face's middle, but looks along the line."""
    bumper = rotations.rotate(turned(e), np.array([-HALF, 0.0, 0.0]))
    place = box.position + bumper - BUMPER * X
    return replace(trunk, position=np.array([*place[:2], HEIGHT])), about(box, box.position, e)


def leant(body: Body, e: float) -> Body:
    """So that the sine of its lean is e, about some level axis."""
    lean = turned(np.arcsin(e), np.array([0.6, 0.8, 0.0]))
    twist = turned(-float(yaw_of(lean)))  # the heading stays
    return replace(body, orientation=rotations.multiply(twist, lean))


def shifted(body: Body, by: FloatArray) -> Body:
    return replace(body, position=body.position + by)


def faster(body: Body, by: FloatArray) -> Body:
    return replace(body, velocity=body.velocity + by)


#: For each term, a scene that is wrong by e in this alone.
WRONG: dict[str, Callable[[Body, Body, float], Scene]] = {
    "box_speed": lambda trunk, box, e: (trunk, faster(box, e * X)),
    "robot_speed": lambda trunk, box, e: (faster(trunk, e * X), box),
    "box_left": lambda trunk, box, e: (shifted(trunk, e * Y), shifted(box, e * Y)),
    "robot_left": lambda trunk, box, e: (shifted(trunk, e * Y), box),
    "yaw": robot_turned,
    "box_yaw": box_turned,
    "height": lambda trunk, box, e: (shifted(trunk, e * Z), box),
    "tilt": lambda trunk, box, e: (leant(trunk, e), box),
    "box_tilt": lambda trunk, box, e: (trunk, leant(box, e)),
}


@FEW
@given(yaw=ANGLE, x=st.floats(-3.0, 3.0))
def test_as_it_should_be_costs_nothing(yaw: float, x: float) -> None:
    shift = np.array([x, -x, 0.0])
    trunk, box = (in_world(body, yaw, shift) for body in scene())
    terms = pushing(trunk, box, reference_in_world(reference(), yaw, shift))
    assert set(terms) == {field.name for field in fields(PushWeights)} - {"knots"}
    for name, term in terms.items():
        assert float(term) == pytest.approx(0.0, abs=1e-20), name


@pytest.mark.parametrize("name", WRONG)
@FEW
@given(error=st.floats(-0.3, 0.3), yaw=ANGLE)
def test_each_term_is_for_its_own_error(name: str, error: float, yaw: float) -> None:
    shift = np.array([0.4, -1.3, 0.0])
    trunk, box = (in_world(body, yaw, shift) for body in WRONG[name](*scene(), error))
    terms = pushing(trunk, box, reference_in_world(reference(), yaw, shift))
    expected = dict.fromkeys(terms, 0.0) | {name: getattr(PUSH, name) * error**2}
    for term, value in terms.items():
        assert float(value) == pytest.approx(expected[term], rel=1e-6, abs=1e-12), term


@pytest.mark.parametrize("name", ["box_speed", "box_left", "box_yaw", "height", "tilt", "box_tilt"])
@FEW
@given(error=st.floats(-0.3, 0.3))
def test_with_one_leg_likewise(name: str, error: float) -> None:
    trunk, box = WRONG[name](*scene(), error)
    standing = replace(trunk, velocity=np.zeros(3))
    terms = sweep_terms(SWEEP, standing, box, HEIGHT, reference())
    expected = dict.fromkeys(terms, 0.0) | {name: getattr(SWEEP, name) * error**2}
    for term, value in terms.items():
        assert float(value) == pytest.approx(expected[term], rel=1e-6, abs=1e-12), term
    moving = sweep_terms(SWEEP, replace(trunk, velocity=error * Y), box, HEIGHT, reference())
    assert float(moving["robot_speed"]) == pytest.approx(SWEEP.robot_speed * error**2)


def test_until_the_box_is_touched_its_speed_does_not_count() -> None:
    trunk, box = WRONG["box_speed"](*scene(), 0.1)
    waiting = replace(reference(), pushing=0.0)
    assert float(pushing(trunk, box, waiting)["box_speed"]) == 0.0
    assert float(sweep_terms(SWEEP, trunk, box, HEIGHT, waiting)["box_speed"]) == 0.0


@FEW
@given(elapsed=st.floats(0.0, 1.0), turn=st.floats(-1.0, 1.0))
def test_a_turning_reference_is_followed_by_who_turns_with_it(elapsed: float, turn: float) -> None:
    trunk, box = scene()
    angle = turn * elapsed
    together = [in_world(body, angle, np.zeros(3)) for body in (trunk, box)]
    at = replace(reference(), origin=together[1].position[:2], turn=turn)
    for name, term in pushing(*together, at, elapsed=elapsed).items():
        assert float(term) == pytest.approx(0.0, abs=1e-16), name


@FEW
@given(seed=st.integers(0, 999), yaw=ANGLE)
def test_a_turned_and_shifted_world_costs_the_same(seed: int, yaw: float) -> None:
    rng = np.random.default_rng(seed)
    shift = np.array([*rng.normal(size=2), 0.0])
    trunk, box = (
        Body(rng.normal(size=3), rotations.exp(rng.normal(size=3)), rng.normal(size=3), rng.normal(size=3))
        for _ in range(2)
    )
    # A heading is turned by a turn of the world only where the body does not lean.
    trunk, box = (replace(b, orientation=turned(rng.uniform(-3, 3))) for b in (trunk, box))
    at = Reference(
        0.0, 0.3, rng.normal(size=2), *rng.uniform(-3.0, 3.0, 3), turn=0.4, offset=0.07, pushing=1.0
    )
    there = [in_world(body, yaw, shift) for body in (trunk, box)]
    at_there = reference_in_world(at, yaw, shift)
    for before, after in (
        (pushing(trunk, box, at, elapsed=0.3), pushing(*there, at_there, elapsed=0.3)),
        (sweep_terms(SWEEP, trunk, box, HEIGHT, at), sweep_terms(SWEEP, *there, HEIGHT, at_there)),
    ):
        for name, term in before.items():
            assert float(after[name]) == pytest.approx(float(term), rel=1e-9, abs=1e-9), name


@FEW
@given(yaw=ANGLE, lean=st.floats(0.0, 1.5), way=ANGLE)
def test_heading_and_lean_of_a_quaternion(yaw: float, lean: float, way: float) -> None:
    assert float(yaw_of(turned(yaw))) == pytest.approx(yaw)
    tilt = turned(lean, np.array([np.cos(way), np.sin(way), 0.0]))
    q = rotations.multiply(turned(yaw), tilt)
    for sign in (1.0, -1.0):
        assert float(tilt_squared(sign * q)) == pytest.approx(np.sin(lean) ** 2, abs=1e-12)
        assert float(wrapped(yaw_of(sign * q) - yaw_of(q))) == pytest.approx(0.0)


def test_the_bumper_is_seen_in_the_box_s_frame() -> None:
    trunk, box = scene()
    ahead, left = bumper_from_box(shifted(trunk, 0.04 * Y), box)
    assert (float(ahead), float(left)) == pytest.approx((-HALF, 0.04))
    ahead, left = bumper_from_box(shifted(trunk, 0.04 * Y), about(box, box.position, 0.5 * np.pi))
    assert (float(ahead), float(left)) == pytest.approx((0.04, HALF))


TURN = st.floats(-7.0, 7.0)
START = st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
#: Bends of either sense, from a circle of 0.5 m to one of 20 m, and the line.
CURVATURE = st.one_of(st.just(0.0), st.floats(0.05, 2.0), st.floats(-2.0, -0.05))
#: Share of what leaves the path unambiguous.
SHARE = st.floats(0.0, 1.0)


def beside(path: Course, progress: float, left: float) -> tuple[FloatArray, float]:
    """The point so far along and left of a path, from the circle's centre; and the heading there."""
    x, y = path.start
    if path.curvature == 0.0:
        heading = path.heading
        foot = np.array([x + progress * np.cos(heading), y + progress * np.sin(heading)])
    else:
        radius = 1.0 / path.curvature
        centre = np.array([x - radius * np.sin(path.heading), y + radius * np.cos(path.heading)])
        heading = path.heading + progress / radius
        foot = centre + radius * np.array([np.sin(heading), -np.cos(heading)])
    return foot + left * np.array([-np.sin(heading), np.cos(heading)]), heading


def length_of(curvature: float, share: float) -> float:
    """Up to 0.95 of a full circle; up to 10 m of a line."""
    return 0.1 + share * (9.9 if curvature == 0.0 else 0.95 * 2.0 * np.pi / abs(curvature) - 0.1)


@FEW
@given(start=START, heading=TURN, curvature=CURVATURE, share=SHARE, along=SHARE, aside=st.floats(-0.9, 0.9))
def test_points_are_found_again(
    start: tuple[float, float], heading: float, curvature: float, share: float, along: float, aside: float
) -> None:
    path = Course(start, heading, length_of(curvature, share), curvature)
    progress, left = along * path.length, aside * (1.0 if curvature == 0.0 else 1.0 / abs(curvature))
    point, there = beside(path, progress, left)
    place = path.place(point)
    assert place.progress == pytest.approx(progress, abs=1e-9)
    assert place.left == pytest.approx(left, abs=1e-9)
    assert place.heading == pytest.approx(there, abs=1e-9)
    on, _ = beside(path, progress, 0.0)
    np.testing.assert_allclose(path.points(np.array(progress)), on, atol=1e-9)


@FEW
@given(
    start=START, heading=TURN, curvature=CURVATURE, share=SHARE,
    beyond=st.floats(0.0, 0.45), after=st.booleans(),
)  # fmt: skip
def test_beyond_its_ends_a_path_goes_on(
    start: tuple[float, float], heading: float, curvature: float, share: float, beyond: float, after: bool
) -> None:
    """A circle goes on up to the point opposite to the path's middle."""
    path = Course(start, heading, length_of(curvature, share), curvature)
    rest = 10.0 if curvature == 0.0 else 2.0 * np.pi / abs(curvature) - path.length
    progress = path.length + beyond * rest if after else -beyond * rest
    place = path.place(beside(path, progress, 0.02)[0])
    assert place.progress == pytest.approx(progress, abs=1e-8)
    assert place.left == pytest.approx(0.02, abs=1e-9)


def test_the_half_circle_of_the_second_task_ends_opposite_to_its_start() -> None:
    path = find_task("t2").path
    np.testing.assert_allclose(path.goal, [0.6, 3.0], atol=1e-12)
    np.testing.assert_allclose(path.points(np.array(0.5 * path.length)), [2.1, 1.5], atol=1e-12)
    assert path.place(path.goal).heading == pytest.approx(np.pi)
    radii = np.hypot(*(path.points(np.linspace(0.0, path.length, 50)) - [0.6, 1.5]).T)
    np.testing.assert_allclose(radii, 1.5)


@FEW
@given(heading=TURN, curvature=CURVATURE)
def test_points_move_along_the_heading_by_what_is_gone(heading: float, curvature: float) -> None:
    path = Course((0.3, -0.2), heading, length_of(curvature, 0.7), curvature)
    at, step = np.linspace(0.0, path.length, 12), 1e-6
    points = path.points(at)
    moved = (path.points(at + step) - points) / step
    headings = np.array([path.place(point).heading for point in points])
    np.testing.assert_allclose(moved, np.stack((np.cos(headings), np.sin(headings)), -1), atol=1e-5)
    np.testing.assert_allclose(points[0], path.start, atol=1e-12)
    np.testing.assert_allclose(points[-1], path.goal, atol=1e-12)
    assert float(wrapped(headings[0] - heading)) == pytest.approx(0.0, abs=1e-9)


TRY = Motion("try", "", (Segment(1.0, 0.25), Segment(0.5, -0.1), Segment(2.0, 0.2, 0.1)))


def state(time: float, gap: float = 0.0, box_yaw: float = 0.0) -> State:
    """Robot behind a box whose face is a gap [m] ahead of its bumper."""
    rest = np.zeros(3)
    turn = np.array([np.cos(0.5 * box_yaw), 0.0, 0.0, np.sin(0.5 * box_yaw)])
    box = Body(np.array([0.6, 0.0, 0.15]), turn, rest, rest)
    trunk = Body(np.array([0.6 - 0.15 - BUMPER - gap, 0.0, 0.28]), np.array([1.0, 0, 0, 0]), rest, rest)
    return State(time, trunk, box, HOME, np.zeros(12))


def helm(motion: Motion) -> MotionHelm:
    return MotionHelm(motion, Course((0.6, 0.0), 0.0, 100.0), (0.3, 0.5, 0.3))


def test_a_motion_repeats_behind_the_approach() -> None:
    speeds = [TRY.at(t).speed for t in (0.5, 1.0, 2.1, 2.6, 4.6, 5.6, 99.0)]
    assert speeds == [0.2, 0.25, -0.1, 0.2, 0.25, -0.1, 0.25]
    assert TRY.at(1.0 + 1000 * 3.5).speed == 0.25, "to the instant, however long"


def test_the_trunk_rises_and_sinks_from_the_approach_on() -> None:
    bobs = helm(replace(TRY, bob=0.03))
    lifts = [bobs.reference(state(t)).lift for t in (0.5, 1.25, 2.15, 2.65, 3.15)]
    assert lifts == pytest.approx([0.0, 0.015 * np.sin(0.7 * np.pi), 0.03, -0.03, 0.03])
    belief = {"box_mass": 4.0, "floor_friction": 0.4}
    usual, high = (Walking(one).move(state(2.15), belief) for one in (helm(TRY), bobs))
    assert high.height - usual.height == pytest.approx(0.03)
    assert high.gait.height - usual.gait.height == pytest.approx(0.03)


def test_surges_keep_step_with_the_trot() -> None:
    sides = named_motion("sides")
    assert sides.seconds == pytest.approx(4.0 * Gait().period)


def test_the_helm_commands_the_motions_speed_and_place_of_the_push() -> None:
    assert helm(TRY).reference(state(1.5)).speed == 0.25
    beside = helm(TRY).reference(state(3.0, box_yaw=0.2))
    assert (beside.speed, beside.offset) == (0.2, 0.1)
    assert beside.box_yaw == pytest.approx(0.2), "the box may turn"


def test_only_a_box_that_is_touched_and_pushed_is_to_move() -> None:
    assert helm(TRY).reference(state(1.5)).pushing == 1.0
    assert helm(TRY).reference(state(1.5, gap=0.1)).pushing == 0.0
    assert helm(TRY).reference(state(2.2)).pushing == 0.0, "it backs off"


def test_a_lost_face_is_found_again_first() -> None:
    at = state(1.5)
    lost = replace(at, trunk=replace(at.trunk, position=at.trunk.position + np.array([0.0, 0.5, 0.0])))
    reference = helm(TRY).reference(lost)
    assert reference.pushing == 0.0
    assert reference.speed <= 0.0


def test_the_motions_and_any_other_stay_within_the_limits() -> None:
    for phase in (phase for motion in MOTIONS for phase in motion.phases):
        assert abs(phase.speed) <= FASTEST
        assert abs(phase.offset or 0.0) <= WIDEST_OFFSET
    wild = helm(Motion("wild", "", (Segment(5.0, 2.0, 1.0),))).reference(state(2.0))
    assert (wild.speed, wild.offset) == (FASTEST, WIDEST_OFFSET)
