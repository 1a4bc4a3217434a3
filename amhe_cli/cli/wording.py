"""The library speaks of arguments, in backquotes; on the command line they are options."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    import click

_QUOTED = re.compile(r"`([a-z_0-9]+)((?:\.\w+)*)(?:=([^`]*))?`")


def options_of(command: click.Command) -> dict[str, str]:
    """Argument of the library -> what the user of a command types: `held_out` -> --held-out, `logs` -> LOG.

    An argument is called as its option is, or as the command's own code calls it: `start` is --from.
    """
    shown: dict[str, str] = {}
    for param in command.params:
        typed = param.opts[0]
        if not typed.startswith("-"):
            metavar: str | None = getattr(param, "metavar", None)
            typed = (metavar or typed.upper()).strip(".[]")
        for name in (str(param.name), *(option.strip("-").replace("-", "_") for option in param.opts)):
            shown.setdefault(name, typed)
    return shown


def in_options(text: str, options: Mapping[str, str]) -> str:
    """A text of the library as the user of a command reads it; other words in backquotes stay.

    Args:
        text: The text.
        options: See `options_of`.
    """

    def typed(match: re.Match[str]) -> str:
        name, rest, value = match.groups()
        if rest:
            setting = f"{name}{rest}" if value is None else f"{name}{rest}={value}"
            return f"--set {setting}" if "assignments" in options and name in _groups() else match.group()
        option = options.get(f"no_{name}" if value == "False" else name)
        if option is None:
            return match.group()
        return option if value in (None, "True", "False") else f"{option} {value}"

    return _QUOTED.sub(typed, text)


def _groups() -> set[str]:
    """Groups of settings: `logs.align=true` is --set logs.align=true."""
    from amhe_cli.cli.settings import groups

    return groups()
