"""The Go1's tasks, settings and legs."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.robots.go1 import kinematics as legs
from amhe_cli.robots.go1.behaviours.sweeping import Sweeping
from amhe_cli.robots.go1.behaviours.walking import Walking
from amhe_cli.robots.go1.kinematics import FOOT_RADIUS, HOME, feet
from amhe_cli.robots.go1.model import Change, layout, planner_model
from amhe_cli.robots.go1.settings import PushSettings, settings_of
from amhe_cli.robots.go1.tasks import LONGEST, TASKS, Believed, find_task
from amhe_cli.system.system import System
from tests.conftest import go1_system_with

Facts: TypeAlias = tuple[
    tuple[float, ...], float, float, tuple[float, float], tuple[float, float], float, float,
    tuple[Change, ...], Believed, Believed | None,
]  # fmt: skip
BIG, SMALL, AHEAD = (0.3, 0.5, 0.3), (0.2, 0.3, 0.3), (0.6, 0.0)
#: "Beside the front right foot" leaves its place open; a test below says what must hold.
BESIDE = TASKS["t5"].box.position
TURF, HEAVIER = Change(floor_friction=0.8, beyond_x=1.5), Change(mass=6.0, at_time=10.0)
LIGHT, KNOWN, STALE = Believed(2.0, 0.3), Believed(4.0, 0.4), Believed(2.0, 0.2)
#: Size, mass and friction of the box, start, goal and length of the path, nominal time, changes, beliefs.
FACTS: dict[str, Facts] = {
    "t1": (BIG, 4.0, 0.6, AHEAD, (3.0, 0.0), 2.4, 12.0, (), LIGHT, None),
    "t2": (BIG, 4.0, 0.4, AHEAD, (0.6, 3.0), 1.5 * np.pi, 23.6, (), LIGHT, None),
    "t3": (BIG, 4.0, 0.4, AHEAD, (3.6, 0.0), 3.0, 15.0, (HEAVIER,), KNOWN, STALE),
    "t4": (BIG, 4.0, 0.4, AHEAD, (3.0, 0.0), 2.4, 12.0, (TURF,), KNOWN, STALE),
    "t5": (SMALL, 3.0, 0.4, BESIDE, (BESIDE[0], BESIDE[1] - 0.5), 0.5, 10.0, (), LIGHT, None),
    "hw1": (BIG, 3.0, 0.4, AHEAD, (3.0, 0.0), 2.4, 12.0, (Change(mass=4.0, beyond_x=1.8),),
            Believed(3.0, 0.4), None),
    "hw2": (BIG, 4.0, 0.4, AHEAD, (3.0, 0.0), 2.4, 12.0, (TURF,), Believed(4.0, 0.6), None),
}  # fmt: skip


def test_these_are_all_the_tasks() -> None:
    assert [task.name for task in TASKS.values()] == list(TASKS) == list(FACTS)
    assert LONGEST == 40.0


@pytest.mark.parametrize("name", FACTS)
def test_a_task_s_numbers(name: str) -> None:
    task, (size, mass, friction, start, goal, length, nominal, *rest) = find_task(name), FACTS[name]
    assert task.box.size == pytest.approx(size)
    assert (task.box.mass, task.box.floor_friction, task.box.yaw) == (mass, friction, 0.0)
    assert task.box.position == task.path.start == pytest.approx(start)
    np.testing.assert_allclose(task.path.goal, goal, atol=1e-12)
    assert task.path.length == pytest.approx(length)
    assert task.nominal_time == nominal
    assert [task.changes, task.baseline, task.stale] == rest
    assert task.corridor == (0.4 if name == "t2" else np.inf)
    assert task.one_leg == (name == "t5")


@pytest.mark.parametrize("name", [name for name in TASKS if name != "t5"])
def test_the_walk_is_at_two_decimetres_a_second_and_tapers_over_two(name: str) -> None:
    task = find_task(name)
    end = task.path.length
    speeds = [
        task.commanded_speed(progress) for progress in (-0.1, 0.0, end - 0.2, end - 0.1, end, end + 0.1)
    ]
    assert speeds == pytest.approx([0.2, 0.2, 0.2, 0.1, 0.0, 0.0])
    assert task.judged_from == 1.0
    assert task.nominal_time == pytest.approx(end / 0.2, abs=0.05)


def test_with_one_leg_the_robot_stays_and_is_judged_from_the_lift_off() -> None:
    task = find_task("t5")
    assert {task.commanded_speed(progress) for progress in (0.0, 0.2, 0.45, 0.5)} == {0.0}
    stands = task.behaviour().standing(np.array([task.judged_from - 1e-6, task.judged_from + 1e-6]))
    np.testing.assert_array_equal(stands, [[True] * 4, [False, True, True, True]])


def test_the_box_of_the_one_leg_lies_beside_the_front_right_foot() -> None:
    """Its face is parallel to x, to the right of the foot, and the foot is level with its length."""
    task, foot = find_task("t5"), feet(HOME)[0]
    depth, width, _ = task.box.size
    x, y = task.box.position
    assert 0.0 < foot[1] - FOOT_RADIUS - (y + 0.5 * width) < 0.1
    assert abs(foot[0] - x) < 0.5 * depth
    assert task.path.heading == pytest.approx(-0.5 * np.pi)


def test_a_task_walks_or_sweeps_and_begins_afresh() -> None:
    for name, task in TASKS.items():
        first, second = task.behaviour(), task.behaviour()
        assert first is not second
        assert isinstance(first, Sweeping if name == "t5" else Walking)
        if isinstance(first, Walking) and isinstance(second, Walking):
            assert first.helm is not second.helm


def test_a_task_that_is_not_there_is_refused_with_a_list() -> None:
    with pytest.raises(ConfigError, match=r"no task 't6'.*hw1, hw2, t1, t2, t3, t4, t5"):
        find_task("t6")


def test_the_robot_reads_its_own_settings() -> None:
    given = {"go1": {"kp": 3.0}, "control": {"sigma_hip": 0.01, "samples": 7}}
    settings = settings_of(System.load("go1_push", given, schema=PushSettings, warn=False))
    assert (settings.go1.kp, settings.control.samples) == (3.0, 7)
    assert settings.control.joint_sigma[:4] == pytest.approx([0.01, 0.012, 0.012, 0.01])


@pytest.mark.parametrize(
    ("line", "column", "text"),
    [
        ("  go1: {trips: {tilt: 9}}", 23, "tilt is 9"),
        ("  control: {sigma_hp: 0.1}", 13, "did you mean 'sigma_hip'"),
        ("  go2: {kp: 1}", 3, "no key 'go2'"),
    ],
)
def test_mistakes_in_the_file_are_reported_with_their_place(
    tmp_path: Path, line: str, column: int, text: str
) -> None:
    folder = tmp_path / "mine"
    row = go1_system_with(line, folder)
    with pytest.raises(ConfigError) as error:
        System.load(folder, schema=PushSettings, warn=False)
    assert str(error.value).startswith(f"{folder / 'system.yaml'}:{row}:{column}: ")
    assert text in str(error.value)


def test_a_system_without_a_robot_has_no_settings_of_one() -> None:
    with pytest.raises(ConfigError, match="no setting 'control'"):
        System.load("pendulum", {"control": {"samples": 7}}, warn=False)


def test_settings_of_a_robot_that_nobody_checks_are_named_once(caplog: pytest.LogCaptureFixture) -> None:
    given = {"control": {"nope": 3}, "go1": {"zz": 1}}
    System.load("go1_push", given)
    (warning,) = [record.getMessage() for record in caplog.records if "not checked" in record.getMessage()]
    assert "settings of the robot go1 (control, go1) were not checked" in warning
    caplog.clear()
    System.load("go1_push", {"clips": {"count": 3}})
    System.load("go1_push", {"control": {"samples": 8}}, schema=PushSettings)
    assert "not checked" not in caplog.text


@pytest.fixture
def joints() -> np.ndarray:
    """Poses within the limits, knees not straight, feet below the hips: shape (50, 12)."""
    rng = np.random.default_rng(0)
    return rng.uniform(np.tile([-0.8, 0.0, -2.6], 4), np.tile([0.8, 1.4, -0.95], 4), (50, 12))


def test_feet_are_where_mujoco_has_them(joints: np.ndarray) -> None:
    model = planner_model()
    data, at = mujoco.MjData(model), layout(model)
    for q in joints:
        data.qpos[at.trunk] = [0, 0, 0, 1, 0, 0, 0]
        data.qpos[at.joints] = q
        mujoco.mj_kinematics(model, data)
        there = np.array([data.site(f"{leg}_foot").xpos for leg in legs.LEGS])
        np.testing.assert_allclose(legs.feet(q), there, atol=1e-9)


def test_inverse_undoes_forward_for_any_leading_shape(joints: np.ndarray) -> None:
    stacked = joints.reshape(5, 10, 12)
    np.testing.assert_allclose(legs.joint_angles(legs.feet(stacked)), stacked, atol=1e-9)


def test_inverse_leaves_a_foot_out_of_reach_in_its_direction() -> None:
    far = legs.feet(legs.HOME) + np.array([0.3, 0.0, -0.4])
    reached = legs.feet(legs.joint_angles(far))
    assert np.isfinite(reached).all()
    thighs = legs.HIPS + legs.SIDE[:, None] * [0.0, legs.HIP_OFFSET, 0.0]
    wanted, got = far - thighs, reached - thighs
    cosine = (wanted * got).sum(-1) / np.linalg.norm(wanted, axis=-1) / np.linalg.norm(got, axis=-1)
    np.testing.assert_allclose(cosine, 1.0, atol=1e-6)


def moved(joints: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Velocity of the feet (..., 4, 3) while the joints move at `rates` (..., 12), by differences."""
    step = 1e-6
    return (legs.feet(joints + step * rates) - legs.feet(joints - step * rates)) / (2.0 * step)


def test_rates_move_the_feet_as_asked(joints: np.ndarray) -> None:
    velocity = np.random.default_rng(1).normal(size=(50, 4, 3))
    np.testing.assert_allclose(moved(joints, legs.posture(joints).rates(velocity)), velocity, atol=1e-7)


def test_holding_torques_do_no_work_against_the_ground(joints: np.ndarray) -> None:
    """Virtual work: joint torques and ground forces cancel for every small motion of the legs."""
    rng = np.random.default_rng(2)
    forces, motion = rng.normal(size=(50, 4, 3)), rng.normal(size=(50, 12))
    work = (legs.posture(joints).holding_torques(forces) * motion).sum(-1)
    work += (forces * moved(joints, motion)).sum((-1, -2))
    np.testing.assert_allclose(work, 0.0, atol=1e-7)
