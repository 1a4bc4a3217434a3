"""The option of a file that is written, and --force, which writes over one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from amhe_cli.cli import options
from amhe_cli.core.errors import ConfigError


def fresh_file(name: str, *names: str, use: str, metavar: str = "FILE") -> Callable[[options.F], options.F]:
    """A file as of `options.new_file`, and --force: without it an existing file is refused, before any work.

    Args:
        name: Name of the argument.
        names, use, metavar: See `options.new_file`.
    """

    def checked(**given: Any) -> Path | None:
        path: Path | None = given[name]
        if path is not None and path.exists() and not given["force"]:
            raise ConfigError(f"{path}: exists; choose another name, or give `force=True` to write over it")
        return path

    over = click.option("--force", is_flag=True, help=f"Write over {metavar} where it exists.")
    return options.bundled(
        name, checked, (name, "force"), options.new_file(*names, use=use, metavar=metavar), over
    )
