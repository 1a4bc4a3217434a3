"""The cost's terms: none at the reference, each for its own error, the same whichever way the world lies."""

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
from amhe_cli.robots.go1.behaviours.objective import (
    BUMPER,
    PushWeights,
    Reference,
    SweepWeights,
    bumper_from_box,
    push_terms,
    sweep_terms,
    tilt_squared,
    wrapped,
)
from amhe_cli.robots.go1.state import Body

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
