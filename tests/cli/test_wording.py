"""The library's arguments are options on the command line."""

import pytest

from amhe_cli.cli.main import amhe
from amhe_cli.cli.wording import _ALIKE, _OTHERS, in_options


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("`held_out`: a.mcap is fitted too", "--held-out: a.mcap is fitted too"),
        ("`end`: 1 is not after `start` 2", "--to: 1 is not after --from 2"),
        ("correct it with `logs.align=true`", "correct it with --set logs.align=true"),
        ("give it more with `identify.iterations`", "give it more with --set identify.iterations"),
        ("or use `mode=baseline`", "or use --mode baseline"),
        ("give `force=True` to write into it", "give --force to write into it"),
        (
            "call it `time`, or `time [ms]`; see `amhe inspect`",
            "call it `time`, or `time [ms]`; see `amhe inspect`",
        ),
        ("`motors.q` is a field", "`motors.q` is a field"),
    ],
)
def test_arguments_become_options(text: str, shown: str) -> None:
    assert in_options(text) == shown


def test_every_option_that_is_named_exists() -> None:
    options = {option for command in amhe.commands.values() for p in command.params for option in p.opts}
    named = {"--" + name.replace("_", "-") for name in _ALIKE} | set(_OTHERS.values()) - {"LOG"}
    assert named <= options
