"""The estimator on paper, with broken sensors, and against the plant's truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amhe_cli.core import rotations
from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.log import Samples
from amhe_cli.robots.go1 import kinematics as legs
from amhe_cli.robots.go1.behaviours.gait import Gait, contacts, walk
from amhe_cli.robots.go1.kalman import REST, Turn, ValueFilter
from amhe_cli.robots.go1.model import Box, plant_model
from amhe_cli.robots.go1.plant import Plant
from amhe_cli.robots.go1.state import Body, State
from amhe_cli.robots.go1.state_estimator import StateEstimator, trunk_velocities

CYCLE = 0.02
TRUNK = Body(
    np.array([0.1, -0.2, 0.3]), rotations.exp(np.array([0.1, -0.05, 2.0])),
    np.array([0.2, -0.1, 0.05]), np.array([0.2, -0.3, 0.5]),
)  # fmt: skip
BOX = Body(
    np.array([0.7, 0.1, 0.15]), rotations.exp(np.array([0.0, 0.0, -1.0])),
    np.array([-0.1, 0.2, 0.0]), np.array([0.1, 0.0, -0.6]),
)  # fmt: skip
RATES = np.linspace(-0.5, 0.5, 12)


def in_the_air(times: FloatArray) -> BoolArray:
    return np.zeros((times.size, 4), dtype=bool)


def on_the_floor(times: FloatArray) -> BoolArray:
    return ~in_the_air(times)


def moved(body: Body, time: float) -> tuple[FloatArray, FloatArray]:
    turned = rotations.multiply(body.orientation, rotations.exp(time * body.rate))
    return body.position + time * body.velocity, turned


def cycle(index: int, trunk: Body = TRUNK, box: Body = BOX, seed: int | None = None) -> Samples:
    """Constant twists and joint rates, seen exactly, or with the sensors' noise."""
    scale, rng = 0.0 if seed is None else 1.0, np.random.default_rng([seed or 0, index])
    start = index * CYCLE
    times = start + 0.002 * np.arange(1, 11)
    pose_times = start + np.array([0.01, 0.02])
    seen = [
        [
            (place + scale * rng.normal(0.0, 2e-3, 3), rotations.multiply(turn, rotations.exp(error)))
            for place, turn in (moved(body, t) for t in pose_times)
            for error in [scale * rng.normal(0.0, 9e-3, 3)]
        ]
        for body in (trunk, box)
    ]
    (trunk_at, trunk_turn), (box_at, box_turn) = (map(np.array, zip(*poses, strict=True)) for poses in seen)
    joints = legs.HOME + np.outer(times, RATES) + scale * rng.normal(0.0, 3e-3, (10, 12))
    return {
        "joints.position": (times, joints),
        "joints.velocity": (times, RATES + scale * rng.normal(0.0, 0.05, (10, 12))),
        "imu.angular_velocity": (times, trunk.rate + scale * rng.normal(0.0, 0.02, (10, 3))),
        "trunk.position": (pose_times, trunk_at),
        "trunk.orientation": (pose_times, trunk_turn),
        "box.position": (pose_times, box_at),
        "box.orientation": (pose_times, box_turn),
    }


def end(index: int) -> float:
    return (index + 1) * CYCLE


def part(measured: Samples, signals: tuple[str, ...], rows: slice | np.ndarray) -> Samples:
    """The samples with only these rows of some signals."""
    return {
        key: (times[rows], values[rows]) if key.split(".")[0] in signals else (times, values)
        for key, (times, values) in measured.items()
    }


def with_values(measured: Samples, **values: FloatArray) -> Samples:
    """The samples with other values; keys are written with __ in place of the point."""
    changed = {name.replace("__", "."): value for name, value in values.items()}
    return {key: (times, changed.get(key, old)) for key, (times, old) in measured.items()}


CAMERAS, ROBOT = ("trunk", "box"), ("joints", "imu")


def without_poses(measured: Samples) -> Samples:
    return part(measured, CAMERAS, slice(0))


def without_robot(measured: Samples) -> Samples:
    return part(measured, ROBOT, slice(0))


def assert_body(body: Body, truth: Body, time: float, tolerance: float) -> None:
    position, orientation = moved(truth, time)
    np.testing.assert_allclose(body.position, position, atol=tolerance)
    np.testing.assert_allclose(rotations.difference(body.orientation, orientation), 0.0, atol=tolerance)
    np.testing.assert_allclose(body.velocity, truth.velocity, atol=tolerance)
    np.testing.assert_allclose(body.rate, truth.rate, atol=tolerance)


def assert_same(a: State, b: State, tolerance: float) -> None:
    for one, other in ((a.trunk, b.trunk), (a.box, b.box)):
        np.testing.assert_allclose(one.position, other.position, atol=tolerance)
        np.testing.assert_allclose(
            rotations.difference(one.orientation, other.orientation), 0.0, atol=tolerance
        )
        np.testing.assert_allclose(one.velocity, other.velocity, atol=tolerance)
        np.testing.assert_allclose(one.rate, other.rate, atol=tolerance)
    np.testing.assert_allclose(a.joints, b.joints, atol=tolerance)
    np.testing.assert_allclose(a.joint_rates, b.joint_rates, atol=tolerance)


def test_constant_twists_seen_exactly_are_found() -> None:
    estimator = StateEstimator(in_the_air)
    for index in range(150):
        state = estimator.update(end(index), cycle(index))
    assert state.time == pytest.approx(3.0)
    assert_body(state.trunk, TRUNK, 3.0, 1e-3)
    assert_body(state.box, BOX, 3.0, 1e-3)
    np.testing.assert_allclose(state.joints, legs.HOME + 3.0 * RATES, atol=1e-6)
    np.testing.assert_allclose(state.joint_rates, RATES, atol=1e-6)


def test_what_rests_is_at_rest_from_the_first_cycle_on() -> None:
    """Two poses 10 ms apart would say 0.3 m/s: a first window's box slid by itself for 3 cm."""
    still = replace(BOX, velocity=np.zeros(3), rate=np.zeros(3))
    for seed in range(1, 21):
        estimator = StateEstimator(in_the_air)
        for index in range(20):
            box = estimator.update(end(index), cycle(index, box=still, seed=seed)).box
            assert np.abs(box.velocity).max() < 0.06
            assert np.abs(box.rate).max() < 0.2


def test_a_value_filter_is_the_kalman_filter_of_the_textbook() -> None:
    """Against matrices: constant velocity, white acceleration, position and velocity measured."""
    filtered = ValueFilter(0.0, [1.0], [-1.0], 0.5, 2.0, drive=0.7, walk=0.3)
    x, P = np.array([1.0, -1.0]), np.diag([0.5, 2.0])
    for time, row, z, sd in ((0.1, [1, 0], 1.3, 0.2), (0.15, [0, 1], 0.4, 0.1), (0.4, [1, -0.05], 1.1, 0.3)):
        dt, H = time - filtered.time, np.array(row, dtype=float)
        F = np.array([[1.0, dt], [0.0, 1.0]])
        Q = 0.49 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) + np.diag([0.09 * dt, 0.0])
        x, P = F @ x, F @ P @ F.T + Q
        gain = P @ H / (H @ P @ H + sd**2)
        x, P = x + gain * (z - H @ x), P - np.outer(gain, H @ P)
        filtered.advance(time)
        if row[0]:
            filtered.see_value([z], sd, time + row[1])
        else:
            filtered.see_rate([z], sd)
        np.testing.assert_allclose([*filtered.value, *filtered.rate], x)
        np.testing.assert_allclose([filtered.vv, filtered.vr, filtered.rr], [P[0, 0], P[0, 1], P[1, 1]])


def test_a_turn_agrees_with_the_rotations_of_core() -> None:
    turn = Turn(TRUNK.orientation.tolist(), ValueFilter(0.0, REST, BOX.rate.tolist(), 1.0, 1.0, 1.0))
    np.testing.assert_allclose(turn.matrix() @ BOX.rate, rotations.rotate(TRUNK.orientation, BOX.rate))
    turn.advance(0.5, TRUNK.rate.tolist())
    expected = rotations.multiply(TRUNK.orientation, rotations.exp(0.5 * BOX.rate + TRUNK.rate))
    np.testing.assert_allclose(turn.orientation, expected, atol=1e-12)
    turn.see((-BOX.orientation).tolist(), 1e-6, 0.5)
    off = rotations.difference(np.array(turn.orientation), BOX.orientation)
    np.testing.assert_allclose(off, 0.0, atol=1e-9)


def test_the_point_of_contact_rests_while_the_foot_rolls() -> None:
    """Moved by the velocity found, the point of the calf that touches the floor stays where it is."""
    rng = np.random.default_rng(3)
    joints, rates = legs.HOME + rng.normal(0.0, 0.2, 12), rng.normal(0.0, 2.0, 12)
    found = trunk_velocities(
        joints[None], rates[None], TRUNK.rate[None], rotations.rotate(rotations.conjugate(TRUNK.orientation),
        np.array([0.0, 0.0, 1.0])),
    )[0]  # fmt: skip
    dt = 1e-5

    def calf(turn: FloatArray, q: FloatArray, leg: int) -> FloatArray:
        hip, thigh, knee = q[3 * leg : 3 * leg + 3]
        in_trunk = rotations.multiply(
            rotations.exp(np.array([hip, 0.0, 0.0])), rotations.exp(np.array([0.0, thigh + knee, 0.0]))
        )
        return rotations.multiply(turn, in_trunk)

    for leg in range(4):
        down = np.array([0.0, 0.0, -legs.FOOT_RADIUS])
        fixed = rotations.rotate(rotations.conjugate(calf(TRUNK.orientation, joints, leg)), down)
        ends = []
        for t in (-dt, dt):
            turn = rotations.multiply(TRUNK.orientation, rotations.exp(t * TRUNK.rate))
            q = joints + t * rates
            centre = t * rotations.rotate(TRUNK.orientation, found[leg]) + rotations.rotate(
                turn, legs.feet(q)[leg]
            )
            ends.append(centre + rotations.rotate(calf(turn, q, leg), fixed))
        np.testing.assert_allclose((ends[1] - ends[0]) / (2.0 * dt), 0.0, atol=1e-6)


def walking(index: int, slip: FloatArray) -> Samples:
    """Joints that move the feet so that a level trunk glides ahead; `slip` of each foot ahead, (4,) [m/s]."""
    measured = cycle(index, replace(TRUNK, orientation=np.array([1.0, 0, 0, 0]), rate=np.zeros(3)))
    feet = -TRUNK.velocity + np.outer(slip, [1.0, 0.0, 0.0])
    rates = legs.posture(legs.HOME).rates(feet)
    for _ in range(30):  # the centre of a foot that rolls moves with the calf's turning
        hips, bends = rates.reshape(4, 3)[:, 0], rates.reshape(4, 3)[:, 1:].sum(axis=1)
        calves = np.stack((hips, bends, np.zeros(4)), axis=1)
        rates = legs.posture(legs.HOME).rates(feet - np.cross(calves, [0.0, 0.0, -legs.FOOT_RADIUS]))
    return with_values(
        measured, joints__position=np.tile(legs.HOME, (10, 1)), joints__velocity=np.tile(rates, (10, 1))
    )


@pytest.mark.parametrize("slipping", [None, 0, 3])
def test_standing_feet_give_the_velocity_without_poses_and_a_slipping_one_is_left_out(
    slipping: int | None,
) -> None:
    estimator, slip = StateEstimator(on_the_floor), np.zeros(4)
    for index in range(25):
        estimator.observe(walking(index, slip))
    if slipping is not None:
        slip[slipping] = 0.3
    for index in range(25, 75):
        state = estimator.update(end(index), without_poses(walking(index, slip)))
    np.testing.assert_allclose(state.trunk.velocity, TRUNK.velocity, atol=2e-3)
    np.testing.assert_allclose(state.trunk.position, TRUNK.position + 1.5 * TRUNK.velocity, atol=3e-3)


@settings(max_examples=10, deadline=None)
@given(
    yaw=st.floats(-4.0, 4.0),
    shift=st.tuples(*[st.floats(-2.0, 2.0)] * 3),
    flips=st.lists(st.sampled_from([-1.0, 1.0]), min_size=20, max_size=20),
    seed=st.integers(0, 99),
)
def test_turning_the_world_turns_the_estimate_and_signs_of_quaternions_do_not_matter(
    yaw: float, shift: tuple[float, float, float], flips: list[float], seed: int
) -> None:
    turn = rotations.exp(np.array([0.0, 0.0, yaw]))
    plain, turned = StateEstimator(on_the_floor), StateEstimator(on_the_floor)
    for index in range(10):
        measured = cycle(index, seed=seed)
        signs = np.array(flips[2 * index : 2 * index + 2])[:, None]
        changed = with_values(
            measured,
            trunk__position=rotations.rotate(turn, measured["trunk.position"][1]) + shift,
            trunk__orientation=signs * rotations.multiply(turn, measured["trunk.orientation"][1]),
            box__position=rotations.rotate(turn, measured["box.position"][1]) + shift,
            box__orientation=-signs * rotations.multiply(turn, measured["box.orientation"][1]),
        )
        a, b = plain.update(end(index), measured), turned.update(end(index), changed)
    bodies = [
        Body(
            rotations.rotate(turn, body.position) + shift,
            rotations.multiply(turn, body.orientation),
            rotations.rotate(turn, body.velocity),
            body.rate,
        )
        for body in (a.trunk, a.box)
    ]
    assert_same(b, replace(a, trunk=bodies[0], box=bodies[1]), 1e-9)


def test_before_the_first_pose_there_is_no_state() -> None:
    estimator = StateEstimator(in_the_air)
    with pytest.raises(ValueError, match="measured once"):
        estimator.update(end(0), without_poses(cycle(0)))
    estimator.observe(without_robot(cycle(1)))
    np.testing.assert_allclose(estimator.state(0.04).joints, legs.HOME + 0.04 * RATES, atol=1e-3)


def test_through_gaps_the_estimate_goes_on_by_prediction() -> None:
    estimator = StateEstimator(in_the_air)
    for index in range(110):
        measured = cycle(index)
        gap = without_poses(measured) if index >= 100 else measured
        state = estimator.update(end(index), gap)
    assert_body(state.trunk, TRUNK, 2.2, 2e-3)
    assert_body(state.box, BOX, 2.2, 2e-3)
    for index in range(110, 120):
        state = estimator.update(end(index), without_robot(cycle(index)))
    assert_body(state.trunk, TRUNK, 2.4, 0.02)
    for index in range(125, 130):
        state = estimator.update(end(index), cycle(index))
    assert_body(state.box, BOX, 2.6, 2e-3)
    np.testing.assert_allclose(state.joints, legs.HOME + 2.6 * RATES, atol=1e-4)


def test_while_the_gyro_is_silent_the_poses_lead() -> None:
    """The trunk turns back unseen; the gyro's offset is not to blame for it."""
    estimator = StateEstimator(in_the_air)
    back = replace(TRUNK, orientation=moved(TRUNK, 2.0)[1], rate=-TRUNK.rate)
    for index in range(50):
        estimator.observe(cycle(index))
    for index in range(50, 100):
        estimator.observe(without_robot(cycle(index, back)))
    assert_turn_is(estimator.state(2.0), TRUNK.orientation, 0.03)
    for index in range(100, 150):
        state = estimator.update(end(index), cycle(index, back))
    assert_turn_is(state, moved(back, 3.0)[1], 0.01)
    np.testing.assert_allclose(state.trunk.rate, back.rate, atol=0.02)


def assert_turn_is(state: State, orientation: FloatArray, tolerance: float) -> None:
    np.testing.assert_allclose(
        rotations.difference(state.trunk.orientation, orientation), 0.0, atol=tolerance
    )


def test_rows_that_are_not_finite_or_lost_change_nothing_else() -> None:
    """Broken rows are as good as missing ones; one body's loss does not blind the other."""
    broken, missing = StateEstimator(on_the_floor), StateEstimator(on_the_floor)
    keep, first = np.arange(10) != 4, np.array([True, False])
    for index in range(20):
        measured = cycle(index, seed=1)
        gyro, box, orientation = (
            np.array(measured[key][1])
            for key in ("imu.angular_velocity", "box.position", "trunk.orientation")
        )
        gyro[4, 1], box[1, 0], orientation[1] = np.nan, np.inf, 0.0
        spoilt = with_values(
            measured, imu__angular_velocity=gyro, box__position=box, trunk__orientation=orientation
        )
        a = broken.update(end(index), spoilt)
        b = missing.update(end(index), part(part(measured, ROBOT, keep), CAMERAS, first))
    assert_same(a, b, 1e-12)


@pytest.mark.medium
def test_rows_in_any_order_and_poses_that_come_a_cycle_late() -> None:
    ordered, shuffled, late = (StateEstimator(in_the_air) for _ in range(3))
    before = without_poses(cycle(0))
    for index in range(150):
        measured = cycle(index)
        a = ordered.update(end(index), measured)
        b = shuffled.update(end(index), part(measured, CAMERAS + ROBOT, slice(None, None, -1)))
        late.observe({key: before[key] if key.startswith(CAMERAS) else measured[key] for key in measured})
        before = measured
    assert_same(a, b, 1e-12)
    assert_body(late.state(3.0).trunk, TRUNK, 3.0, 1e-3)
    assert_body(late.state(3.0).box, BOX, 3.0, 1e-3)


def errors_in_the_plant() -> tuple[dict[str, FloatArray], FloatArray]:
    """Root mean square errors while a robot walks and pushes a box, after the first second.

    And that of the trunk's velocity to an estimator without feet.
    """
    gait, box = Gait(), Box()
    plant = Plant(plant_model(box), [], np.random.default_rng(7))
    estimator, errors = StateEstimator(lambda times: contacts(gait, times)), []
    footless, blind = StateEstimator(in_the_air), []
    while plant.time < 4.0:
        push = np.array([box.mass * 9.81 * box.floor_friction if plant.time > 1.0 else 0.0, 0.0])
        targets = walk(gait, plant.time + 0.01, np.array([0.2, 0.0, 0.0]), push).targets
        measured = plant.advance(targets, CYCLE)
        found = estimator.update(plant.time, measured)
        without = footless.update(plant.time, measured)
        if plant.time > 1.0:
            errors.append((found, plant.state))
            blind.append(without.trunk.velocity - plant.state.trunk.velocity)

    def rms(values: list[FloatArray]) -> FloatArray:
        return np.sqrt(np.square(values).mean(axis=0))

    known = {
        "position": rms([a.trunk.position - b.trunk.position for a, b in errors]),
        "velocity": rms([a.trunk.velocity - b.trunk.velocity for a, b in errors]),
        "turn": rms([rotations.difference(a.trunk.orientation, b.trunk.orientation) for a, b in errors]),
        "rate": rms([a.trunk.rate - b.trunk.rate for a, b in errors]),
        "box position": rms([a.box.position - b.box.position for a, b in errors]),
        "box velocity": rms([a.box.velocity - b.box.velocity for a, b in errors]),
        "box turn": rms([rotations.difference(a.box.orientation, b.box.orientation) for a, b in errors]),
        "box rate": rms([a.box.rate - b.box.rate for a, b in errors]),
        "joints": rms([a.joints - b.joints for a, b in errors]),
        "joint rates": rms([a.joint_rates - b.joint_rates for a, b in errors]),
    }
    return known, rms(blind)


@pytest.mark.medium
def test_walking_and_pushing_in_the_plant() -> None:
    """Without feet the trunk's velocity is known worse."""
    errors, without_feet = errors_in_the_plant()
    bounds = {
        "position": 0.003, "velocity": (0.012, 0.012, 0.03), "turn": 0.003, "rate": 0.025,
        "box position": 0.002, "box velocity": 0.035, "box turn": 0.006, "box rate": 0.12,
        "joints": 0.002, "joint rates": 0.08,
    }  # fmt: skip
    for name, bound in bounds.items():
        assert (errors[name] <= bound).all(), f"{name}: {errors[name]} > {bound}"
    assert (without_feet[:2] > 0.018).all()
