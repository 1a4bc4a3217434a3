"""Settings of the robot: they stand in the system's file, and only the robot's room checks them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.robots.go1.settings import PushSettings, settings_of
from amhe_cli.system.system import System
from tests.conftest import go1_system_with

_PROGRAM = """
import sys
from amhe_cli.system.system import System
System.load("go1_push", {"go1": {"kp": 3.0}, "control": {"sigma_hip": 0.01}})
print([name for name in sys.modules if name.startswith(("amhe_cli.robots", "amhe_cli.control"))])
"""


@pytest.mark.medium
def test_a_system_is_loaded_without_its_robot() -> None:
    loaded = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True)
    assert loaded.stdout.strip() == "[]"


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
