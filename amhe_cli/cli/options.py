"""Options that several commands share, in the words of one place.

common: --strict --json -q -v --no-color --limit --version, on every command and before it
where:  --system --topic --msg-path --from --to, of all that read logs
tuning: --set --config
work:   --seed --threads --engine
out:    -o --force

Besides these, a command has at most 16 options of its own; what is seldom needed is a setting.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from amhe_cli import __version__
from amhe_cli.cli import completion, log_path
from amhe_cli.cli.parsing import (
    EXISTING_FILE,
    EXISTING_FOLDER,
    F,
    Number,
    WholeNumber,
    bundled,
    pairs,
    stacked,
)
from amhe_cli.cli.session import Session
from amhe_cli.core.errors import ConfigError

if TYPE_CHECKING:
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.cli.settings import Overrides


def _remember(ctx: click.Context, param: click.Parameter, value: Any) -> None:
    if value and param.name:
        setattr(ctx.ensure_object(Session), param.name, value)


def _flag(*names: str, help: str, **more: Any) -> Callable[[F], F]:
    options: dict[str, Any] = {"is_flag": True, "expose_value": False, "callback": _remember}
    return click.option(*names, help=help, **(options | more))


def _set_limits(ctx: click.Context, param: click.Parameter, given: tuple[str, ...]) -> None:
    from amhe_cli.core.limits import limit

    if ctx.resilient_parsing:  # the line of a file that somebody wrote, or one that is completed
        return
    parts = [text.partition("=") for text in given]
    try:
        ctx.with_resource(limit(**{name: int(number) for name, _, number in parts}))
    except (ConfigError, ValueError) as error:
        raise click.BadParameter(str(error), ctx, param) from None


#: Limits on what reading a log may cost; they hold as long as the command.
limits = click.option(
    "--limit",
    multiple=True,
    metavar="NAME=N",
    is_eager=True,
    expose_value=False,
    callback=_set_limits,
    help="Set a limit on what reading a file may cost, such as topics=20000. Repeatable.",
)


def _cores() -> int:
    """Cores that this process may use."""
    from amhe_cli.api.arguments import cores

    return cores()


def _known_engine(ctx: click.Context, param: click.Parameter, value: str) -> str:
    if value != "cpu":  # the default needs no look at the library, which is slow to load
        from amhe_cli.engine.open import check_kind

        try:
            check_kind(value)
        except ConfigError as error:
            raise click.BadParameter(str(error), ctx, param) from None
    return value


common = stacked(
    _flag("--json", help="Print one JSON object on stdout, the content of result.json."),
    _flag("--strict", help="Exit with code 3 if there was any warning."),
    _flag("-q", "--quiet", help="No progress; warnings, errors and results only."),
    _flag("-v", "--verbose", help="Say more on stderr; twice: everything.", is_flag=False, count=True),
    _flag("--no-color", help="No colours (NO_COLOR in the environment does the same)."),
    limits,
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


#: Likewise the longest run of a task [s].
LONGEST = 40.0


def duration(about: str) -> Callable[[F], F]:
    """Longest duration of a run [s]."""
    return click.option(
        "--duration",
        type=Number(min=0, min_open=True, max=600),
        metavar="S",
        default=LONGEST,
        show_default="40, the tasks' own limit",
        help=about,
    )


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


system = system_or("named by the log")


msg_path = click.option(
    "--msg-path",
    type=EXISTING_FOLDER,
    metavar="DIR",
    help="Folder of .msg files, for message types that the log does not define itself.",
)


def held_out(use: str) -> Callable[[F], F]:
    """Logs that are not fitted; `use` says what for."""
    return click.option(
        "--held-out",
        multiple=True,
        type=log_path.LOG,
        callback=log_path.episodes,
        metavar="LOG",
        help=f"{use}; repeat for more.  [default: a quarter of the logs' time]",
    )


def _inputs(**values: Any) -> Inputs:
    from amhe_cli.cli.inputs import Inputs

    return Inputs(**values)


topics = click.option(
    "--topic",
    "topics",
    metavar="SIGNAL=/name",
    multiple=True,
    callback=pairs(str),
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
        "--from", "start", type=Number(min=0), metavar="S", help="Begin S seconds after the log's start."
    ),
    click.option("--to", "end", type=Number(min=0), metavar="S", help="End S seconds after the log's start."),
)


#: Where the options that stand for settings leave what was given, as --set would have it.
_CHOSEN = "amhe.settings"


def _overrides(assignments: Sequence[str], config: Path | None) -> Overrides:
    from amhe_cli.cli.settings import gathered

    chosen = click.get_current_context().meta.get(_CHOSEN, ())
    return gathered(config, os.environ, (*assignments, *chosen))


def setting(key: str, **how: Any) -> Callable[[F], F]:
    """An option that stands for a setting, and wins over --set: `mhe.update_period` is --update-period."""

    def choose(ctx: click.Context, param: click.Parameter, value: Any) -> None:
        given = {key: value}
        if how.get("multiple"):
            given = {f"{key}.{name}": number for name, number in pairs(float)(ctx, param, value).items()}
        chosen = [f"{name}={one}" for name, one in given.items() if one is not None]
        ctx.meta[_CHOSEN] = (*ctx.meta.get(_CHOSEN, ()), *chosen)

    flag = "--" + key.rpartition(".")[2].replace("_", "-")
    return click.option(flag, callback=choose, expose_value=False, **how)


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
            help="A dask scheduler whose workers do it instead; needs the extra [cluster]. Whoever reaches "
            "its port can run any code as you (docs/scaling.md).",
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

    def reserve(self) -> Path:
        """The folder to write to; it is refused before any work is done if it cannot be written."""
        from amhe_cli.report.folder import reserve

        session = click.get_current_context().ensure_object(Session)
        session.folder = reserve(self.folder, session.name, self.force)
        return session.folder


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
