"""Settings from options, environment and files."""

from __future__ import annotations

from pathlib import Path

import pytest

from amhe_cli.cli.main import run
from amhe_cli.cli.settings import from_environment, gathered, merged, parse_set
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.settings import Settings
from amhe_cli.robots.go1.settings import PushSettings
from tests.conftest import MODELS, go1_system_with

LOGS = MODELS.parent / "examples" / "logs"


def test_options_are_nested_and_typed() -> None:
    options = [
        "clips.count=8",
        "clips.length=[0.3, 1e-1]",
        "logs.align=true",
        "signals.cube.topic=/x",
        "clips.count=9",
    ]
    assert parse_set(options) == {
        "clips": {"count": 9, "length": [0.3, 0.1]},
        "logs": {"align": True},
        "signals": {"cube": {"topic": "/x"}},
    }


@pytest.mark.parametrize("option", ["clips.count", "=3", ".a=3", "a..b=3"])
def test_what_is_no_assignment_is_refused(option: str) -> None:
    with pytest.raises(ConfigError, match="write KEY=VALUE"):
        parse_set([option])


def test_a_value_that_is_no_yaml_is_refused() -> None:
    with pytest.raises(ConfigError, match="is not a value"):
        parse_set(["clips.length=[1, 2"])


def test_environment_variables_have_two_underscores_between_levels() -> None:
    environment = {
        "AMHE_CLIPS__HELD_OUT_LENGTH": "0.4",
        "AMHE_PARAMETERS__load_mass__NOMINAL": "2",
        "AMHE_PARAMETERS__MASS__NOMINAL": "3",
        "AMHE_THREADS": "4",
        "HOME": "/home",
    }
    assert from_environment(environment) == {
        "clips": {"held_out_length": 0.4},
        "parameters": {"load_mass": {"nominal": 2}, "mass": {"nominal": 3}},
    }


def test_a_file_is_read_with_the_same_care(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("clips: {count: 3}\n")
    assert gathered(path, {}, []).shared == {"clips": {"count": 3}}
    path.write_text("clips: {count: 3, count: 4}\n")
    with pytest.raises(ConfigError, match="here twice"):
        gathered(path, {}, [])


def test_the_stronger_source_wins_key_by_key() -> None:
    weak, strong = {"a": {"b": 1, "c": 2}}, {"a": {"b": 3}}
    assert merged(weak, strong) == {"a": {"b": 3, "c": 2}}
    assert weak == {"a": {"b": 1, "c": 2}}


def test_shared_settings_of_a_robot_do_not_reach_a_system_without_it(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text("control: {samples: 8}\ngo1: {kp: 20}\nclips: {count: 3}\n")
    given = gathered(file, {"AMHE_CONTROL__HORIZON": "9", "AMHE_CLIPS__COUNT": "4"}, ["mhe.window=1"])
    common = {"clips": {"count": 4}, "mhe": {"window": 1}}
    assert given.suited(MODELS / "pendulum") == (common, Settings)
    robots = {"control": {"samples": 8, "horizon": 9}, "go1": {"kp": 20}}
    assert given.suited(MODELS / "go1_push") == (common | robots, PushSettings)


def test_a_log_states_the_weakest_settings() -> None:
    given = gathered(None, {"AMHE_CLIPS__COUNT": "4"}, [])
    settings, _ = given.suited(MODELS / "pendulum", {"clips": {"count": 1, "still": 2}})
    assert settings == {"clips": {"count": 4, "still": 2}}


def test_an_option_of_a_robot_is_refused_by_name_where_there_is_none(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    line = ["identify", str(LOGS / "pendulum.mcap"), "--set", "control.samples=8", "-o", str(out)]
    assert run(line) == 2
    assert "--set control.samples: a setting of the robot go1, which the system pendulum does not have" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize(
    "command",
    [
        ("identify", str(LOGS / "t1.mcap")),
        ("mhe-replay", str(LOGS / "t1.mcap"), "--to", "1.2"),
        ("probe", "--dry-run"),
    ],
)
def test_misspelt_settings_of_a_robot_are_refused(
    command: tuple[str, ...], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    wrong = ("--set", "control.nope=1", "--set", "go1.zz=3", "-o", str(tmp_path / "out"))
    assert run([*command, *wrong]) == 2
    err = capsys.readouterr().err
    assert "setting control.nope: no key 'nope'" in err
    assert "setting go1.zz: no key 'zz'" in err


@pytest.mark.parametrize("command", ["identify", "mhe-replay", "inspect", "probe"])
def test_misspelt_settings_of_a_robot_in_its_file_have_their_place(
    command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder = tmp_path / "mine"
    row = go1_system_with("  control: {nope: 3}", folder)
    log = [] if command == "probe" else [str(LOGS / "t1.mcap")]
    out = [] if command == "inspect" else ["-o", str(tmp_path / "out")]
    assert run([command, *log, "--system", str(folder), *out]) == 2
    # a long line is broken where it is shown
    assert f"system.yaml:{row}:13: no key 'nope'" in capsys.readouterr().err
