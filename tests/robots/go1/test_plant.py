"""Sensors of the plant against its truth, its changes, and its end when it diverges."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.control.controller import Plan
from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import belief_of, held_by
from amhe_cli.core.errors import ConfigError, SimulationError
from amhe_cli.estimation.design.probe import ProbeOptions
from amhe_cli.live.target import SimTarget
from amhe_cli.robots.go1.behaviours.gait import Gait, walk
from amhe_cli.robots.go1.judge import History
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.model import Box, Change, home, layout, plant_model
from amhe_cli.robots.go1.plant import PLANTS, Plant, PlantShape, find_plant, shaped_plant
from amhe_cli.robots.go1.probing.motions import WALK
from amhe_cli.robots.go1.probing.probe import PushProbe
from amhe_cli.robots.go1.run import RunOptions, gait_of, latency_of, open_run, system_of, without_dry_friction
from amhe_cli.robots.go1.state import SensorNoise
from amhe_cli.robots.go1.tasks import find_task

SILENT = SensorNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
#: None like another, so that none can stand in for another.
NOISE = SensorNoise(
    position=0.011, orientation=0.023, joint=0.037, joint_rate=0.41, gyro=0.053, accelerometer=0.67
)
DEFAULT, BOX = SensorNoise(), Box()


def plant(*changes: Change, noise: SensorNoise = DEFAULT, seed: int = 0, box: Box = BOX) -> Plant:
    return Plant(plant_model(box), changes, np.random.default_rng(seed), noise)


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


def test_the_same_seed_gives_the_same_measurements() -> None:
    first, same, other = (plant(seed=seed).advance(HOME, 0.04) for seed in (1, 1, 2))
    np.testing.assert_equal(first, same)
    for key in ("joints.position", "box.position"):
        np.testing.assert_array_equal(first[key][0], other[key][0])
        assert (first[key][1] != other[key][1]).all()


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


def a_plant(shape: PlantShape) -> Plant:
    return Plant(shaped_plant(Box(), shape), (), np.random.default_rng(0), SILENT, shape=shape)


@pytest.mark.parametrize(
    "task, measured, ahead, above",
    [("t1", None, -0.015, -0.0075), ("t5", None, 0.0075, -0.0075), ("t1", [0.33, 0.475, 0.315], 0.0, 0.0)],
)
def test_a_box_of_another_size_is_as_much_ahead_and_above_the_stated_one(
    task: str, measured: list[float] | None, ahead: float, above: float
) -> None:
    """The crate of t1 is 0.33 x 0.475 x 0.315 m, of stated 0.3 x 0.5 x 0.3; stated right, 0."""
    settings: dict[str, object] = {"boxes": {"box": measured}} if measured else {}
    asked = open_run(RunOptions(task, plant="crate", settings=settings | {"unknowns": ["box", "box_size"]}))
    assert asked.plant is not None
    assert asked.plant.parameters["face_overlap"] == pytest.approx(ahead)
    assert asked.plant.parameters["floor_overlap"] == pytest.approx(above)
    if measured:
        np.testing.assert_allclose(2.0 * asked.plant.model.geom("box").size, measured)


def known(**values: float) -> dict[str, object]:
    """Settings of a robot that was identified: these values, each to a percent."""
    return {"parameters": {name: {"held": value, "held_sd": 0.01} for name, value in values.items()}}


def test_every_number_of_a_shape_is_in_the_plant() -> None:
    shape = PlantShape(
        "all", (0.1, 0.2, 0.3), (0.4, 0.5, 0.6), 0.007, gain=0.9, load=1.5, centre=(0.01, 0.02, 0.03),
        foot_friction=0.55, sole=0.002, legs=1.1, box=(1.1, 1.0, 0.9), box_centre=(0.02, 0.0, 0.01),
    )  # fmt: skip
    model, plain = shaped_plant(Box(), shape), plant_model()
    dofs, servos = layout(model).joints_v, layout(model).servos
    np.testing.assert_allclose(model.dof_frictionloss[dofs], [0.1, 0.2, 0.3] * 4)
    np.testing.assert_allclose(model.dof_damping[dofs], [0.4, 0.5, 0.6] * 4)
    np.testing.assert_allclose(model.dof_armature[dofs], 0.007)
    np.testing.assert_allclose(model.actuator_biasprm[servos, 1], -54.0)
    trunk = model.body("trunk").id
    legs = plain.body_subtreemass[trunk] - plain.body_mass[trunk]
    assert model.body("trunk").mass[0] == pytest.approx(plain.body("trunk").mass[0] + 1.5)
    np.testing.assert_allclose(
        model.body_subtreemass[trunk] - plain.body_subtreemass[trunk], 1.5 + 0.1 * legs
    )
    np.testing.assert_allclose(model.body("trunk").ipos - plain.body("trunk").ipos, [0.01, 0.02, 0.03])
    assert model.pair("robot/FL_foot_floor").friction[0] == 0.55
    assert model.geom("robot/FL_foot").size[0] == pytest.approx(0.025)
    np.testing.assert_allclose(model.geom("box").size, [0.165, 0.25, 0.135])
    np.testing.assert_allclose(model.body("box").ipos, [0.02, 0.0, 0.01])
    assert model.body("box").mass[0] == pytest.approx(4.0)


def test_a_late_plant_acts_later_and_its_encoders_err() -> None:
    zeros = np.repeat([0.02, -0.02, 0.02, -0.02], 3)
    shape = PlantShape(latency=0.03, zeros=tuple(zeros))
    late, prompt = a_plant(shape), a_plant(PLANTS["ours"])
    for _ in range(2):
        seen = late.advance(HOME + 0.2, 0.02)
        prompt.advance(HOME + 0.2, 0.02)
    moved, far = (np.abs(one.state.joints - HOME).max() for one in (late, prompt))
    assert 0.0 < moved < 0.5 * far
    errors = seen["joints.position"][1][-1] - late.state.joints
    np.testing.assert_allclose(errors, zeros, atol=1e-12)


def test_gears_rub_under_load() -> None:
    geared = a_plant(PlantShape(load_friction=0.1))
    geared.advance(HOME, 0.2)
    dofs = layout(geared.model).joints_v
    assert (geared.model.dof_frictionloss[dofs] > 0.2).all()
    assert geared.model.dof_frictionloss[dofs].max() > 0.5, "knees carry the robot"


def test_a_plant_has_a_name_or_a_file() -> None:
    assert find_plant("dry") == (PLANTS["dry"], None)
    with pytest.raises(ConfigError, match="no plant 'wet'; there is: crate, dry, .* or the MJCF of a Go1"):
        find_plant("wet")


def test_nobody_knows_the_robot_unless_told() -> None:
    system = system_of(RunOptions("t1"), find_task("t1"))
    assert gait_of(system) == Gait()
    assert latency_of(system) == 0.0
    assert system.space.names == ("box_mass", "box_inertia_scale", "floor_friction")
    robot = system_of(RunOptions("t1", settings={"unknowns": ["robot"]}), find_task("t1"))
    assert "motor_gain" in robot.space.names and "box_mass" not in robot.space.names


def test_what_is_known_of_the_robot_is_in_gait_planner_and_estimator() -> None:
    settings = known(
        motor_gain=0.9, trunk_load=1.5, joint_friction_calf=0.8, command_latency=0.03, zero_FL_calf=0.02
    )
    system = system_of(RunOptions("t1", settings=settings), find_task("t1"))
    gait, plain = gait_of(system), Gait()
    assert gait.kp == pytest.approx(54.0)
    assert gait.weight == pytest.approx(plain.weight + 1.5 * 9.81, abs=0.01)
    assert gait.damping[2] > plain.damping[2], "dry friction is led by, too"
    assert latency_of(system) == 0.03
    away = walk(gait, 0.3, np.zeros(3)).targets - walk(replace(gait, zeros=(0.0,)), 0.3, np.zeros(3)).targets
    np.testing.assert_allclose(away, 0.02 * (np.arange(12) == 5), atol=1e-12)
    assert system.model.qpos0[layout(system.model).joints][5] == pytest.approx(0.02)
    dofs = layout(system.model).joints_v
    assert system.model.dof_frictionloss[dofs][2] == pytest.approx(0.8), "the estimator's model"
    assert not without_dry_friction(system).model.dof_frictionloss[dofs].any(), "the planner's"


def test_a_robot_that_was_weighed_is_held_at_its_weight() -> None:
    robot = system_of(RunOptions("t1", settings={"unknowns": ["robot"]}), find_task("t1"))
    chosen, _ = robot.starting_from(None, fix={"trunk_load": 1.2})
    found = belief_of(chosen, np.zeros(len(chosen.space)), 0.01 * np.eye(len(chosen.space)))
    system = system_of(RunOptions("t1", settings={"parameters": held_by(found)}), find_task("t1"))
    assert system.edits.held["trunk_load"] == (1.2, 0.0)
    assert system.edits.held["motor_gain"].sd > 0.0
    assert gait_of(system).weight == pytest.approx(Gait().weight + 1.2 * 9.81, abs=0.01)


def test_plans_are_played_earlier_by_what_commands_take() -> None:
    plant = a_plant(PLANTS["ours"])
    target = SimTarget(plant, 0.02, HOME, lead=0.03)
    target.play(Plan(0.0, 0.02, HOME + 0.1 * np.arange(6.0)[:, None]))
    now, measured = target.measure()
    _, commands = measured["command.position"]
    np.testing.assert_allclose(commands[-1] - HOME, 0.1 * (now + 0.03) / 0.02)
    np.testing.assert_allclose(target.in_force(now) - HOME, 0.1), "what acts now was sent before"


@pytest.mark.medium
@pytest.mark.parametrize(
    ("plant", "asked", "said"),
    [
        ("ours", "box", ""),
        ("dry", "box", "weigh and identify the robot first"),
        ("loaded", "box", "weigh and identify the robot first"),
        ("crate", "box", "the box's middle is [78] mm higher than half of its stated height: measure it"),
        ("crate", "box_size", ""),
    ],
)
def test_what_is_another_one_is_noticed_while_the_robot_walks_freely(
    plant: str, asked: str, said: str
) -> None:
    settings = {"unknowns": ["box", asked]}
    run = open_run(RunOptions("t1", "true", plant=plant, duration=1.0, settings=settings))
    history = History(run.task)
    for cycle in run.episode.cycles():
        history.add(cycle)
    assert ("face_overlap" in history.truth) == (asked == "box_size"), "only who asks is told"
    assert len(history.troubles) == bool(said)
    assert not said or re.search(said, history.troubles[0])


@pytest.mark.medium
def test_free_walking_goes_back_and_ahead_and_never_to_the_box() -> None:
    run = open_run(RunOptions("walk", "baseline", plant="dry", duration=5.0), replace(WALK, nominal_time=5.0))
    places = np.array([cycle.truth.trunk.position[0] for cycle in run.episode.cycles()])
    assert not run.judge.fell
    assert places.min() < -0.25 and places.max() < 0.1
    assert np.diff(places).max() > 0.002, "it goes ahead, too"
    start = run.plant.qpos[layout(run.plant.model).box][:2]
    np.testing.assert_allclose(start, [0.6, 0.0], atol=0.04)


@pytest.mark.slow
def test_free_walking_is_expected_to_tell_every_number_of_the_robot() -> None:
    probe = PushProbe(ProbeOptions(task="walk", seconds=3.0))
    plan = probe.design(lambda text: None)
    assert (np.sqrt(np.diag(plan.expected.covariance)) < 0.6 * probe.system.space.prior_sd).all()
