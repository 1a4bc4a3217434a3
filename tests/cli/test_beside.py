"""`amhe.toml` beside the logs: their system, noise, priors and settings."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from amhe_cli.cli.inputs import Inputs
from amhe_cli.cli.main import run
from amhe_cli.cli.settings import Overrides
from amhe_cli.core.errors import ConfigError
from tests.conftest import MODELS

SAID = """\
system = "mine"
[noise]
joints.position = 0.007
[priors]
load_mass = 0.7
damping = {nominal = 0.03, prior_sd = 0.2}
[settings]
clips.count = 7
"""


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A table that names no system, beside a system folder and what belongs to both."""
    shutil.copytree(MODELS / "pendulum", tmp_path / "logs" / "mine")
    (tmp_path / "logs" / "amhe.toml").write_text(SAID)
    path = tmp_path / "logs" / "run1.csv"
    path.write_text("time,q\n0,0.1\n0.01,0.1\n")
    return path


def test_what_is_said_beside_the_logs_holds(log: Path) -> None:
    system = Inputs().open([log])
    assert system.folder is not None and system.folder.resolve() == log.with_name("mine").resolve()
    assert system.space.named(system.space.nominal)["load_mass"] == pytest.approx(0.7)
    assert {p.name: p.prior_sd for p in system.space.parameters}["damping"] == pytest.approx(0.2)
    assert system.settings.clips.count == 7
    (position,) = (one for one in system.channels if one.key == "joints.position")
    assert position.noise == pytest.approx(0.007)


def test_options_win_and_another_system_is_not_concerned(log: Path) -> None:
    system = Inputs(overrides=Overrides({}, {"clips": {"count": 3}})).open([log])
    assert system.settings.clips.count == 3
    other = Inputs(system="pendulum").open([log])
    assert other.settings.clips.count != 7
    assert Inputs(system=log.with_name("mine")).open([log]).settings.clips.count == 7


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("sytem = 1", "no key 'sytem' (did you mean 'system'?)"),
        ("system = ", "amhe.toml: "),
        ('system = "nowhere"', "no system 'nowhere'"),
        ('system = "mine"\n[priors]\nmass = 1', "mass"),
    ],
)
def test_a_mistake_in_it_is_one_line(log: Path, text: str, said: str, capsys) -> None:
    log.with_name("amhe.toml").write_text(text)
    assert run(["identify", str(log), "-o", "out"]) == 2
    assert said in capsys.readouterr().err


def test_logs_of_two_folders_are_refused(log: Path, tmp_path: Path) -> None:
    other = shutil.copy(log, tmp_path / "run2.csv")
    with pytest.raises(ConfigError, match="beside some of the logs only"):
        Inputs().open([log, Path(other)])
