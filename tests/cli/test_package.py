"""What `pip install` brings: a wheel that needs no clone beside it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.view.browser import PIXELS, browser, needs_chromium

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder that the wheel was installed into."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run(
        [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, ROOT],
        check=True,
        cwd=folder,
    )
    (wheel,) = folder.glob("amhe-*.whl")
    subprocess.run(
        [*pip, "install", "--no-deps", "--no-index", "--target", folder / "site", wheel], check=True
    )
    return folder / "site"


def test_the_wheel_carries_systems_logs_and_templates(installed: Path) -> None:
    bundled = installed / "amhe_cli" / "_bundled"
    assert (bundled / "models" / "pendulum" / "system.yaml").is_file()
    assert (bundled / "models" / "cube_toss" / "system.yaml").is_file()
    for log in ("pendulum", "pusher", "t1", "t4"):
        assert (bundled / "examples" / "logs" / f"{log}.mcap").is_file()
    assert (installed / "amhe_cli" / "report" / "templates" / "report.css").is_file()
    assert not (installed / "tests").exists()


@pytest.mark.slow
@needs_chromium
def test_a_page_of_the_installed_command_opens_and_plays(installed: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    subprocess.run(
        [sys.executable, "-m", "amhe_cli", "view", "example:pendulum", "--save", page],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(installed)},
        check=True,
    )
    with browser(tmp_path) as one:
        one.cut_off()
        one.open(page.as_uri())
        first, colors = one.run(PIXELS)
        assert colors > 50
        one.run("document.getElementById('play').click()")
        one.run("new Promise((done) => setTimeout(done, 500))")
        assert one.run(PIXELS)[0] != first
        assert one.run("document.getElementById('failure').hidden")
        assert one.requests == [page.as_uri()]


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
