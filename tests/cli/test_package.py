"""What `pip install` brings: a wheel that needs no clone beside it."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder that the wheel was unpacked to."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "wheel"]
    subprocess.run(
        [*pip, "--no-deps", "--no-build-isolation", "--wheel-dir", folder, ROOT], check=True, cwd=folder
    )
    (wheel,) = folder.glob("amhe-*.whl")
    zipfile.ZipFile(wheel).extractall(folder / "site")
    return folder / "site"


def test_the_wheel_carries_systems_logs_and_templates(installed: Path) -> None:
    bundled = installed / "amhe_cli" / "_bundled"
    assert (bundled / "models" / "pendulum" / "system.yaml").is_file()
    assert (bundled / "models" / "cube_toss" / "system.yaml").is_file()
    for log in ("pendulum", "pusher", "t1", "t4"):
        assert (bundled / "examples" / "logs" / f"{log}.mcap").is_file()
    assert (installed / "amhe_cli" / "report" / "templates" / "report.css").is_file()
    assert not (installed / "tests").exists()


def test_the_installed_command_works_anywhere(installed: Path, tmp_path: Path) -> None:
    log = installed / "amhe_cli" / "_bundled" / "examples" / "logs" / "pendulum.mcap"
    done = subprocess.run(
        [sys.executable, "-m", "amhe_cli", "inspect", log],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "usable: " in done.stdout
