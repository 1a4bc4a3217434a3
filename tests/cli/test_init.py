"""`amhe init` from the outside; what it guesses is tested with the systems."""

import json
import re
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest

from amhe_cli.cli.main import run
from tests.conftest import MODELS
from tests.system.test_urdf import mesh_file

ROOT = Path(__file__).parents[2]
SCENE = str(MODELS / "pendulum" / "scene.xml")


@pytest.mark.medium
def test_it_writes_a_system_that_the_log_suits(pendulum_log: Path, tmp_path: Path, capsys) -> None:
    system = tmp_path / "mine"
    assert run(["init", SCENE, str(pendulum_log), "-o", str(system)]) == 0
    out = capsys.readouterr().out
    assert "system.yaml" in out
    sources = {line.split()[0]: line.split()[1] for line in out.splitlines() if len(line.split()) > 1}
    assert sources["joints"] == "log"
    assert sources["hinge_damping"] == "model"
    assert sources["command_delay"] == "guess"
    lines = (system / "system.yaml").read_text().splitlines()
    assert [line.split(":")[0].strip() for line in lines if "# GUESS: " in line] == ["command_delay"]
    assert run(["inspect", str(pendulum_log), "--system", str(system)]) == 0
    assert "usable: 8 s" in capsys.readouterr().out


def test_json(pendulum_log: Path, tmp_path: Path, capsys) -> None:
    system = tmp_path / "mine"
    assert run(["init", SCENE, str(pendulum_log), "--system", str(system), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["command"] == "init"
    assert Path(record["system"], "system.yaml").is_file()


def test_a_folder_that_holds_something_is_refused(pendulum_log: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "mine").touch()
    assert run(["init", SCENE, str(pendulum_log), "-o", str(tmp_path)]) == 2
    assert "--force" in capsys.readouterr().err


def test_a_model_that_is_none_is_one_line(pendulum_log: Path, tmp_path: Path, capsys) -> None:
    model = tmp_path / "robot.xml"
    model.write_text("<robot")
    assert run(["init", str(model), str(pendulum_log), "-o", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err
    assert err.startswith("amhe init: error: ")
    assert not (tmp_path / "out").exists()


ARM = """<robot name="arm"><link name="base"/><link name="rod"><inertial><mass value="1"/>
  <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><geometry><mesh filename="package://parts/meshes/a.stl"/></geometry></collision></link>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/></joint>
</robot>"""


@pytest.mark.medium
def test_a_missing_package_names_the_options_and_either_helps(
    pendulum_log: Path, tmp_path: Path, capsys
) -> None:
    arm = tmp_path / "ws" / "arm.urdf"
    arm.parent.mkdir()
    arm.write_text(ARM)
    mesh_file(tmp_path / "elsewhere" / "meshes" / "a.stl")
    call = ["init", str(arm), str(pendulum_log), "-o"]
    assert run([*call, str(tmp_path / "one")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "package 'parts' in --package, or give --no-meshes" in err
    assert run([*call, str(tmp_path / "two"), "--package", f"parts={tmp_path / 'elsewhere'}"]) == 0
    assert (tmp_path / "two" / "assets" / "a.stl").is_file()
    assert run([*call, str(tmp_path / "three"), "--no-meshes"]) == 0
    assert run([*call, str(tmp_path / "four"), "--package", "parts"]) == 2
    assert "'parts' is not of the form NAME=DIR" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"])
def test_packages_are_found_where_ros_says(
    kind: str, pendulum_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = tmp_path / "ws" / "arm.urdf"
    arm.parent.mkdir()
    arm.write_text(ARM)
    package = tmp_path / "ros" / "share" / "parts"
    mesh_file(package / "meshes" / "a.stl")
    (package / "package.xml").write_text("<package>\n <name>parts</name></package>")
    monkeypatch.setenv(kind, f"{tmp_path / 'nowhere'}:{tmp_path / 'ros'}")
    assert run(["init", str(arm), str(pendulum_log), "-o", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "assets" / "a.stl").is_file()


class Menagerie(ModuleType):
    """The part of the package mujoco-menagerie that is used, with the bundled pendulum as its only model."""

    class MenagerieError(Exception):
        pass

    class DownloadError(MenagerieError):
        pass

    def names(self) -> list[str]:
        return ["pendulum"]

    def get(self, name: str) -> "Menagerie":
        return self

    def xml(self, entry: str | None) -> Path:
        if entry not in (None, "scene"):
            raise self.MenagerieError(f"'pendulum' has no entry point {entry!r}")
        return Path(SCENE)


@pytest.mark.medium
def test_a_model_of_the_menagerie(pendulum_log: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", Menagerie("mujoco_menagerie"))
    for number, model in enumerate(("menagerie:pendulum", "menagerie:pendulum/scene")):
        assert run(["init", model, str(pendulum_log), "-o", str(tmp_path / str(number))]) == 0
        assert (tmp_path / str(number) / "scene.xml").is_file()
    call = [str(pendulum_log), "-o", str(tmp_path / "out")]
    assert run(["init", "menagerie:pendulun", *call]) == 2
    assert "no model of the menagerie 'pendulun' (did you mean 'pendulum'?)" in capsys.readouterr().err
    assert run(["init", "menagerie:pendulum/mjx", *call]) == 2
    assert "'pendulum' has no entry point 'mjx'" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    assert run(["init", "menagerie:pendulum", *call]) == 2
    assert "pip install 'amhe[robots]'" in capsys.readouterr().err


@pytest.mark.medium
def test_a_model_of_the_menagerie_without_a_network(
    pendulum_log: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    pytest.importorskip("mujoco_menagerie")
    monkeypatch.setenv("MENAGERIE_BASE_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path / "cache"))
    assert run(["init", "menagerie:unitree_go2", str(pendulum_log), "-o", str(tmp_path / "out")]) == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert f"offline, copy the folder {tmp_path}/cache/models/unitree_go2-" in printed


@pytest.mark.medium
def test_the_commands_of_the_docs_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pendulum_log: Path
) -> None:
    page = (ROOT / "docs" / "your_model.md").read_text(encoding="utf-8")
    section = page.split("## Robots from URDF and the menagerie")[1].split("\n## ")[0]
    commands = re.findall(r"^amhe (init .*)$", section, re.MULTILINE)
    assert len(commands) == 4
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", Menagerie("mujoco_menagerie"))
    monkeypatch.chdir(tmp_path)
    text = ARM.replace("//parts", "//arm_description")
    for package in ("arm_description", "ws/src/arm_description"):
        mesh_file(tmp_path / package / "meshes" / "a.stl")
    Path("arm_description/urdf").mkdir()
    Path("arm_description/urdf/arm.urdf").write_text(text)
    Path("arm.urdf").write_text(text)
    shutil.copy(pendulum_log, "run.mcap")
    for command in commands:
        name = "menagerie:pendulum" if "menagerie" in command else command.split()[1]
        assert run(["init", name, *command.split()[2:], "--force"]) == 0
