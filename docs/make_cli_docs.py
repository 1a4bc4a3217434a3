"""Write docs/cli.md from the commands' own help: `make docs`."""

import re
from copy import copy
from pathlib import Path
from typing import Any

import click

from amhe_cli.cli import options
from amhe_cli.cli.command import Command
from amhe_cli.cli.main import amhe

WIDE: dict[str, Any] = {"terminal_width": 100, "max_content_width": 100}
FILE = Path(__file__).with_name("cli.md")

HEAD = """\
# The command line

This page is written by `make docs` from the commands' own help; a test holds that it is current.

| exit code | meaning |
|---|---|
| 0 | done |
| 1 | failed: the data were read, but the run came to no result (of `run`: a fall, a task not done) |
| 2 | usage or configuration; a path that does not exist |
| 3 | with `--strict`: done, with a warning |
| 4 | an input exists but cannot be read |
| 130, 143 | interrupted (Ctrl-C), terminated (SIGTERM, SIGHUP); an estimation writes the best so far |

Results go to stdout, everything else to stderr. With `--json` stdout is one JSON object, the content of
`result.json`. A setting comes from, in this order: `--set`, the environment (`AMHE_CLIPS__COUNT=40` for
`clips.count`), `--config`, `amhe.toml` beside the logs, the system's own `settings:`, its default. Files of a
command appear whole or not at all. `--for` and `--duration` are former names of `--seconds`.

## Completion

TAB completes commands, options and their choices, systems (bundled ones and folders), `example:` logs, tasks,
modes, targets, formats, the system's parameters, `menagerie:` models and files. One line in the shell's file
switches it on:

| shell | file | line |
|---|---|---|
| bash 4.4 or newer | `~/.bashrc` | `eval "$(amhe completion bash)"` |
| zsh | `~/.zshrc` | `eval "$(amhe completion zsh)"` |
| fish | `~/.config/fish/completions/amhe.fish` | `amhe completion fish \\| source` |
"""


#: Options that many commands have.
SHARED = (
    *options.where,
    *options.narrowing,
    options.belief_anyway,
    *options.work,
    *options.tuning,
    *options.output,
)


def document() -> str:
    """The whole page."""
    group = click.Context(amhe, info_name="amhe", **{**WIDE, **amhe.context_settings})
    parts = [
        HEAD,
        _section("`amhe`", amhe.get_help(group)),
    ]
    every = Command("COMMAND", add_help_option=False, params=list(SHARED))
    parts.append(
        _section("Options of many commands", every.get_help(click.Context(every, parent=group, **WIDE)))
    )
    for name in sorted(amhe.commands):
        command = copy(amhe.commands[name])
        also = [one.opts[0] for one in command.params if one in SHARED]
        command.params = [one for one in command.params if one not in SHARED]
        command.epilog = f"Also, of the options of many commands: {' '.join(also)}" if also else None
        context = click.Context(command, info_name=name, parent=group, **WIDE)
        parts.append(_section(f"`amhe {name}`", command.get_help(context)))
    return "\n".join(parts)


def _section(title: str, text: str) -> str:
    body = re.sub(r"\nCommon: .*?(\n\n|$)", r"\n", text, flags=re.DOTALL).strip()
    return f"## {title}\n\n```text\n{body}\n```\n"


if __name__ == "__main__":
    FILE.write_text(document(), encoding="utf-8")
