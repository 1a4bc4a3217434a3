"""What the shell offers on TAB, beyond options, choices and paths.

The functions are `shell_complete=` of options. They import nothing heavy: a shell waits for the answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from glob import escape
from pathlib import Path

import click
from click.shell_completion import CompletionItem

from amhe_cli.cli.kinds import LOG

#: The system of commands that were given no log.
_ONLY = "go1_push"

Completer = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]


def systems(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Bundled systems, system folders that begin so, and any other folder by the shell."""
    from amhe_cli.system.description.folders import FILE_NAME, bundled_systems

    start, _, name = incomplete.rpartition("/")
    near = sorted(Path(start or ".").glob(f"{escape(name)}*/{FILE_NAME}"))
    names = [*bundled_systems(), *(str(path.parent) for path in near)]
    return [CompletionItem(incomplete, type="dir"), *_beginning(names, incomplete)]


def parameters(ending: str = "") -> Completer:
    """Names of the system's parameters, with commas between them, each with an ending such as '='."""

    def complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        from amhe_cli.core.errors import AmheError
        from amhe_cli.system.description.folders import bundled_systems, find_system, parameter_names

        given = ctx.params.get("system")
        try:
            folder = find_system(given) if given else bundled_systems()[_named_by_log(ctx) or _ONLY]
        except (AmheError, KeyError):
            return []
        return _listed((name + ending for name in parameter_names(folder)), incomplete)

    return complete


def listed(names: Iterable[str]) -> Completer:
    """Some of these names, with commas between them."""
    known = tuple(names)
    return lambda ctx, param, incomplete: _listed(known, incomplete)


def _named_by_log(ctx: click.Context) -> str | None:
    """The system that the first log on the command line names."""
    if not ctx.args:  # click leaves the words before an option without a value there
        return None
    from amhe_cli.core.errors import AmheError
    from amhe_cli.logs import read_metadata

    try:
        return read_metadata(LOG.convert(ctx.args[0], None, ctx)).get("system")
    except (AmheError, OSError, click.BadParameter):
        return None


def _beginning(names: Iterable[str], incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(name) for name in names if name.startswith(incomplete)]


def _listed(names: Iterable[str], incomplete: str) -> list[CompletionItem]:
    done, comma, _ = incomplete.rpartition(",")
    return _beginning((f"{done}{comma}{name}" for name in names if name not in done.split(",")), incomplete)
