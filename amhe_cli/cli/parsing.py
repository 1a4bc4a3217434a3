"""What an option may be, and how several become one argument of a command."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import click

from amhe_cli.cli.session import Session
from amhe_cli.cli.wording import options_of
from amhe_cli.core.errors import ConfigError

F = TypeVar("F", bound=Callable[..., Any])
V = TypeVar("V")


EXISTING_FILE = click.Path(exists=True, dir_okay=False, readable=False, path_type=Path)
EXISTING_FOLDER = click.Path(exists=True, file_okay=False, readable=False, path_type=Path)


class Number(click.FloatRange):
    """A finite number; click would call it a float range, and let nan through."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Refuse what no comparison refuses."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


class WholeNumber(click.IntRange):
    """A whole number; click would call it an integer range."""

    name = "whole number"


#: Option that a command had once -> what the user types instead.
_SLOW = {"--slow": "--set go1.slow=X"}
#: Command -> its former options.
GONE: dict[str, dict[str, str]] = {
    "run": _SLOW
    | {
        "--realtime": "--set control.realtime=true",
        "--window": "--set mhe.window=S",
        "--update-period": "--set mhe.update_period=S",
        "--samples": "--set mhe.samples=B",
        "--iterations": "--set mhe.iterations=L",
        "--learning-rate": "--set mhe.learning_rate=A",
        "--prior-weight": "--set mhe.prior_weight.NAME=W",
        "--video": "amhe view RESULT, or --view while it runs",
    },
    "inspect": {"--layout": "amhe view LOG"},
    "init": {"--xacro-arg": "xacro FILE NAME:=VALUE > robot.urdf"},
    "probe": _SLOW
    | {
        "--speed": "--set probe.speed=X",
        "--rate": "--set probe.rate=HZ",
        "--plan-only": "--dry-run",
    },
    "calibrate": _SLOW,
    "mhe-replay": {"--view": "amhe view RESULT"},
    "emulate": _SLOW
    | {"--view": "amhe run --target go1 --view"}
    | {
        f"--{body}-offset": f"--set go1.{body}_offset=[X,Y,Z,RX,RY,RZ]" for body in ("trunk", "box")
    },
}  # fmt: skip


class Command(click.Command):
    """A command that listens to the library's log from the moment its options are known."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the options; of one that is no more, say what replaced it."""
        session = ctx.ensure_object(Session)
        session.name, session.command, session.options = str(self.name), ctx.command_path, options_of(self)
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            if instead := GONE.get(str(self.name), {}).get(error.option_name):
                raise click.UsageError(
                    f"no such option {error.option_name} any more: use {instead}", ctx
                ) from None
            raise

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command's body."""
        ctx.ensure_object(Session).begin()
        return super().invoke(ctx)


def pairs(
    kind: Callable[[str], V],
) -> Callable[[click.Context, click.Parameter, Sequence[str]], dict[str, V]]:
    """A callback that makes a dictionary of SIGNAL=/name or the like; the option's metavar shows the form.

    Args:
        kind: Makes a value of its text, or raises ValueError.
    """

    def gathered(ctx: click.Context, param: click.Parameter, given: Sequence[str]) -> dict[str, V]:
        form = str(param.metavar)  # pyright: ignore[reportAttributeAccessIssue]
        values: dict[str, V] = {}
        for text in given:
            key, _, value = text.partition("=")
            if (key := key.strip()) in values:
                raise click.BadParameter(f"{key} is given twice; leave one of them out", ctx, param)
            try:
                if not (key and value):
                    raise ValueError
                values[key] = kind(value)
            except ValueError:
                raise click.BadParameter(f"{text!r} is not of the form {form}", ctx, param) from None
        return values

    return gathered


def listed(ctx: click.Context, param: click.Parameter, given: str | Sequence[str] | None) -> tuple[str, ...]:
    """NAME,NAME, perhaps repeated, as a tuple; each once."""
    texts = [given] if isinstance(given, str) else given or ()
    parts = [name.strip() for text in texts for name in text.split(",")]
    return tuple(dict.fromkeys(name for name in parts if name))


def _in_existing_folder(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    """A file that will be written: better refused now than after the first minutes of work."""
    if value is not None and not value.absolute().parent.is_dir():
        raise click.BadParameter(f"there is no folder '{value.parent}'", ctx, param)
    return value


def new_file(*names: str, use: str, metavar: str = "FILE") -> Callable[[F], F]:
    """A file that will be written, in a folder that exists; `use` says what for."""
    kind = click.Path(dir_okay=False, path_type=Path)
    return click.option(*names, type=kind, callback=_in_existing_folder, metavar=metavar, help=use)


def fresh_file(name: str, *names: str, use: str, metavar: str = "FILE") -> Callable[[F], F]:
    """A `new_file`, and --force: without it an existing file is refused, before any work.

    Args:
        name: Name of the argument.
        names, use, metavar: See `new_file`.
    """

    def checked(**given: Any) -> Path | None:
        path: Path | None = given[name]
        if path is not None and path.exists() and not given["force"]:
            raise ConfigError(f"{path}: exists; choose another name, or give `force=True` to write over it")
        return path

    over = click.option("--force", is_flag=True, help=f"Write over {metavar} where it exists.")
    return bundled(name, checked, (name, "force"), new_file(*names, use=use, metavar=metavar), over)


def stacked(*decorators: Callable[[F], F]) -> Callable[[F], F]:
    """Several options as one."""

    def decorate(function: F) -> F:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return decorate


def bundled(
    name: str, make: Callable[..., Any], keys: Sequence[str], *decorators: Callable[[F], F]
) -> Callable[[F], F]:
    """Several options as one argument of the command.

    Args:
        name: Name of the argument.
        make: Makes it of the options' values, which are given by name when the command begins.
        keys: Names of the options' values.
        decorators: The options.
    """

    def decorate(function: F) -> F:
        @wraps(function)
        def command(*args: Any, **values: Any) -> Any:
            own = {key: values.pop(key) for key in keys}
            return function(*args, **{name: make(**own)}, **values)

        return stacked(*decorators)(command)  # type: ignore[arg-type]

    return decorate
