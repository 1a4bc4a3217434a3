"""Bundled logs by name, from any folder."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from amhe_cli.cli.main import amhe, run


def test_an_example_is_found_by_its_name_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["inspect", "example:pendulum"]) == 0
    assert "usable" in capsys.readouterr().out
    assert run(["inspect", "example:pendulun"]) == 2
    assert (
        "no example 'pendulun' (did you mean 'pendulum'?); there is: pendulum, t1, t4"
        in capsys.readouterr().err
    )


def test_the_shell_completes_examples() -> None:
    environment = {
        "_AMHE_COMPLETE": "bash_complete",
        "COMP_WORDS": "amhe inspect example:t",
        "COMP_CWORD": "2",
    }
    result = CliRunner().invoke(amhe, [], prog_name="amhe", env=environment)
    assert {line.partition(",")[2] for line in result.output.split()} == {"example:t1", "example:t4"}
