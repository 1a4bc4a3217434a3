"""How many options a command has, and how help shows them."""

import click
import pytest

from amhe_cli.cli import options
from amhe_cli.cli.command import command
from amhe_cli.cli.main import GROUPS, amhe, run

#: Options of a command beyond those that many commands share.
MOST = 16


def options_in(command: click.Command) -> set[str]:
    """Names of the arguments that a command's options give; four flags of one choice count once."""
    return {str(param.name) for param in command.params if isinstance(param, click.Option)}


SHARED = options_in(
    command("t", options.where, options.narrowing, options.work, options.tuning, options.output)(
        lambda session, given: None
    )
)


@pytest.mark.parametrize("name", amhe.commands)
def test_a_command_has_at_most_16_options_of_its_own(name: str) -> None:
    assert len(options_in(amhe.commands[name]) - SHARED) <= MOST, "make the rarest a setting"


@pytest.mark.parametrize("former", ["--for", "--duration"])
def test_a_length_is_in_seconds_by_any_of_its_names(former: str, capsys) -> None:
    assert run(["run", "--task", "t1", former, "x"]) == run(["run", "--task", "t1", "--seconds=x"]) == 2
    assert len(set(capsys.readouterr().err.splitlines())) == 1


def test_help_has_panels_and_one_line_of_what_is_common(capsys) -> None:
    assert run(["help", "identify"]) == 0
    shown = capsys.readouterr().out
    assert run(["identify", "--help"]) == 0
    assert capsys.readouterr().out == shown
    panels = [line.rstrip(":") for line in shown.splitlines() if line.endswith(":") and line[0] != " "]
    assert panels == ["Logs and system", "What is known", "Options", "Computing", "Settings", "Output"]
    assert sum("--strict" in line for line in shown.splitlines()) == 1
    assert run(["help", "identfy"]) == 2
    assert "did you mean 'identify'" in capsys.readouterr().err


def test_what_comes_with_amhe_is_listed(capsys) -> None:
    from amhe_cli.core.bundled import bundled_logs
    from amhe_cli.system.description.folders import bundled_systems

    assert run(["examples"]) == run(["systems"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name in bundled_logs():
        (line,) = (line for line in lines if line.startswith(f"example:{name} "))
        assert len(line.split()) > 3, "it says what the log is"
    assert {line.split()[0] for line in lines} >= set(bundled_systems())


def test_help_lists_each_command_once_in_a_group(capsys) -> None:
    assert run(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    named = [line.split()[0] for line in lines[lines.index("Start:") :] if line.startswith("  ")]
    assert sorted(named) == sorted(amhe.commands)
    assert [line.rstrip(":") for line in lines if line.rstrip(":") in GROUPS] == list(GROUPS)
