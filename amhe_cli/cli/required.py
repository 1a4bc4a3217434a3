"""`--require 'NAME<5%'`: how precisely parameters must be known, for scripts that ask by the exit code."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import click

from amhe_cli.core.errors import ConfigError, one_of

if TYPE_CHECKING:
    from amhe_cli.estimation.core.result import ParameterResult
    from amhe_cli.system.system import System

_REQUIRED = re.compile(r"^\s*([\w.*-]+)\s*<\s*([0-9.]+)\s*%\s*$")


def required(ctx: click.Context, param: click.Parameter, given: Sequence[str]) -> dict[str, float]:
    """NAME<5% -> the largest share."""
    found = {}
    for text in given:
        match = _REQUIRED.match(text)
        if match is None:
            raise click.BadParameter(f"{text!r} is not of the form 'NAME<5%'", ctx, param)
        found[match.group(1)] = float(match.group(2)) / 100.0
    return found


def names_of(system: System) -> list[str]:
    """What may be required: the parameters of a system, and the numbers of bodies that they make."""
    bodies = system.edits.inertias(system.space.nominal[None])
    return [*system.space.names, *(f"{body}.{number}" for body, numbers in bodies for number in numbers)]


def matching(names: Sequence[str], require: Mapping[str, float]) -> dict[str, list[str]]:
    """The parameters that each name or pattern means.

    Raises:
        ConfigError: It means none.
    """
    found = {pattern: [name for name in names if fnmatchcase(name, pattern)] for pattern in require}
    for pattern, alike in found.items():
        if not alike:
            raise ConfigError(f"`require`: {one_of('parameter', pattern, names)}")
    return found


def missed_of(parameters: Sequence[ParameterResult], require: Mapping[str, float], known: str) -> list[str]:
    """What is required of parameters and not reached, in words.

    Args:
        parameters: What is known of them.
        require: Name or pattern -> the largest sd, as a share of the value.
        known: 'known', or 'expected to be known'.
    """
    from amhe_cli.report.check import relative

    alike, shares = matching([p.name for p in parameters], require), {p.name: relative(p) for p in parameters}
    return [
        f"{name} is {known} to {100 * shares[name]:.2g} %, not {100 * most:g} %"
        for pattern, most in require.items()
        for name in alike[pattern]
        if shares[name] > most
    ]
