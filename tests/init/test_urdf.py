"""`init` on URDFs: what it adds, what it leaves out, and that the folder stands on its own."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.core.settings import LogSettings
from amhe_cli.init.folder import init_system
from amhe_cli.logs import LogWriter, read_signals
from amhe_cli.system.model.urdf import UrdfOptions
from amhe_cli.system.system import System
from tests.system.test_urdf import BODY, FINGERS, mesh_file, robot, shape, written

STEP_NS = 10_000_000
ARM = ("shoulder", "elbow")


def recorded(
    path: Path,
    joints: Sequence[str],
    command: str = "/joint_commands",
    driven: Sequence[str] = ARM,
    odom: bool = False,
) -> Path:
    """A log of joint states and commands, with the robot's odometry if demanded."""
    with LogWriter(path, {}) as log:
        for step in range(60):
            stamp, values = 10**18 + step * STEP_NS, np.full(len(joints), 0.002 * step)
            log.joint_state("/joint_states", stamp, list(joints), values, 0.2 * np.ones(len(joints)))
            numbers = 0.002 * step * np.ones(len(driven))
            slot = next(
                (i for i, word in enumerate(("position", "velocity", "torque")) if word in command), 0
            )
            log.joint_state(command, stamp, list(driven), *[()] * slot, numbers)
            if odom:
                still = np.array([1.0, 0.0, 0.0, 0.0])
                place = np.array([0.01 * step, 0.0, 0.5])
                log.odometry("/odom", stamp, place, still, np.array([1.0, 0.0, 0.0]), child_frame="base")
    return path


def made(folder: Path, text: str, log: Path, **options: object) -> tuple[System, list[str]]:
    path = written(folder, text)
    urdf = UrdfOptions(**options)  # type: ignore[arg-type]
    guesses = init_system(path, [log], folder / "out", urdf=urdf).sentences
    return System.load(folder / "out"), guesses


def test_a_mimic_joint_is_no_unknown_and_gets_no_servo(tmp_path: Path) -> None:
    log = recorded(tmp_path / "a.mcap", (*ARM, "left", "right"), driven=(*ARM, "left", "right"))
    system, guesses = made(tmp_path, robot(more=FINGERS), log)
    actuators = {system.model.actuator(row).name for row in range(system.model.nactuator)}
    assert actuators == {"shoulder", "elbow", "left"}
    assert not [name for name in system.space.names if "right" in name]
    assert "left_damping" in system.space.names
    assert "joint right follows left: it is no unknown" in guesses
    assert system.model.eq_data[0, :2] == pytest.approx([0.01, -0.5])


def test_a_mimic_joint_that_no_topic_measures_is_not_lost(tmp_path: Path) -> None:
    log = recorded(tmp_path / "a.mcap", (*ARM, "left"))
    _, guesses = made(tmp_path, robot(more=FINGERS), log)
    assert not [guess for guess in guesses if "no topic measures" in guess]


@pytest.mark.parametrize(
    ("command", "added", "gains"),
    [
        ("/joint_commands", "2 position servos", {"shoulder_gain", "shoulder_kv"}),
        ("/velocity_commands", "2 velocity servos", {"shoulder_gain"}),
        ("/torque_commands", "2 torque motors", set()),
    ],
)
def test_the_commands_decide_which_actuators_are_added(
    tmp_path: Path, command: str, added: str, gains: set[str]
) -> None:
    system, guesses = made(tmp_path, robot(), recorded(tmp_path / "a.mcap", ARM, command))
    assert any(added in guess and command in guess for guess in guesses)
    assert {name for name in system.space.names if name in ("shoulder_gain", "shoulder_kv")} == gains
    edited = system.edits.apply(system.model, system.space.nominal)
    np.testing.assert_allclose(edited.actuator_gainprm, system.model.actuator_gainprm)
    read_signals(tmp_path / "a.mcap", system.signals, 0.002, LogSettings())


def test_the_root_moves_freely_where_odometry_gives_its_pose(tmp_path: Path) -> None:
    ball = '<collision><geometry><sphere radius="0.05"/></geometry></collision>'
    text = robot(ball).replace(
        '<link name="base"/>',
        '<link name="base"><inertial><mass value="9"/><inertia ixx="1"'
        ' iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>',
    )
    system, guesses = made(tmp_path / "free", text, recorded(tmp_path / "a.mcap", ARM, odom=True))
    assert system.model.nq == 9
    assert any("base is free, because /odom gives its pose; a floor" in guess for guess in guesses)
    assert system.model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert {"base_mass", "friction"} <= set(system.space.names)
    fixed, guesses = made(tmp_path / "fixed", text, recorded(tmp_path / "b.mcap", ARM))
    assert fixed.model.nq == 2
    assert any("base is fixed to the world" in guess for guess in guesses)


def test_the_mass_of_an_empty_root_is_that_of_what_it_carries(tmp_path: Path) -> None:
    trunk = f"""<link name="trunk">{BODY}</link><joint name="weld" type="fixed"><parent link="base"/>
      <child link="trunk"/></joint>"""
    log = recorded(tmp_path / "a.mcap", ARM, odom=True)
    system, _ = made(tmp_path, robot(more=trunk), log)
    assert "trunk_mass" in system.space.names
    assert "base_mass" not in system.space.names


def test_hinges_and_slides_share_no_parameter(tmp_path: Path) -> None:
    more = FINGERS + FINGERS.replace("left", "third").replace("right", "fourth")
    joints = (*ARM, "left", "right", "third", "fourth")
    system, _ = made(tmp_path, robot(more=more), recorded(tmp_path / "a.mcap", joints, driven=joints))
    assert {"left_damping", f"{ARM[0]}_armature"} <= set(system.space.names)
    assert not any(ARM[0] in words and "left" in words for words in system.sets.values())


def test_the_folder_stands_on_its_own(tmp_path: Path) -> None:
    log = recorded(tmp_path / "a.mcap", ARM)
    for name, size in (("upper", 0.1), ("lower", 0.3)):
        mesh_file(tmp_path / "parts" / name / "part.stl", size)
    text = robot(shape("package://parts/upper/part.stl"), shape("package://parts/lower/part.stl"))
    made(tmp_path / "ws", text, log, packages={"parts": tmp_path / "parts"})
    shutil.move(tmp_path / "ws" / "out", tmp_path / "moved")
    shutil.rmtree(tmp_path / "parts")
    shutil.rmtree(tmp_path / "ws")
    model = System.load(tmp_path / "moved").model
    assert np.sort(model.geom_rbound)[1] == pytest.approx(3.0 * np.sort(model.geom_rbound)[0], rel=1e-4)
    assert str(tmp_path) not in (tmp_path / "moved" / "model.xml").read_text()


def test_boxes_stay_in_the_folder(tmp_path: Path) -> None:
    log = recorded(tmp_path / "a.mcap", ARM)
    system, _ = made(tmp_path, robot(shape("a.dae"), shape("b.dae")), log, meshes=False)
    assert list(system.model.geom_type) == [mujoco.mjtGeom.mjGEOM_BOX] * 2
    assert (system.model.nmesh, system.model.nexclude) == (0, 0)
