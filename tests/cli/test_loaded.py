"""A command loads what it needs: another robot's code, or a link to a robot, is not in the way."""

import subprocess
import sys
from pathlib import Path

import pytest

LOGS = Path(__file__).parents[2] / "examples" / "logs"
LOG = LOGS / "pendulum.mcap"
FOREIGN = ("amhe_cli.control", "amhe_cli.live", "amhe_cli.robots")
SCRIPT = """
import sys
from amhe_cli.cli.main import main
try:
    main()
except SystemExit as end:
    assert end.code == 0, end.code
print(*(name for name in sys.modules if name.startswith("amhe_cli.")), file=sys.stderr)
"""


def loaded(*arguments: str) -> set[str]:
    """Modules of the package that a command has loaded by its end."""
    command = [sys.executable, "-c", SCRIPT, *arguments, "--threads", "1", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(done.stderr.splitlines()[-1].split())


@pytest.mark.medium
@pytest.mark.parametrize(
    "command",
    [
        ("mhe-replay", str(LOG), "--to", "1"),
        ("identify", str(LOG), "--to", "3", "--max-time", "1"),
    ],
)
def test_a_pendulum_needs_no_robot_and_no_controller(command: tuple[str, ...], tmp_path: Path) -> None:
    modules = loaded(*command, "--out", str(tmp_path / "out"))
    assert "amhe_cli.report.page" in modules
    assert not {name for name in modules if name.startswith(FOREIGN)}


@pytest.mark.medium
def test_settings_of_a_robot_are_checked_without_the_robot(tmp_path: Path) -> None:
    command = ("mhe-replay", str(LOGS / "t1.mcap"), "--to", "1.2", "--set", "control.samples=9")
    modules = loaded(*command, "--out", str(tmp_path / "out"))
    rooms = {"amhe_cli.control", "amhe_cli.robots", "amhe_cli.robots.go1"}
    settings = {"amhe_cli.control.settings", "amhe_cli.robots.go1.settings"}
    assert {name for name in modules if name.startswith(FOREIGN)} == rooms | settings


def test_settings_of_a_robot_need_no_simulator() -> None:
    code = "import sys, amhe_cli.robots.go1.settings; assert 'mujoco' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_simulated_run_loads_neither_link_nor_poses(tmp_path: Path) -> None:
    modules = loaded("run", "--task", "t1", "--duration", "0.04", "--out", str(tmp_path / "out"))
    assert "amhe_cli.robots.go1.plant" in modules
    wire = tuple(f"amhe_cli.robots.go1.{room}" for room in ("link", "poses", "emulator", "probing"))
    assert not {name for name in modules if name.startswith(wire)}
