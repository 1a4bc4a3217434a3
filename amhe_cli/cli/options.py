"""Options that several commands share, in the words of one place.

common: --strict --json -q -v --no-color --limit --version, on every command and before it
where:  --system --topic --msg-path --from --to
tuning: --set --config
engine: --engine
work:   --seed --threads --engine
spread: --workers --cluster
out:    -o --force
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from amhe_cli import __version__
from amhe_cli.cli import completion, log_path
from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.cli.settings import Overrides

F = TypeVar("F", bound=Callable[..., Any])


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


_SECONDS = Number(min=0)


class Command(click.Command):
    """A command that listens to the library's log from the moment its options are known."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command's body."""
        ctx.ensure_object(Session).begin(ctx.command_path)
        return super().invoke(ctx)


def _remember(ctx: click.Context, param: click.Parameter, value: Any) -> None:
    if value and param.name:
        setattr(ctx.ensure_object(Session), param.name, value)


def _flag(*names: str, help: str, **more: Any) -> Callable[[F], F]:
    options: dict[str, Any] = {"is_flag": True, "expose_value": False, "callback": _remember}
    return click.option(*names, help=help, **(options | more))


def pairs(ctx: click.Context, param: click.Parameter, given: tuple[str, ...]) -> dict[str, str]:
    """SIGNAL=/name or the like, repeated, as a dictionary; the option's metavar shows the form."""
    form = str(param.metavar)  # pyright: ignore[reportAttributeAccessIssue]
    sign = ":=" if ":=" in form else "="
    values = {}
    for text in given:
        key, found, value = text.partition(sign)
        if not (key and found and value):
            raise click.BadParameter(f"{text!r} is not of the form {form}", ctx, param)
        values[key] = value
    return values


def _in_existing_folder(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    """A file that will be written: better refused now than after the first minutes of work."""
    if value is not None and not value.absolute().parent.is_dir():
        raise click.BadParameter(f"there is no folder '{value.parent}'", ctx, param)
    return value


def new_file(*names: str, use: str, metavar: str = "FILE") -> Callable[[F], F]:
    """A file that will be written, in a folder that exists; `use` says what for."""
    kind = click.Path(dir_okay=False, path_type=Path)
    return click.option(*names, type=kind, callback=_in_existing_folder, metavar=metavar, help=use)


def _cores() -> int:
    """Cores that this process may use."""
    from amhe_cli.api.arguments import cores

    return cores()


def _known_engine(ctx: click.Context, param: click.Parameter, value: str) -> str:
    if value != "cpu":  # the default needs no look at the library, which is slow to load
        from amhe_cli.core.errors import ConfigError
        from amhe_cli.engine.open import check_kind

        try:
            check_kind(value)
        except ConfigError as error:
            raise click.BadParameter(str(error), ctx, param) from None
    return value


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


common = stacked(
    _flag("--json", help="Print one JSON object on stdout, the content of result.json."),
    _flag("--strict", help="Exit with code 3 if there was any warning."),
    _flag("-q", "--quiet", help="No progress; warnings, errors and results only."),
    _flag("-v", "--verbose", help="Say more on stderr; twice: everything.", is_flag=False, count=True),
    _flag("--no-color", help="No colours (NO_COLOR in the environment does the same)."),
    log_path.limits,
    click.version_option(__version__, message="amhe %(version)s"),
)

#: Names of the tasks in robots/go1/tasks.py, which --help need not load.
TASKS = ("t1", "t2", "t3", "t4", "t5", "hw1", "hw2")
#: Likewise of the modes in robots/go1/run.py.
MODES = ("true", "baseline", "stale", "adaptive")


def choice(name: str, values: Sequence[str], default: str | None, about: str) -> Callable[[F], F]:
    """One of a few values."""
    kind = click.Choice(values)
    return click.option(name, type=kind, default=default, show_default=bool(default), help=about)


def task(about: str, default: str | None = "t1") -> Callable[[F], F]:
    """Whose box and floor."""
    return choice("--task", TASKS, default, about)


def seconds(about: str, default: float, **bounds: Any) -> Callable[[F], F]:
    """How long something goes on [s]."""
    kind = Number(**bounds)
    return click.option(
        "--for", "seconds", type=kind, default=default, show_default=True, metavar="S", help=about
    )


def system_or(default: str) -> Callable[[F], F]:
    """The system, and which it is where the user does not say."""
    return click.option(
        "--system",
        metavar="NAME|DIR",
        shell_complete=completion.systems,
        help=f"A bundled system or your own system folder.  [default: {default}]",
    )


system = system_or("named by the log, else go1_push")


msg_path = click.option(
    "--msg-path",
    type=EXISTING_FOLDER,
    metavar="DIR",
    help="Folder of .msg files, for message types that the log does not define itself.",
)


def _inputs(**values: Any) -> Inputs:
    from amhe_cli.cli.inputs import Inputs

    return Inputs(**values)


topics = click.option(
    "--topic",
    "topics",
    metavar="SIGNAL=/name",
    multiple=True,
    callback=pairs,
    help="Read a signal of the system from another topic; repeat for more.",
)

where = bundled(
    "inputs",
    _inputs,
    ("system", "topics", "msg_path", "start", "end"),
    system,
    topics,
    msg_path,
    click.option(
        "--from", "start", type=_SECONDS, metavar="S", help="Begin S seconds after the log's start."
    ),
    click.option("--to", "end", type=_SECONDS, metavar="S", help="End S seconds after the log's start."),
)


def _overrides(assignments: Sequence[str], config: Path | None) -> Overrides:
    from amhe_cli.cli.settings import gathered

    return gathered(config, os.environ, assignments)


tuning = bundled(
    "overrides",
    _overrides,
    ("assignments", "config"),
    click.option(
        "--set",
        "assignments",
        metavar="A.B=V",
        multiple=True,
        help="Override a setting, such as clips.count=40; repeat for more.",
    ),
    click.option("--config", type=EXISTING_FILE, metavar="FILE", help="YAML file of settings; --set wins."),
)

engine = click.option(
    "--engine",
    metavar="KIND",
    default="cpu",
    show_default=True,
    callback=_known_engine,
    help="What computes the rollouts: cpu; gpu, with the extra [gpu] and a card; auto: for each call the "
    "quicker. See docs/gpu.md.",
)

seed = click.option("--seed", type=WholeNumber(min=0), metavar="N", default=0, show_default=True)

work = stacked(
    seed,
    click.option(
        "--threads",
        type=WholeNumber(min=1),
        metavar="N",
        default=_cores,
        show_default="all cores",
        help="Results depend on the seed, never on this.",
    ),
    engine,
)


def _spread(default: Callable[[], int] | None, shown: str) -> Callable[[F], F]:
    return stacked(
        click.option(
            "--workers",
            type=WholeNumber(min=1),
            metavar="N",
            default=default,
            show_default=shown,
            help="Processes on this machine.",
        ),
        click.option(
            "--cluster",
            metavar="tcp://HOST:PORT",
            help="A dask scheduler whose workers do it instead; needs the extra [cluster].",
        ),
    )


spread = _spread(_cores, "all cores")
spread_if_chosen = _spread(None, "none: threads of this one")

force = click.option("--force", is_flag=True, help="Write into an existing OUT that is not empty.")


@dataclass(frozen=True, slots=True)
class Output:
    """The options -o and --force.

    Args:
        folder: Folder to write to; None: a fresh one.
        force: Write into a folder that is not empty.
    """

    folder: Path | None
    force: bool

    def reserve(self, command: str) -> Path:
        """The folder to write to; it is refused before any work is done if it cannot be written."""
        from amhe_cli.report.folder import reserve

        session = click.get_current_context().find_object(Session)
        folder = reserve(self.folder, command, self.force)
        if session is not None:
            session.folder = folder
        return folder


out = bundled(
    "out",
    lambda out, force: Output(out, force),
    ("out", "force"),
    click.option(
        "-o",
        "--out",
        type=click.Path(path_type=Path),
        metavar="OUT",
        help="Folder to write to.  [default: amhe-out/<command>-<date>-<time>/]",
    ),
    force,
)
