"""URDF as ROS writes it: packages, meshes, mimic joints, links that MuJoCo alone would refuse."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.system.model.elements import followers
from amhe_cli.system.model.files import compiled, read_spec
from amhe_cli.system.model.urdf import UrdfOptions
from amhe_cli.system.system import System

BODY = """<inertial><mass value="2"/><origin xyz="0 0 -0.2"/>
  <inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0" ixz="0" iyz="0"/></inertial>"""


def mesh_file(path: Path, size: float = 0.1) -> Path:
    """A tetrahedron as a binary STL file."""
    corners = size * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = [corners[list(face)].ravel() for face in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))]
    path.parent.mkdir(parents=True, exist_ok=True)
    records = b"".join(struct.pack("<12fH", 0, 0, 0, *face, 0) for face in faces)
    path.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + records)
    return path


def shape(mesh: str, kind: str = "collision") -> str:
    return f'<{kind}><geometry><mesh filename="{mesh}"/></geometry></{kind}>'


def robot(upper: str = "", lower: str = "", more: str = "", head: str = "") -> str:
    """An arm of two links; `upper` and `lower` are added to them."""
    return f"""<robot name="arm">{head}<link name="base"/>
      <link name="upper">{BODY}{upper}</link><link name="lower">{BODY}{lower}</link>
      <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
        <limit lower="-2" upper="1.5" effort="10" velocity="5"/>
        <dynamics damping="0.3" friction="0.2"/></joint>
      <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/>
        <origin xyz="0 0 -0.4"/></joint>{more}</robot>"""


def written(folder: Path, text: str, name: str = "arm.urdf") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def read(path: Path, packages: Mapping[str, Path] | None = None, meshes: bool = True) -> mujoco.MjModel:
    return compiled(read_spec(path, UrdfOptions(packages or {}, meshes)))


@pytest.mark.parametrize(
    ("mesh", "place"),
    [
        ("package://arm_description/meshes/a.stl", "ws/arm_description/meshes/a.stl"),  # above, by its folder
        ("package://other/a.stl", "ws/other/a.stl"),  # beside one of the folders above
        ("package://named/a.stl", "ws/folder/a.stl"),  # given
        ("package://manifest/a.stl", "ws/arm_description/a.stl"),  # above, by its package.xml
        ("model://arm_description/a.stl", "ws/arm_description/a.stl"),
        ("../meshes/a.stl", "ws/arm_description/meshes/a.stl"),
        ("..\\meshes\\a.stl", "ws/arm_description/meshes/a.stl"),
        ("package://nowhere/a.stl", "ws/arm_description/urdf/a.stl"),  # MuJoCo alone: the base name, beside
        ("file://{tmp}/ws/my%20files/a.stl", "ws/my files/a.stl"),
    ],
)
def test_a_mesh_is_found(tmp_path: Path, mesh: str, place: str) -> None:
    mesh_file(tmp_path / place)
    home = tmp_path / "ws" / "arm_description"
    text = robot(shape(mesh.format(tmp=tmp_path)))
    path = written(home / "urdf", text)
    (home / "package.xml").write_text("<package><name>manifest</name></package>")
    assert read(path, {"named": tmp_path / "ws" / "folder"}).nmesh == 1


def test_two_meshes_of_one_name_stay_two(tmp_path: Path) -> None:
    for name, size in (("a", 0.1), ("b", 0.3)):
        mesh_file(tmp_path / name / "part.stl", size)
    model = read(written(tmp_path, robot(shape("a/part.stl"), shape("b/part.stl"))))
    assert np.sort(model.geom_rbound)[1] == pytest.approx(3.0 * np.sort(model.geom_rbound)[0], rel=1e-5)


@pytest.mark.parametrize(
    ("mesh", "content", "problem"),
    [
        (
            "package://arm_description/a.stl",
            None,
            "give the folder of package 'arm_description' in `packages`",
        ),
        ("a.stl", None, "mesh 'a.stl' is not there; correct its path"),
        ("a.dae", b"<COLLADA/>", "mesh 'a.dae' is a .dae file, which MuJoCo cannot read; convert it"),
        ("a.stl", b"solid a\n facet normal 0 0 1\n", "mesh 'a.stl' is an STL file of text"),
    ],
)
def test_a_mesh_that_cannot_be_read_is_one_line(
    tmp_path: Path, mesh: str, content: bytes | None, problem: str
) -> None:
    path = written(tmp_path, robot(shape(mesh)))
    if content is not None:
        (tmp_path / mesh).write_bytes(content)
    with pytest.raises(ConfigError) as error:
        read(path)
    assert problem in str(error.value)
    assert str(error.value).endswith("or give `meshes=False` to do without meshes")
    assert str(error.value).startswith(f"{path}: ")
    assert read(path, meshes=False).nmesh == 0


def test_visual_meshes_are_not_needed(tmp_path: Path) -> None:
    assert read(written(tmp_path, robot(shape("package://x/nothing.dae", "visual")))).ngeom == 0


def test_a_box_of_the_same_inertia_takes_the_place_of_meshes(tmp_path: Path) -> None:
    ball = '<collision><geometry><sphere radius="0.05"/></geometry></collision>'
    model = read(written(tmp_path, robot(shape("a.dae"), shape("b.dae") + ball)), meshes=False)
    box, sphere = model.geom_type
    assert (box, sphere) == (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE)
    edges = 2.0 * model.geom_size[0]
    squares = edges**2
    assert 2.0 / 12.0 * (squares.sum() - squares) == pytest.approx(model.body("upper").inertia)
    assert model.geom_pos[0] == pytest.approx([0.0, 0.0, -0.2])
    assert model.body("upper").mass == pytest.approx(2.0)


def test_limits_damping_friction_and_effort_are_those_of_the_file(tmp_path: Path) -> None:
    model = read(written(tmp_path, robot()))
    shoulder = model.joint("shoulder")
    assert shoulder.range == pytest.approx([-2.0, 1.5])
    assert (shoulder.damping[0], shoulder.frictionloss[0]) == pytest.approx((0.3, 0.2))
    assert model.jnt_actfrcrange[shoulder.id] == pytest.approx([-10.0, 10.0])
    assert not model.jnt_limited[model.joint("elbow").id]


FINGERS = "".join(
    f"""<link name="{name}">{BODY}</link><joint name="{name}" type="prismatic"><parent link="lower"/>
    <child link="{name}"/><axis xyz="0 1 0"/><limit lower="0" upper="0.04" effort="20" velocity="1"/>
    {mimic}</joint>"""
    for name, mimic in (("left", ""), ("right", '<mimic joint="left" multiplier="-0.5" offset="0.01"/>'))
)


def test_a_mimic_joint_follows_with_multiplier_and_offset(tmp_path: Path) -> None:
    model = read(written(tmp_path, robot(more=FINGERS)))
    assert followers(model) == {"right": "left"}
    assert model.eq_data[0, :5] == pytest.approx([0.01, -0.5, 0.0, 0.0, 0.0])


def test_links_that_are_joined_or_overlap_do_not_collide(tmp_path: Path) -> None:
    ball = '<collision><geometry><sphere radius="0.5"/></geometry></collision>'
    text = robot(ball, ball).replace('<link name="base"/>', f'<link name="base">{ball}</link>')
    model = read(written(tmp_path, text))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    assert model.nexclude == 2  # base with upper, which MuJoCo would not leave out, and base with lower


def test_an_inertia_that_no_body_has_becomes_the_nearest_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = robot().replace('izz="0.04"', 'izz="0.08"', 1)
    model = read(written(tmp_path, text))
    # second moments (izz + iyy - ixx) / 2 and so on: 0.045, 0.035, -0.015, of which the last becomes 2e-6
    assert np.sort(model.body("upper").inertia) == pytest.approx([0.035, 0.045, 0.08], abs=1e-5)
    assert np.sort(model.body("lower").inertia) == pytest.approx([0.02, 0.03, 0.04])
    assert "no body has the inertia of upper;" in caplog.text


def test_meshes_that_are_not_closed_are_no_obstacle(tmp_path: Path) -> None:
    path = mesh_file(tmp_path / "a.stl")
    content = path.read_bytes()
    path.write_bytes(content[:80] + struct.pack("<I", 3) + content[84 : 84 + 3 * 50])
    assert read(written(tmp_path, robot(shape("a.stl")))).nmesh == 1


def test_what_is_no_urdf_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"arm.urdf: not a URDF: .*line 1"):
        read(written(tmp_path, "<robot"))


@pytest.mark.parametrize(("mass", "ixx"), [("heavy", "1"), ("", "1"), ("1", "x"), ("1", "nan"), ("inf", "1")])
def test_a_mass_or_inertia_that_is_no_number_is_one_line(mass: str, ixx: str, tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(
        f'<robot name="arm"><link name="base"><inertial><mass value="{mass}"/>'
        f'<inertia ixx="{ixx}" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    with pytest.raises(ConfigError, match=r"arm\.urdf: link 'base': its (mass or inertia|inertial)"):
        read_spec(tmp_path / "arm.urdf", None)


def test_the_library_takes_packages_and_meshes(tmp_path: Path) -> None:
    path = written(tmp_path / "urdf", robot(shape("package://parts/a.stl")))
    mesh_file(tmp_path / "elsewhere" / "a.stl")
    parts = {
        "parameters": {"damping": {"targets": [{"joint": "shoulder", "set": "damping"}]}},
        "signals": {"joints": {"joints": ["shoulder", "elbow"], "noise": {"position": 0.01}}},
    }
    with pytest.raises(ConfigError, match="`packages`"):
        System.from_model(path, **parts)
    assert System.from_model(path, packages={"parts": tmp_path / "elsewhere"}, **parts).model.nmesh == 1
    assert System.from_model(path, meshes=False, **parts).model.nmesh == 0


def test_a_xacro_file_is_refused_with_the_command_that_makes_a_urdf_of_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"arm.urdf.xacro: .* xacro FILE > robot.urdf"):
        read(written(tmp_path, "<robot/>", "arm.urdf.xacro"))
