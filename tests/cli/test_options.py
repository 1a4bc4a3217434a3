"""How many options a command has, and what became of those that it has no more."""

import click
import pytest

from amhe_cli.cli import options
from amhe_cli.cli.main import GROUPS, amhe, run
from amhe_cli.cli.parsing import GONE

#: Options of a command beyond those that many commands share.
MOST = 16


def options_in(command: click.Command) -> set[str]:
    """Names of the arguments that a command's options give; four flags of one choice count once."""
    return {str(param.name) for param in command.params if isinstance(param, click.Option)}


@options.common
@options.where
@options.work
@options.tuning
@options.out
def _shared() -> None:
    """Has what many commands share."""


SHARED = options_in(click.command()(_shared))


@pytest.mark.parametrize("name", amhe.commands)
def test_a_command_has_at_most_16_options_of_its_own(name: str) -> None:
    assert len(options_in(amhe.commands[name]) - SHARED) <= MOST, "make the rarest a setting"


REPLACED = [(command, option, new) for command, gone in GONE.items() for option, new in gone.items()]


@pytest.mark.parametrize(("command", "option", "instead"), REPLACED)
def test_a_former_option_says_what_replaced_it(capsys, command: str, option: str, instead: str) -> None:
    assert run([command, option, "1"]) == 2
    said = f"no such option {option} any more: use {instead} (see 'amhe {command} --help')"
    assert capsys.readouterr().err == f"amhe {command}: error: {said}\n"


@pytest.mark.parametrize(("command", "option", "instead"), REPLACED)
def test_what_replaces_an_option_exists(command: str, option: str, instead: str) -> None:
    from amhe_cli.robots.go1.settings import PushSettings

    first, *rest = instead.split()
    if not first.startswith("-"):
        assert first == "xacro" or rest[0] in amhe.commands
        return
    assert any(first in param.opts for param in amhe.commands[command].params)
    if rest:
        key, _, _ = rest[0].partition("=")
        group, name, *_ = key.split(".")
        assert name in type(getattr(PushSettings(), group)).model_fields


def test_help_lists_each_command_once_in_a_group(capsys) -> None:
    assert run(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    named = [line.split()[0] for line in lines[lines.index("Start:") :] if line.startswith("  ")]
    assert sorted(named) == sorted(amhe.commands)
    assert [line.rstrip(":") for line in lines if line.rstrip(":") in GROUPS] == list(GROUPS)
