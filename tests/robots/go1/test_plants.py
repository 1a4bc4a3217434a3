"""Go1s that are not ours, and what is done with what is known of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from amhe_cli.control.controller import Plan
from amhe_cli.core.errors import ConfigError
from amhe_cli.estimation.design.probe import ProbeOptions
from amhe_cli.live.target import SimTarget
from amhe_cli.robots.go1.behaviours.gait import Gait
from amhe_cli.robots.go1.judge import History
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.model import Box, layout, plant_model
from amhe_cli.robots.go1.plant import PLANTS, Plant, PlantShape, find_plant, shaped_plant
from amhe_cli.robots.go1.probing.motions import WALK
from amhe_cli.robots.go1.probing.probe import PushProbe
from amhe_cli.robots.go1.run import RunOptions, gait_of, latency_of, open_run, system_of, without_dry_friction
from amhe_cli.robots.go1.state import SensorNoise
from amhe_cli.robots.go1.tasks import find_task

QUIET = SensorNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def a_plant(shape: PlantShape) -> Plant:
    return Plant(shaped_plant(Box(), shape), (), np.random.default_rng(0), QUIET, shape=shape)


def known(**values: float) -> dict[str, object]:
    """Settings of a robot that was identified: these values, each to a percent."""
    return {"parameters": {name: {"held": value, "held_sd": 0.01} for name, value in values.items()}}


def test_our_own_plant_is_the_model_as_it_is() -> None:
    ours, plain = shaped_plant(Box(), PLANTS["ours"]), plant_model()
    for field in ("dof_damping", "body_mass", "body_ipos", "geom_size", "pair_friction", "actuator_gainprm"):
        np.testing.assert_array_equal(getattr(ours, field), getattr(plain, field), field)


def test_every_number_of_a_shape_is_in_the_plant() -> None:
    shape = PlantShape(
        "all", (0.1, 0.2, 0.3), (0.4, 0.5, 0.6), 0.007, gain=0.9, load=1.5, centre=(0.01, 0.02, 0.03),
        foot_friction=0.55, sole=0.002, box=(1.1, 1.0, 0.9), box_centre=(0.02, 0.0, 0.01),
    )  # fmt: skip
    model, plain = shaped_plant(Box(), shape), plant_model()
    dofs, servos = layout(model).joints_v, layout(model).servos
    np.testing.assert_allclose(model.dof_frictionloss[dofs], [0.1, 0.2, 0.3] * 4)
    np.testing.assert_allclose(model.dof_damping[dofs], [0.4, 0.5, 0.6] * 4)
    np.testing.assert_allclose(model.dof_armature[dofs], 0.007)
    np.testing.assert_allclose(model.actuator_biasprm[servos, 1], -54.0)
    assert model.body("trunk").mass[0] == pytest.approx(plain.body("trunk").mass[0] + 1.5)
    np.testing.assert_allclose(model.body("trunk").ipos - plain.body("trunk").ipos, [0.01, 0.02, 0.03])
    assert model.pair("robot/FL_foot_floor").friction[0] == 0.55
    assert model.geom("robot/FL_foot").size[0] == pytest.approx(0.025)
    np.testing.assert_allclose(model.geom("box").size, [0.165, 0.25, 0.135])
    np.testing.assert_allclose(model.body("box").ipos, [0.02, 0.0, 0.01])
    assert model.body("box").mass[0] == pytest.approx(4.0)


def test_a_late_plant_acts_later_and_its_encoders_err() -> None:
    shape = PlantShape(latency=0.03, zero=0.02)
    late, prompt = a_plant(shape), a_plant(PLANTS["ours"])
    for _ in range(2):
        seen = late.advance(HOME + 0.2, 0.02)
        prompt.advance(HOME + 0.2, 0.02)
    moved, far = (np.abs(one.state.joints - HOME).max() for one in (late, prompt))
    assert 0.0 < moved < 0.5 * far
    errors = seen["joints.position"][1][-1] - late.state.joints
    np.testing.assert_allclose(errors, np.repeat([0.02, -0.02, 0.02, -0.02], 3), atol=1e-12)


def test_gears_rub_under_load() -> None:
    geared = a_plant(PlantShape(load_friction=0.1))
    geared.advance(HOME, 0.2)
    dofs = layout(geared.model).joints_v
    assert (geared.model.dof_frictionloss[dofs] > 0.2).all()
    assert geared.model.dof_frictionloss[dofs].max() > 0.5, "knees carry the robot"


def test_a_plant_has_a_name_or_a_file() -> None:
    assert find_plant("dry") == (PLANTS["dry"], None)
    with pytest.raises(ConfigError, match="no plant 'wet': give the MJCF of a Go1, or one of ours, dry"):
        find_plant("wet")


def test_nobody_knows_the_robot_unless_told() -> None:
    system = system_of(RunOptions("t1"), find_task("t1"))
    assert gait_of(system) == Gait()
    assert latency_of(system) == 0.0
    assert system.space.names == ("box_mass", "box_inertia_scale", "floor_friction")
    robot = system_of(RunOptions("t1", settings={"unknowns": ["robot"]}), find_task("t1"))
    assert "motor_gain" in robot.space.names and "box_mass" not in robot.space.names


def test_what_is_known_of_the_robot_is_in_gait_planner_and_estimator() -> None:
    settings = known(motor_gain=0.9, trunk_load=1.5, joint_friction_calf=0.8, command_latency=0.03)
    system = system_of(RunOptions("t1", settings=settings), find_task("t1"))
    gait, plain = gait_of(system), Gait()
    assert gait.kp == pytest.approx(54.0)
    assert gait.weight == pytest.approx(plain.weight + 1.5 * 9.81, abs=0.01)
    assert gait.damping[2] > plain.damping[2], "dry friction is led by, too"
    assert latency_of(system) == 0.03
    dofs = layout(system.model).joints_v
    assert system.model.dof_frictionloss[dofs][2] == pytest.approx(0.8), "the estimator's model"
    assert not without_dry_friction(system).model.dof_frictionloss[dofs].any(), "the planner's"


def test_plans_are_played_earlier_by_what_commands_take() -> None:
    plant = a_plant(PLANTS["ours"])
    target = SimTarget(plant, 0.02, HOME, lead=0.03)
    target.play(Plan(0.0, 0.02, HOME + 0.1 * np.arange(6.0)[:, None]))
    now, measured = target.measure()
    _, commands = measured["command.position"]
    np.testing.assert_allclose(commands[-1] - HOME, 0.1 * (now + 0.03) / 0.02)
    np.testing.assert_allclose(target.in_force(now) - HOME, 0.1), "what acts now was sent before"


@pytest.mark.medium
@pytest.mark.parametrize(("plant", "missed"), [("ours", False), ("dry", True)])
def test_a_robot_that_is_another_one_is_noticed_while_it_walks_freely(plant: str, missed: bool) -> None:
    run = open_run(RunOptions("t1", "true", plant=plant, duration=1.0))
    history = History(run.task)
    for cycle in run.episode.cycles():
        history.add(cycle)
    assert bool(history.troubles) == missed
    assert all("identify the robot first" in trouble for trouble in history.troubles)


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
