"""The plant and its changes, and plants made of other robots' files."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.robots.go1.behaviours.gait import Gait, standing, walk
from amhe_cli.robots.go1.behaviours.objective import BUMPER
from amhe_cli.robots.go1.kinematics import HOME, JOINTS, TORQUE_LIMIT
from amhe_cli.robots.go1.model import (
    Box,
    Change,
    home,
    layout,
    planner_model,
    plant_model,
)
from amhe_cli.system.description.folders import find_system
from tests.robots.go1.playing import FAR, play

GO1 = (find_system("go1_push") / "go1.xml").read_text()


def test_planner_and_plant_are_the_same_robot_and_box() -> None:
    planner, plant = planner_model(FAR, timestep=0.002), plant_model(FAR)
    a, b = layout(planner), layout(plant)
    assert (a.trunk, a.box, a.joints.tolist()) == (b.trunk, b.box, b.joints.tolist())
    for field in ("body_mass", "body_inertia", "body_ipos", "dof_damping", "dof_armature",
                  "actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "actuator_ctrlrange",
                  "jnt_range", "qpos0"):  # fmt: skip
        np.testing.assert_allclose(getattr(planner, field), getattr(plant, field), err_msg=field)
    assert planner.npair < 20 < plant.npair


def test_what_pushes_in_the_plant_pushes_in_the_scene() -> None:
    """A shape of the trunk that stands before both bars of the bumper takes part of the push."""
    scene, plant = mujoco.MjModel.from_xml_path(str(find_system("go1_push") / "scene.xml")), plant_model()
    data = mujoco.MjData(plant)
    data.qpos[:] = home(plant)
    mujoco.mj_forward(plant, data)

    def front(name: str) -> float:
        geom, wall = plant.geom(name).id, plant.geom("box").id
        return -float(mujoco.mj_geomDistance(plant, data, geom, wall, 1.0, np.zeros(6)))

    bar = min(front("robot/bumper_high"), front("robot/bumper_low"))
    before = {name for name in _touching_box(plant) if front(f"robot/{name}") >= bar - 1e-6}
    assert "head_5" in before
    assert before <= _touching_box(scene)


def _touching_box(model: mujoco.MjModel) -> set[str]:
    """Shapes of the trunk that are paired with the box; MuJoCo orders a pair as it likes."""
    pairs = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    geoms = {geom for pair in pairs if model.geom("box").id in pair for geom in pair}
    trunk = model.body("trunk").id
    return {model.geom(g).name.removeprefix("robot/") for g in geoms if model.geom_bodyid[g] == trunk}


def test_the_planner_s_forehead_touches_no_box() -> None:
    """With it plans expect too slow a box, and the robot overspeeds; the estimator's model keeps it."""
    scene = mujoco.MjModel.from_xml_path(str(find_system("go1_push") / "scene.xml"))
    for model, touches in ((planner_model(), False), (scene, True)):
        data, at = mujoco.MjData(model), layout(model)
        data.qpos[:] = home(model)
        data.qpos[at.trunk][[0, 2]] = 0.45 - BUMPER + 0.003, 0.265  # as in a stride, the bars 3 mm in the box
        mujoco.mj_forward(model, data)
        names = {model.geom(int(g)).name for pair in data.contact.geom for g in pair}
        assert {"bumper_high", "bumper_low"} <= names
        assert ("head_5" in names) == touches


def test_the_planner_solves_cheaply() -> None:
    planner = planner_model()
    assert (planner.opt.impratio, planner.opt.iterations) == (1.0, 10)


def test_planner_and_plant_fly_alike() -> None:
    """Legs thrown about in the air, where no contact is: the same motion but for the integrator."""
    ends = []
    for model in (planner_model(FAR, timestep=0.0005), plant_model(FAR, timestep=0.0005)):
        model.dof_frictionloss[:] = 0.0  # the planner has none
        data, at = mujoco.MjData(model), layout(model)
        data.qpos[:] = home(model)
        data.qpos[at.trunk][2] = 2.0
        data.qvel[at.trunk_v] = [0.3, 0.1, 0.5, 0.5, -0.4, 0.3]
        data.ctrl[at.servos] = HOME + np.tile([0.1, 0.3, -0.4], 4)
        for _ in range(400):
            mujoco.mj_step(model, data)
        ends.append(data.qpos[np.r_[at.trunk, at.joints]].copy())
    np.testing.assert_allclose(ends[0], ends[1], atol=2e-3)


def test_every_contact_with_floor_and_box_is_a_pair_of_its_own(plant: mujoco.MjModel) -> None:
    names = {plant.pair(i).name: plant.pair_friction[i, :2] for i in range(plant.npair)}
    np.testing.assert_allclose(names["robot/FR_foot_floor"], 0.8)
    np.testing.assert_allclose(names["robot/FR_calf_1_box"], 0.5)
    np.testing.assert_allclose(names["box_floor"], 0.4)
    assert not plant.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE
    for name in ("floor", "box"):
        assert plant.geom(name).contype == plant.geom(name).conaffinity == 0


def test_home_touches_nothing_but_the_floor(plant: mujoco.MjModel) -> None:
    data = mujoco.MjData(plant)
    data.qpos[:] = home(plant)
    mujoco.mj_forward(plant, data)
    floor = plant.geom("floor").id
    assert data.ncon >= 4, "all feet stand"
    assert all(floor in contact.geom for contact in data.contact)


def test_box_has_the_size_mass_and_place_asked_for() -> None:
    box = Box(size=(0.2, 0.3, 0.3), mass=3.0, floor_friction=0.5, position=(0.2, -0.4), yaw=0.3)
    for model in (planner_model(box), plant_model(box)):
        np.testing.assert_allclose(model.geom("box").size, [0.1, 0.15, 0.15])
        np.testing.assert_allclose(model.body("box").mass, 3.0)
        np.testing.assert_allclose(
            np.sort(model.body("box").inertia), np.sort(0.25 * np.array([0.18, 0.13, 0.13]))
        )
        start = home(model)[layout(model).box]
        np.testing.assert_allclose(start, [0.2, -0.4, 0.15, np.cos(0.15), 0, 0, np.sin(0.15)])
        np.testing.assert_allclose(model.pair("box_floor").friction[:2], 0.5)


def test_servos_have_the_gains_and_limits_asked_for() -> None:
    for model in (planner_model(), plant_model()):
        rows = layout(model).servos
        np.testing.assert_allclose(model.actuator_gainprm[rows, 0], 60.0)
        np.testing.assert_allclose(model.actuator_biasprm[rows, 1:3], np.tile([-60.0, -1.0], (12, 1)))
        np.testing.assert_allclose(model.actuator_forcerange[rows, 1], TORQUE_LIMIT)


def slide(model: mujoco.MjModel, speed: float) -> float:
    """How far the box slides [m], far from the robot."""
    data, at = mujoco.MjData(model), layout(model)
    data.qpos[:] = home(model)
    data.ctrl[at.servos] = HOME
    for _ in range(100):
        mujoco.mj_step(model, data)
    start = data.qpos[at.box][0]
    data.qvel[at.box_v][0] = speed
    for _ in range(500):
        mujoco.mj_step(model, data)
    return float(data.qpos[at.box][0] - start)


def test_friction_changed_at_run_time_changes_the_slide() -> None:
    plant = plant_model(FAR)
    for friction in (0.4, 0.8):
        Change(floor_friction=friction).apply(plant)
        assert slide(plant, 1.0) == pytest.approx(1.0 / (2.0 * friction * 9.81), rel=0.05)


def test_mass_changed_at_run_time_is_as_if_built_so() -> None:
    changed, built = plant_model(Box(mass=4.0)), plant_model(Box(mass=6.0))
    Change(mass=6.0).apply(changed)
    for field in ("body_mass", "body_inertia", "body_invweight0", "dof_invweight0", "body_subtreemass"):
        np.testing.assert_allclose(getattr(changed, field), getattr(built, field), rtol=1e-9, err_msg=field)


def test_any_go1_can_be_the_plant_whatever_its_joints_are_called(tmp_path: Path) -> None:
    """One in a file with its own floor, box and motors."""
    text = re.sub(r"(F|R)(R|L)_(hip|thigh|calf)_joint", r"\3-of-\2\1", GO1)
    text = text.replace('<position name="', '<motor name="').replace('class="hip" joint', "joint")
    text = re.sub(r"<motor (.*?) class=.*? joint", r"<motor \1 joint", text)
    own = (
        '<geom name="floor" type="plane" size="1 1 1"/><body name="box" pos="3 3 3"><geom size="0.1"/></body>'
    )
    text = text.replace("<worldbody>", f"<worldbody>{own}", 1).replace('name="trunk" pos', 'name="base" pos')
    (tmp_path / "robot.xml").write_text(text)
    model = plant_model(FAR, robot=tmp_path / "robot.xml")
    assert model.nu == 12
    assert [model.joint(name).id for name in JOINTS]
    motion = play(model, lambda t: walk(standing(Gait()), t, np.zeros(3)), 1.0)
    assert motion.tilt.max() < np.radians(2.0)
    assert abs(motion.trunk[-1, 2] - 0.27) < 0.01


def test_another_robot_gets_our_bumper_and_keeps_its_damping(tmp_path: Path) -> None:
    text = re.sub(r'\s*<geom name="bumper_.*?/>', "", GO1).replace('damping="2"', 'damping="0.6"')
    (tmp_path / "robot.xml").write_text(text)
    other, ours = plant_model(robot=tmp_path / "robot.xml"), plant_model()
    for bar in ("robot/bumper_high", "robot/bumper_low"):
        np.testing.assert_allclose(other.geom(bar).pos, ours.geom(bar).pos)
        np.testing.assert_allclose(other.geom(bar).size, ours.geom(bar).size)
    assert other.body("trunk").subtreemass[0] == pytest.approx(12.743, abs=1e-3)
    assert other.joint("FL_calf_joint").damping[0] == 0.6


def test_a_robot_in_degrees_without_a_free_joint(tmp_path: Path) -> None:
    text = GO1.replace('angle="radian"', 'angle="degree"').replace('<freejoint name="trunk"/>', "")

    def in_degrees(found: re.Match[str]) -> str:
        low, high = np.degrees([float(found[1]), float(found[2])])
        return f'range="{low:.9g} {high:.9g}"'

    text = re.sub(r'range="(-?[\d.]+) (-?[\d.]+)"', in_degrees, text)
    (tmp_path / "robot.xml").write_text(text)
    other, ours = plant_model(robot=tmp_path / "robot.xml"), plant_model()
    np.testing.assert_allclose(other.jnt_range, ours.jnt_range, atol=1e-6)
    np.testing.assert_allclose(other.actuator_ctrlrange, ours.actuator_ctrlrange)


def test_a_robot_with_meshes_contact_pairs_and_tendons(tmp_path: Path) -> None:
    """As published robots come: meshes beside the file, and elements that refer to what is left out."""
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], dtype="<f4")
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    triangles = b"".join(bytes(12) + corners[list(face)].tobytes() + bytes(2) for face in faces)
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "hull.stl").write_bytes(bytes(80) + len(faces).to_bytes(4, "little") + triangles)
    text = GO1.replace("<compiler", '<compiler meshdir="assets"', 1)
    text = text.replace("<worldbody>", '<worldbody><geom name="floor" type="plane" size="1 1 1"/>', 1)
    text = text.replace("<asset>", '<asset><mesh name="hull" file="hull.stl"/>')
    inside = (
        '<geom type="mesh" mesh="hull" class="collision"/>'
        '<camera name="side" mode="targetbody" target="trunk" pos="0 2 1"/>'
    )
    text = text.replace('<site name="imu"/>', inside)
    more = """<contact><pair geom1="FL_foot" geom2="floor"/><exclude body1="trunk" body2="FL_calf"/></contact>
              <tendon><fixed name="knees"><joint joint="FL_calf_joint" coef="1"/></fixed></tendon>
              <sensor><tendonpos tendon="knees"/></sensor>
              <keyframe><key qpos="0 0 0.3 1 0 0 0  0 1 -2  0 1 -2  0 1 -2  0 1 -2"/></keyframe></mujoco>"""
    (tmp_path / "robot.xml").write_text(text.replace("</mujoco>", more))
    model = plant_model(robot=tmp_path / "robot.xml")
    assert model.nmesh == 1
    assert model.ntendon == model.nsensor == model.nkey == 0
    names = [model.pair(i).name for i in range(model.npair)]
    assert sum(name.endswith("FL_foot_floor") for name in names) == 1


def test_soft_feet_sink_into_the_floor_and_not_into_the_box(tmp_path: Path) -> None:
    """Menagerie's Go1: feet that give way, six friction directions, options and lights of its own."""
    feet = 'pos="0 0 -0.213" solimp="0.015 1 0.031" condim="6" friction="0.8 0.02 0.01"'
    text = GO1.replace('pos="0 0 -0.213"', feet, 1)
    text = text.replace("<asset>", '<option impratio="100" cone="elliptic"/><size njmax="500"/><asset>', 1)
    text = text.replace('<site name="imu"/>', '<site name="imu"/><light pos="0 0 2"/>')
    (tmp_path / "robot.xml").write_text(text)
    model = plant_model(robot=tmp_path / "robot.xml")
    floor, box = model.pair("robot/FL_foot_floor"), model.pair("robot/FL_foot_box")
    assert floor.solimp[0] == 0.015 and floor.dim[0] == 6
    np.testing.assert_allclose(floor.friction, [0.8, 0.8, 0.02, 0.01, 0.01])
    assert box.solimp[0] == 0.9 and box.dim[0] == 3
    np.testing.assert_allclose(box.friction[:2], 0.5)
    assert model.opt.impratio == 10.0
    assert model.nlight == plant_model().nlight


def test_what_a_file_of_its_own_brings_along_warns_of_nothing(tmp_path: Path, caplog) -> None:
    options = '<option impratio="100" gravity="0 0 -1"/><size njmax="500" nconmax="100"/><asset>'
    more = '<custom><tuple name="t"><element objtype="body" objname="trunk"/></tuple></custom></mujoco>'
    text = GO1.replace("<asset>", options, 1).replace("</mujoco>", more)
    (tmp_path / "robot.xml").write_text(text)
    assert plant_model(robot=tmp_path / "robot.xml").opt.gravity[2] == pytest.approx(-9.81)
    assert not caplog.records


def test_a_robot_that_lists_its_contacts_as_pairs(tmp_path: Path) -> None:
    text = GO1.replace('conaffinity="1"', 'conaffinity="0"')
    feet = "".join(f'<pair geom1="{leg}_foot" geom2="floor"/>' for leg in ("FR", "FL", "RR", "RL"))
    text = text.replace("<worldbody>", '<worldbody><geom name="floor" type="plane" size="1 1 1"/>', 1)
    (tmp_path / "robot.xml").write_text(text.replace("</mujoco>", f"<contact>{feet}</contact></mujoco>"))
    model = plant_model(robot=tmp_path / "robot.xml")
    assert {model.pair(i).name for i in range(model.npair)} >= {"robot/FR_foot_floor", "robot/FR_foot_box"}


SECOND_HIP = (
    '<body pos="0.19 0.045 0"><joint name="other" axis="1 0 0"/>'
    '<geom type="sphere" size="0.1" mass="1"/></body>'
)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"hinge" axis="0 1 0"', '"slide" axis="0 1 0"', "no body carries the twelve hinge joints of a Go1"),
        (
            'pos="0 0.08 0"',
            'pos="0 0.14 0"',
            "no joint where a Go1 has FL_thigh_joint: .* is 6 cm from there",
        ),
        (
            '"hinge" axis="0 1 0"',
            '"hinge" axis="0 -1 0"',
            r"'FR_thigh_joint' does not turn about \+y as a Go1's",
        ),
        ('<freejoint name="trunk"/>', '<joint name="lift"/>', "'trunk' must move by one free joint"),
        ('conaffinity="1"', 'conaffinity="0"', "no geom that collides"),
        ("<worldbody>", "<worldbdy>", r"MuJoCo cannot read 'robot\.xml'"),
        ('mass="5.204"', 'mass="nan"', r"cannot compile the robot of 'robot\.xml'"),
        ('<site name="imu"/>', SECOND_HIP, "joints .*other.* could both be FL_hip_joint"),
    ],
)
def test_what_is_no_go1_is_refused_in_one_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in GO1
    (tmp_path / "robot.xml").write_text(GO1.replace(old, new))
    with pytest.raises(ConfigError, match=message) as caught:
        plant_model(robot=tmp_path / "robot.xml")
    assert "\n" not in str(caught.value)


def test_a_missing_robot_file_is_named() -> None:
    with pytest.raises(ConfigError, match="no robot model 'nowhere.xml'"):
        plant_model(robot=Path("nowhere.xml"))
