"""`amhe init` from the outside; what it guesses is tested with the systems."""

import json
from pathlib import Path

from amhe_cli.cli.main import run
from tests.conftest import MODELS

SCENE = str(MODELS / "pendulum" / "scene.xml")


def test_it_writes_a_system_that_the_log_suits(pendulum_log: Path, tmp_path: Path, capsys) -> None:
    system = tmp_path / "mine"
    assert run(["init", SCENE, str(pendulum_log), "-o", str(system)]) == 0
    assert "system.yaml" in capsys.readouterr().out
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
