"""The library's arguments are options on the command line."""

import pytest

from amhe_cli.cli.command import options_of
from amhe_cli.cli.main import amhe
from amhe_cli.cli.session import in_options

SHOWN = [
    ("identify", "`held_out`: a.mcap is fitted too", "--held-out: a.mcap is fitted too"),
    ("identify", "`end`: 1 is not after `start` 2", "--to: 1 is not after --from 2"),
    ("identify", "`logs`: there is none", "LOG: there is none"),
    ("identify", "correct it with `logs.align=true`", "correct it with --set logs.align=true"),
    ("identify", "give it more with `identify.iterations`", "give it more with --set identify.iterations"),
    ("run", "or use `mode=baseline`", "or use --mode baseline"),
    ("run", "both need the same `go1.slow`", "both need the same --set go1.slow"),
    ("pool", "give `force=True` to write into it", "give --force to write into it"),
    ("pool", "give `out`", "give -o"),
    ("init", "`meshes=False` to do without", "--no-meshes to do without"),
    ("export", "`to`: one of urdf, mjcf", "--to: one of urdf, mjcf"),
    ("inspect", "call it `time`, or `time [ms]`; see `amhe inspect`", None),
    ("inspect", "give more with `logs.align`", None),
    ("identify", "`motors.q` is a field", None),
    ("pool", "`held_out` is of another command", None),
]


@pytest.mark.parametrize(("command", "text", "shown"), SHOWN)
def test_arguments_become_options_of_the_command(command: str, text: str, shown: str | None) -> None:
    assert in_options(text, options_of(amhe.commands[command])) == (text if shown is None else shown)
