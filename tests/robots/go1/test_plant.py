"""Sensors of the plant against its truth, its changes, and its end when it diverges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import SimulationError
from amhe_cli.core.log import Samples, merged
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.model import Box, Change, home, layout, plant_model
from amhe_cli.robots.go1.plant import Plant
from amhe_cli.robots.go1.state import SensorNoise

SILENT = SensorNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
#: None like another, so that none can stand in for another.
NOISE = SensorNoise(
    position=0.011, orientation=0.023, joint=0.037, joint_rate=0.41, gyro=0.053, accelerometer=0.67
)
DEFAULT, BOX = SensorNoise(), Box()


def plant(*changes: Change, noise: SensorNoise = DEFAULT, seed: int = 0, box: Box = BOX) -> Plant:
    return Plant(plant_model(box), changes, np.random.default_rng(seed), noise)


def test_sensors_are_as_noisy_as_the_benchmarks_say() -> None:
    assert DEFAULT.position == 0.002
    assert DEFAULT.orientation == pytest.approx(np.radians(0.5))
    assert (DEFAULT.joint, DEFAULT.joint_rate, DEFAULT.gyro) == (0.003, 0.05, 0.02)
    assert DEFAULT.pose_period == 0.01


@pytest.fixture(scope="module")
def errors() -> dict[str, FloatArray]:
    """What the sensors said of each instant, less the truth; the robot stands for 2 s."""
    noisy, quiet = plant(noise=NOISE), plant(noise=SILENT)
    found: dict[str, list[FloatArray]] = {}

    def note(name: str, error: FloatArray) -> None:
        found.setdefault(name, []).append(error)

    for _ in range(1000):
        seen, true = noisy.advance(HOME, 0.002), quiet.advance(HOME, 0.002)
        truth = noisy.state
        note("joint", seen["joints.position"][1][0] - truth.joints)
        note("joint_rate", seen["joints.velocity"][1][0] - truth.joint_rates)
        note("gyro", seen["imu.angular_velocity"][1][0] - truth.trunk.rate)
        force = "imu.linear_acceleration"
        note("accelerometer", seen[force][1][0] - true[force][1][0])
        for name, body in (("trunk", truth.trunk), ("box", truth.box)):
            for position, orientation in zip(
                seen[f"{name}.position"][1], seen[f"{name}.orientation"][1], strict=True
            ):
                note(f"{name} position", position - body.position)
                note(f"{name} orientation", rotations.difference(orientation, body.orientation))
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.parametrize(
    "name", ["joint", "joint_rate", "gyro", "accelerometer",
             "trunk position", "trunk orientation", "box position", "box orientation"],
)  # fmt: skip
def test_noise_is_white_unbiased_and_as_strong_as_asked_for(name: str, errors: dict[str, FloatArray]) -> None:
    error = errors[name]
    sd = getattr(NOISE, name.split()[-1])
    assert len(error) == (200 if " " in name else 1000)
    assert error.std() == pytest.approx(sd, rel=5.0 / np.sqrt(2.0 * error.size))
    assert np.abs(error.mean(axis=0)).max() < 4.5 * sd / np.sqrt(len(error))
    neighbours = (error[1:] * error[:-1]).mean() / sd**2
    assert abs(neighbours) < 5.0 / np.sqrt(error.size)
    axes = np.corrcoef(error.T) - np.eye(error.shape[1])
    assert np.abs(axes).max() < 5.0 / np.sqrt(len(error))


def test_noise_of_trunk_and_box_is_not_the_same(errors: dict[str, FloatArray]) -> None:
    for kind in ("position", "orientation"):
        together = (errors[f"trunk {kind}"] * errors[f"box {kind}"]).mean() / getattr(NOISE, kind) ** 2
        assert abs(together) < 5.0 / np.sqrt(600)


def test_without_noise_the_sensors_tell_the_truth() -> None:
    still = plant(noise=SILENT)
    measured = still.advance(HOME, 0.1)
    truth = still.state
    np.testing.assert_array_equal(measured["joints.position"][1][-1], truth.joints)
    np.testing.assert_array_equal(measured["joints.velocity"][1][-1], truth.joint_rates)
    np.testing.assert_array_equal(measured["imu.angular_velocity"][1][-1], truth.trunk.rate)
    np.testing.assert_array_equal(measured["trunk.position"][1][-1], truth.trunk.position)
    np.testing.assert_allclose(measured["box.orientation"][1][-1], truth.box.orientation)


def test_samples_come_at_500_hz_and_poses_at_100_hz() -> None:
    running = plant()
    for cycle in range(3):
        measured = running.advance(HOME, 0.02)
        start = 0.02 * cycle
        np.testing.assert_allclose(measured["joints.position"][0], start + 0.002 * np.arange(1, 11))
        np.testing.assert_allclose(measured["box.position"][0], start + np.array([0.01, 0.02]))
        assert running.time == pytest.approx(start + 0.02)


def test_slower_cameras_see_less_often_and_a_short_wait_sees_none() -> None:
    slow = plant(noise=replace(DEFAULT, pose_period=0.05))
    np.testing.assert_allclose(slow.advance(HOME, 0.2)["box.position"][0], [0.05, 0.1, 0.15, 0.2])
    nothing = slow.advance(HOME, 0.004)
    assert nothing["trunk.position"][1].shape == nothing["box.position"][1].shape == (0, 3)
    assert nothing["trunk.orientation"][1].shape == nothing["box.orientation"][1].shape == (0, 4)
    assert nothing["joints.position"][1].shape == (2, 12)
    assert slow.advance(HOME, 0.0)["joints.position"][1].shape == (0, 12)


def test_at_rest_the_accelerometer_shows_gravity_upwards_and_the_gyro_nothing() -> None:
    still = plant(noise=SILENT)
    still.advance(HOME, 1.0)
    measured = still.advance(HOME, 0.5)
    up = rotations.rotate(rotations.conjugate(still.state.trunk.orientation), np.array([0.0, 0.0, 9.81]))
    np.testing.assert_allclose(measured["imu.linear_acceleration"][1].mean(axis=0), up, atol=0.02)
    assert up[2] == pytest.approx(9.81, abs=0.01)
    np.testing.assert_allclose(measured["imu.angular_velocity"][1].mean(axis=0), 0.0, atol=0.005)


def test_in_free_fall_the_accelerometer_shows_nothing() -> None:
    model = plant_model()
    start = home(model)
    start[layout(model).trunk][2] = 1.0
    falling = Plant(model, [], np.random.default_rng(0), SILENT, start)
    measured = falling.advance(HOME, 0.1)
    assert falling.state.trunk.velocity[2] == pytest.approx(-0.981, abs=0.02)
    assert np.linalg.norm(measured["imu.linear_acceleration"][1].mean(axis=0)) < 0.2


def test_a_trunk_that_turns_is_felt_in_its_own_frame() -> None:
    """Lying on its side in the fall, turning about its own x."""
    model = plant_model()
    at, start = layout(model), home(model)
    start[at.trunk][2:] = [1.0, *rotations.exp(np.array([0.0, 0.5 * np.pi, 0.0]))]
    falling = Plant(model, [], np.random.default_rng(0), SILENT, start)
    falling._data.qvel[at.trunk_v][3:] = [0.7, 0.0, 0.0]
    measured = falling.advance(HOME, 0.004)
    np.testing.assert_allclose(measured["imu.angular_velocity"][1][0], [0.7, 0.0, 0.0], atol=0.1)


def assert_same(one: Samples, other: Samples) -> None:
    assert set(one) == set(other)
    for key in one:
        for a, b in zip(one[key], other[key], strict=True):
            np.testing.assert_array_equal(a, b, key)


def test_several_short_waits_measure_what_one_long_one_does() -> None:
    one, parts = plant(), plant()
    whole = one.advance(HOME, 0.06)
    assert_same(merged([parts.advance(HOME, 0.02) for _ in range(3)]), whole)


def test_the_same_seed_gives_the_same_measurements() -> None:
    first, same, other = (plant(seed=seed).advance(HOME, 0.04) for seed in (1, 1, 2))
    assert_same(first, same)
    np.testing.assert_array_equal(first["joints.position"][0], other["joints.position"][0])
    assert (first["joints.position"][1] != other["joints.position"][1]).all() and (
        first["box.position"][1] != other["box.position"][1]
    ).all()


def test_noise_does_not_move_the_plant() -> None:
    ends = []
    for noise in (SILENT, NOISE):
        running = plant(noise=noise)
        running.advance(HOME, 0.1)
        ends.append(running.qpos)
    np.testing.assert_array_equal(*ends)


def test_changes_come_once_and_the_true_parameters_follow() -> None:
    changing = plant(Change(mass=6.0, at_time=0.05), Change(floor_friction=0.8, at_time=0.1))
    first = {"box_mass": 4.0, "box_inertia_scale": 1.0, "floor_friction": 0.4}
    assert changing.parameters == pytest.approx(first)
    changing.advance(HOME, 0.048)
    assert changing.parameters == pytest.approx(first)
    changing.advance(HOME, 0.002)
    assert changing.parameters == pytest.approx(first | {"box_mass": 6.0})
    changing.advance(HOME, 0.05)
    assert changing.parameters == pytest.approx(first | {"box_mass": 6.0, "floor_friction": 0.8})
    Change(mass=5.0).apply(changing.model)
    changing.advance(HOME, 0.05)
    assert changing.parameters["box_mass"] == pytest.approx(5.0), "a change that has come does not come again"


def test_a_change_of_place_waits_for_the_box() -> None:
    turf = Change(floor_friction=0.8, beyond_x=1.5)
    for x, friction in ((1.49, 0.4), (1.51, 0.8)):
        there = plant(turf, box=Box(position=(x, 0.0)))
        assert there.parameters["floor_friction"] == pytest.approx(0.4)
        there.advance(HOME, 0.02)
        assert there.parameters["floor_friction"] == pytest.approx(friction)


def test_a_load_set_elsewhere_in_the_box_is_reported() -> None:
    model = plant_model()
    loaded = Plant(model, [], np.random.default_rng(0))
    model.body("box").inertia[:] *= 1.3
    assert loaded.parameters["box_inertia_scale"] == pytest.approx(1.3)


@pytest.mark.parametrize("cause", ["a coordinate out of all bounds", "steps that are far too long"])
def test_a_plant_that_diverges_says_so(cause: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log where it stands
    model = plant_model()
    start = home(model)
    if "coordinate" in cause:
        start[layout(model).box][2] = 2e10
    else:
        model.opt.timestep = 0.1
    diverging = Plant(model, [], np.random.default_rng(0), start=start)
    with pytest.raises(SimulationError, match=r"the plant diverged at \d+\.\d{3} s"):
        diverging.advance(np.zeros(12), 5.0)


def test_states_and_measurements_are_copies() -> None:
    running = plant()
    before, seen = running.state, running.advance(HOME, 0.02)
    height, joints = before.trunk.position[2], seen["joints.position"][1].copy()
    running.advance(HOME + 0.2, 0.1)
    assert before.trunk.position[2] == height != running.state.trunk.position[2]
    np.testing.assert_array_equal(seen["joints.position"][1], joints)
