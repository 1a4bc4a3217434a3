"""The options --belief, --belief-anyway, --fix and --only: what is known before a log is read."""

from __future__ import annotations

from collections.abc import Callable

import click

from amhe_cli.cli import completion, options

belief_anyway = click.option(
    "--belief-anyway",
    is_flag=True,
    help="Take a belief about another model too, and only warn of what has changed.",
)


def believed(about: str) -> Callable[[options.F], options.F]:
    """A belief to start from, and whether it may be about another model."""
    return options.stacked(
        click.option("--belief", type=options.EXISTING_FILE, metavar="FILE", help=about),
        belief_anyway,
    )


def _values(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> dict[str, float]:
    """NAME=value, repeated, as a dictionary."""
    values: dict[str, float] = {}
    for text in value:
        name, _, number = text.partition("=")
        if (name := name.strip()) in values:
            raise click.BadParameter(f"{name} is given twice; leave one of them out", ctx, param)
        try:
            values[name] = float(number)
        except ValueError:
            raise click.BadParameter(f"{text!r} is not of the form NAME=value", ctx, param) from None
    return values


def _names(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> list[str] | None:
    """NAME,NAME, repeated, as a list."""
    return [name.strip() for text in value for name in text.split(",")] or None


narrowing = options.stacked(
    click.option(
        "--fix",
        metavar="NAME=VALUE",
        shell_complete=completion.parameters("="),
        multiple=True,
        callback=_values,
        help="Take a parameter as known; it is not estimated. Repeat for more.",
    ),
    click.option(
        "--only",
        metavar="NAME,NAME",
        shell_complete=completion.parameters(),
        multiple=True,
        callback=_names,
        help="Estimate these parameters (names, or patterns such as 'left_*') and fix all others.",
    ),
)
